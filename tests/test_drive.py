"""The derivative by hand of the guided step's hot line, against finite differences."""

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from jax.test_util import check_grads

from numpyro_bridges.guiding._drive import drive

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
