"""Probabilities of boxes: against products of normals, a multivariate normal, quadrature, and
simulated ends.
"""

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
import scipy.integrate
from scipy.special import log_ndtr, ndtr
from scipy.stats import multivariate_normal, norm

import numpyro_bridges as nb

INF = np.inf


pytestmark = pytest.mark.usefixtures("compile_quickly")


def run(sde, box, x0, num_steps, count, t1=1.0, seed=0):
    """Log weights of independent noises; every path ends in the set."""

    @jax.jit
    def many(key):
        bridge = nb.GuidedBridge(sde, box, x0=x0, ts=np.linspace(0, t1, num_steps + 1))
        z = jr.normal(key, (count, *bridge.noise_shape))
        paths, log_weights = jax.vmap(bridge.path_and_log_weight)(z)
        return paths[:, -1], log_weights

    ends, log_weights = many(jr.key(seed))
    ends = np.asarray(ends)[:, np.array(box.rows)]
    assert np.all((ends >= np.asarray(box.lower) - 1e-12) & (ends <= np.asarray(box.upper) + 1e-12))
    return np.asarray(log_weights)


def estimate(log_weights):
    """Log of the mean weight and its standard error; the tail of the weights is light."""
    assert nb.weights.pareto_k(log_weights) < 0.7
    return float(nb.weights.log_mean_exp(log_weights)), float(
        nb.weights.standard_error(log_weights)
    )


def log_interval(low, high, mean, sd):
    """log P(low ≤ N(mean, sd²) ≤ high), the log density where low = high."""
    a, b = (np.asarray(low) - mean) / sd, (np.asarray(high) - mean) / sd
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = np.where(a + b > 0, -b, a), np.where(a + b > 0, -a, b)
        inside = log_ndtr(b) + np.log1p(-np.exp(log_ndtr(a) - log_ndtr(b)))
    return np.where(low == high, norm.logpdf(low, mean, sd), inside)


# Independent coordinates: the guide's law is the truth, and every noise has the same weight.

# An interval, two half-lines, a point, a free coordinate.
LOWER = np.array([-0.3, 0.5, -INF, 0.4, -INF])
UPPER = np.array([0.9, INF, 0.2, 0.4, INF])
START = np.array([0.1, 0.0, 0.3, -0.2, 0.7])
RATE, SIGMA, SHIFT = np.array([0.3, 1.5, 0.0, -0.4, 2.0]), np.array([0.5, 0.8, 0.3, 0.6, 1.0]), 0.2


def ou_law(x0, t):
    rate = np.where(RATE == 0, 1e-12, RATE)
    mean = np.exp(-rate * t) * x0 - SHIFT * np.expm1(-rate * t) / rate
    return mean, SIGMA * np.sqrt(-np.expm1(-2 * rate * t) / (2 * rate))


INDEPENDENT = {
    "one variance": (nb.BrownianMotion(0.4), lambda x0, t: (x0, np.sqrt(0.4 * t) * np.ones(5))),
    "linear": (nb.LinearSDE(-RATE, SIGMA, SHIFT), ou_law),
}


@pytest.mark.parametrize("name", INDEPENDENT)
def test_product_of_probabilities(name):
    sde, law = INDEPENDENT[name]
    mean, sd = law(START, 1.3)
    truth = np.sum(log_interval(LOWER, UPPER, mean, sd))
    found = run(sde, nb.CylinderSet(LOWER, UPPER), START, 4, count=50, t1=1.3)
    np.testing.assert_allclose(found, truth, rtol=0, atol=1e-8)


def test_only_the_first_rows_of_a_planar_state():
    """Two columns share a covariance; the third row is free and left out."""
    lower, upper = np.array([[-0.2, 0.0], [0.1, -INF]]), np.array([[0.5, 0.8], [INF, 0.3]])
    x0 = np.array([[0.1, 0.2], [0.0, 0.4], [1.0, -1.0]])
    truth = np.sum(log_interval(lower, upper, x0[:2], SIGMA[:2, None]))
    found = run(nb.BrownianMotion(SIGMA[:3] ** 2), nb.CylinderSet(lower, upper), x0, 3, count=50)
    np.testing.assert_allclose(found, truth, rtol=0, atol=1e-8)


# Correlated coordinates.

Q = np.array([[0.5, 0.3, 0.1], [0.3, 0.4, -0.1], [0.1, -0.1, 0.3]])
BOXES = {
    "interval": (np.array([-0.2, 0.1, -0.9]), np.array([0.6, 1.2, -0.1])),
    "half-lines": (np.array([0.3, -INF, 0.2]), np.array([INF, -0.4, INF])),
}


def test_correlated_coordinates():
    x0, count = np.array([0.1, -0.2, 0.0]), 20_000

    @jax.jit
    def run(lower, upper, z):
        box = nb.CylinderSet(lower, upper)
        bridge = nb.GuidedBridge(nb.BrownianMotion(Q), box, x0=x0, ts=np.linspace(0, 1, 3))
        return jax.vmap(bridge.log_weight)(z)

    for lower, upper in BOXES.values():
        truth = np.log(multivariate_normal(x0, Q, seed=0).cdf(upper, lower_limit=lower))
        found, error = estimate(run(lower, upper, jr.normal(jr.key(0), (count, 3, 3, 1))))
        assert error < 0.01
        assert abs(found - truth) < 3 * error


def test_correlated_linear_process():
    """Euler steps of a full matrix drift: the law of the end by products of matrices."""
    B, x0, num_steps = np.array([[-0.5, 0.9], [-0.8, -0.2]]), np.array([0.6, -0.3]), 8
    sigma, dt = np.array([[0.5, 0.0], [0.3, 0.4]]), 1 / num_steps
    mean, S = x0, np.zeros((2, 2))
    for _ in range(num_steps):
        mean, S = (
            mean + dt * B @ mean,
            (np.eye(2) + dt * B) @ S @ (np.eye(2) + dt * B).T + dt * sigma @ sigma.T,
        )
    lower, upper = np.array([-0.5, -0.6]), np.array([0.1, 0.0])
    truth = np.log(multivariate_normal(mean, S).cdf(upper, lower_limit=lower))
    sde = nb.SDE(lambda t, x, args: jnp.asarray(B) @ x, lambda t, x, args: sigma)
    found, error = estimate(run(sde, nb.CylinderSet(lower, upper), x0, num_steps, count=20_000))
    assert error < 0.01
    assert abs(found - truth) < 3 * error


# Rare events.


def test_probability_of_1e_12():
    """Value and derivatives in closed form: an interval 7 SD away, and a half-line on the other
    side.
    """

    @jax.jit
    @jax.value_and_grad
    def log_probability(arguments):
        x0, low, high = arguments
        infinity = jnp.array(INF)
        box = nb.CylinderSet(jnp.stack([low, -infinity]), jnp.stack([high, -high]))
        bridge = nb.GuidedBridge(
            nb.BrownianMotion(1.0), box, x0=jnp.stack([x0, 0.0 * x0]), ts=np.linspace(0, 1, 3)
        )
        return bridge.log_weight(0.7 * jnp.ones((3, 2, 1)))

    low, high = 3.7, 4.1
    value, (d_x0, d_low, d_high) = log_probability(
        (jnp.array(-3.3), jnp.array(low), jnp.array(high))
    )
    a, b = low + 3.3, high + 3.3
    first = ndtr(-a) - ndtr(-b)
    assert 1e-13 < first < 1.3e-12
    np.testing.assert_allclose(value, np.log(first) + log_ndtr(-high), rtol=1e-10)
    np.testing.assert_allclose(d_x0, (norm.pdf(a) - norm.pdf(b)) / first, rtol=1e-8)
    np.testing.assert_allclose(d_low, -norm.pdf(a) / first, rtol=1e-8)
    hazard = np.exp(norm.logpdf(high) - log_ndtr(-high))
    np.testing.assert_allclose(d_high, norm.pdf(b) / first - hazard, rtol=1e-8)


@pytest.mark.slow
def test_probability_of_1e_12_of_correlated_coordinates():
    """P(X > 5.2, Y > 5.5) at correlation 0.6, and its derivative with respect to the start, by
    quadrature.
    """
    rho, a, b = 0.6, 5.8, 6.2
    R = np.array([[1.0, rho], [rho, 1.0]])

    def truth(shift):
        def f(x):
            return np.exp(norm.logpdf(x) + log_ndtr((rho * x - (b - shift)) / np.sqrt(1 - rho**2)))

        return scipy.integrate.quad(f, a - shift, 14, epsabs=0, epsrel=1e-11)[0]

    p, h = truth(0.0), 1e-4
    slope = (np.log(truth(h)) - np.log(truth(-h))) / (2 * h)
    assert 1e-13 < p < 1e-11

    @jax.jit
    def run(z):
        def log_weight(shift, z):
            box = nb.CylinderSet(np.array([a, b]), np.array([INF, INF]))
            x0 = shift * jnp.ones(2)
            return nb.GuidedBridge(
                nb.BrownianMotion(R), box, x0=x0, ts=np.linspace(0, 1, 3)
            ).log_weight(z)

        return jax.vmap(jax.value_and_grad(log_weight), in_axes=(None, 0))(jnp.zeros(()), z)

    log_weights, gradients = (np.asarray(x) for x in run(jr.normal(jr.key(0), (10_000, 3, 2, 1))))
    assert np.all(np.isfinite(gradients))
    found, error = estimate(log_weights)
    assert error < 0.01
    assert abs(found - np.log(p)) < 3 * error
    w = np.exp(log_weights - found)
    gradient = np.sum(w * gradients) / np.sum(w)
    error = np.sqrt(np.sum((w * (gradients - gradient)) ** 2)) / np.sum(w)
    assert error < 0.01 * slope
    assert abs(gradient - slope) < 3 * error


# Nonlinear processes, against ends that are simulated without the package.

STEPS = 10


def drift(xp, x):
    return xp.stack([xp.sin(2 * x[1]) - 0.5 * x[0], 0.8 * xp.cos(x[0]) - x[1]])


def noise(xp, x):
    return xp.stack([0.4 + 0.2 * xp.tanh(x[1]), 0.5 + 0.1 * xp.sin(x[0])])


NONLINEAR = nb.SDE(lambda t, x, args: drift(jnp, x), lambda t, x, args: noise(jnp, x))
X0 = np.array([0.3, -0.4])


def simulated(count, num_steps):
    """States of Euler paths, (2, count)."""
    rng, dt = np.random.default_rng(1), 1 / STEPS
    x = np.broadcast_to(X0[:, None], (2, count))
    for _ in range(num_steps):
        x = x + dt * drift(np, x) + np.sqrt(dt) * noise(np, x) * rng.normal(size=(2, count))
    return x


@pytest.fixture(scope="module")
def last_but_one():
    return simulated(300_000, STEPS - 1)


@jax.jit
def nonlinear(lower, upper, z):
    """One program for all bounds."""
    box = nb.CylinderSet(lower, upper)
    bridge = nb.GuidedBridge(NONLINEAR, box, x0=X0, ts=np.linspace(0, 1, STEPS + 1))
    paths, log_weights = jax.vmap(bridge.path_and_log_weight)(z)
    return paths[:, -1], log_weights


@pytest.mark.parametrize(
    "lower, upper",
    [
        ([0.4, 0.1], [0.9, 0.6]),
        ([0.5, -INF], [INF, 0.1]),
        ([0.5, 0.2], [0.5, INF]),
        pytest.param([-INF, 0.8], [INF, 0.8], marks=pytest.mark.slow),
    ],
    ids=["interval", "half-lines", "point and half-line", "free and point"],
)
def test_nonlinear_process(lower, upper, last_but_one):
    """The last step of a simulated path is averaged over in closed form, so that points have a
    density.
    """
    lower, upper, dt = np.array(lower), np.array(upper), 1 / STEPS
    x = last_but_one
    mean, sd = x + dt * drift(np, x), np.sqrt(dt) * noise(np, x)
    chance = np.exp(np.sum(log_interval(lower[:, None], upper[:, None], mean, sd), axis=0))
    truth, own = np.log(np.mean(chance)), np.std(chance) / np.mean(chance) / np.sqrt(len(chance))
    if np.all(np.isinf([lower[0], upper[0]])):  # known to be free, it is left out
        log_weights = run(NONLINEAR, nb.CylinderSet(lower, upper), X0, STEPS, count=20_000)
    else:
        ends, log_weights = (
            np.asarray(x) for x in nonlinear(lower, upper, jr.normal(jr.key(0), (20_000, 11, 2, 1)))
        )
        assert np.all((ends >= lower - 1e-12) & (ends <= upper + 1e-12))
    found, error = estimate(log_weights)
    assert error < 0.01 and own < 0.01
    assert abs(found - truth) < 3 * np.hypot(error, own)


def kunita_ends(x0, alpha, length, num_steps, count, jitter=1e-10):
    """Ends of Euler paths of the flow, from Cholesky factors in NumPy."""
    rng, n = np.random.default_rng(2), len(x0)
    x = np.broadcast_to(x0, (count, n, 2))
    variance = alpha**2 * np.pi * length**2
    for _ in range(num_steps):
        square = np.sum((x[:, :, None] - x[:, None]) ** 2, -1)
        K = variance * (np.exp(-square / (4 * length**2)) + jitter * np.eye(n))
        x = x + np.linalg.cholesky(K / num_steps) @ rng.normal(size=(count, n, 2))
    return x


@pytest.mark.parametrize(
    "n, num_steps, count, simulations",
    [(4, 10, 10_000, 80_000), pytest.param(8, 10, 40_000, 400_000, marks=pytest.mark.slow)],
)
def test_kunita_flow(n, num_steps, count, simulations):
    alpha, length, s = 0.3, 0.5, 2 * np.pi * np.arange(n) / n
    x0 = np.stack([np.cos(s), np.sin(s)], 1)
    lower, upper = x0 - np.array([0.35, 0.25]), x0 + np.array([0.3, 0.4])
    ends = np.concatenate(
        [kunita_ends(x0, alpha, length, num_steps, simulations // 10 + i) for i in range(10)]
    )
    p = np.mean(np.all((ends >= lower) & (ends <= upper), axis=(1, 2)))
    own = np.sqrt((1 - p) / (p * len(ends)))
    flow = nb.KunitaFlow(nb.Landmarks(n, 2), nb.GaussianKernel(alpha, length))
    found, error = estimate(run(flow, nb.CylinderSet(lower, upper), x0, num_steps, count))
    print(f"log P = {found:.4f} ± {error:.4f}, counted {np.log(p):.4f} ± {own:.4f}")
    assert error < 0.015 and own < 0.015
    assert abs(found - np.log(p)) < 3 * np.hypot(error, own)
