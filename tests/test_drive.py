"""The derivative by hand of the guided step's hot line, against finite differences."""

import jax.numpy as jnp
import jax.random as jr
from jax.test_util import check_grads

from numpyro_bridges.guiding._drive import drive


def test_derivative_of_the_drive(key):
    """In all five arguments, the covariances through factors so that they stay symmetric."""
    keys = jr.split(key, 5)
    shapes = (3, 4), (3, 3), (3, 3), (3, 2), (4, 2)
    arguments = [jr.normal(k, shape) for k, shape in zip(keys, shapes, strict=True)]

    def f(A, X, Y, r, z):
        return drive(A, X @ X.T + jnp.eye(3), Y @ Y.T + jnp.eye(3), r, z)

    check_grads(f, arguments, order=1, modes=["rev"], atol=1e-5, rtol=1e-5)
