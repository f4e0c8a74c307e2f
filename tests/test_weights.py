"""Weight arithmetic against extended precision, ArviZ and samples whose tail is known."""

import math
import warnings

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

from numpyro_bridges import weights

pytestmark = pytest.mark.usefixtures("compile_quickly")

SHIFTS = [0.0, 1e4, -1e4]
STATISTICS = [weights.effective_sample_size, weights.standard_error, weights.pareto_k]


def extended(log_weights):
    """Log mean, ESS, and standard error in extended precision: of the weights drawn, and of those
    missed.
    """
    log_weights = np.asarray(log_weights, np.longdouble)
    w = np.exp(log_weights - log_weights.max())
    log_mean = log_weights.max() + np.log(w.mean())
    drawn = w.std(ddof=1) / (w.mean() * np.sqrt(np.longdouble(w.size)))
    return log_mean, w.sum() ** 2 / (w**2).sum(), np.hypot(drawn, missing(w) / w.mean())


def missing(w):
    """σ n^κ / ((1 − κ)² S) of a tail fitted as Zhang and Stephens (2009) have it."""
    length = math.ceil(min(w.size / 5, 3 * math.sqrt(w.size)))
    ordered = np.sort(w)
    y = ordered[-length:] - ordered[-length - 1]
    y = y[y > 0]
    n = y.size
    m = 30 + math.isqrt(length)
    b = 1 / y[-1] + (1 - np.sqrt(m / (np.arange(m) + np.longdouble(0.5)))) / (
        3 * y[(n + 2) // 4 - 1]
    )
    k = np.mean(np.log1p(-b[:, None] * y), axis=1)
    log_likelihood = n * (np.log(np.abs(b / k)) - k - 1)
    b = np.average(b, weights=np.exp(log_likelihood - log_likelihood.max()))
    k = np.mean(np.log1p(-b * y))
    scale, k = np.abs(k / b), (n * k + 5) / (n + 10)
    raised = k + (1 + max(k, 0)) / np.sqrt(np.longdouble(n))
    if k >= 0.7 or raised >= 1:
        return np.inf
    return scale * n**raised / (1 - raised) ** 2 / w.size


def arviz_k(log_weights):
    """The same shape from whichever ArviZ is installed: 1.x negates its argument."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # 0.23 announces 1.0 once a day
        try:
            from arviz_stats.base import array_stats
        except ImportError:
            import arviz

            return float(arviz.psislw(np.asarray(log_weights))[1])
    return float(array_stats.psislw(-np.asarray(log_weights))[1])


@pytest.mark.parametrize("scale", [0.5, 1.5, 3.0])
@pytest.mark.parametrize("shift", SHIFTS)
def test_extended_precision(key, shift, scale):
    log_weights = shift + scale * jr.normal(key, (1000,))
    log_mean, ess, error = extended(log_weights)
    assert abs(weights.log_mean_exp(log_weights) - float(log_mean)) < 1e-14 * max(abs(shift), 100)
    np.testing.assert_allclose(weights.effective_sample_size(log_weights), float(ess), rtol=1e-11)
    np.testing.assert_allclose(weights.standard_error(log_weights), float(error), rtol=1e-8)
    together = weights.quality(log_weights)
    for statistic, value in zip(
        ["standard_error", "effective_sample_size", "pareto_k"], together, strict=True
    ):
        np.testing.assert_allclose(value, getattr(weights, statistic)(log_weights), rtol=1e-12)


@pytest.mark.parametrize("shift", SHIFTS)
def test_equal_weights(shift):
    equal = jnp.full((1000,), shift)
    assert abs(weights.log_mean_exp(equal) - shift) < 1e-11
    assert weights.effective_sample_size(equal) == 1000
    assert weights.standard_error(equal) == 0
    assert weights.pareto_k(equal) == -jnp.inf


def test_standard_error_is_the_spread_of_the_estimate():
    # no tail, of which to miss something
    log_weights = jnp.log(jr.uniform(jr.key(1), (4000, 500), minval=0.01))
    estimates = weights.log_mean_exp(log_weights)
    # the standard deviation of 4000 estimates has a relative error of 1.1 %
    np.testing.assert_allclose(
        weights.standard_error(log_weights).mean(), estimates.std(), rtol=0.045
    )


# where the two lines round the length of the tail alike
@pytest.mark.parametrize("num_particles", [100, 4096])
@pytest.mark.parametrize("scale", [0.3, 3.0])
@pytest.mark.parametrize("shift", SHIFTS)
def test_pareto_k_is_arviz(key, num_particles, scale, shift):
    log_weights = shift + scale * jr.normal(key, (num_particles,))
    np.testing.assert_allclose(
        weights.pareto_k(log_weights), arviz_k(log_weights), rtol=1e-8, atol=1e-8
    )


@pytest.mark.parametrize("k", [0.2, 0.5, 0.9])
def test_pareto_k_of_pareto_samples(k):
    # w = u^-k has an exactly generalised Pareto tail of shape k above every cutoff.
    num_particles, num_tail, replicates = 10_000, 300, 64
    found = weights.pareto_k(k * jr.exponential(jr.key(2), (replicates, num_particles)))
    # asymptotic, of the maximum likelihood estimate
    error = (1 + k) / math.sqrt(num_tail * replicates)
    assert error < 0.014
    shrunk = (num_tail * k + 5) / (num_tail + 10)
    assert abs(found.mean() - shrunk) < 4 * error
    # 4 errors of 9 %
    np.testing.assert_allclose(found.std(), (1 + k) / math.sqrt(num_tail), rtol=0.35)


def test_pareto_k_of_degenerate_weights(key):
    normal = jr.normal(key, (1000,))
    assert weights.pareto_k(300 * normal) > 50  # hundreds of nats apart: all but a few underflow
    assert weights.pareto_k(jnp.minimum(normal, 0.0)) == -jnp.inf
    few = jnp.where(jnp.arange(1000) < 3, normal, -jnp.inf)
    assert weights.pareto_k(few) == jnp.inf
    some = jnp.where(jnp.arange(1000) < 500, normal, -jnp.inf)
    assert jnp.isfinite(weights.pareto_k(some))
    for num_particles in [2, 5, 20]:
        assert weights.pareto_k(normal[:num_particles]) == jnp.inf
    assert jnp.isfinite(weights.pareto_k(normal[:21]))


def test_zero_weights(key):
    some = jnp.concatenate([jr.normal(key, (500,)), jnp.full((500,), -jnp.inf)])
    log_mean, ess, error = extended(some)
    np.testing.assert_allclose(weights.log_mean_exp(some), float(log_mean), rtol=1e-12)
    np.testing.assert_allclose(weights.effective_sample_size(some), float(ess), rtol=1e-12)
    np.testing.assert_allclose(weights.standard_error(some), float(error), rtol=1e-8)

    none = jnp.full((100,), -jnp.inf)
    assert weights.log_mean_exp(none) == -jnp.inf
    assert weights.effective_sample_size(none) == 0
    assert weights.standard_error(none) == jnp.inf
    assert weights.pareto_k(none) == jnp.inf


@pytest.mark.parametrize("others", [0.0, -jnp.inf])
def test_a_failed_weight_shows(others):
    failed = jnp.full((2, 100), others).at[0, 7].set(jnp.nan)
    for statistic in [weights.log_mean_exp, *STATISTICS]:
        assert jnp.isnan(statistic(failed)).tolist() == [True, False]
    for statistic in STATISTICS:
        assert jnp.isnan(statistic(failed.at[0, 7].set(jnp.inf)))[0]


@pytest.mark.parametrize("statistic", [weights.log_mean_exp, *STATISTICS])
def test_batches(key, statistic):
    log_weights = jr.normal(key, (2, 3, 60))
    expected = [[statistic(row) for row in block] for block in log_weights]
    np.testing.assert_allclose(jax.jit(statistic)(log_weights), expected, rtol=1e-12)


def test_log_mean_exp_along_another_axis(key):
    log_weights = jr.normal(key, (40, 3))
    np.testing.assert_allclose(
        weights.log_mean_exp(log_weights, axis=0), weights.log_mean_exp(log_weights.T), rtol=1e-12
    )


def test_single_precision_stays_single(key):
    log_weights = 1e3 + jr.normal(key, (400,), jnp.float32)
    for statistic in [weights.log_mean_exp, *STATISTICS]:
        value = statistic(log_weights)
        assert value.dtype == jnp.float32
        np.testing.assert_allclose(
            value, statistic(log_weights.astype(jnp.float64)), rtol=1e-4, atol=1e-4
        )


@pytest.mark.parametrize("statistic", [weights.log_mean_exp, weights.quality, *STATISTICS])
@pytest.mark.parametrize(
    ("value", "message"),
    [
        ([], "at least one particle along axis -1; got shape \\(0,\\)"),
        (np.zeros((3, 0)), "at least one particle along axis -1; got shape \\(3, 0\\)"),
        (0.5, "at least one particle along axis -1; got shape \\(\\)"),
        ("0.5", "number"),
        (["a", "b"], "number"),
        (None, "number"),
        ([True, False], "number"),
        ([1j, 2.0], "number"),
    ],
)
def test_what_is_no_array_of_particles_is_refused(statistic, value, message):
    with pytest.raises(ValueError, match=f"`log_weights` must .*{message}"):
        statistic(value)


def test_whole_numbers_are_weights():
    np.testing.assert_allclose(weights.log_mean_exp([0, 1]), np.log((1 + np.e) / 2), rtol=1e-12)
    with pytest.raises(ValueError, match="along axis 1; got shape"):
        weights.log_mean_exp(np.zeros(3), axis=1)


def test_threshold():
    root = math.sqrt(20)  # 100 particles have a tail of 20
    assert weights.pareto_k_threshold(100) == pytest.approx((root - 1) / (root + 1))
    assert weights.pareto_k_threshold(160) < 0.7 == weights.pareto_k_threshold(np.int64(161))
    with pytest.raises(ValueError, match="`num_particles` must be an integer, at least 2; got 1"):
        weights.pareto_k_threshold(1)
