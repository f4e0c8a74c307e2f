"""The README's first page and the examples run as they stand."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
# One thread, and programs that are compiled quickly: they run once.
ENVIRONMENT = os.environ | {
    "OPENBLAS_NUM_THREADS": "1",
    "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
    "PYTHONPATH": str(ROOT),
}


def run(*command, cwd):
    done = subprocess.run(
        [sys.executable, *command], cwd=cwd, env=ENVIRONMENT, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_first_page(tmp_path):
    pytest.importorskip("ktch")
    page = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S).group(1)
    shorter = page.replace("num_warmup=500, num_samples=500", "num_warmup=1, num_samples=1, progress_bar=False")
    shorter = shorter.replace("num_particles=4096", "num_particles=256")
    assert shorter != page
    (tmp_path / "page.py").write_text(
        shorter + "\nprint(path.shape, float(log_weight), *map(float, (\n"
        "    estimate.log_evidence, estimate.standard_error, estimate.ess, estimate.pareto_k)))\n"
    )
    *shape, log_weight, log_evidence, error, ess, k = (
        run("page.py", cwd=tmp_path).replace("(", "").replace(")", "").split()
    )
    assert [int(n.rstrip(",")) for n in shape] == [51, 32, 2]
    assert 100 < float(log_evidence) < 300 and float(error) < 0.2 and float(ess) > 50 and float(k) < 0.7
    assert abs(float(log_weight) - float(log_evidence)) < 10


def test_mosquito_wings(tmp_path):
    pytest.importorskip("ktch")
    pytest.importorskip("matplotlib")
    out = run(str(ROOT / "examples/mosquito_wings.py"), "--quick", "--output", "output", cwd=tmp_path)
    assert "r_hat" in out and "divergences: 0" in out
    for name in ("wings.nc", "bridges.png", "posterior.png", "score.png"):
        assert (tmp_path / "output" / name).stat().st_size > 5000


def test_calibration(tmp_path):
    """A small version: 64 replicates of one model and kernel."""
    pytest.importorskip("matplotlib")
    chosen = "--quick --models sine --kernels FunctionSpaceHMC --output output".split()
    out = run(str(ROOT / "benchmarks/calibration.py"), *chosen, cwd=tmp_path)
    (row,) = [json.loads(line) for line in out.splitlines()]
    assert len(row["largest_over_band"]) == 4 and row["inside"], row
    assert (tmp_path / "output" / "calibration.png").stat().st_size > 5000


@pytest.mark.slow
def test_mcmc_benchmark(tmp_path):
    out = run(str(ROOT / "benchmarks/mcmc.py"), "--quick", cwd=tmp_path)
    assert [json.loads(line)["kernel"] for line in out.splitlines()] == ["gibbs-pcn-nuts", "function-space-hmc"]


@pytest.mark.slow
def test_guided_weight_benchmark(tmp_path):
    out = run(str(ROOT / "benchmarks/guided_weight.py"), "--quick", cwd=tmp_path)
    assert float(re.search(r'"value_difference": ([^,]*)', out).group(1)) < 1e-4


@pytest.mark.slow
def test_score_table_benchmark(tmp_path):
    """A small version: two landmarks, 20 updates of ours, from nothing."""
    pytest.importorskip("matplotlib")
    out = run(str(ROOT / "benchmarks/score_table.py"), "--quick", "--output", "output", cwd=tmp_path)
    (row,) = [json.loads(line) for line in out.splitlines()]
    assert row["error"] < 1 and row["reference"]["steps_per_second"] > 0, row
    assert (tmp_path / "output" / "score_table.png").stat().st_size > 5000
