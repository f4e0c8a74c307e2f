"""The continuous weight under diffrax solvers: exact for a true auxiliary, dense replays, limits as
dt → 0.
"""

import itertools

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
import scipy.special
import scipy.stats
from helpers import columns, columns_of_path, conditional, exact_affine, jacobian, log_normal
from models import CURVE, SDES, X3

import numpyro_bridges as nb
from numpyro_bridges.distributions._tree import _problem
from numpyro_bridges.guiding import GridNoise as NoisePath, GuidedTerm, arrive

pytestmark = pytest.mark.usefixtures("compile_quickly")

ITO = {"Euler": diffrax.Euler(), "ItoMilstein": diffrax.ItoMilstein(), "SRA1": diffrax.SRA1()}
STRATONOVICH = {
    "Heun": diffrax.Heun(),
    "EulerHeun": diffrax.EulerHeun(),
    "ShARK": diffrax.ShARK(),
    "SPaRK": diffrax.SPaRK(),
}
SOLVERS = ITO | STRATONOVICH


@pytest.mark.parametrize(
    "solver, exact", [("Euler", False), *((s, i % 2 == 0) for i, s in enumerate(SOLVERS))]
)
def test_the_true_auxiliary_gives_one_weight(solver, exact, key):
    """Ornstein–Uhlenbeck on any grid: log h̃(0, x0), whatever the noise. At T = 1 from 1 to 1 it is
    −1.739737.
    """
    match, ts = nb.ExactMatch() if exact else nb.InexactMatch(0.1), np.array([0.0, 0.3, 0.8, 1.0])
    bridge = nb.GuidedBridge(
        nb.LinearSDE(-2.0, 1.0), match.at([1.0]), x0=[1.0], ts=ts, solver=SOLVERS[solver]
    )
    assert bridge.noise_shape == (3, 2 if solver in ("ShARK", "SPaRK", "SRA1") else 1, 1)
    found = jax.jit(jax.vmap(bridge.log_weight))(jr.normal(key, (5, *bridge.noise_shape)))
    variance = (1 - np.exp(-4)) / 4 + (0 if exact else 0.1)
    truth = scipy.stats.norm.logpdf(1.0, np.exp(-2), np.sqrt(variance))
    np.testing.assert_allclose(found, truth, rtol=1e-10)
    if exact:
        np.testing.assert_allclose(truth, -1.739737, atol=1e-6)


# Dense replays.


def replay(process, auxiliary, L, noise, v, x0, ts, z):
    """log h̃(0, x0) + Σ G dt along Euler steps of b + a r̃, with G = (b − b̃)ᵀ r̃ − ½ tr[(a − ã)(H
    − r̃ r̃ᵀ)].

    `noise` None pins the end: a last step drawn given v, after G at its beginning.
    """
    B, beta, sigma_aux = auxiliary
    dim, T = x0.shape[1], ts[-1]

    def forecast(t, x):
        flow, shift, C = exact_affine(B, beta, sigma_aux, T - t)
        M = L @ C @ L.T + (0 if noise is None else noise)
        return L @ flow, L @ (flow @ x + shift), M

    def rate(t, x):
        operator, mean, M = forecast(t, x)
        H, r = operator.T @ np.linalg.solve(M, operator), operator.T @ np.linalg.solve(M, v - mean)
        b, a = process.drift(t, x), process.covariance(t, x)
        excess = a - sigma_aux @ sigma_aux.T
        second = dim * np.trace(excess @ H) - np.sum(r * (excess @ r))
        return b + a @ r, np.sum((b - B @ x - beta) * r) - 0.5 * second

    _, mean, M = forecast(ts[0], x0)
    x, log_weight, path = x0, log_normal(v, mean, M), [x0]
    for k, (s, t) in enumerate(itertools.pairwise(ts)):
        guided, G = rate(s, x)
        log_weight += (t - s) * G
        if noise is None and t == T:
            m, sigma = x + (t - s) * process.drift(s, x), np.sqrt(t - s) * process.diffusion(s, x)
            mu, _, root, _ = conditional(
                sigma, m, L, np.zeros_like(v), np.zeros((len(v), len(v))), v, exact=True
            )
            x = m + sigma @ (mu + root @ z[k])
        else:
            x = x + (t - s) * guided + np.sqrt(t - s) * process.diffusion(s, x) @ z[k]
        path.append(x)
    return np.stack(path), log_weight


PAIR = np.array([[1.0, 0.5, 0.0], [0.0, 1.0, -0.3]])
AUXILIARY = (np.array([-0.5, 0.1, -0.2]), np.array([0.5, 0.4, 0.6]), 0.2)


@pytest.mark.parametrize("name", ["user-square", "user-planar", "user-wide"])
def test_the_weight_of_a_path(name, key):
    """An inexact match of two rows and a wrong auxiliary: path and weight against the dense replay."""
    sde, process, x0 = SDES[name]()
    ts = np.array([0.1, 0.3, 0.7, 1.0])
    v = PAIR @ (np.array([0.6, -0.2, 0.4]) if x0.ndim == 1 else CURVE[::-1])
    B, sigma, beta = AUXILIARY
    guide = nb.FrozenGuide(nb.LinearSDE(B, sigma, beta))
    match = nb.InexactMatch(0.05, PAIR)
    bridge = nb.GuidedBridge(sde, match.at(v), x0=x0, ts=ts, guide=guide, solver=diffrax.Euler())
    z = np.asarray(jr.normal(key, bridge.noise_shape))
    path, log_weight = bridge.path_and_log_weight(z)
    auxiliary = np.diag(B), np.full(columns(x0).shape, beta), np.diag(sigma)
    truth, log_truth = replay(
        process, auxiliary, PAIR, 0.05 * np.eye(2), columns(v), columns(x0), ts, z
    )
    np.testing.assert_allclose(columns_of_path(path), truth, rtol=0, atol=1e-9)
    np.testing.assert_allclose(log_weight, log_truth, rtol=0, atol=1e-8)


@pytest.mark.parametrize("L", [np.eye(3), PAIR], ids=["whole", "operator"])
def test_the_weight_of_a_pinned_path(L, key):
    """An exact match, the auxiliary linearised at a state that meets it: the covariances agree
    there; the end is v.
    """
    sde, process, x0 = SDES["user-diagonal"]()
    ts, v = np.array([0.1, 0.3, 0.7, 1.0]), L @ np.array([0.6, -0.2, 0.4])
    match = nb.ExactMatch(None if len(L) == 3 else L)
    z = np.asarray(jr.normal(key, (3, 3, 1)))

    @jax.jit
    def run(z):
        bridge = nb.GuidedBridge(
            sde, match.at(v), x0=x0, ts=ts, guide=nb.FrozenGuide(), solver=diffrax.Euler()
        )
        return bridge.path_and_log_weight(z)

    path, log_weight = run(z)

    free = columns(x0)
    for s, t in itertools.pairwise(ts):
        free = free + (t - s) * process.drift(s, free)
    end = columns(v) if len(L) == 3 else free + np.linalg.pinv(L) @ (columns(v) - L @ free)
    B = jacobian(lambda y: process.drift(ts[-1], y), end)
    auxiliary = B, process.drift(ts[-1], end) - B @ end, process.diffusion(ts[-1], end)
    truth, log_truth = replay(process, auxiliary, L, None, columns(v), columns(X3), ts, z)
    np.testing.assert_allclose(columns_of_path(path), truth, rtol=0, atol=1e-9)
    np.testing.assert_allclose(log_weight, log_truth, rtol=0, atol=1e-8)
    np.testing.assert_allclose(L @ path[-1], v, rtol=0, atol=1e-12)


def test_milstein_steps(key):
    """dX = −X dt + σ(X) dW: x + b° dt + σ dW + ½ σ σ' (dW² − dt), with b° the guided drift."""
    sde = nb.SDE(lambda t, x, args: -x, lambda t, x, args: 0.5 + 0.2 * jnp.sin(x))
    ts = np.array([0.0, 0.4, 1.0])
    guide = nb.FrozenGuide(nb.LinearSDE(-0.7, 0.6))
    match = nb.InexactMatch(0.1).at([0.5])
    bridge = nb.GuidedBridge(sde, match, x0=[0.2], ts=ts, guide=guide, solver=diffrax.ItoMilstein())
    z, x, log_weight = np.asarray(jr.normal(key, (2, 1, 1))), 0.2, None
    for k, (s, t) in enumerate(itertools.pairwise(ts)):
        flow, variance = np.exp(-0.7 * (1 - s)), 0.36 * (1 - np.exp(-1.4 * (1 - s))) / 1.4 + 0.1
        if log_weight is None:
            log_weight = scipy.stats.norm.logpdf(0.5, flow * x, np.sqrt(variance))
        H, r, sigma, dt = (
            flow**2 / variance,
            flow * (0.5 - flow * x) / variance,
            0.5 + 0.2 * np.sin(x),
            t - s,
        )
        log_weight += dt * ((-x + 0.7 * x) * r - 0.5 * (sigma**2 - 0.36) * (H - r**2))
        dW = np.sqrt(dt) * z[k, 0, 0]
        x = x + dt * (-x + sigma**2 * r) + sigma * dW + 0.5 * sigma * 0.2 * np.cos(x) * (dW**2 - dt)
    path, found = bridge.path_and_log_weight(z)
    np.testing.assert_allclose(path[-1], [x], rtol=1e-10)
    np.testing.assert_allclose(found, log_weight, rtol=1e-10)


# The limit.


def geometric():
    """dX = 0.1 X dt + 0.4 X dW, 1 → 1.5 at T = 1."""
    sde = nb.SDE(lambda t, x, args: 0.1 * x, lambda t, x, args: 0.4 * x)
    return (
        sde,
        1.0,
        1.5,
        scipy.stats.norm.logpdf(np.log(1.5), 0.1 - 0.08, 0.4) - np.log(1.5),
        -0.872436,
    )


def radial(theta=4.0, x=1.5, y=1.0, t=1.0):
    """dX = (θ/X − X) dt + dW; the density of a radial Ornstein–Uhlenbeck process with a Bessel
    function.
    """
    sde = nb.SDE(lambda t, x, args: 4.0 / x - x, lambda t, x, args: 1.0)
    z = x * y / np.sinh(t)
    truth = (
        theta * np.log(y / x) + 0.5 * np.log(x * y) - y**2 + (theta + 0.5) * t - np.log(np.sinh(t))
    )
    truth += -(y**2 + x**2) / np.expm1(2 * t) + np.log(scipy.special.ive(theta - 0.5, z)) + z
    return sde, x, y, truth, -2.525135


def ornstein():
    """dX = −2X dt + dW, 1 → 1 at T = 1, led by another process."""
    truth = scipy.stats.norm.logpdf(1.0, np.exp(-2), np.sqrt((1 - np.exp(-4)) / 4))
    return nb.LinearSDE(-2.0, 1.0), 1.0, 1.0, truth, -1.739737


TO_THE_DATUM = nb.FrozenGuide(nb.LinearSDE(-2.0, 0.6, 3.0))
WRONG = nb.FrozenGuide(nb.LinearSDE(-1.5, 1.0, 0.3))
# name: SDE, guide, solver, paths
LIMITS = {
    "OU-Euler": (ornstein, WRONG, diffrax.Euler(), 20000),
    "OU-ShARK": (ornstein, WRONG, diffrax.ShARK(), 20000),
    # the heaviest tails: a(x) may exceed a(v)
    "geometric-Euler": (geometric, TO_THE_DATUM, diffrax.Euler(), 200000),
    "radial-Euler": (radial, nb.FrozenGuide(), diffrax.Euler(), 20000),
}


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, marks=pytest.mark.slow if case == "geometric-Euler" else ())
        for case in LIMITS
    ],
)
def test_the_evidence_tends_to_the_density(case):
    """An exact match: within 2 dt + 3 SE of the closed form at dt = 1/40 and at dt = 1/80, the SE
    below dt/2.

    One program for both: the shorter grid begins with steps of no length and no noise.
    """
    make, guide, solver, count = LIMITS[case]
    sde, x0, v, truth, published = make()
    np.testing.assert_allclose(truth, published, atol=1e-6)
    most = 80
    width = 2 if isinstance(solver, diffrax.ShARK) else 1

    @jax.jit
    def log_weights(ts, z):
        bridge = nb.GuidedBridge(
            sde, nb.ExactMatch().at([v]), x0=[x0], ts=ts, guide=guide, solver=solver
        )
        return jax.vmap(bridge.log_weight)(z)

    for K in (40, 80):
        s = np.linspace(0, 1, K + 1)
        ts = np.concatenate([1e-13 * np.arange(K - most, 0), s * (2 - s)])
        z = jr.normal(jr.key(K), (count, K, width, 1))
        w = np.exp(
            np.asarray(log_weights(ts, jnp.pad(z, ((0, 0), (most - K, 0), (0, 0), (0, 0))))) - truth
        )
        error = w.std() / np.sqrt(count)
        assert error < 1 / (2 * K)
        assert abs(w.mean() - 1) < 2 / K + 3 * error


def test_space_time_area_of_the_noise(key):
    """W = √dt z and H = √(dt/12) z', independent: cov(∫ W ds) of a step has the mean dt²/3 of
    Brownian motion.
    """
    ts = jnp.array([0.0, 0.3, 1.0])
    z = jr.normal(key, (2, 4, 1))
    found = NoisePath(ts, z, diffrax.SpaceTimeLevyArea).evaluate(ts[1], ts[2], use_levy=True)
    np.testing.assert_allclose(found.W, np.sqrt(0.7) * z[1, :2], rtol=1e-12)
    np.testing.assert_allclose(found.H, np.sqrt(0.7 / 12) * z[1, 2:], rtol=1e-12)
    # ∫ W = dt (W/2 + H)
    np.testing.assert_allclose(0.7**2 * (0.7 / 4 + 0.7 / 12), 0.7**3 / 3, rtol=1e-12)
    np.testing.assert_allclose(
        NoisePath(ts, z).evaluate(ts[0], ts[1]), np.sqrt(0.3) * z[0], rtol=1e-12
    )


# What is refused.

CURVED = nb.SDE(lambda t, x, args: -x, lambda t, x, args: 0.5 + 0.2 * jnp.sin(x))


def bridge(match, guide, solver=None, sde=CURVED):
    solver = diffrax.Euler() if solver is None else solver
    return nb.GuidedBridge(
        sde, match.at([0.5]), x0=[0.2], t1=1.0, num_steps=3, guide=guide, solver=solver
    )


@pytest.mark.parametrize("solver", STRATONOVICH)
def test_stratonovich_solvers_need_both_readings_to_coincide(solver):
    with pytest.raises(
        ValueError,
        match=f"`solver` must be an Itô solver.*got {solver}.*reading is another process",
    ):
        bridge(nb.InexactMatch(0.1), nb.FrozenGuide(), STRATONOVICH[solver])
    curve, v = CURVE, nb.InexactMatch(0.1).at(CURVE)
    space, kernel = nb.Landmarks(3, 2), nb.GaussianKernel(0.3, 0.7)
    settings = dict(
        x0=curve, t1=1.0, num_steps=3, guide=nb.FrozenGuide(), solver=STRATONOVICH[solver]
    )
    with pytest.raises(ValueError, match="`solver` must be an Itô solver"):
        nb.GuidedBridge(nb.KunitaFlow(space, kernel), v, **settings)
    nb.GuidedBridge(
        nb.KunitaFlow(space, kernel, noise=nb.SpectralNoise(1, period=6.0)), v, **settings
    )


def test_the_covariance_must_match_at_an_exact_end():
    """ã = a(v), as a scalar or a matrix alike; 1 % off is refused, unless the match is inexact or
    the step guided.
    """
    at_end = 0.5 + 0.2 * np.sin(0.5)
    for sigma in (at_end, [at_end], [[at_end]]):
        bridge(nb.ExactMatch(), nb.FrozenGuide(nb.LinearSDE(-1.0, sigma)))
    for sigma in (1.01 * at_end, [0.99 * at_end]):
        guide = nb.FrozenGuide(nb.LinearSDE(-1.0, sigma))
        with pytest.raises(
            ValueError,
            match=r"`auxiliary` must match.*L ã\(T\) Lᵀ = L a\(T, v\) Lᵀ.*differ by 0\.00",
        ):
            bridge(nb.ExactMatch(), guide)
        bridge(nb.InexactMatch(0.1), guide)
        nb.GuidedBridge(
            CURVED, nb.ExactMatch().at([0.5]), x0=[0.2], t1=1.0, num_steps=3, guide=guide
        )


def test_guides_without_one_auxiliary_process():
    with pytest.raises(ValueError, match="RecedingGuide has none. Use `guide=FrozenGuide"):
        bridge(nb.InexactMatch(0.1), nb.RecedingGuide())
    with pytest.raises(ValueError, match="RecedingGuide has none"):
        bridge(nb.InexactMatch(0.1), None)


# The guided step under diffrax's own loop.


def by_diffrax(terms, ts, start):
    """States after `start` and the log weight of the steps between `ts`."""
    solution = diffrax.diffeqsolve(
        terms, nb.GuidedStep(), ts[0], ts[-1], None, (start, jnp.zeros(())),
        stepsize_controller=diffrax.StepTo(ts), saveat=diffrax.SaveAt(ts=ts[1:]),
    )  # fmt: skip
    assert solution.ys is not None
    return solution.ys[0], solution.ys[1][-1]


@pytest.mark.parametrize(
    "name, exact", [("kunita-landmark", False), ("user-square", True), ("linear-matrix", False)]
)
def test_a_guided_bridge_is_what_diffrax_solves(name, exact, key):
    """The same path and log weight, but for the last step, which is onto what is observed."""
    sde, _, x0 = SDES[name]()
    ts = np.array([0.1, 0.3, 0.7, 1.0])
    match = nb.ExactMatch() if exact else nb.InexactMatch(0.05)
    bridge = nb.GuidedBridge(sde, match.at(0.5 - 0.3 * x0), x0=x0, ts=ts)
    z = jr.normal(key, bridge.noise_shape)
    terms, times, origins = bridge.guided_terms(z)
    states, log_weight = by_diffrax(terms, times, x0 - origins[0])
    frame, _, seen, _, elapsed = bridge.problem()
    noise = z[-1, :, 0] if x0.ndim == 1 else z[-1]
    end, log_density = arrive(frame.sde, seen, elapsed, states[-1], noise, terms.observed)

    path, total = bridge.path_and_log_weight(z)
    np.testing.assert_allclose(total, log_weight + log_density, rtol=1e-10)
    states = origins[1:] + jnp.concatenate([states, end[None]])
    np.testing.assert_allclose(path[1:], states, rtol=1e-10, atol=1e-12)


def test_a_branch_of_a_tree_is_what_diffrax_solves(key):
    """An inner branch of a flow's tree, from the root: all of its steps."""
    sde, _, x0 = SDES["kunita-landmark"]()
    tree = nb.Tree.from_newick("((a:0.4,b:0.6)x:0.5,c:1);")
    law = nb.DiffusionTree(sde, x0, nb.InexactMatch(0.05), tree=tree, num_steps=3)
    data = x0[None] + 0.2 * jr.normal(key, (3, *x0.shape))
    z = jr.normal(key, law.noise_prior().shape())
    problem = _problem(law.parts, data)
    up = problem.up()
    branch, plan, value = jax.tree.map(
        lambda a: a[0], (problem._of(problem.schedule.inner), up.plans, up.data)
    )
    ts = problem._grid(branch.length, False)
    terms = GuidedTerm.of(problem._edge(branch), plan, value, ts, z[:3])
    states, log_weight = by_diffrax(terms, ts, x0 - branch.anchor)
    np.testing.assert_allclose(
        law.given(z).path(data)[0, 1:], branch.anchor[None] + states, rtol=1e-10
    )
    np.testing.assert_allclose(law.given(z)._log_prob_by_block(data)[0], log_weight, rtol=1e-10)
