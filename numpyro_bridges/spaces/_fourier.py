"""Curves as finite Fourier series, with coefficients in an orthonormal basis of L²(ds / 2π)."""

from math import sqrt
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from .._checks import floating, positive_integer, require, require_finite
from ._base import AbstractSpace, equispaced


def fourier_functions(s: ArrayLike, num_modes: int) -> Any:
    """1, √2 cos s, √2 sin s, √2 cos 2s, ... at s, (m, 2 num_modes + 1).

    In NumPy and double precision unless s is traced: single precision loses digits in cos ns for a large n.
    """
    converted = floating(s, "s")
    traced = isinstance(converted, Tracer)
    xp, s = (jnp, converted) if traced else (np, np.asarray(s, float))
    require(s.ndim == 1, f"`s` must be a vector of parameters; got shape {s.shape}.")
    require_finite(converted, "s")
    angles = s[:, None] * xp.arange(1, num_modes + 1, dtype=s.dtype)[None]
    waves = xp.stack([xp.cos(angles), xp.sin(angles)], axis=-1).reshape(s.size, 2 * num_modes)
    return xp.concatenate([xp.ones_like(s)[:, None], sqrt(2) * waves], axis=1)


class FourierBasis(AbstractSpace):
    """Closed curves of finite bandwidth: coefficients of 2 num_modes + 1 real functions in the order

        1, √2 cos s, √2 sin s, √2 cos 2s, √2 sin 2s, ..., √2 cos ms, √2 sin ms      (m = num_modes).

    They are orthonormal in L²(ds / 2π), so the H-norm is the Euclidean norm of the coefficients. Fields along
    the curve are evaluated at q equispaced points. With Φ the (q, n) values of the functions there, points
    are Φ x and the coefficients of a field f are Φᵀ W f, W = I / q, Φᵀ W Φ = I.

    **Arguments:**

    - `num_modes`: m, the highest frequency.
    - `dim`: dimension of the space in which the curve lies.
    - `num_quadrature`: q, at least 2m + 1. With the default max(4m, 32) the coefficients of a field that is
        quadratic in the curve are exact.
    """

    num_modes: int = eqx.field(static=True)
    dim: int = eqx.field(static=True)
    num_quadrature: int = eqx.field(static=True)

    def __init__(self, num_modes: int, dim: int, *, num_quadrature: int | None = None):
        self.num_modes = positive_integer(num_modes, "num_modes")
        self.dim = positive_integer(dim, "dim")
        if num_quadrature is None:
            num_quadrature = max(4 * self.num_modes, 32)
        self.num_quadrature = positive_integer(num_quadrature, "num_quadrature")
        require(
            self.num_quadrature >= self.size,
            f"`num_quadrature` must be at least 2 num_modes + 1 = {self.size}, or the functions are not "
            f"orthonormal on the grid; got {num_quadrature}.",
        )

    @property
    def size(self) -> int:
        return 2 * self.num_modes + 1

    @property
    def grid(self) -> np.ndarray:
        return equispaced(self.num_quadrature)

    @property
    def weights(self) -> Float[Array, " n"]:
        """Ones: the basis is orthonormal."""
        return jnp.ones(self.size)

    def basis(self, s: ArrayLike) -> Float[Array, "m n"]:
        return jnp.asarray(fourier_functions(s, self.num_modes))

    def to_points(self, x: Float[Array, "n dim"]) -> Float[Array, "q dim"]:
        return self.evaluate(x, self.grid)

    def from_points(self, values: Float[Array, "q ..."]) -> Float[Array, "n ..."]:
        """Φᵀ W f: exact for a field whose bandwidth and `num_modes` add up to less than `num_quadrature`."""
        values = self._field(values)
        projection = fourier_functions(self.grid, self.num_modes).T / self.num_quadrature
        return jnp.tensordot(jnp.asarray(projection, values.dtype), values, axes=1, precision="highest")
