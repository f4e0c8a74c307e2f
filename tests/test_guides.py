"""What makes a guide right: weights whose mean is the density, paths of their law, no variance for
a true auxiliary.

Referees: dense Gaussians for linear models, and for a nonlinear scalar model the Euler density
itself, by quadrature.
"""

import functools
import itertools

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
import scipy.stats
from helpers import linear_process, log_normal

import numpyro_bridges as nb
from numpyro_bridges.guiding._score import Standard

pytestmark = pytest.mark.usefixtures("compile_quickly")

STANDARD = (1.0, 0.8, 0.0, 1.0, np.zeros(0), np.zeros(0))
GUIDES = {
    "frozen": nb.FrozenGuide(),
    # ã below a(v) = 0.41 would give heavy tails
    "auxiliary": nb.FrozenGuide(nb.LinearSDE(-0.3, 0.65, 0.1)),
    "receding": nb.RecedingGuide(),
    "receding-mixed": nb.RecedingGuide(end_weight=0.2),
    "geodesic": nb.GeodesicGuide(),
    "drift": nb.DriftGuide(nb.FrozenGuide()),
    "learned": nb.scores.ScoreGuide(
        nb.FrozenGuide(),
        lambda t, x, v, theta: 0.3 * jnp.sin(3 * x) + 0.2 * t,
        Standard(*map(jnp.asarray, STANDARD)),
    ),
}


# Linear models.

B, SIGMA, BETA = (
    np.array([[-0.5, 0.4], [-0.2, -0.8]]),
    np.array([[0.5, 0.1], [0.0, 0.4]]),
    np.array([0.3, -0.1]),
)
X0, L = np.array([0.4, -0.3]), np.array([[1.0, 0.5]])
UNIFORM, GRADED = np.linspace(0, 1.2, 7), 1.2 * (lambda s: s * (2 - s))(np.linspace(0, 1, 7))


def euler():
    return nb.SDE(lambda t, x, args: jnp.asarray(B) @ x + BETA, lambda t, x, args: SIGMA)


LINEAR = {
    "exact-matrix": (nb.LinearSDE(B, SIGMA, BETA), linear_process(B, SIGMA, BETA, 2)),
    "exact-diagonal": (
        nb.LinearSDE(B[0], SIGMA[0] + 0.2, BETA),
        linear_process(B[0], SIGMA[0] + 0.2, BETA, 2),
    ),
    "euler": (euler(), linear_process(B, SIGMA, BETA, 2, exact=False)),
    "brownian": (
        nb.BrownianMotion(SIGMA @ SIGMA.T),
        linear_process(0.0, SIGMA, 0.0, 2, exact=False),
    ),
}
SEEN = {
    "inexact": (nb.InexactMatch(0.1, L), L, 0.1 * np.eye(1), [0.7]),
    "exact": (nb.ExactMatch(), np.eye(2), np.zeros((2, 2)), [0.7, -0.4]),
}


def gaussian_law(process, ts, x0):
    """Mean and covariance of the end state, step by step."""
    mean, S = x0[:, None], np.zeros((2, 2))
    for s, t in itertools.pairwise(ts):
        phi, shift, C = process.affine(s, t, mean)
        mean, S = phi @ mean + shift, phi @ S @ phi.T + C
    return mean, S


def linear_evidence(process, ts, x0, seen):
    _, L, noise, v = SEEN[seen]
    mean, S = gaussian_law(process, ts, x0)
    return log_normal(np.array(v)[:, None], L @ mean, L @ S @ L.T + noise)


@pytest.mark.parametrize(
    "model, seen",
    # the slowest to compile
    [(m, s) for m in LINEAR for s in SEEN if (m, s) != ("exact-matrix", "exact")],
)
def test_a_true_auxiliary_gives_constant_weights(model, seen, key):
    """On two grids of one length, so that one program serves both."""
    sde, process = LINEAR[model]
    match, _, _, v = SEEN[seen]
    guide = nb.RecedingGuide() if model == "euler" else nb.FrozenGuide()
    z = jr.normal(key, (20, 6, 2, 1))
    log_weights = jax.jit(
        lambda ts: jax.vmap(
            nb.GuidedBridge(sde, match.at(v), x0=X0, ts=ts, guide=guide).log_weight
        )(z)
    )
    for ts in (UNIFORM, GRADED):
        found = np.asarray(log_weights(ts))
        assert np.ptp(found) < 1e-8
        np.testing.assert_allclose(found[0], linear_evidence(process, ts, X0, seen), rtol=1e-9)


def test_a_wrong_auxiliary_gives_weights_that_vary():
    """And their mean is still the density: 0.1 nats off would be seen."""
    sde, process = LINEAR["exact-diagonal"]
    wrong = nb.FrozenGuide(nb.LinearSDE(np.array([0.1, -0.3]), 0.6, 0.2))
    bridge = nb.GuidedBridge(sde, SEEN["inexact"][0].at([0.7]), x0=X0, ts=UNIFORM, guide=wrong)
    found = nb.estimate_evidence(bridge, jr.key(0), 4000)
    assert np.std(found.log_weights) > 0.1
    assert found.standard_error < 0.02
    assert (
        abs(found.log_evidence - linear_evidence(process, UNIFORM, X0, "inexact"))
        < 3 * found.standard_error
    )


@pytest.mark.parametrize("model", ["exact-diagonal", "euler"])
def test_h_is_a_martingale(model):
    """E h̃(t, X_t) = h̃(0, x0) along free paths where the auxiliary is the truth; h̃ at the start
    is the evidence.
    """
    sde, process = LINEAR[model]
    bridge = nb.GuidedBridge(sde, SEEN["inexact"][0].at([0.7]), x0=X0, ts=UNIFORM)
    count = 20000

    @jax.jit
    def log_h_along(key):
        z = jr.normal(key, (count, 6, 2, 1))
        paths = jax.vmap(lambda z: nb.simulate(sde, jnp.asarray(X0), jnp.asarray(UNIFORM), z))(z)
        return jax.vmap(lambda p: jax.vmap(bridge.log_h)(jnp.asarray(UNIFORM[:-1]), p[:-1]))(paths)

    start = linear_evidence(process, UNIFORM, X0, "inexact")
    ratios = np.exp(np.asarray(log_h_along(jr.key(3))) - start)
    np.testing.assert_allclose(ratios[:, 0], 1.0, rtol=1e-9)
    error = ratios.std(0) / np.sqrt(count)
    assert np.all(error < 0.012)
    assert np.all(np.abs(ratios.mean(0) - 1)[1:] < 3 * error[1:])


def test_score_is_the_gradient_of_log_h(key):
    bridge = nb.GuidedBridge(euler(), SEEN["inexact"][0].at([0.7]), x0=X0, ts=UNIFORM)
    x, t = jr.normal(key, (2,)), UNIFORM[2]
    score, (log_h, gradient) = jax.jit(
        lambda x: (bridge.score(t, x), jax.value_and_grad(bridge.log_h, 1)(t, x))
    )(x)
    np.testing.assert_allclose(score, gradient, rtol=1e-10)
    mean, S = gaussian_law(LINEAR["euler"][1], UNIFORM[2:], np.asarray(x))
    residual = 0.7 - (L @ mean)[0, 0]
    variance = (L @ S @ L.T)[0, 0] + 0.1
    phi = np.linalg.multi_dot([np.eye(2) + dt * B for dt in np.diff(UNIFORM[2:])])
    np.testing.assert_allclose(score, (L @ phi)[0] * residual / variance, rtol=1e-10)
    np.testing.assert_allclose(
        log_h, scipy.stats.norm.logpdf(residual, 0, np.sqrt(variance)), rtol=1e-10
    )


# A nonlinear scalar model with a diffusion that depends on the state.

START, TIME, DATUM, VARIANCE = 0.3, 1.0, 0.9, 0.02


def drift(xp, x):
    return xp.sin(2 * x) - 0.5 * x


def diffusion(xp, x):
    return 0.5 + 0.2 * xp.tanh(x)


SCALAR = nb.SDE(lambda t, x, args: drift(jnp, x), lambda t, x, args: diffusion(jnp, x))


@functools.lru_cache
def quadrature(num_steps, exact, points=1500):
    """The Euler density of the datum, and the distribution function of the bridge at mid-time, by
    matrix powers.
    """
    grid = np.linspace(-3.5, 4.5, points)
    w, dt = grid[1] - grid[0], TIME / num_steps

    def transition(x, y):
        x = np.atleast_1d(x)[:, None]
        return scipy.stats.norm.pdf(y[None], x + dt * drift(np, x), np.sqrt(dt) * diffusion(np, x))

    P = transition(grid, grid) * w
    if exact:
        end, rest = transition(grid, np.array([DATUM]))[:, 0], num_steps - 1
    else:
        end, rest = scipy.stats.norm.pdf(DATUM, grid, np.sqrt(VARIANCE)), num_steps
    forward = transition(START, grid)[0] * w
    for _ in range(num_steps // 2 - 1):
        forward = forward @ P
    for _ in range(rest - num_steps // 2):
        end = P @ end
    density = forward * end
    return (
        np.log(density.sum()),
        grid,
        np.cumsum(density) / density.sum() - 0.5 * density / density.sum(),
    )


@pytest.mark.parametrize("exact", [False, True], ids=["inexact", "exact"])
@pytest.mark.parametrize(
    "guide, steps", [*((g, [20]) for g in GUIDES if g != "receding"), ("receding", [10, 20, 40])]
)
def test_unbiased_for_the_euler_density(guide, steps, exact):
    """Within 3 SE of the quadrature, the SE below 1 %; paths at mid-time within 0.02 of their
    distribution function.

    One program for every number of steps: a grid that is shorter begins with steps of no length and
    no noise.
    """
    match, count, most = nb.ExactMatch() if exact else nb.InexactMatch(VARIANCE), 20000, max(steps)

    @jax.jit
    def run(ts, z):
        bridge = nb.GuidedBridge(SCALAR, match.at([DATUM]), x0=[START], ts=ts, guide=GUIDES[guide])
        return jax.vmap(bridge.path_and_log_weight)(z)

    for num_steps in steps:
        missing = most - num_steps
        ts = np.concatenate([1e-13 * np.arange(-missing, 0), np.linspace(0, TIME, num_steps + 1)])
        z = jr.normal(jr.key(num_steps), (count, num_steps, 1, 1))
        path, log_weight = run(ts, jnp.pad(z, ((0, 0), (missing, 0), (0, 0), (0, 0))))
        truth, grid, law = quadrature(num_steps, exact)
        weight = np.exp(np.asarray(log_weight) - truth)
        error = weight.std() / np.sqrt(count)
        assert error < 0.01
        assert abs(weight.mean() - 1) < 3 * error

        middle = np.asarray(path)[:, missing + num_steps // 2, 0]
        order = np.argsort(middle)
        empirical = np.cumsum(weight[order]) / weight.sum()
        assert np.sum(weight) ** 2 / np.sum(weight**2) > 5000
        assert np.max(np.abs(empirical - np.interp(middle[order], grid, law))) < 0.02


def test_evidence_estimate():
    """What `estimate_evidence` reports, from its own log weights by plain NumPy, whatever the batch
    size.
    """
    ts = np.linspace(0, TIME, 11)
    bridge = nb.GuidedBridge(SCALAR, nb.InexactMatch(VARIANCE).at([DATUM]), x0=[START], ts=ts)
    found = nb.estimate_evidence(bridge, jr.key(0), 1024)
    w = np.exp(np.asarray(found.log_weights))
    np.testing.assert_allclose(found.log_evidence, np.log(w.mean()), rtol=1e-12)
    drawn = w.std(ddof=1) / w.mean() / np.sqrt(1024)
    np.testing.assert_allclose(
        found.standard_error, nb.weights.standard_error(found.log_weights), rtol=1e-12
    )
    assert drawn < found.standard_error < 1.3 * drawn
    np.testing.assert_allclose(found.ess, w.sum() ** 2 / np.sum(w**2), rtol=1e-12)
    other = nb.estimate_evidence(bridge, jr.key(0), 1024, batch_size=1024)
    np.testing.assert_allclose(other.log_weights, found.log_weights, rtol=1e-12)
    assert found.pareto_k < 0.7 and found.standard_error < 0.03
    assert abs(found.log_evidence - quadrature(10, False)[0]) < 3 * found.standard_error
