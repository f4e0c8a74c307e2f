"""`to_arviz`, on both lines of ArviZ: 0.x with Python 3.11, 1.x with later ones."""

import warnings

import jax.random as jr
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro.infer import MCMC, NUTS, log_likelihood

import numpyro_bridges as nb

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # ArviZ 0.x announces 1.x when it is imported
    import arviz

pytestmark = [pytest.mark.numpyro, pytest.mark.usefixtures("compile_quickly")]

N, STEPS = 6, 2
DATA = np.random.default_rng(0).normal(0.5, 0.6, (N, 2))


def model(data=None, n=N):
    mean = numpyro.sample("mean", dist.Normal(0.0, 2.0))
    spread = numpyro.deterministic("twice", 2 * mean)
    numpyro.factor("no_datum", -0.01 * spread**2)
    law = nb.DiffusionEndpoint(
        nb.LinearSDE(-1.0, 0.6, mean), np.zeros(2), nb.InexactMatch(0.1), t1=1.0, num_steps=STEPS
    )
    with numpyro.plate("specimens", n):
        nb.sample("wing", law, obs=data)


@pytest.fixture(scope="module")
def mcmc():
    mcmc = MCMC(
        NUTS(model), num_warmup=100, num_samples=150, num_chains=2, chain_method="sequential", progress_bar=False
    )
    mcmc.run(jr.key(0), DATA, extra_fields=nb.infer.HMC_FIELDS)
    return mcmc


@pytest.fixture(scope="module")
def data(mcmc):
    """With what `Predictive` returns; made up, which compiles nothing."""
    prior = {"mean": np.zeros(7), "wing": np.zeros((7, N, 2)), "wing_noise": np.zeros((7, N, STEPS, 2, 1))}
    return nb.to_arviz(mcmc, prior=prior, posterior_predictive={"wing": np.zeros((300, N, 2))})


def test_posterior_is_without_the_noise(mcmc, data):
    assert set(data.posterior.data_vars) == {"mean", "twice"}
    np.testing.assert_array_equal(data.posterior["mean"], mcmc.get_samples(group_by_chain=True)["mean"])
    assert len(arviz.summary(data)) == 2
    kept = nb.to_arviz(mcmc, noise=True).posterior["wing_noise"]
    assert kept.shape == (2, 150, N, STEPS, 2, 1) and kept.dims[2] == "specimens"


def test_log_likelihood_is_pointwise(mcmc, data):
    assert set(data.log_likelihood.data_vars) == {"wing"}
    found = data.log_likelihood["wing"]
    assert found.dims == ("chain", "draw", "specimens") and found.shape == (2, 150, N)
    expected = log_likelihood(model, mcmc.get_samples(), DATA)["wing"].reshape(2, 150, N)
    np.testing.assert_allclose(found, expected)


def test_leave_one_out(data):
    """Against the closed form: the predictive density of a datum given the others, from a grid over the mean."""
    grid = np.linspace(-4, 6, 2001)
    end = (1 - np.exp(-1)) * grid
    variance = 0.36 * (1 - np.exp(-2)) / 2 + 0.1
    pointwise = dist.Normal(end, np.sqrt(variance)).log_prob(DATA[..., None]).sum(1)
    prior = dist.Normal(0, 2).log_prob(grid) - 0.04 * grid**2
    rest = prior + pointwise.sum(0) - pointwise
    weights = np.exp(rest - rest.max(1, keepdims=True))
    expected = np.log(np.sum(weights * np.exp(pointwise), 1) / weights.sum(1)).sum()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # on a high Pareto k of so few draws
        loo = arviz.loo(data)
    assert loo.n_data_points == N
    elpd = getattr(loo, "elpd", None) or loo["elpd_loo"]
    assert elpd == pytest.approx(float(expected), abs=0.3)


def test_sample_statistics(mcmc, data):
    stats = data.sample_stats
    names = {"lp", "energy", "acceptance_rate", "n_steps", "step_size", "diverging", "tree_depth"}
    assert set(stats.data_vars) == names
    fields = mcmc.get_extra_fields(group_by_chain=True)
    np.testing.assert_array_equal(stats["lp"], -fields["potential_energy"])
    assert np.all(2 ** stats["tree_depth"] > stats["n_steps"])


def test_data_and_predictions(data):
    np.testing.assert_array_equal(data.observed_data["wing"], DATA)
    assert data.observed_data["wing"].dims[0] == "specimens"
    assert set(data.observed_data.data_vars) == {"wing"}
    assert data.posterior_predictive["wing"].shape == (2, 150, N, 2)
    assert "mean" in data.prior and "wing_noise" not in data.prior
    assert data.prior_predictive["wing"].shape == (1, 7, N, 2)


def test_samplers_without_a_model():
    mcmc = MCMC(NUTS(potential_fn=lambda z: 0.5 * z**2), num_warmup=2, num_samples=2, progress_bar=False)
    with pytest.raises(ValueError, match="must run a NumPyro model"):
        nb.to_arviz(mcmc)
