"""The MCMC kernels at their edges: settings, starts, what a model may not do, and new data for an old chain."""

import jax.numpy as jnp
import jax.random as jr
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro.infer import MCMC, init_to_median

import numpyro_bridges as nb
from numpyro_bridges.infer import (
    PCN,
    PCNL,
    CorrelatedPseudoMarginal,
    CorrelatedPseudoMarginalMALA,
    FunctionSpaceHMC,
    _kernel,
)
from numpyro_bridges.infer._reference import Reference

pytestmark = pytest.mark.usefixtures("compile_quickly")

DATA = np.array([[0.4], [0.9]])


def law_of(mean):
    return nb.DiffusionEndpoint(nb.LinearSDE(-1.0, 0.6, mean), [0.0], nb.InexactMatch(0.1), t1=1.0, num_steps=1)


def model(data):
    mean = numpyro.sample("mean", dist.Normal(0.0, 2.0))
    with numpyro.plate("specimen", len(data)):
        nb.sample("wing", law_of(mean), obs=data)


# For each setting: what is accepted, and what is out of range.
POSITIVE = [1e-9, 0.5, 50, np.int64(3)], [0, -1.0, 1e-400]
PROPORTION = [0.01, 0.99], [0.0, 1.0, -0.5, 2]
PROPORTION_OR_0 = [0, 0.0, 0.99], [1.0, -1e-9, 2]
NUMBERS = [
    (FunctionSpaceHMC, "step_size", *POSITIVE),
    (FunctionSpaceHMC, "trajectory_length", *POSITIVE),
    (FunctionSpaceHMC, "target_accept_prob", *PROPORTION),
    (FunctionSpaceHMC, "jitter", *PROPORTION_OR_0),
    (PCN, "angle", [1e-9, np.pi / 2, np.float32(np.pi / 2)], [0.0, -1.0, 1.5709]),
    (PCNL, "target_accept_prob", *PROPORTION),
    (CorrelatedPseudoMarginal, "correlation", *PROPORTION_OR_0),
    (CorrelatedPseudoMarginalMALA, "step_size", *POSITIVE),
]
NO_NUMBERS = ["0.5", True, np.True_, 0.5 + 0j, np.nan, np.inf, [0.5], np.array([0.5]), b"1", np.datetime64("2020"), {}]


def name_of(x):
    return x if isinstance(x, str) else getattr(x, "__name__", None)


@pytest.mark.parametrize("kernel, name, inside, outside", NUMBERS, ids=name_of)
def test_numbers(kernel, name, inside, outside):
    """Of any real type and in range, anything else refused by name."""
    for value in inside:
        kernel(model, **{name: value})
    for value in (np.float32(0.5), np.float64(0.5), np.array(0.5), jnp.asarray(0.5)):
        kernel(model, **{name: value})
    for value in outside + NO_NUMBERS:
        with pytest.raises(ValueError, match=f"`{name}` must be"):
            kernel(model, **{name: value})


COUNT = [1, np.int64(3)], [0, -3, 2.0, "a", True, np.inf], "a positive integer"
SWITCH = [True, np.False_], ["no", 1, 0.0, None], "True or False"
STRATEGY = [init_to_median, init_to_median(num_samples=3)], ["median", 3, None], "a strategy"
OTHERS = [
    (FunctionSpaceHMC, "max_num_steps", *COUNT),
    (PCN, "num_moves", *COUNT),
    (PCNL, "num_blocks", *COUNT),
    (CorrelatedPseudoMarginal, "num_particles", *COUNT),
    (CorrelatedPseudoMarginalMALA, "max_particles", *COUNT),
    (FunctionSpaceHMC, "adapt_step_size", *SWITCH),
    (PCNL, "adapt_angle", *SWITCH),
    (FunctionSpaceHMC, "init_strategy", *STRATEGY),
    (PCN, "init_strategy", *STRATEGY),
    (CorrelatedPseudoMarginal, "init_strategy", *STRATEGY),
]


@pytest.mark.parametrize("kernel, name, good, bad, rule", OTHERS, ids=name_of)
def test_counts_switches_and_strategies(kernel, name, good, bad, rule):
    for value in good:
        kernel(model, **{name: value})
    for value in bad:
        with pytest.raises(ValueError, match=f"`{name}` must be {rule}"):
            kernel(model, **{name: value})


@pytest.fixture(scope="module", autouse=True)
def no_laplace():
    """Its search is most of the time that a kernel takes to start, and no subject here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_kernel, "laplace", lambda _, theta: Reference(theta, jnp.eye(theta.size)))
        yield


@pytest.mark.parametrize(
    "settings, num_warmup, expected",
    [({"max_num_steps": 1}, 5, {1}), ({"max_num_steps": 3, "step_size": 1e-9, "adapt_step_size": False}, 0, {3})],
)
def test_number_of_steps(settings, num_warmup, expected):
    """Within its bound, adapted or not; the step is the one that was made."""
    kernel = FunctionSpaceHMC(model, trajectory_length=2.1, **settings)
    mcmc = MCMC(kernel, num_warmup=num_warmup, num_samples=4, thinning=2, progress_bar=False)
    mcmc.run(jr.key(0), DATA, extra_fields=("num_steps", "adapt_state.step_size", "accept_prob"))
    found = mcmc.get_extra_fields()
    assert set(found["num_steps"].tolist()) == expected
    np.testing.assert_allclose(found["num_steps"] * found["adapt_state.step_size"], 2.1)
    assert np.all(found["accept_prob"] > 0.1)
