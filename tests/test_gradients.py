"""Derivatives, at ordinary and at special values of the parameters."""

import inspect

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from jax.flatten_util import ravel_pytree

import numpyro_bridges as nb
from numpyro_bridges._linalg import safe_sqrt
from numpyro_bridges.guiding._score import Standard
from numpyro_bridges.sdes._exponential import _phi1
from numpyro_bridges.sdes._noise import AbstractNoise

pytestmark = pytest.mark.usefixtures("compile_quickly")


def slope(f):
    """f′, elementwise."""
    return lambda x: jax.jvp(f, (x,), (jnp.ones_like(x),))[1]


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("order", range(4))
def test_phi_of_every_order(order, dtype):
    """φ₁⁽ʲ⁾(x) = ∫₀¹ sʲ e^{sx} ds by quadrature, through 0 and through the seam at 1."""
    x = np.array(
        [
            -30.0,
            -3.0,
            -1.001,
            -1.0,
            -0.999,
            -0.1,
            -1e-6,
            -1e-20,
            0,
            1e-9,
            1e-3,
            0.5,
            0.999,
            1.0,
            1.001,
            9.0,
        ]
    )
    f = _phi1
    for _ in range(order):
        f = slope(f)
    found = jax.jit(f)(jnp.asarray(x, dtype))
    exactly = {"epsabs": 0, "epsrel": 1e-13}
    integrals = [
        scipy.integrate.quad(lambda s, y=y: s**order * np.exp(s * y), 0, 1, **exactly) for y in x
    ]
    truth = [value for value, _ in integrals]
    np.testing.assert_allclose(found, truth, rtol=1000 * np.finfo(dtype).eps)


def test_a_root_at_zero():
    """Its derivative there is that of |y|, the mean of both sides; below 0 it is NaN, as it should
    be.
    """
    assert jax.grad(safe_sqrt)(0.0) == 0 and jax.jvp(safe_sqrt, (0.0,), (1.0,)) == (0, 0)
    assert jax.grad(lambda y: safe_sqrt(y * y))(0.0) == 0
    np.testing.assert_allclose(jax.grad(safe_sqrt)(2.0), 0.5 / np.sqrt(2), rtol=1e-15)
    assert np.isnan(safe_sqrt(jnp.asarray(-1.0)))


TRIANGLE = np.array([[1.0, 0.1], [-0.4, 0.9], [-0.6, -0.8]])
COINCIDENT = np.array([[1.0], [1.0], [-0.6]])
B = np.array([[-1.0, 0.3], [0.2, -0.5]])
"""Parameters of the cases: arrays, in which every entry is differentiated."""


def linear(p):
    return nb.LinearSDE(p["drift"], p["diffusion"], p.get("shift", 0.3))


def user(p):
    return nb.SDE(
        lambda t, x, a: a[0] * x,
        lambda t, x, a: a[1] * (1 + 0.1 * x**2),
        (p["drift"], p["diffusion"]),
    )


def clocked(p):
    return nb.SDE(lambda t, x, a: a * t * x, lambda t, x, a: 0.6 + 0.1 * jnp.cos(t + x), p["drift"])


def flow(p):
    return nb.KunitaFlow(nb.Landmarks(3, 2), nb.GaussianKernel(p["amplitude"], p["length_scale"]))


def jittered(p):
    space, noise = nb.Landmarks(3, 2, weights=p["weights"]), nb.LandmarkNoise(p["jitter"])
    return nb.KunitaFlow(space, covariance=nb.GaussianKernel(p["amplitude"], 0.8), noise=noise)


def controls(p):
    kernel = nb.GaussianKernel(p["amplitude"], p["length_scale"])
    return nb.KunitaFlow(nb.Landmarks(3, 2), kernel, noise=nb.ControlNoise(points=[1]))


def semilinear(space):
    """Of a space whose basis has two or three functions."""

    def made(p):
        def pulled(t, x, rate):
            u = space.to_points(x)
            return space.from_points(rate * (u - u**3))

        linear = p["diffusivity"] * space.laplacian
        return nb.SemilinearSDE(linear, pulled, p["diffusion"], p["rate"], space=space)

    return made


def along_a_path(p):
    return nb.RecedingGuide(rounds=2)


def spectral(p):
    kernel = nb.GaussianKernel(p["amplitude"], p["length_scale"])
    return nb.KunitaFlow(nb.Landmarks(3, 1), kernel, noise=nb.SpectralNoise(20, p["period"]))


def grid(p):
    kernel = nb.MaternKernel(p["amplitude"], p["length_scale"])
    return nb.KunitaFlow(nb.FourierBasis(1, 1), kernel, noise=nb.GridNoise(p["lower"], 5.0, 24))


def sum_of_kernels(p):
    rough = p["factor"] * nb.MaternKernel(p["amplitude"], 0.7, order=1)
    return nb.KunitaFlow(
        nb.Landmarks(3, 2), covariance=rough + nb.GaussianKernel(0.2, p["length_scale"])
    )


def quadrature(p):
    kernel = nb.MaternKernel(p["amplitude"], p["length_scale"], order=2)
    covariance = nb.kernels.QuadratureCovariance(kernel, [p["lower"]], [4.0], 20)
    return nb.KunitaFlow(nb.Landmarks(3, 1), covariance=covariance)


def on_the_grid(p):
    kernel = nb.MaternKernel(p["amplitude"], 0.8, order=1)
    return nb.KunitaFlow(nb.Landmarks(3, 1), kernel, noise=nb.GridNoise(p["lower"], 4.0, 20))


def learned(p):
    one, none = jnp.ones(()), jnp.zeros(0)
    base = nb.DriftGuide(nb.FrozenGuide())
    standard = Standard(one, one, 0 * one, one, none, none)
    return nb.ScoreGuide(base, lambda t, x, v, theta: p["network"] * jnp.tanh(x) * v, standard)


def inexact(p):
    return nb.InexactMatch(p["variance"], p.get("operator")).at(p["observed"])


PLAIN = {"x0": np.array([0.3, -0.2]), "observed": np.array([1.0, 0.5]), "t1": 1.2, "variance": 0.1}
SHAPES = {"x0": TRIANGLE, "observed": 1.1 * TRIANGLE, "t1": 1.2, "variance": 0.1, "amplitude": 0.4}
PAIR = {"x0": COINCIDENT, "observed": COINCIDENT}
MATRIX = np.array([[1.0, 0.2], [0.2, 0.6]])
FEW = {name: PLAIN[name] for name in ("x0", "observed", "t1")}
RATE = {"drift": 0.0, "diffusion": 0.7}
STILL = {"observed": TRIANGLE, "length_scale": 0.9}
JITTER = {"weights": np.ones(3), "jitter": 0.0}


def no_guide(p):
    return None


def unguided(p):
    return nb.Unguided()


def receding(p):
    return nb.RecedingGuide(p["end_weight"])


def geodesic(p):
    return nb.GeodesicGuide(p["correction"], p["end_weight"])


def exact(p):
    return nb.ExactMatch().at(p["observed"])


def bins(p):
    return nb.IntervalCensored(p["cuts"]).at(np.array([0.0, 1.0]))


def pinned(p):
    return nb.CylinderSet(jnp.stack([p["pin"], p["lower"]]), jnp.stack([p["pin"], p["upper"]]))


def quartic(p):
    def log_density(x, observed, args):
        square = jnp.sum((x - observed) ** 2)
        return -square / args - square**2

    return nb.DensityMatch(log_density, p["args"]).at(p["observed"])


def student(p):
    return nb.StudentMatch(p["variance"], p["degrees"]).at(p["observed"])


def huber(p):
    return nb.HuberMatch(p["variance"], p["threshold"]).at(p["observed"])


def procrustes(p):
    return nb.ProcrustesMatch(p["variance"]).at(p["observed"])


def current(p):
    return nb.CurrentMatch(p["variance"], p["width"]).at(p["observed"])


def varifold(p):
    return nb.VarifoldMatch(p["variance"], p["width"], p["angle"]).at(p["observed"])


def brownian(p):
    return nb.BrownianMotion(p["Q"])


DIAGONAL = {"drift": np.array([0.0, -1.0]), "diffusion": np.array([0.7, 0.0])}
OPPOSITE = {"drift": np.array([1.0, -1.0]), "diffusion": MATRIX}
CUTS = {"cuts": np.array([0.1, 0.9])}
FAR = {"length_scale": 14.0, "amplitude": 0.05}
WIDE = {"length_scale": 0.9, "period": 9.5}
CURVE = {"x0": 0.4 * TRIANGLE[:, :1], "observed": 0.4 * TRIANGLE[:, 1:]}
BOX = {"length_scale": 0.5, "lower": -4.0}
MIXED = {"factor": 0.5, "length_scale": 0.9, "end_weight": 0.2}
# two of them are midpoints of cells
CELLS = {"x0": np.array([[0.2], [1.0], [-0.6]]), "lower": -4.0}
MEETING = {"x0": np.array([[0.2], [0.2], [-0.6]]), "lower": -4.0}
CLOCK = {"x0": PLAIN["x0"], "observed": PLAIN["observed"], "variance": 0.1, "drift": -0.5}
FIELD = {"diffusivity": 0.2, "diffusion": 0.4, "rate": 0.7}
SQUARE = {
    "x0": np.linspace(-0.1, 0.2, 81),
    "observed": 0.1 * np.cos(np.arange(81)),
    "t1": 1.2,
    "variance": 0.1,
}
PIN = {"x0": PLAIN["x0"], "t1": 1.2, "pin": 0.4, "lower": -0.2, "upper": 0.5}
RANK_ONE = {"drift": B, "diffusion": B[:, 1:], "operator": np.array([[1.0, 0.5], [0.0, 1.0]])}

OUTLINE = {
    "x0": TRIANGLE,
    "observed": np.array([[1.0, 0.1], [0.2, 1.2], [-0.7, -0.6]]),
    "t1": 1.2,
    "variance": 0.1,
}

CASES = {
    "no rate": (linear, inexact, no_guide, PLAIN | RATE | {"shift": np.array([1.0, 0.2])}),
    "no rate, no noise": (linear, inexact, no_guide, PLAIN | DIAGONAL),
    "opposite rates": (linear, inexact, no_guide, PLAIN | OPPOSITE),
    "no matrix of rates": (
        linear,
        inexact,
        no_guide,
        PLAIN | {"drift": np.zeros((2, 2)), "diffusion": MATRIX},
    ),
    "rank one": (linear, inexact, no_guide, PLAIN | RANK_ONE),
    "learned": (user, inexact, learned, PLAIN | DIAGONAL | {"network": 0.3}),
    "semilinear": (semilinear(nb.CosineBasis(1, 1)), inexact, no_guide, PLAIN | FIELD),
    "semilinear, along a path": (
        semilinear(nb.SineBasis(2, 1)),
        inexact,
        along_a_path,
        PLAIN | FIELD,
    ),
    "semilinear, diagonal": (semilinear(nb.FourierSquare(4, 1)), inexact, no_guide, FIELD | SQUARE),
    "covariance": (brownian, inexact, no_guide, PLAIN | {"Q": MATRIX, "variance": 0.1 * MATRIX}),
    "exact": (linear, exact, unguided, FEW | RATE),
    "pinned": (linear, pinned, no_guide, PIN | RATE),
    "density": (linear, quartic, no_guide, FEW | RATE | {"args": 0.4}),
    "student": (linear, student, no_guide, PLAIN | RATE | {"degrees": 4.0}),
    "huber": (linear, huber, no_guide, PLAIN | RATE | {"threshold": 1.0}),
    "procrustes": (linear, procrustes, no_guide, OUTLINE | RATE),
    "current": (linear, current, no_guide, OUTLINE | RATE | {"width": 0.9}),
    "varifold": (linear, varifold, no_guide, OUTLINE | RATE | {"width": 0.9, "angle": 1.0}),
    "times": (clocked, inexact, no_guide, CLOCK | {"ts": np.array([0.4, 1.0, 1.3])}),
    "interval": (clocked, inexact, no_guide, CLOCK | {"t0": 0.4, "t1": 1.3}),
    "bins": (linear, bins, no_guide, FEW | RATE | CUTS),
    "geodesic": (
        flow,
        inexact,
        geodesic,
        SHAPES | {"length_scale": 0.9, "end_weight": 0.1, "correction": 0.75},
    ),
    "geodesic, straight": (
        flow,
        inexact,
        geodesic,
        SHAPES | STILL | {"end_weight": 0.0, "correction": 1.0},
    ),
    "flow": (flow, inexact, receding, SHAPES | {"length_scale": 0.9, "end_weight": 0.0}),
    "controls": (
        controls,
        inexact,
        geodesic,
        SHAPES | FAR | {"end_weight": 0.0, "correction": 0.75},
    ),
    "no jitter": (jittered, inexact, receding, SHAPES | JITTER | {"end_weight": 1.0}),
    "sum of kernels": (sum_of_kernels, inexact, receding, SHAPES | MIXED),
    "quadrature": (quadrature, inexact, no_guide, SHAPES | CURVE | CELLS | {"length_scale": 0.8}),
    "on the grid, coincident": (on_the_grid, inexact, no_guide, SHAPES | CURVE | MEETING),
    "underflow": (spectral, inexact, no_guide, SHAPES | PAIR | WIDE),
    "basis": (grid, inexact, no_guide, SHAPES | CURVE | BOX),
}
"""What is built: an SDE, a condition, a guide; and the parameters."""


def bridge_of(name, p):
    sde, condition, guide, _ = CASES[name]
    times = {name: p[name] for name in ("t0", "t1", "ts") if name in p}
    num_steps = None if "ts" in p else 2
    return nb.GuidedBridge(
        sde(p), condition(p), x0=p["x0"], num_steps=num_steps, guide=guide(p), **times
    )


def test_every_public_class_has_a_case():
    """What can be a part of a bridge is a part of one of the cases."""
    kinds = (
        nb.AbstractSDE,
        nb.AbstractSpace,
        nb.AbstractKernel,
        nb.AbstractMatch,
        nb.AbstractCondition,
        nb.AbstractGuide,
        AbstractNoise,
    )
    public = {c for c in vars(nb).values() if inspect.isclass(c) and issubclass(c, kinds)}
    public = {c for c in public if not inspect.isabstract(c)}
    used = {nb.IntervalCensored}  # a set, once it has its datum

    def visit(part):
        used.add(type(part))
        for name in vars(part) if isinstance(part, eqx.Module) else ():
            visit(getattr(part, name))

    for name, (*_, p) in CASES.items():
        visit(bridge_of(name, p))
    assert public <= used


@pytest.mark.parametrize("name", CASES)
def test_gradient_of_a_log_weight(name):
    """By every parameter, both modes, against central differences, and in single precision.

    The differences have an error of 1e-9 here; 1e-5 of each entry is asked for, in single precision
    2e-3 of the largest.
    """
    bridge = bridge_of(name, CASES[name][3])
    noise = np.random.default_rng(3).normal(size=bridge.noise_shape)

    def problem(dtype):
        p = jax.tree.map(lambda a: jnp.asarray(a, dtype), CASES[name][3])
        flat, unravel = ravel_pytree(p)
        z = jnp.asarray(noise, dtype)
        return flat, lambda flat: bridge_of(name, unravel(flat)).log_weight(z)

    flat, log_weight = problem(float)
    one, none = np.eye(flat.size), np.zeros((flat.size, flat.size))
    points = np.asarray(flat)[None] + 1e-5 * np.concatenate([none, one, -one])
    directions = np.concatenate([one, none, none])

    @jax.jit
    def derivatives(flat, points, directions):
        along = jax.vmap(lambda x, dx: jax.jvp(log_weight, (x,), (dx,)))
        return jax.grad(log_weight)(flat), *along(points, directions)

    reverse, values, slopes = derivatives(flat, points, directions)
    _, plus, minus = np.split(np.asarray(values), 3)
    forward, *_ = np.split(np.asarray(slopes), 3)
    size = np.max(np.abs(reverse))
    np.testing.assert_allclose(reverse, (plus - minus) / 2e-5, rtol=1e-5, atol=1e-7 * size)
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-9 * size)
    with jax.enable_x64(False):
        flat, log_weight = problem(np.float32)
        single = jax.jit(jax.grad(log_weight))(flat)
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, reverse, rtol=0, atol=2e-3 * size)
