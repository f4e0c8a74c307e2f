"""Parameters and points of kernels: what is checked when they come in, and when they are used."""

from collections.abc import Callable
from functools import reduce

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._checks import as_float, floating, positive_integer, require, require_positive


def scalar(value: Array, name: str, dtype: jnp.dtype) -> Float[Array, ""]:
    """A parameter at the moment of its use, in the precision of the points.

    `jax.vmap` of a constructor returns a module whose parameters have a leading axis. Used without
    `vmap`, it would broadcast against the rows of a matrix and give a wrong number, so any axis is
    refused.
    """
    require(
        jnp.ndim(value) == 0,
        f"`{name}` must be a scalar; got an array of shape {jnp.shape(value)}. For a batch, "
        "`jax.vmap` the constructor, and with it the function that uses what it makes.",
    )
    return value.astype(dtype)


def positive_scalar(name: str) -> Callable[[ArrayLike], Float[Array, ""]]:
    """A field converter: a positive, finite scalar of the default float type, or traced."""

    # A closure, since equinox calls a converter with the value alone and an error says the name.
    def convert(value: ArrayLike) -> Float[Array, ""]:
        value = as_float(value, name)
        value = scalar(value, name, value.dtype)
        require_positive(
            value, name, "A prior on the positive half-line (`dist.LogNormal`) keeps it there."
        )
        return value

    return convert


def point(x: ArrayLike, name: str) -> Float[Array, " dim"]:
    """One point."""
    x = floating(x, name)
    require(
        x.ndim == 1,
        f"`{name}` must be of shape (dim,); got shape {x.shape}. Many points are for `matrix`, a "
        "batch for `jax.vmap`.",
    )
    return x


def points(x: ArrayLike, name: str) -> Float[Array, "n dim"]:
    """Points, one a row."""
    x = floating(x, name)
    require(
        x.ndim == 2,
        f"`{name}` must hold one point a row, (n, dim); got shape {x.shape}. For a batch, use "
        "`jax.vmap`.",
    )
    return x


def squared_distances(
    x: Float[Array, "n dim"], y: Float[Array, "m dim"], unit: Float[Array, ""]
) -> Float[Array, "n m"]:
    """|x_i - y_j|² in a unit of length, from differences: exactly 0 at coincident points, symmetric
    where x is y.
    """
    x = points(x, "x")
    y = points(y, "y")
    require(
        x.shape[1] == y.shape[1],
        f"`x` and `y` must hold points of one dimension; got shapes {x.shape} and {y.shape}.",
    )
    # Points are scaled, not squares: n divisions in place of n m, and as few for the slope in the
    # unit.
    x = x / unit.astype(x.dtype)
    y = y / unit.astype(y.dtype)
    # Not |x|² + |y|² − 2 x·y, whose cancellation may give near points a negative square.
    # One coordinate at a time: whole n × m arrays, and a derivative with none of shape (n, m, dim).
    return reduce(
        jnp.add, (jnp.square(a[:, None] - b[None, :]) for a, b in zip(x.T, y.T, strict=True))
    )


def squared_frequency(omega: Float[Array, "... dim"], dim: int) -> Float[Array, "..."]:
    """|ω|² of frequency vectors, the last axis being that of space."""
    dim = positive_integer(dim, "dim")
    omega = floating(omega, "omega")
    require(
        omega.ndim > 0 and omega.shape[-1] == dim,
        f"`omega` must hold frequency vectors of R^{dim}, (..., {dim}); got shape "
        f"{jnp.shape(omega)}.",
    )
    return jnp.sum(jnp.square(omega), axis=-1)
