"""Derivatives by hand in the guided step, against finite differences and plain solves."""

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from jax.test_util import check_grads

import numpyro_bridges as nb
from numpyro_bridges._linalg import half_square, solve_positive
from numpyro_bridges.guiding._drive import drive
from numpyro_bridges.guiding._few_noises import Errors, LowRank, NoiseSteering

pytestmark = pytest.mark.usefixtures("compile_quickly")


def test_derivative_of_the_drive(key):
    """In all five arguments, the covariances through factors so that they stay symmetric."""
    keys = jr.split(key, 5)
    shapes = (3, 4), (3, 3), (3, 3), (3, 2), (4, 2)
    arguments = [jr.normal(k, shape) for k, shape in zip(keys, shapes, strict=True)]

    def f(A, X, Y, r, z):
        return drive(A, X @ X.T + jnp.eye(3), Y @ Y.T + jnp.eye(3), r, z)

    check_grads(f, arguments, order=1, modes=["fwd", "rev"], atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("over", [3, 4])
def test_derivative_of_a_batch(key, over):
    """By what a batch shares: the sum of its examples' derivatives, log determinants that it shares
    included.
    """
    keys = jr.split(key, 6)
    shapes = (3, 4), (3, 3), (3, 3), (3, 2), (4, 2)
    A, X, Y, r, z = (jr.normal(k, shape) for k, shape in zip(keys, shapes, strict=False))
    several = jr.normal(keys[5], (5, *shapes[over]))

    def f(shared, one):
        u, log_det = drive(*shared, one, z) if over == 3 else drive(*shared, r, one)
        return jnp.sum(u**2) + log_det

    shared = A, X @ X.T + jnp.eye(3), Y @ Y.T + jnp.eye(3)
    found = jax.grad(lambda shared: jnp.sum(jax.vmap(f, (None, 0))(shared, several)))(shared)
    each = [jax.grad(f)(shared, one) for one in several]
    for gradient, *others in zip(found, *each, strict=True):
        np.testing.assert_allclose(gradient, sum(others), rtol=1e-9, atol=1e-10)


def positive(X):
    return X @ X.T + jnp.eye(len(X))


def dense(sd, F, end_scale, G, scale):
    return jnp.diag(sd**2) + end_scale * F @ F.T + scale * G @ G.T


def low_rank(sd, F, end_scale, G, scale):
    return LowRank(Errors.of(sd, F), end_scale, G, scale)


def steering(sd, F, end_scale, G, scale, step):
    return NoiseSteering(low_rank(sd, F, end_scale, G, scale), step, jnp.zeros((6, 2)))


# What is solved by factors that carry no derivative, and the same by a dense solve.
SOLUTIONS = {
    "positive": (lambda X, r: solve_positive(positive(X), r), "X r"),
    "positive, dense": (lambda X, r: jnp.linalg.solve(positive(X), r), "X r"),
    "square": (lambda X, r: half_square(positive(X), r), "X r"),
    "square, dense": (lambda X, r: 0.5 * jnp.sum(r * jnp.linalg.solve(positive(X), r)), "X r"),
    "low rank": (lambda *a: low_rank(*a[:-1]).solve(a[-1]), "sd F l G k v"),
    "low rank, dense": (lambda *a: jnp.linalg.solve(dense(*a[:-1]), a[-1]), "sd F l G k v"),
    "step": (lambda *a: steering(*a[:-1]).solve(a[-1]), "sd F l G k s v"),
    "step, dense": (
        lambda *a: jnp.linalg.solve(dense(*a[:4], a[4] + a[5] ** 2), a[6]),
        "sd F l G k s v",
    ),
    "information": (lambda *a: low_rank(*a).information(), "sd F l G k"),
    "information, dense": (
        lambda *a: a[3].T @ jnp.linalg.solve(dense(*a), a[3]),
        "sd F l G k",
    ),
}


@pytest.mark.parametrize("name", ["positive", "square", "low rank", "step", "information"])
def test_derivatives_of_solutions(key, name):
    """Values, gradients and second derivatives in all that the matrix is made of."""
    f, letters = SOLUTIONS[name]
    g, _ = SOLUTIONS[f"{name}, dense"]
    rng = np.random.default_rng(0)
    shapes = {"X": (3, 3), "r": (3, 2), "F": (6, 2), "G": (6, 2), "v": (6, 2), "sd": (6,)}
    shapes |= {"l": (), "k": (), "s": ()}
    values = {name: jnp.asarray(rng.normal(size=shape)) for name, shape in shapes.items()}
    values |= {name: jnp.abs(values[name]) + 0.5 for name in ("sd", "l", "k", "s")}
    arguments = tuple(values[letter] for letter in letters.split())
    direction = tuple(jnp.asarray(rng.normal(size=jnp.shape(a))) for a in arguments)

    def derivatives(f):
        def scalar(*a):
            return jnp.sum(jnp.sin(f(*a)))

        every = tuple(range(len(arguments)))
        slope = jax.grad(scalar, every)
        return f(*arguments), *jax.jvp(slope, arguments, direction)

    found, expected = jax.jit(lambda: (derivatives(f), derivatives(g)))()
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("noise", [nb.LandmarkNoise(), nb.ControlNoise(4)], ids=["all", "few"])
def test_every_product_keeps_its_digits(noise):
    """A GPU's default would round them; the rules above are traced apart from what they belong to."""
    x0 = np.stack([np.cos(np.arange(12.0)), np.sin(np.arange(12.0))], 1)

    def log_weight(amplitude, length_scale, z):
        kernel = nb.GaussianKernel(amplitude, length_scale)
        flow = nb.KunitaFlow(nb.Landmarks(12, 2), kernel, noise=noise)
        match = nb.InexactMatch(0.003).at(1.1 * x0)
        return nb.GuidedBridge(flow, match, x0=x0, t1=1.0, num_steps=3).log_weight(z)

    size = 12 if isinstance(noise, nb.LandmarkNoise) else 4
    gradient = jax.jit(jax.grad(log_weight, (0, 1, 2)))
    program = gradient.lower(0.3, 0.9, jnp.zeros((3, size, 2))).as_text()
    products = [line for line in program.splitlines() if "dot_general" in line]
    assert products and all("precision = [HIGHEST, HIGHEST]" in line for line in products)
