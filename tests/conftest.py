"""Strict settings for everything below the NumPyro layers, and the fixtures that the tests share."""

import gc
import importlib.metadata
import os
import secrets
from pathlib import Path

# Before JAX is imported: threads cost more than they give on the small matrices of the tests.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Half of the compile time of small programs, while JAX has this choice, and no parts for other
# threads. XLA stops at a flag that it does not know.
if importlib.metadata.version("jaxlib").startswith("0.9."):
    os.environ.setdefault(
        "XLA_FLAGS", "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
    )

import jax
import jax.random as jr
import pytest

# Tracing makes many small objects that live on: to look for garbage among them as often as by
# default takes a sixth of the time of the suite.
gc.set_threshold(200_000, 20, 50)

jax.config.update("jax_enable_x64", True)

# NumPyro promotes dtypes and ranks freely. Tests that run it are named like this, or carry
# `pytestmark = pytest.mark.numpyro`.
NUMPYRO = ("test_distributions", "test_infer", "test_examples", "test_readme")

# Modules whose few tests take longest.
LONG = ("test_examples", "test_docs", "test_kunita", "test_reference")

# Modules that show soonest what another version of Python, JAX, NumPyro or ArviZ breaks, each of
# them quick.
SHORT = (
    "test_arviz",
    "test_drive",
    "test_infer_parts",
    "test_layers",
    "test_sample",
    "test_weights",
)


def pytest_addoption(parser):
    parser.addoption(
        "--slow", action="store_true", help="run the tests marked slow, which take minutes"
    )
    parser.addoption("--short", action="store_true", help=f"run {', '.join(SHORT)} alone")
    parser.addoption(
        "--bad-inputs",
        type=int,
        help="random bad inputs in all, others in each run (5000: minutes)",
    )
    parser.addoption(
        "--seed", type=int, help="seed of the `key` fixture; by default a new one for each test"
    )


def pytest_ignore_collect(collection_path, config):
    """Whether a path is left out; `None` leaves the decision to others."""
    is_module = collection_path.name.startswith("test_") and collection_path.suffix == ".py"
    if config.getoption("--short") and is_module and collection_path.stem not in SHORT:
        return True
    return None


def pytest_collection_modifyitems(config, items):
    # first, so that both cores end together
    items.sort(key=lambda item: not item.path.name.startswith(LONG))
    if not config.getoption("--slow"):
        skip = pytest.mark.skip(reason="slow: run with --slow")
        for item in items:
            if item.get_closest_marker("slow"):
                item.add_marker(skip)


@pytest.fixture(scope="module", autouse=True)
def _promotion(request):
    """Of module scope, so that fixtures of a module run under the settings of its tests."""
    numpyro = request.path.name.startswith(NUMPYRO) or request.node.get_closest_marker("numpyro")
    dtypes, ranks = ("standard", "allow") if numpyro else ("strict", "raise")
    with jax.numpy_dtype_promotion(dtypes), jax.numpy_rank_promotion(ranks):
        yield


@pytest.fixture(scope="module")
def compile_quickly():
    """For modules of many small programs that run once: `pytestmark =
    pytest.mark.usefixtures("compile_quickly")`.
    """
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.fixture
def key(request):
    """A random key, for identities that hold for every key. A failure shows its seed."""
    seed = request.config.getoption("--seed")
    seed = secrets.randbits(31) if seed is None else seed
    print(f"key of seed {seed}: repeat with --seed {seed}")
    return jr.key(seed)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real data sets, which are not part of the package."""
    default = Path(__file__).parents[2] / "shared" / "data"
    path = Path(os.environ.get("NUMPYRO_BRIDGES_DATA", default))
    if not path.is_dir():
        pytest.skip(f"no data at {path}: set NUMPYRO_BRIDGES_DATA")
    return path
