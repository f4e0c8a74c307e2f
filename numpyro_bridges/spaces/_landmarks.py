"""Curves, or plain configurations, as points."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._checks import as_float, positive_integer, require, require_positive
from ._base import AbstractSpace, equispaced
from ._basis import fourier_functions


class Landmarks(AbstractSpace):
    """n points x_i in R^dim with quadrature weights w_i; row i of a state is the point x_i.

    As a closed curve, x_i is its point at s_i = 2π i / n, and between the points it is the
    trigonometric interpolant: the curve of least bandwidth through them, exact if all frequencies
    of the curve are below n/2 (for an even n the frequency n/2 is a cosine). For points that are no
    curve everything has its meaning but `evaluate`, `project` and `refine`.

    **Arguments:**

    - `num_points`: n.
    - `dim`: dimension of the space in which the points lie.
    - `weights`: w, a positive scalar or one for each point. With the default 1/n the curve has unit
      mass, and its H-norm does not depend on n; with `1.0` variances are per landmark.
    """

    num_points: int = eqx.field(static=True)
    dim: int = eqx.field(static=True)
    weights: Float[Array, " n"]

    def __init__(self, num_points: int, dim: int, weights: ArrayLike | None = None):
        self.num_points = positive_integer(num_points, "num_points")
        self.dim = positive_integer(dim, "dim")
        w = as_float(1.0 / self.num_points if weights is None else weights, "weights")
        require(
            w.shape in ((), (self.num_points,)),
            f"`weights` must be a scalar or of shape ({self.num_points},), one for each point; got "
            f"shape {w.shape}.",
        )
        require_positive(w, "weights", "A point that is not seen is left out by the condition.")
        # a strong dtype: `jit` keys on it
        self.weights = jnp.broadcast_to(w.astype(w.dtype), (self.num_points,))

    @property
    def size(self) -> int:
        return self.num_points

    @property
    def grid(self) -> np.ndarray:
        return self.parameters(self.num_points)

    def parameters(self, count: int) -> np.ndarray:
        return equispaced(count)

    def basis(self, s: ArrayLike) -> Float[Array, "m n"]:
        """Column i is the trigonometric interpolant of 1 at s_i and 0 at the other points."""
        # The points' Fourier coefficients, evaluated at s; both are constants if s is known.
        num_modes = self.num_points // 2
        coefficients = fourier_functions(self.grid, num_modes).T / self.num_points
        # on the grid √2 cos(ns/2) has squared norm 2, and the sine vanishes
        if self.num_points % 2 == 0:
            coefficients[-2:] *= [[0.5], [0.0]]
        functions = fourier_functions(s, num_modes)
        return jnp.asarray(functions @ coefficients.astype(functions.dtype))

    def to_points(self, x: Float[Array, "n dim"]) -> Float[Array, "n dim"]:
        """The state itself."""
        return self._state(x)

    def from_points(self, values: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
        """The values themselves."""
        return self._field(values)
