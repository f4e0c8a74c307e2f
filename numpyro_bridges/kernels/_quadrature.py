"""The covariance of a flow by quadrature over a grid, for kernels without a closed convolution."""

from collections.abc import Sequence
from math import prod
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from .._checks import (
    as_float,
    concrete,
    positive_integer,
    require,
    require_finite,
    require_instance,
    words,
)
from ._base import AbstractKernel


class QuadratureCovariance(AbstractKernel):
    """a(x, x') = ∫ k(x, y) k(x', y) dy, the midpoint rule on a box of equal cells.

    For a smooth kernel the error is negligible once cells are half a length scale wide and the box
    reaches several length scales beyond the points; what lies outside the box is lost, so a(x, x)
    falls towards its border. A matrix costs (n + m) · cells kernel values.

    **Arguments:**

    - `kernel`: k.
    - `lower`, `upper`: corners of the box, (dim,).
    - `num_cells`: cells per axis, an integer or one for each axis.
    """

    kernel: AbstractKernel
    lower: Float[Array, " dim"]
    upper: Float[Array, " dim"]
    num_cells: tuple[int, ...] = eqx.field(static=True)

    def __init__(
        self,
        kernel: AbstractKernel,
        lower: ArrayLike,
        upper: ArrayLike,
        num_cells: int | Sequence[int],
    ):
        require_instance(
            kernel,
            AbstractKernel,
            "kernel",
            "a kernel, such as `MaternKernel(amplitude, length_scale)`",
        )
        self.kernel = kernel
        self.lower = as_float(lower, "lower")
        self.upper = as_float(upper, "upper")
        shape = self.lower.shape
        require(
            len(shape) == 1 and shape[0] > 0 and self.upper.shape == shape,
            "`lower` and `upper` must be corners of a box, two arrays of shape (dim,); got shapes "
            f"{shape} and {self.upper.shape}.",
        )
        require_finite(self.lower, "lower")
        require_finite(self.upper, "upper")
        low = concrete(self.lower)
        high = concrete(self.upper)
        if low is not None and high is not None and not np.all(low < high):
            raise ValueError(f"`lower` must lie below `upper` on every axis; got {low} and {high}.")
        # A sequence or an array is one number for each axis; `positive_integer` judges the rest.
        cells: Any = num_cells
        several = isinstance(cells, Sequence) or getattr(cells, "ndim", 0) > 0
        per_axis = list(cells) if several else [cells] * shape[0]
        require(
            len(per_axis) == shape[0],
            f"`num_cells` must be a positive integer, or one for each of {shape[0]} axes; got "
            f"{words(num_cells)}.",
        )
        self.num_cells = tuple(positive_integer(number, "num_cells") for number in per_axis)

    @property
    def cell_volume(self) -> Float[Array, ""]:
        """Volume of one cell."""
        return jnp.prod(self.upper - self.lower) / prod(self.num_cells)

    @property
    def centres(self) -> Float[Array, "cells dim"]:
        """Midpoints of the cells."""
        # Asked again: `jax.vmap` of the constructor gives corners an axis more.
        require(
            self.lower.ndim == 1,
            f"`lower` must be of shape (dim,); got {self.lower.shape}. For a batch, use "
            "`jax.vmap`.",
        )
        dtype = self.lower.dtype
        axes = [(jnp.arange(c, dtype=dtype) + 0.5) / c for c in self.num_cells]
        unit = jnp.stack([g.ravel() for g in jnp.meshgrid(*axes, indexing="ij")], axis=-1)
        return self.lower[None] + (self.upper - self.lower)[None] * unit

    def matrix(self, x: Float[Array, "n dim"], y: Float[Array, "m dim"]) -> Float[Array, "n m"]:
        # Positive semi-definite to the last digit where x is y: a product with its transpose.
        left = self._factor(x)
        right = self._factor(y)
        return jnp.matmul(left, right.T, precision="highest")

    def _factor(self, x: Float[Array, "n dim"]) -> Float[Array, "n cells"]:
        """k(x_i, y) √Δy."""
        # in the precision of the points, whatever that of the box
        values = self.kernel.matrix(x, self.centres.astype(jnp.asarray(x).dtype))
        return values * jnp.sqrt(self.cell_volume).astype(values.dtype)

    @property
    def variance(self) -> Float[Array, ""]:
        """a(x, x) in the middle of the box."""
        # It falls towards the border; this is what the kernel without a box has everywhere.
        middle = (self.lower + self.upper) / 2
        return self(middle, middle)

    def convolved_with(self, other: AbstractKernel, dim: int) -> AbstractKernel:
        raise ValueError(
            "a `QuadratureCovariance` is a covariance: it is passed as `covariance=`, not as a "
            "kernel."
        )

    def spectral_density(self, omega: Float[Array, "... dim"], dim: int) -> Float[Array, "..."]:
        raise ValueError(
            "a `QuadratureCovariance` is not stationary and has no spectral density; without the "
            "box it is the square of the kernel's, `kernel.spectral_density(omega, dim) ** 2`."
        )
