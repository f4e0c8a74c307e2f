"""Guided bridges against a dense replay in NumPy: for every SDE, condition and guide, the path and

log weight = log p(path) + log p(v | x_K) − log q(path).
"""

import itertools
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import lineax as lx
import numpy as np
import pytest
from helpers import Condition, Guide, Problem, Process, check_bridge, columns, linear_process
from models import CONSTANT, CURVE, CURVED, SDES, X3, Q, R, W

import numpyro_bridges as nb
from numpyro_bridges.guiding._score import Standard

pytestmark = pytest.mark.usefixtures("compile_quickly")

TS = np.array([0.1, 0.3, 0.7, 1.0])


# Conditions.

EYE = np.eye(3)
PAIR = np.array([[1.0, 0.5, 0.0], [0.0, 1.0, -0.3]])
PICK = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
V = np.array([0.6, -0.2, 0.4])
S2, S3 = np.array([[0.3, 0.1], [0.1, 0.2]]), 0.3 * Q


def datum(L, dim):
    """A value of L x_T for states (3, dim) or (3,)."""
    v = L @ (V if dim is None else np.stack([V, 0.5 - V], 1))
    return v


def inexact(variance, noise, L=EYE, seen=None, scale=0.0, **kwargs):
    """`noise` is the covariance of the rows that are seen, L x; `seen` what the match is told."""

    def make(dim):
        v = datum(L, dim)
        match = nb.InexactMatch(variance, **kwargs)
        told = v if seen is None else seen(dim)
        log_scale = (
            scale * (1 if dim is None else dim) / 2 * np.linalg.slogdet(2 * np.pi * noise)[1]
        )
        return match.at(told), Condition(L, columns(v), noise, log_scale)

    return make


def exact(L=EYE, **kwargs):
    return lambda dim: (
        nb.ExactMatch(**kwargs).at(datum(L, dim)),
        Condition(L, columns(datum(L, dim))),
    )


def cylinder(lower, upper):
    def make(dim):
        low, high = (
            np.array(b) if dim is None else np.stack([b, np.array(b) + 0.1], 1)
            for b in (lower, upper)
        )
        rows = [i for i in range(len(low)) if np.any(np.isfinite(low[i]) | np.isfinite(high[i]))]
        truth = Condition(np.eye(3)[rows], bounds=(columns(low)[rows], columns(high)[rows]))
        return nb.CylinderSet(low, high), truth

    return make


def masked(dim):
    told = datum(np.eye(3), dim)
    told[1] = np.nan
    return told


MASK = np.array([True, False, True])
CONDITIONS = {
    "exact": exact(),
    "exact-operator": exact(PAIR, operator=PAIR),
    "exact-lineax": exact(PAIR, operator=lx.MatrixLinearOperator(jnp.asarray(PAIR))),
    "exact-mask": exact(np.eye(3)[MASK], mask=MASK),
    "inexact": inexact(0.05, 0.05 * np.eye(3)),
    "inexact-tiny": inexact(1e-7, 1e-7 * np.eye(3)),
    "inexact-diagonal": inexact(V**2, np.diag(V**2)),
    "inexact-matrix": inexact(S3, S3),
    "inexact-operator": inexact(0.05, 0.05 * np.eye(2), PAIR, operator=PAIR),
    "inexact-operator-matrix": inexact(S2, S2, PAIR, operator=PAIR),
    "inexact-mask": inexact(0.05, 0.05 * np.eye(2), np.eye(3)[MASK], masked, mask=MASK),
    "inexact-weights": inexact(0.05, np.diag(0.05 / W), space=nb.Landmarks(3, 2, weights=W)),
    "inexact-weights-picked": inexact(
        0.05, np.diag(0.05 / W[[2, 0]]), PICK, operator=PICK, space=nb.Landmarks(3, 2, weights=W)
    ),
    "inexact-weights-matrix": inexact(
        S3,
        S3 / np.sqrt(np.outer(W, W)),
        space=nb.Landmarks(3, 2, weights=W),
        normalised=False,
        scale=1.0,
    ),
    "inexact-kernel": inexact(
        0.05, 0.05 * np.eye(2), PAIR, operator=PAIR, normalised=False, scale=1.0
    ),
    "inexact-kernel-mask": inexact(
        0.05,
        np.diag(0.05 / W[MASK]),
        np.eye(3)[MASK],
        masked,
        mask=MASK,
        normalised=False,
        scale=1.0,
        space=nb.Landmarks(3, 2, weights=W),
    ),
    "cylinder": cylinder([-0.2, -np.inf, 0.1], [0.7, 0.3, np.inf]),
    "cylinder-pinned": cylinder([-0.2, 0.3], [0.7, 0.3]),
    "cylinder-gap": cylinder([-np.inf, -np.inf, 0.1], [0.7, np.inf, 0.2]),
}


# Guides.

AUX = (np.array([-0.5, 0.1, -0.2]), 0.6, 0.2)
GUIDES = {
    "frozen": (nb.FrozenGuide, Guide()),
    "auxiliary": (lambda: nb.FrozenGuide(nb.LinearSDE(*AUX)), AUX),
    "receding": (nb.RecedingGuide, Guide(receding=0.0)),
    "receding-mixed": (lambda: nb.RecedingGuide(end_weight=0.2), Guide(receding=0.2)),
    "geodesic": (nb.GeodesicGuide, Guide(receding=0.2, geodesic=0.75)),
    "drift": (lambda: nb.DriftGuide(nb.FrozenGuide()), Guide(euler=True)),
    "drift-receding": (lambda: nb.DriftGuide(nb.RecedingGuide()), Guide(euler=True, receding=0.0)),
    "unguided": (nb.scores.Unguided, Guide(unguided=True)),
    "learned": (lambda: learned(nb.RecedingGuide()), Guide(receding=0.0)),
    "learned-unguided": (lambda: learned(nb.scores.Unguided()), Guide(unguided=True)),
}


def learned(guide):
    """A network that is no good, told the time, the displacement, the target and a parameter."""
    standard = Standard(
        *(jnp.asarray(a) for a in (0.9, 0.8, 0.1, 0.7, np.array([0.2]), np.array([0.5])))
    )
    return nb.scores.ScoreGuide(guide, output, standard, lambda sde: jnp.array([0.7]))


def output(t, x, v, theta):
    return theta[0] * (0.6 * jnp.cos(x + 2 * t) - 0.4 * v) + 0.3 * x[::-1]


def network_score(sde, process):
    """The network's output in its units, from numbers alone."""
    weights = np.ones(3) if sde.space is None else np.asarray(sde.space.weights)
    pooled = isinstance(sde.space, nb.Landmarks)

    def score(t, x, v, ts):
        a = np.sum(weights * np.diag(process.covariance(ts[-1], v))) / np.sum(weights)
        shifted = v - (v.mean(0) if pooled else 0.1)
        said = output(1 - (ts[-1] - t) / 0.9, (x - v) / 0.8, shifted / 0.7, np.array([1.0]))
        return weights[:, None] * np.asarray(said) / np.sqrt(0.9 * a)

    return score


def problem(sde_name, condition_name, guide_name):
    sde, process, x0 = SDES[sde_name]()
    dim = None if x0.ndim == 1 else x0.shape[1]
    condition, truth = CONDITIONS[condition_name](dim)
    make, guide = GUIDES[guide_name]
    if guide is AUX:
        exact_steps = process.linear is not None
        guide = Guide(auxiliary=linear_process(*AUX, 3, columns(x0).shape[1], exact=exact_steps))
    if sde_name in CONSTANT or sde_name == "user-time":
        # the receding guide of a constant covariance is frozen
        guide = replace(guide, receding=None, geodesic=0.0)
    if guide_name.startswith("learned"):
        guide = replace(guide, learned=network_score(sde, process))
    bridge = nb.GuidedBridge(sde, condition, x0=x0, ts=TS, guide=make())
    return bridge, Problem(process, truth, guide, columns(x0), TS)


def rotate(names, *choices):
    """Each name with one of each list of choices, in turn: every pair of names and choices without
    their product.
    """
    return [
        (name, *(choice[i % len(choice)] for choice in choices)) for i, name in enumerate(names)
    ]


@pytest.mark.parametrize(
    "sde, condition, guide",
    rotate(
        CONSTANT,
        ["inexact", "exact", "inexact-mask", "exact-operator"],
        ["frozen", "auxiliary", "receding"],
    )
    + [("BM-matrix", "inexact-operator", "drift"), ("linear-hypoelliptic", "inexact", "learned")],
)
def test_constant_covariance(sde, condition, guide, key):
    check_bridge(
        *problem(sde, condition, guide), key, compiled=True, inverse=sde != "linear-matrix"
    )


def alternate(names, *choices):
    """Every pair; the quick run has the first of the choices for one name, the second for the next,
    and so on.
    """
    pairs = itertools.product(enumerate(names), enumerate(choices))
    marks = {True: (), False: pytest.mark.slow}
    return [
        pytest.param(name, c, marks=marks[i % len(choices) == j]) for (i, name), (j, c) in pairs
    ]


# Boxes and periods are small, so that the dense replay has few noises.
@pytest.mark.filterwarnings("ignore:`x0` does not fit the noise")
@pytest.mark.parametrize("sde, guide", alternate(CURVED, *GUIDES))
def test_curved_covariance(sde, guide, key):
    check_bridge(
        *problem(sde, "inexact-operator", guide),
        key,
        inverse=guide in ("receding", "drift-receding"),
    )


@pytest.mark.parametrize(
    "condition, guide", rotate([c for c in CONDITIONS if c != "cylinder-gap"], list(GUIDES))
)
def test_conditions(condition, guide, key):
    compiled = "cylinder" in condition
    check_bridge(
        *problem("user-square", condition, guide),
        key,
        compiled=compiled,
        inverse=condition != "cylinder",
    )


@pytest.mark.parametrize(
    "sde, condition",
    [("user-planar", "exact"), ("kunita-landmark", "inexact-weights-picked"), ("kunita-spectral", "exact-mask"),
     ("user-planar", "cylinder-gap")],
)  # fmt: skip
def test_planar_states(sde, condition, key):
    check_bridge(
        *problem(sde, condition, "receding"), key, compiled="cylinder" in condition, inverse=False
    )


def test_many_coordinates(key):
    """Beyond 16 rows the receding guide keeps the diagonal of the drift: less good, and no less
    right.
    """
    n = 17
    B = np.diag(np.full(n, -0.5)) + 0.4 * np.diag(np.ones(n - 1), 1)
    x0, v = np.linspace(-1, 1, n), np.linspace(1, 0, n)
    sde = nb.SDE(lambda t, x, args: jnp.asarray(B) @ x, lambda t, x, args: 0.4 + 0.1 * jnp.sin(x))
    process = Process(lambda t, x: B @ x, lambda t, x: np.diag(0.4 + 0.1 * np.sin(x[:, 0])))
    bridge = nb.GuidedBridge(
        sde, nb.InexactMatch(0.1).at(v), x0=x0, ts=TS, guide=nb.RecedingGuide()
    )
    truth = Condition(np.eye(n), columns(v), 0.1 * np.eye(n))
    check_bridge(
        bridge,
        Problem(process, truth, Guide(receding=0.0, dense=False), columns(x0), TS),
        key,
        inverse=False,
    )


# Noise, shapes, transformations.


def nonlinear(args, guide=None, match=None):
    sigma = lambda t, x, a: a["scale"] * (Q * (1 + 0.2 * jnp.cos(x))[:, None])  # noqa: E731
    sde = nb.SDE(lambda t, x, a: -a["rate"] * jnp.sin(x), sigma, args)
    match = nb.InexactMatch(0.05) if match is None else match
    return nb.GuidedBridge(sde, match.at(V), x0=X3, ts=TS, guide=guide)


ARGS = {"rate": 0.5, "scale": 1.4}


def test_the_part_of_the_noise_that_a_path_leaves_free_has_its_law():
    """Constant weights: (path forward, v given path) and then the noise is N(0, I), whatever the
    path leaves open.
    """
    wide = np.hstack([Q, R])
    sde = nb.SDE(lambda t, x, args: -0.5 * x, lambda t, x, args: wide)
    ts, count = np.array([0.0, 0.3, 1.0]), 4000
    for match in (nb.ExactMatch(PAIR), nb.InexactMatch(0.1, PAIR)):

        @jax.jit
        @jax.vmap
        def draw(key, match=match):
            key_path, key_seen, key_free = jr.split(key, 3)
            path = nb.simulate(sde, jnp.asarray(X3), ts, jr.normal(key_path, (2, 5, 1)))
            bridge = nb.GuidedBridge(
                sde, match.at(match.sample(key_seen, sde, path[-1])), x0=X3, ts=ts
            )
            return bridge.noise_from_path(path, key_free).ravel()

        z = np.asarray(draw(jr.split(jr.key(1), count)))
        se = 1 / np.sqrt(count)
        assert se < 0.02
        assert np.max(np.abs(z.mean(0))) < 4.5 * se
        assert np.max(np.abs(z.T @ z / count - np.eye(10))) < 4.5 * np.sqrt(2) * se


def test_noise_from_path_without_noise_of_its_own(key):
    """Rows of σ that vanish, and square matrices without full rank."""
    for sigma in (
        np.array([0.0, 0.5, 0.3]),
        np.diag([0.0, 0.5, 0.3]),
        np.outer([1.0, 2.0, 0.5], [0.0, 0.5, 0.3]),
    ):
        sde = nb.SDE(
            lambda t, x, args: -x[::-1],
            lambda t, x, args, sigma=sigma: sigma * (1 + 0.1 * jnp.sin(x[1])),
        )
        bridge = nb.GuidedBridge(sde, nb.InexactMatch(0.1).at(V), x0=X3, ts=TS)
        with jax.disable_jit():
            path = bridge.path(jr.normal(key, bridge.noise_shape))
            again = bridge.path(bridge.noise_from_path(path, key))
        np.testing.assert_allclose(again, path, rtol=0, atol=1e-9)


def test_an_sde_is_an_argument_of_jit_vmap_and_grad():
    """Values and gradients with respect to parameters inside the SDE, the match and the guide,
    against differences.
    """
    z = jr.normal(jr.key(0), (3, 3, 1))

    def log_weight(sde, match, guide):
        return nb.GuidedBridge(sde, match.at(V), x0=X3, ts=TS, guide=guide).log_weight(z)

    sde, match, guide = nonlinear(ARGS).sde, nb.InexactMatch(0.05), nb.RecedingGuide(0.3)
    value, gradient = jax.jit(jax.value_and_grad(log_weight, argnums=(0, 1, 2)))(sde, match, guide)
    np.testing.assert_allclose(value, log_weight(sde, match, guide), rtol=1e-12)

    def shifted(h):
        return log_weight(
            nonlinear(ARGS | {"rate": 0.5 + h[0]}).sde,
            nb.InexactMatch(0.05 + h[1]),
            nb.RecedingGuide(0.3 + h[2]),
        )

    steps = np.diag([1e-5, 1e-6, 1e-5])
    high, low = jax.jit(jax.vmap(shifted))(
        jnp.asarray(np.stack([steps, -steps]).reshape(6, 3))
    ).reshape(2, 3)
    differences = (high - low) / (2 * steps.sum(0))
    np.testing.assert_allclose(gradient[0].args["rate"], differences[0], rtol=1e-6)
    np.testing.assert_allclose(gradient[1].variance, differences[1], rtol=1e-6)
    np.testing.assert_allclose(gradient[2].end_weight, differences[2], rtol=1e-6)
    np.testing.assert_allclose(eqx.filter_jit(log_weight)(sde, match, guide), value, rtol=1e-12)


def test_default_guide_and_grid():
    constant, curved = SDES["linear-scalar"]()[0], SDES["user-diagonal"]()[0]
    bridge = nb.GuidedBridge(
        constant, nb.InexactMatch(0.1).at(V), x0=X3, t0=0.5, t1=2.5, num_steps=4
    )
    assert isinstance(bridge.guide, nb.FrozenGuide) and bridge.num_steps == 4
    np.testing.assert_allclose(bridge.ts, [0.5, 1.0, 1.5, 2.0, 2.5])
    bridge = nb.GuidedBridge(
        curved, nb.ExactMatch().at(V), x0=X3, t0=0.5, t1=2.5, num_steps=np.int64(4)
    )
    assert isinstance(bridge.guide, nb.RecedingGuide) and bridge.noise_shape == (4, 3, 1)
    s = np.linspace(0, 1, 5)
    np.testing.assert_allclose(bridge.ts, 0.5 + 2 * s * (2 - s))
    flow, _, x0 = SDES["kunita-landmark"]()
    assert isinstance(
        nb.GuidedBridge(flow, nb.InexactMatch(0.1).at(x0), x0=x0, ts=TS).guide, nb.GeodesicGuide
    )
    other = bridge.with_guide(nb.FrozenGuide())
    assert isinstance(other.guide, nb.FrozenGuide) and np.array_equal(other.ts, bridge.ts)


def test_single_precision():
    """A Kunita flow of 32 landmarks, point SD 0.006: within 0.05 nats of double precision, at the
    same jitter.
    """
    n = 32
    s = 2 * np.pi * np.arange(n) / n
    x0 = np.stack([np.cos(s), np.sin(s)], 1)
    v = np.stack([1.1 * np.cos(s) + 0.1, 0.9 * np.sin(s) + 0.05 * np.cos(2 * s)], 1)
    z = np.random.default_rng(0).normal(size=(10, n, 2))

    def value_and_gradient(dtype, jitter=1e-5):
        def log_weight(theta, z):
            noise = nb.LandmarkNoise(jitter)
            flow = nb.KunitaFlow(
                nb.Landmarks(n, 2), nb.GaussianKernel(theta[0], theta[1]), noise=noise
            )
            condition = nb.InexactMatch(1e-6).at(v)
            return nb.GuidedBridge(flow, condition, x0=x0, t1=1.0, num_steps=10).log_weight(z)

        return jax.jit(jax.value_and_grad(log_weight))(
            jnp.asarray([0.3, 0.6], dtype), jnp.asarray(z, dtype)
        )

    double, double_gradient = value_and_gradient(float)
    with jax.enable_x64(False):
        single, single_gradient = value_and_gradient(jnp.float32)
        default = value_and_gradient(jnp.float32, None)[0]
    assert single.dtype == jnp.float32 and single == default
    np.testing.assert_allclose(single, double, atol=0.05)
    np.testing.assert_allclose(single_gradient, double_gradient, rtol=0.02)


MATRIX = np.array([[-1.0, 0.2, 0.0], [0.0, -0.5, 0.0], [0.1, 0.0, -0.3]])
FLOW = nb.Landmarks(3, 2)
SOME = nb.ExactMatch(mask=[True, False, True])
AROUND = nb.CylinderSet([0.9, -np.inf, 0.5], [1.1, np.inf, 3.0])
DEGENERATE = {
    "scalar": (lambda c: nb.LinearSDE(-0.5, c), nb.ExactMatch().at(V), X3),
    "one component": (
        lambda c: nb.LinearSDE(-0.5, jnp.stack([1.0, c, 1.0])),
        nb.ExactMatch().at(V),
        X3,
    ),
    "some rows": (lambda c: nb.LinearSDE(MATRIX, c * EYE), SOME.at(V[:2]), X3),
    "set": (lambda c: nb.LinearSDE(MATRIX, c * EYE), AROUND, X3),
    "landmarks": (
        lambda c: nb.KunitaFlow(FLOW, nb.GaussianKernel(c, 0.5)),
        nb.ExactMatch().at(datum(EYE, 2)),
        CURVE,
    ),
    "waves": (
        lambda c: nb.KunitaFlow(FLOW, nb.GaussianKernel(c, 0.5), noise=nb.SpectralNoise(2)),
        nb.ExactMatch().at(datum(EYE, 2)),
        CURVE,
    ),
}


@pytest.mark.parametrize("name", DEGENERATE)
def test_a_datum_that_no_path_reaches(name):
    """Where a parameter takes the noise away, the weight is that of an impossible datum, and
    gradients stay finite.
    """
    make, condition, x0 = DEGENERATE[name]

    def weigh(c):
        bridge = nb.GuidedBridge(make(c), condition, x0=x0, t1=1.0, num_steps=3)
        path, log_weight = bridge.path_and_log_weight(jnp.ones(bridge.noise_shape))
        return log_weight, path

    (log_weight, path), slope = jax.jit(jax.value_and_grad(weigh, has_aux=True))(0.0)
    assert log_weight == -np.inf and np.isfinite(slope) and np.isfinite(path).all()


def test_a_datum_that_is_met_without_noise():
    """It has no density: a weight that is visibly no number."""

    @jax.jit
    def weigh(c):
        bridge = nb.GuidedBridge(
            nb.LinearSDE(0.0, c), nb.ExactMatch().at(V), x0=V, t1=1.0, num_steps=3
        )
        return bridge.log_weight(jnp.ones(bridge.noise_shape))

    assert np.isnan(weigh(0.0)) and np.isfinite(weigh(1.0))
