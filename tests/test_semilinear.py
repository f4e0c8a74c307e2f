"""Semilinear equations: steps against dense matrices, evidence against quadrature, resolution,
guides along a path.
"""

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
import scipy.integrate
import scipy.linalg
import scipy.stats
from numpyro.infer.util import log_density

import numpyro_bridges as nb
from numpyro_bridges._linalg import promote
from numpyro_bridges.guiding import Standard
from numpyro_bridges.spaces import CosineBasis, FourierBasis, FourierSquare, SineBasis
from tests.helpers import as_matrix, exact_affine

pytestmark = pytest.mark.usefixtures("compile_quickly")

RNG = np.random.default_rng(5)
MATRIX = RNG.normal(size=(4, 4)) - 2 * np.eye(4)
DIAGONAL = -np.array([0.0, 0.3, 4.0, 400.0])
LINEAR = {"scalar": -0.7, "diagonal": DIAGONAL, "matrix": MATRIX}
DIFFUSION = {
    "scalar": 0.4,
    "diagonal": np.array([0.1, 0.5, 1.0, 2.0]),
    "tall": RNG.normal(size=(4, 2)),
}


def bend(t, x, args):
    return jnp.sin(2 * x) - 0.3 * x**3


@pytest.mark.parametrize("diffusion", DIFFUSION)
@pytest.mark.parametrize("linear", LINEAR)
def test_a_step_is_that_of_the_process_with_what_is_not_linear_held(linear, diffusion, dt=0.3):
    A, sigma = LINEAR[linear], DIFFUSION[diffusion]

    def grown(t, x, args):
        return args * (1 + x[0, 0] ** 2)

    sde = nb.SemilinearSDE(A, bend, grown, jnp.asarray(sigma))
    x = RNG.normal(size=(4, 2))
    step = sde.transition(0.0, dt, jnp.asarray(x))
    held = np.sin(2 * x) - 0.3 * x**3
    a = np.asarray(sigma, float) * (1 + x[0, 0] ** 2)
    a = as_matrix(a, 4) if a.ndim < 2 else a
    flow, shift, covariance = exact_affine(A, held, a, dt, nodes=200)
    np.testing.assert_allclose(step.mean, flow @ x + shift, rtol=1e-10)
    factor = np.asarray(promote(step.factor, 2, 4))
    np.testing.assert_allclose(factor @ factor.T, covariance, atol=1e-9 * covariance.max())
    np.testing.assert_allclose(
        promote(step.covariance, 2, 4), covariance, atol=1e-9 * covariance.max()
    )
    assert sde.noise_size(jnp.asarray(x)) == factor.shape[1]


def test_without_a_nonlinearity_it_is_the_linear_process(key):
    x0, v = RNG.normal(size=(2, 4))
    linear = nb.LinearSDE(DIAGONAL, DIFFUSION["diagonal"])
    semilinear = nb.SemilinearSDE(DIAGONAL, lambda t, x, args: 0 * x, DIFFUSION["diagonal"])
    for match in (nb.InexactMatch(0.1), nb.ExactMatch()):
        bridges = [
            nb.GuidedBridge(sde, match.at(v), x0=x0, t1=1.0, num_steps=5)
            for sde in (linear, semilinear)
        ]
        z = jr.normal(key, bridges[0].noise_shape)
        for found, expected in zip(
            *(b.path_and_log_weight(z) for b in reversed(bridges)), strict=True
        ):
            np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("linear", LINEAR)
@pytest.mark.parametrize("rounds", [0, 2])
def test_a_linear_pull_has_one_weight(linear, rounds, key, K=6):
    """The process linearised is the process: the weight is the density of the scheme's dense
    Gaussian chain.
    """
    A, slope, shift = LINEAR[linear], RNG.normal(size=(4, 4)), RNG.normal(size=4)
    x0, v = RNG.normal(size=(2, 4))
    sde = nb.SemilinearSDE(
        A, lambda t, x, args: args[0] @ x + args[1], 0.5, (jnp.asarray(slope), jnp.asarray(shift))
    )
    match = nb.InexactMatch(0.2)
    bridge = nb.GuidedBridge(
        sde, match.at(v), x0=x0, t1=0.9, num_steps=K, guide=nb.FrozenGuide(rounds=rounds)
    )
    mean, covariance = x0, np.zeros((4, 4))
    eye = np.eye(4)
    for _ in range(K):
        flow, _, noise = exact_affine(A, np.zeros((4, 1)), 0.5 * eye, 0.9 / K, nodes=200)
        held = exact_affine(A, eye, 0.5 * eye, 0.9 / K, nodes=200)[1]
        operator = flow + held @ slope
        mean = operator @ mean + held @ shift
        covariance = operator @ covariance @ operator.T + noise
    expected = scipy.stats.multivariate_normal(mean, covariance + 0.2 * eye).logpdf(v)
    weights = jax.vmap(bridge.log_weight)(jr.normal(key, (3, *bridge.noise_shape)))
    np.testing.assert_allclose(weights, expected, rtol=1e-8)


def chapman_kolmogorov(step_law, grid, x0, times, observe):
    """log of the integral of the scheme's own densities on a grid; `observe(k, x)`: log density of
    what is seen.
    """
    h = grid[1] - grid[0]
    density = None
    for k, (s, t) in enumerate(zip(times[:-1], times[1:], strict=True)):
        start = np.array([x0]) if density is None else grid
        mean, sd = step_law(s, t, start)
        kernel = np.exp(-0.5 * ((grid[:, None] - mean) / sd) ** 2) / (np.sqrt(2 * np.pi) * sd)
        density = kernel[:, 0] if density is None else h * kernel @ density
        density = density * np.exp(observe(k + 1, grid))
    return np.log(h * np.sum(density))


def seen(v, variance, at):
    def observe(k, x):
        if k not in at:
            return np.zeros_like(x)
        return -0.5 * (v[at.index(k)] - x) ** 2 / variance - 0.5 * np.log(2 * np.pi * variance)

    return observe


A1, K1, VARIANCE = -3.0, 8, 0.05


def pulled(t, x, args):
    return 2.0 * jnp.sin(2 * x) + 1.0


def rough(t, x, args):
    return 0.5 + 0.3 * jnp.cos(x)


def one_step(diffusion):
    def law(s, t, x):
        phi = np.expm1(A1 * (t - s)) / A1
        mean = np.exp(A1 * (t - s)) * x + phi * (2.0 * np.sin(2 * x) + 1.0)
        variance = np.expm1(2 * A1 * (t - s)) / (2 * A1)
        return mean, np.sqrt(variance) * diffusion(x)

    return law


CONSTANT, VARYING = (lambda x: 0.6 + 0 * x), (lambda x: 0.5 + 0.3 * np.cos(x))


@pytest.mark.parametrize(
    "diffusion, guide",
    [
        (CONSTANT, None),
        (CONSTANT, nb.RecedingGuide(rounds=1)),
        (VARYING, None),
        (VARYING, nb.DriftGuide(nb.FrozenGuide(rounds=3))),
    ],
)
def test_evidence_is_that_of_quadrature(diffusion, guide):
    times = np.linspace(0, 1, K1 + 1)
    law = one_step(diffusion)
    expected = chapman_kolmogorov(
        law, np.linspace(-4, 5, 4001), -0.5, times, seen([1.3], VARIANCE, [K1])
    )
    sde = nb.SemilinearSDE(A1, pulled, 0.6 if diffusion is CONSTANT else rough)
    condition = nb.InexactMatch(VARIANCE).at([1.3])
    bridge = nb.GuidedBridge(sde, condition, x0=[-0.5], t1=1.0, num_steps=K1, guide=guide)
    found = nb.estimate_evidence(bridge, jr.key(0), 20_000)
    assert found.trusted and found.standard_error < 0.03
    assert abs(found.log_evidence - expected) < 4 * found.standard_error


def test_one_step_has_the_closed_form():
    sde = nb.SemilinearSDE(-1.0, lambda t, x, args: jnp.sin(x), 0.5)
    bridge = nb.GuidedBridge(sde, nb.InexactMatch(0.1).at([0.3]), x0=[0.1], t1=0.5, num_steps=1)
    mean = np.exp(-0.5) * 0.1 - np.expm1(-0.5) * np.sin(0.1)
    variance = -0.25 * np.expm1(-1.0) / 2 + 0.1
    expected = -0.5 * (0.3 - mean) ** 2 / variance - 0.5 * np.log(2 * np.pi * variance)
    np.testing.assert_allclose(
        bridge.log_weight(np.zeros(bridge.noise_shape)), expected, rtol=1e-12
    )


def test_one_step_by_the_midpoint_has_the_closed_form():
    sde = nb.SemilinearSDE(-1.0, lambda t, x, args: jnp.sin(x), 0.5, scheme="midpoint")
    bridge = nb.GuidedBridge(sde, nb.InexactMatch(0.1).at([0.3]), x0=[0.1], t1=0.5, num_steps=1)
    half = np.exp(-0.25) * 0.1 - np.expm1(-0.25) * np.sin(0.1)
    mean = np.exp(-0.5) * 0.1 - np.expm1(-0.5) * np.sin(half)
    variance = -0.25 * np.expm1(-1.0) / 2 * np.exp(0.5 * np.cos(half)) + 0.1
    expected = -0.5 * (0.3 - mean) ** 2 / variance - 0.5 * np.log(2 * np.pi * variance)
    np.testing.assert_allclose(
        bridge.log_weight(np.zeros(bridge.noise_shape)), expected, rtol=1e-12
    )


@pytest.mark.parametrize(
    "A", [-1.0, [-1.0, -3.0], [[-1.0, 0.6], [-0.2, -3.0]]], ids=["scalar", "diagonal", "matrix"]
)
def test_order_of_the_schemes(A):
    """Mean and covariance at t = 1 of dX = (A X + S X) dt + σ dW, against the exact law: halving
    steps, 1/2 and 1/4.
    """
    A, S, sigma = np.array(A), np.array([0.7, -0.4]), np.array([0.5, 0.8])
    x0, one = np.array([1.0, -0.5]), np.eye(2)
    whole = (A if A.ndim == 2 else A * one) + np.diag(S)
    mean = scipy.linalg.expm(whole) @ x0
    spread = [scipy.linalg.expm(whole * u) @ np.diag(sigma) for u in np.linspace(0, 1, 2001)]
    covariance = scipy.integrate.simpson([s @ s.T for s in spread], dx=1 / 2000, axis=0)

    def errors(scheme, K):
        sde = nb.SemilinearSDE(A, lambda t, x, args: jnp.asarray(S) * x, sigma, scheme=scheme)
        x, P = jnp.asarray(x0), jnp.zeros((2, 2))
        step = jax.jit(lambda x: sde.transition(0.0, 1 / K, x))
        slope = jax.jacfwd(lambda x: step(x).mean)(x)
        for _ in range(K):
            law = step(x)
            own = law.covariance if law.covariance.ndim == 2 else jnp.diag(law.covariance)
            x, P = law.mean, slope @ P @ slope.T + own
        return np.max(np.abs(x - mean)), np.max(np.abs(P - covariance))

    euler = np.divide(errors("euler", 8), errors("euler", 16))
    midpoint = np.divide(errors("midpoint", 8), errors("midpoint", 16))
    assert np.all((1.7 < euler) & (euler < 2.4)), euler
    assert np.all((3.3 < midpoint) & (midpoint < 4.8)), midpoint


def test_a_scheme_without_a_nonlinearity_is_exact():
    linear = nb.LinearSDE([-0.5, -2.0], 0.4)
    step = linear.transition(0.0, 0.7, jnp.ones(2))
    sde = nb.SemilinearSDE([-0.5, -2.0], lambda t, x, args: 0 * x, 0.4, scheme="midpoint")
    found = sde.transition(0.0, 0.7, jnp.ones(2))
    np.testing.assert_allclose(found.mean, step.mean, rtol=1e-13)
    np.testing.assert_allclose(found.covariance, step.covariance, rtol=1e-13)


def test_a_chain_of_observations_is_that_of_quadrature():
    """Two times; each branch has its own steps, and the first is led by what is seen later."""
    v, lengths, K = [0.4, 1.3], [0.5, 0.7], 4
    times = np.concatenate([np.linspace(0, 0.5, K + 1), 0.5 + np.linspace(0, 0.7, K + 1)[1:]])
    law = one_step(CONSTANT)
    expected = chapman_kolmogorov(
        law, np.linspace(-4, 5, 4001), -0.5, times, seen(v, VARIANCE, [K, 2 * K])
    )
    sde = nb.SemilinearSDE(A1, pulled, 0.6)
    tree = nb.Tree.from_parents(
        [-1, 0, 1], [0.0, *lengths], names=["start", "first", "second"], observed=[1, 2]
    )
    law = nb.DiffusionTree(sde, [-0.5], nb.InexactMatch(VARIANCE), tree=tree, num_steps=K)
    value = jnp.asarray(v)[:, None]
    noise = jr.normal(jr.key(1), (20_000, *law.noise_prior().shape()))
    weights = jax.jit(jax.vmap(lambda z: law.given(z).log_prob(value)))(noise)
    standard_error = nb.weights.standard_error(weights)
    assert (
        standard_error < 0.03
        and abs(nb.weights.log_mean_exp(weights) - expected) < 4 * standard_error
    )


def allen_cahn(num_modes, num_steps, **settings):
    space = FourierBasis(num_modes, 1)
    spectrum = 0.04 * (1 - space.laplacian) ** -2.0

    def reaction(t, x, args):
        u = space.to_points(x)
        return space.from_points(u - u**3)

    sde = nb.SemilinearSDE(0.1 * space.laplacian, reaction, jnp.sqrt(spectrum), space=space)
    s = space.grid
    x0, v = space.from_points(0.5 * np.cos(s)), space.from_points(0.3 + 0.8 * np.sin(s))
    condition = nb.InexactMatch(0.01, normalised=False).at(v)
    return nb.GuidedBridge(sde, condition, x0=x0, t1=1.0, num_steps=num_steps, **settings)


def test_resolution_changes_no_path_and_no_weight():
    """The same noise of the modes that are shared, 67 and 129 functions: what the others add is of
    the size of q.
    """
    z = jr.normal(jr.key(0), (20, 129, 1))
    coarse, fine = (allen_cahn(m, 20).path_and_log_weight(z[:, : 2 * m + 1]) for m in (33, 64))
    np.testing.assert_allclose(coarse[0], fine[0][:, :67], atol=1e-4)
    np.testing.assert_allclose(coarse[1], fine[1], atol=1e-2)


def test_a_path_makes_a_better_linearisation_than_the_end():
    by_rounds = [allen_cahn(4, 20, guide=nb.FrozenGuide(rounds=r)) for r in (0, 2)]
    end, path = (nb.estimate_evidence(b, jr.key(3), 1000) for b in by_rounds)
    assert path.ess > 5 * end.ess and path.log_weights.std() < 0.6
    assert type(allen_cahn(4, 20).guide) is nb.FrozenGuide and allen_cahn(4, 20).guide.rounds == 2


def test_scores_at_one_time_are_those_along_the_path(key):
    """`log_h` and `score` linearise along the path of the bridge's start, whatever the state that
    they are asked of.
    """
    bridge = allen_cahn(4, 6)
    path = bridge.path(jr.normal(key, bridge.noise_shape))
    expected = bridge.scores(path)
    for k in (0, 3, 5):
        np.testing.assert_allclose(bridge.score(bridge.ts[k], path[k]), expected[k], rtol=1e-9)


def test_a_learned_guide_stands_on_the_same_path(key):
    bridge = allen_cahn(4, 6)
    standard = Standard(*(jnp.asarray(a) for a in (1.0, 1.0, 0.0, 1.0, np.zeros(0), np.zeros(0))))
    learned = bridge.with_guide(nb.ScoreGuide(bridge.guide, lambda t, x, v, theta: 0 * x, standard))
    z = jr.normal(key, bridge.noise_shape)
    np.testing.assert_allclose(learned.log_weight(z), bridge.log_weight(z), rtol=1e-10)


def test_noise_is_recovered_and_weights_are_differentiated(key):
    bridge = allen_cahn(3, 5)
    z = jr.normal(key, bridge.noise_shape)
    np.testing.assert_allclose(bridge.noise_from_path(bridge.path(z), key), z, atol=1e-8)
    direction = jr.normal(jr.key(1), z.shape)
    slope = jnp.vdot(jax.grad(bridge.log_weight)(z), direction)
    ends = [bridge.log_weight(z + h * direction) for h in (1e-5, -1e-5)]
    np.testing.assert_allclose(slope, (ends[0] - ends[1]) / 2e-5, rtol=1e-5)


def test_stiff_equations_are_stable_in_single_precision(key):
    def results(dtype, z):
        space = FourierBasis(40, 1)
        sde = nb.SemilinearSDE(100.0 * space.laplacian, bend, 0.3, space=space)
        x0 = np.ones((space.size, 1), dtype)
        bridge = nb.GuidedBridge(
            sde, nb.InexactMatch(0.1).at(0.1 * x0), x0=x0, t1=1.0, num_steps=10
        )
        return bridge.path_and_log_weight(jnp.asarray(z, dtype))

    z = np.asarray(jr.normal(key, (10, 81, 1)))
    path, log_weight = results(np.float64, z)
    with jax.enable_x64(False):
        single_path, single_weight = results(np.float32, z)
    assert single_path.dtype == jnp.float32 and jnp.max(jnp.abs(path[1:])) < 5
    np.testing.assert_allclose(single_path, path, atol=2e-5)
    np.testing.assert_allclose(single_weight, log_weight, rtol=2e-5)


def test_priors_on_everything_in_both_precisions():
    """Generator, pull, noise, error and start, inside a model under jit: float32 within 2e-3 of the
    largest slope.
    """
    space = CosineBasis(3, 1)
    datum = np.array([0.3, -0.2, 0.1, 0.05])

    def everything(datum):
        def reaction(t, x, rate):
            u = space.to_points(x)
            return space.from_points(rate * (u - u**3))

        def drawn(name, shape=()):
            return numpyro.sample(
                name, dist.LogNormal(-1.0, 0.3).expand(shape).to_event(len(shape))
            )

        linear = drawn("diffusivity") * space.laplacian
        sde = nb.SemilinearSDE(
            linear, reaction, drawn("diffusion", (4,)), drawn("rate"), space=space
        )
        match = nb.InexactMatch(drawn("variance"))
        nb.sample(
            "field",
            nb.DiffusionEndpoint(sde, drawn("start", (4,)), match, t1=0.5, num_steps=3),
            obs=datum,
        )

    values = {
        "diffusivity": 0.1,
        "diffusion": np.full(4, 0.4),
        "rate": 0.7,
        "variance": 0.05,
        "start": 0.2 + datum**2,
    }
    values |= {"field_noise": np.random.default_rng(0).normal(size=(3, 4, 1))}

    def value_and_gradient(dtype):
        sites = {name: jnp.asarray(value, dtype) for name, value in values.items()}
        density = lambda sites: log_density(everything, (datum.astype(dtype),), {}, sites)[0]  # noqa: E731
        return jax.jit(jax.value_and_grad(density))(sites)

    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        double, slopes = value_and_gradient(np.float64)
        with jax.enable_x64(False):
            single, single_slopes = value_and_gradient(np.float32)
    assert single.dtype == np.float32 and abs(float(single) - float(double)) < 2e-3
    for name in values:
        largest = np.max(np.abs(np.asarray(slopes[name])))
        assert largest > 0
        found, expected = np.asarray(single_slopes[name]), np.asarray(slopes[name])
        np.testing.assert_allclose(found, expected, rtol=0, atol=2e-3 * largest, err_msg=name)


BASES = [
    FourierBasis(5, 1),
    SineBasis(6, 1, length=2.0),
    CosineBasis(6, 1, length=0.5),
    FourierSquare(2, 1),
]


def name(space):
    return type(space).__name__


@pytest.mark.parametrize("space", BASES, ids=name)
def test_a_basis_is_orthonormal_and_diagonalises_the_laplacian(space):
    phi = np.asarray(space.basis(space.grid))
    np.testing.assert_allclose(phi.T @ phi / len(phi), np.eye(space.size), atol=1e-12)
    x = jnp.asarray(RNG.normal(size=space.size))
    points = space.to_points(x)
    np.testing.assert_allclose(points, phi @ x, atol=1e-12)
    np.testing.assert_allclose(space.from_points(points), x, atol=1e-12)
    np.testing.assert_allclose(space.project(points, space.grid), x, atol=1e-10)
    np.testing.assert_allclose(space.project(points), x, atol=1e-10)
    np.testing.assert_allclose(space.norm(x[:, None]), np.linalg.norm(x), rtol=1e-12)

    def value(s):
        return space.evaluate(x, s[None])[0]

    for s in jnp.asarray(space.grid[[1, 3]]):
        laplacian = jnp.trace(jnp.atleast_2d(jax.hessian(value)(s)))
        np.testing.assert_allclose(
            laplacian, space.evaluate(space.laplacian * x, s[None])[0], rtol=1e-8
        )


def test_boundary_conditions():
    x = jnp.asarray(RNG.normal(size=6))
    sines, cosines = SineBasis(6, 1, length=3.0), CosineBasis(5, 1, length=3.0)
    np.testing.assert_allclose(sines.evaluate(x, [0.0, 3.0]), 0, atol=1e-12)
    slope = jax.vmap(jax.grad(lambda s: cosines.evaluate(x, s[None])[0]))(jnp.array([0.0, 3.0]))
    np.testing.assert_allclose(slope, 0, atol=1e-10)


@pytest.mark.parametrize(
    "space", [SineBasis(5, 1), CosineBasis(5, 1), FourierBasis(5, 1, num_quadrature=21)], ids=name
)
def test_cubic_fields_have_exact_coefficients(space):
    fine = type(space)(5, 1, num_quadrature=301)
    x = jnp.asarray(RNG.normal(size=space.size))
    found, expected = (s.from_points(s.to_points(x) ** 3) for s in (space, fine))
    np.testing.assert_allclose(found, expected, atol=1e-11)


@pytest.mark.parametrize(
    "make, message",
    [
        (
            lambda: nb.SemilinearSDE(np.ones((3, 2)), bend, 1.0),
            r"`linear` must be .* square matrix .* \(3, 2\)",
        ),
        (lambda: nb.SemilinearSDE([1.0, np.nan], bend, 1.0), "`linear` must be finite"),
        (
            lambda: nb.SemilinearSDE(-1.0, 2.0, 1.0),
            r"`nonlinearity` must be a function f\(t, x, args\).*got 2.0",
        ),
        (
            lambda: nb.SemilinearSDE(-1.0, lambda x: x, 1.0),
            "`nonlinearity` must be .* of three arguments",
        ),
        (lambda: nb.SemilinearSDE(-1.0, bend, [np.inf]), "`diffusion` must be finite"),
        (
            lambda: _bridge(nb.SemilinearSDE([-1.0, -2.0], bend, 1.0)),
            r"`linear` must be .* diagonal \(3,\).*\(2,\)",
        ),
        (
            lambda: _bridge(nb.SemilinearSDE(-np.eye(4), bend, 1.0)),
            "does not diagonalise, is Φᵀ A Φ / q for coeff",
        ),
        (
            lambda: _bridge(nb.SemilinearSDE(-1.0, lambda t, x, a: x[:2], 1.0)),
            r"`nonlinearity` must return .*\(2,\)",
        ),
        (
            lambda: _bridge(nb.SemilinearSDE(-1.0, bend, [1.0, 2.0])),
            r"`diffusion` must be .*got \(2,\)",
        ),
        (lambda: nb.FrozenGuide(rounds=-1), "`rounds` must be an integer, at least 0; got -1"),
        (
            lambda: nb.FrozenGuide(nb.BrownianMotion(1.0), rounds=1),
            "`rounds` linearise .* `auxiliary` is linear",
        ),
        (lambda: SineBasis(0, 1), "`num_modes` must be a positive integer"),
        (lambda: SineBasis(3, 1, length=0.0), "`length` must be a positive number; got 0.0"),
        (
            lambda: CosineBasis(3, 1, num_quadrature=3),
            r"`num_quadrature` must be at least num_modes \+ 1 = 4.*got 3",
        ),
        (
            lambda: FourierSquare(1, 1).project(np.ones(10)),
            "`s` must be given, .*no square grid; got 10 points",
        ),
        (
            lambda: FourierSquare(1, 1).basis(np.ones(9)),
            r"`s` must be parameters \(m, 2\).*got shape \(9,\)",
        ),
    ],
)
def test_what_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def _bridge(sde):
    return nb.GuidedBridge(
        sde, nb.InexactMatch(1.0).at(np.zeros(3)), x0=np.zeros(3), t1=1.0, num_steps=2
    )
