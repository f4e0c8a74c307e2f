"""The reference values: closed forms, and long runs by other means of nonlinear bridges.

Closed forms are typed here again and agree with the printed digits of the table. Where the value is
that of the continuous process and the model takes Euler steps, a test states its allowance for the
discretisation, in units of 1/num_steps, and runs at two numbers of steps, one twice the other.
"""

from dataclasses import dataclass
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
import scipy.special
import scipy.stats

import numpyro_bridges as nb

# Exact log densities and evidences.


def ou_log_density(rate, mean, sigma, x0, v, t):
    center = mean + np.exp(-rate * t) * (x0 - mean)
    return scipy.stats.norm.logpdf(
        v, center, sigma * np.sqrt(-np.expm1(-2 * rate * t) / (2 * rate))
    )


@pytest.fixture(scope="module")
def ou():
    """The log weights of four noises."""

    @jax.jit
    def log_weights(rate, mean, sigma, x0, v, t):
        sde = nb.LinearSDE(-rate, sigma, rate * mean)
        bridge = nb.GuidedBridge(
            sde, nb.ExactMatch().at([v]), x0=jnp.array([x0]), t1=t, num_steps=5
        )
        return jax.vmap(bridge.log_weight)(jr.normal(jr.key(0), (4, 5, 1, 1)))

    return log_weights


@pytest.mark.parametrize(
    "setting, table",
    [
        ((2.0, 0.0, 1.0, 1.0, 1.0, 1.0), -1.739737),
        ((2.0, 0.0, 1.0, 1.0, 1.0, 2.0), -2.153679),
        ((1.7, 1.0, 0.3, 0.0, 1.0, 1.0), 0.261745),
        ((0.6, 1.0, 0.3, 0.0, 1.0, 1.0), -2.318032),
        ((1.7, 1.0, 1.0, 0.0, 1.0, 1.0), -0.348773),
    ],
)
def test_ornstein_uhlenbeck(ou, setting, table):
    truth = ou_log_density(*setting)
    np.testing.assert_allclose(truth, table, atol=5.1e-7)
    np.testing.assert_allclose(ou(*setting), truth, rtol=0, atol=1e-8)


CHAIN = np.array([[0.0, 1.0], [0.0, -1.0]]), np.array([[0.0], [0.7]]), np.array([0.0, 0.5])
FIRST = np.array([[1.0, 0.0]])


def test_hypo_elliptic_linear_process():
    """dX1 = X2 dt, dX2 = (½ − X2) dt + 0.7 dW, by matrix exponentials and a quadrature."""
    B, sigma, beta = CHAIN
    t, x0, v = 1.5, np.array([2.0, 1.0]), 2.5
    u, w = np.polynomial.legendre.leggauss(40)
    flows = [scipy.linalg.expm(B * t * (1 + s) / 2) for s in u]
    mean = scipy.linalg.expm(B * t) @ x0 + sum(
        0.5 * t * wi * E @ beta for wi, E in zip(w, flows, strict=True)
    )
    S = sum(0.5 * t * wi * E @ sigma @ sigma.T @ E.T for wi, E in zip(w, flows, strict=True))
    truth = scipy.stats.norm.logpdf(v, mean[0], np.sqrt(S[0, 0] + 0.1))
    np.testing.assert_allclose(truth, -0.992611, atol=5.1e-7)

    @jax.jit
    def run(z):
        sde, seen = nb.LinearSDE(B, sigma, beta), nb.InexactMatch(0.1, FIRST).at([v])
        bridge = nb.GuidedBridge(sde, seen, x0=x0, ts=np.linspace(0, t, 7))
        return bridge.log_h(0.0, x0), jax.vmap(bridge.log_weight)(z)

    log_h, log_weights = run(jr.normal(jr.key(0), (4, 6, 2, 1)))
    np.testing.assert_allclose(log_h, truth, rtol=0, atol=1e-8)
    np.testing.assert_allclose(log_weights, truth, rtol=0, atol=1e-8)


# Brownian motion on curves, with the covariance of a Kunita flow frozen at the circle.

LENGTH, VARIANCE = 0.5, 0.01
ALPHAS = np.linspace(0.002, 1.6, 400)


def circle_and_datum(n):
    s = 2 * np.pi * np.arange(n) / n
    x0 = np.stack([np.cos(s), np.sin(s)], 1)
    return x0, np.stack([1.3 * np.cos(s) + 0.1 + 0.05 * np.cos(3 * s), 0.8 * np.sin(s) - 0.2], 1)


def unit_covariance(x):
    """a(x, x') = α² πℓ² exp(−|x − x'|²/4ℓ²) at α = 1."""
    return np.pi * LENGTH**2 * np.exp(-np.sum((x[:, None] - x[None]) ** 2, -1) / (4 * LENGTH**2))


def log_kernel(n, alphas, variance):
    """log E exp(−‖X_T − v‖²/2σ) in closed form for every α."""
    x0, v = circle_and_datum(n)
    values, vectors = np.linalg.eigh(unit_covariance(x0))
    r = np.sum((vectors.T @ (v - x0)) ** 2, axis=1)
    total = alphas[:, None] ** 2 * values + variance * n
    return -np.sum(np.log(total / (variance * n)), axis=1) - 0.5 * np.sum(r / total, axis=1)


@pytest.fixture(scope="module")
def curve_evidence():
    """The log evidence as a function of n, the amplitudes and the variance; one compilation for
    each n.
    """
    compiled = {}

    def evidence(n, alphas, variance):
        x0, v = circle_and_datum(n)
        space, C = nb.Landmarks(n, 2), unit_covariance(x0) + 1e-12 * np.eye(n)

        def one(alpha, variance):
            sde = nb.BrownianMotion(alpha**2 * C, space=space)
            seen = nb.InexactMatch(variance, normalised=False).at(v)
            bridge = nb.GuidedBridge(sde, seen, x0=x0, ts=np.linspace(0, 1, 2))
            return bridge.log_weight(jnp.ones((1, n, 2)))

        run = compiled.setdefault(
            n, jax.jit(lambda a, s: jax.lax.map(lambda alpha: one(alpha, s), a))
        )
        return np.asarray(run(alphas, variance))

    return evidence


@pytest.mark.parametrize(
    "n, table", [(8, -5.714164), (16, -5.716044), (64, -5.716044), (256, -5.716044)]
)
def test_brownian_motion_on_curves(curve_evidence, n, table):
    truth = log_kernel(n, np.array([0.2]), VARIANCE)
    np.testing.assert_allclose(truth, table, atol=5.1e-7)
    alphas = np.where(np.arange(len(ALPHAS)) == 0, 0.2, ALPHAS)
    np.testing.assert_allclose(curve_evidence(n, alphas, VARIANCE)[:1], truth, rtol=0, atol=1e-8)


def sd(log_density):
    w = np.exp(log_density - np.max(log_density))
    mean = np.sum(w * ALPHAS) / np.sum(w)
    return np.sqrt(np.sum(w * (ALPHAS - mean) ** 2) / np.sum(w))


@pytest.mark.parametrize("n, shrunk", [(16, 0.046), (64, 0.037), (256, 0.031)])
def test_spread_of_the_amplitude(curve_evidence, n, shrunk):
    """With the H-norm the same posterior for every n; with a fixed variance per landmark it
    shrinks.

    The flat prior is that on α > 0: an interval that leaves out α < 0.001 gives 0.1015.
    """
    evidence = curve_evidence(n, ALPHAS, VARIANCE)
    np.testing.assert_allclose(evidence, log_kernel(n, ALPHAS, VARIANCE), rtol=1e-8)
    prior = scipy.stats.lognorm.logpdf(ALPHAS, 1.0)
    np.testing.assert_allclose(sd(evidence + prior), 0.0916, atol=5.1e-5)
    np.testing.assert_allclose(sd(evidence), 0.1017, atol=5.1e-5)
    np.testing.assert_allclose(sd(curve_evidence(n, ALPHAS, VARIANCE / n)), shrunk, atol=5.1e-4)


def test_kunita_covariance():
    alpha, length = 0.3, 0.7
    x, _ = circle_and_datum(5)
    flow = nb.KunitaFlow(
        nb.Landmarks(5, 2), nb.GaussianKernel(alpha, length), noise=nb.LandmarkNoise(jitter=0.0)
    )
    square = np.sum((x[:, None] - x[None]) ** 2, -1)
    expected = alpha**2 * np.pi * length**2 * np.exp(-square / (4 * length**2))
    np.testing.assert_allclose(flow.covariance(0.0, jnp.asarray(x)), expected, rtol=1e-12)


# Nonlinear bridges.

COUNT = 10_000


@dataclass(frozen=True)
class Case:
    """`table`: number of steps to (value, its standard error or rounding) where the value is that
    of the Euler model.

    `limit`: (value, its error, allowance times the number of steps) of the continuous process.
    """

    sde: Any
    condition: Any
    x0: list
    t1: float
    steps: tuple
    guide: Any = None
    count: int = COUNT
    graded: bool = False
    table: dict | None = None
    limit: tuple | None = None

    def bridge(self, num_steps):
        s = np.linspace(0, 1, num_steps + 1)
        ts = self.t1 * (s * (2 - s) if self.graded else s)
        return nb.GuidedBridge(self.sde, self.condition, x0=self.x0, ts=ts, guide=self.guide)


def radial_log_density(theta, x0, x, t):
    order, product = theta - 0.5, x * x0 / np.sinh(t)
    return (
        theta * np.log(x / x0)
        + 0.5 * np.log(x * x0)
        - x**2
        + (theta + 0.5) * t
        - np.log(np.sinh(t))
        - (x**2 + x0**2) / np.expm1(2 * t)
        + np.log(scipy.special.ive(order, product))
        + product
    )


def gbm_log_density(mu, sigma, x0, x, t):
    return scipy.stats.norm.logpdf(
        np.log(x), np.log(x0) + (mu - sigma**2 / 2) * t, sigma * np.sqrt(t)
    ) - np.log(x)


def switch(y):
    return y**4 / (1 / 16 + y**4)


def cell_drift(t, x, args):
    a, b = switch(x)
    return jnp.stack([a + 1 - b, b + 1 - a]) - x


def fitzhugh_nagumo_drift(t, x, args):
    y, z = x
    return jnp.stack([(y - z - y**3) / 0.1, 1.5 * y - z + 0.8])


def integrated_drift(t, x, args):
    return jnp.stack([x[1], -(x[1] + jnp.sin(x[1])) + 0.5])


CELL = nb.SDE(cell_drift, lambda t, x, args: 0.1)
CELL_ENDS = {"x0": [0.1, -0.1], "t1": 4.0}
CASES = {
    "radial": Case(
        nb.SDE(lambda t, x, args: 4 / x - x, lambda t, x, args: 1.0),
        nb.ExactMatch().at([1.0]),
        x0=[1.5],
        t1=1.0,
        steps=(50, 100),
        graded=True,
        limit=(radial_log_density(4.0, 1.5, 1.0, 1.0), 0.0, 1.0),
    ),
    "geometric": Case(
        nb.SDE(lambda t, x, args: 0.1 * x, lambda t, x, args: 0.4 * x),
        nb.ExactMatch().at([1.5]),
        x0=[1.0],
        t1=1.0,
        steps=(50, 100),
        table={50: (-0.866, 0.0005)},
        limit=(gbm_log_density(0.1, 0.4, 1.0, 1.5, 1.0), 0.0, 0.5),
    ),
    "cell": Case(
        CELL,
        nb.ExactMatch().at([2.0, -0.1]),
        **CELL_ENDS,
        steps=(400, 800),
        guide=nb.FrozenGuide(nb.LinearSDE(-1.0, 0.1, np.array([2.0, 0.0]))),
        table={400: (1.4258, 0.0017), 800: (1.4286, 0.0017)},
        limit=(1.435, 0.0017, 4.0),
    ),
    "fitzhugh-nagumo": Case(
        nb.SDE(fitzhugh_nagumo_drift, lambda t, x, args: np.array([[0.0], [0.3]])),
        nb.InexactMatch(0.01, FIRST).at([-1.0]),
        x0=[-0.5, -0.6],
        t1=2.0,
        steps=(400, 2000),
        table={400: (0.7017, 0.0006), 2000: (0.6966, 0.0011)},
    ),
    "integrated": Case(
        nb.SDE(integrated_drift, lambda t, x, args: np.array([[0.0], [0.7]])),
        nb.InexactMatch(0.1, FIRST).at([2.5]),
        x0=[2.0, 1.0],
        t1=1.5,
        steps=(50, 100),
        limit=(-0.294, 0.001, 0.3),
    ),
}


def check_estimate(log_evidence, error, pareto_k, case, num_steps):
    assert error < 0.01
    assert pareto_k < 0.7
    if case.table and num_steps in case.table:
        value, own = case.table[num_steps]
        assert abs(log_evidence - value) < 3 * np.hypot(error, own)
    if case.limit:
        value, own, allowance = case.limit
        assert abs(log_evidence - value) < 3 * np.hypot(error, own) + allowance / num_steps


@pytest.mark.parametrize(
    "name, num_steps", [(name, k) for name, case in CASES.items() for k in case.steps]
)
def test_nonlinear_bridge(name, num_steps):
    case = CASES[name]
    found = nb.estimate_evidence(
        case.bridge(num_steps), jr.key(0), case.count, batch_size=case.count
    )
    check_estimate(
        float(found.log_evidence), float(found.standard_error), found.pareto_k, case, num_steps
    )


def test_closed_forms_have_the_printed_digits():
    np.testing.assert_allclose(CASES["radial"].limit[0], -2.525135, atol=5.1e-7)
    np.testing.assert_allclose(CASES["geometric"].limit[0], -0.872436, atol=5.1e-7)
    for theta in (2.0, 4.0):  # the closed form is a density
        total = scipy.integrate.quad(
            lambda x, a=theta: np.exp(radial_log_density(a, 1.5, x, 1.0)), 1e-9, 12
        )[0]
        np.testing.assert_allclose(total, 1.0, rtol=1e-7)


def test_a_poor_auxiliary_misses_the_evidence_and_shows_it():
    case = CASES["cell"]
    poor = case.bridge(400).with_guide(
        nb.FrozenGuide(nb.LinearSDE(-1.0, 0.1, np.array([1.0, 1.0])))
    )
    found = nb.estimate_evidence(poor, jr.key(0), case.count, batch_size=case.count)
    assert found.log_evidence < 1.43 - 20
    assert found.pareto_k > 0.7 and found.ess < 0.01 * case.count


def test_exact_end_with_the_covariance_of_the_start():
    """ã = a(x0) is no auxiliary for the continuous weight of an exactly seen end, and is refused
    there.
    """
    case = CASES["geometric"]
    with pytest.raises(ValueError, match="must match the SDE at the observed end"):
        nb.GuidedBridge(
            case.sde,
            case.condition,
            x0=case.x0,
            ts=np.linspace(0, 1, 51),
            guide=nb.FrozenGuide(nb.BrownianMotion(0.16)),
            solver=diffrax.Euler(),
        )


# Laws of a state. The Euler chain on a grid of points, by sums.


def chain(mean, sd, grid):
    """One step from every point of the grid: the points within 6 SD of its mean, and their
    probabilities.
    """
    width = grid[1] - grid[0]
    reach = int(np.ceil(6 * np.max(sd) / width))
    near = np.round((mean - grid[0]) / width).astype(int)[:, None] + np.arange(-reach, reach + 1)
    probability = scipy.stats.norm.pdf(grid[0] + near * width, mean[:, None], sd[:, None]) * width
    outside = (near < 0) | (near >= len(grid))
    return np.where(outside, 0, near), np.where(outside, 0.0, probability)


def forward(p, step):
    near, probability = step
    return np.bincount(near.ravel(), (p[:, None] * probability).ravel(), len(p))


def backward(f, step):
    near, probability = step
    return np.sum(probability * f[near], axis=1)


def distribution_function(law):
    """At the points, which carry half of their weight to either side."""
    law = law / law.sum()
    return np.cumsum(law) - 0.5 * law


def largest_difference(states, weights, grid, law):
    order = np.argsort(states)
    found = (np.cumsum(weights[order]) - 0.5 * weights[order]) / weights.sum()
    return np.max(np.abs(found - np.interp(states[order], grid, distribution_function(law))))


def weighted_paths(bridge, count, index):
    """The states at one step, weights and what is to be known of them."""

    @jax.jit
    def run(key):
        def one(z):
            path, log_weight = bridge.path_and_log_weight(z)
            return path[index, 0], log_weight

        return jax.vmap(one)(jr.normal(key, (count, *bridge.noise_shape)))

    states, log_weights = run(jr.key(0))
    log_evidence, error = (
        nb.weights.log_mean_exp(log_weights),
        nb.weights.standard_error(log_weights),
    )
    weights = np.exp(np.asarray(log_weights - log_evidence))
    return (
        np.asarray(states),
        weights,
        (float(log_evidence), float(error), float(nb.weights.pareto_k(log_weights))),
    )


def weighted_mean(f, weights):
    mean = np.sum(weights * f) / np.sum(weights)
    return mean, np.sqrt(np.sum((weights * (f - mean)) ** 2)) / np.sum(weights)


SINE = Case(
    nb.SDE(lambda t, x, args: 2 - 2 * jnp.sin(8 * x), lambda t, x, args: 0.5),
    nb.ExactMatch().at([np.pi / 2]),
    x0=[0.0],
    t1=1.0,
    steps=(100, 200),
    count=40_000,
    limit=(-0.2610, 0.00005, 6.0),
)
QUANTILES = {0.05: 0.171, 0.25: 0.590, 0.5: 0.826, 0.75: 0.938, 0.95: 1.189}


@pytest.mark.parametrize("num_steps", SINE.steps)
def test_sine_bridge(num_steps):
    """Evidence and the multimodal law at mid-time; allowances 6 / num_steps in nats, 1 / num_steps
    for the law.
    """
    dt, grid = 1 / num_steps, np.arange(-1.5, 4, 0.008)
    step = chain(
        grid + dt * (2 - 2 * np.sin(8 * grid)), np.full(len(grid), 0.5 * np.sqrt(dt)), grid
    )
    p = scipy.stats.norm.pdf(grid, 2 * dt, 0.5 * np.sqrt(dt)) * 0.008
    f = scipy.stats.norm.pdf(np.pi / 2, grid + dt * (2 - 2 * np.sin(8 * grid)), 0.5 * np.sqrt(dt))
    for _ in range(num_steps // 2 - 1):
        p, f = forward(p, step), backward(f, step)
    truth = np.log(np.sum(p * f))

    states, weights, (log_evidence, error, pareto_k) = weighted_paths(
        SINE.bridge(num_steps), SINE.count, num_steps // 2
    )
    check_estimate(log_evidence, error, pareto_k, SINE, num_steps)
    assert abs(log_evidence - truth) < 3 * error
    assert largest_difference(states, weights, grid, p * f) < 0.02

    allowance = 1 / num_steps
    for level, quantile in QUANTILES.items():
        found, error = weighted_mean(states < quantile, weights)
        assert error < 0.006
        assert abs(found - level) < 3 * error + allowance
    mean, error = weighted_mean(states, weights)
    assert error < 0.006
    assert abs(mean - 0.759) < 3 * error + allowance
    variance, error = weighted_mean((states - mean) ** 2, weights)
    assert error < 0.006
    assert abs(np.sqrt(variance) - 0.311) < 3 * error / (2 * 0.311) + allowance


def test_law_of_an_endpoint():
    """Periodic drift and noise over a long time: evidence, and the law of X_T given the datum, of
    the Euler chain.
    """
    t1, num_steps, x0, v, variance = 12.57, 1257, -np.pi / 2, 1.0, 0.1
    ts, grid = np.linspace(0, t1, num_steps + 1), np.arange(-30, 30, 0.075)
    dt, sd = ts[1], np.sqrt(ts[1]) * (2 + 0.5 * np.cos(grid))
    p = np.zeros(len(grid))
    for k, t in enumerate(ts[:-1]):
        mean = grid + dt * (-0.1 * grid + 0.5 * np.sin(grid) + 0.5 * np.sin(t / 4))
        if k == 0:
            p = 0.075 * scipy.stats.norm.pdf(
                grid, x0 + dt * (-0.1 * x0 + 0.5 * np.sin(x0)), sd0(x0, dt)
            )
        else:
            p = forward(p, chain(mean, sd, grid))
    posterior = p * scipy.stats.norm.pdf(v, grid, np.sqrt(variance))
    truth = np.log(posterior.sum())

    sde = nb.SDE(
        lambda t, x, args: -0.1 * x + 0.5 * jnp.sin(x) + 0.5 * jnp.sin(t / 4),
        lambda t, x, args: 2 + 0.5 * jnp.cos(x),
    )
    guide = nb.FrozenGuide(nb.LinearSDE(-0.1, 2.0))
    bridge = nb.GuidedBridge(sde, nb.InexactMatch(variance).at([v]), x0=[x0], ts=ts, guide=guide)
    states, weights, (log_evidence, error, pareto_k) = weighted_paths(bridge, COUNT, num_steps)
    assert error < 0.01
    assert pareto_k < 0.7
    assert abs(log_evidence - truth) < 3 * error
    assert largest_difference(states, weights, grid, posterior) < 0.02


def sd0(x, dt):
    return np.sqrt(dt) * (2 + 0.5 * np.cos(x))
