"""What a space is: finitely many functions on a domain, and a norm that compares curves and fields.

A function s ↦ x(s) in R^dim, such as a closed curve with s in [0, 2π), is held as a state of n rows
x_i in R^dim,

    x(s) = Σ_i φ_i(s) x_i,    ‖x‖² = Σ_i w_i |x_i|² ≈ ∫ |x(s)|² ds / ∫ ds      (the H-norm).
"""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._checks import floating, require, require_finite, require_instance
from .._linalg import as_columns, rows, safe_sqrt


class AbstractSpace(eqx.Module):
    """Functions with values in R^dim, discretised. All is written for one state, (size, dim).

    A state of values in R may be a vector, (size,), and then so are its points. Here are functions
    on [0, 1) that are constant on n equal cells:

        class Cells(AbstractSpace):
            num_cells: int = eqx.field(static=True)
            dim: int = eqx.field(static=True)

            @property
            def size(self):
                return self.num_cells

            @property
            def weights(self):
                return jnp.full(self.num_cells, 1 / self.num_cells)

            @property
            def grid(self):
                return self.parameters(self.num_cells)

            def parameters(self, count):
                return (np.arange(count) + 0.5) / count

            def basis(self, s):
                cell = (jnp.asarray(s) * self.num_cells).astype(int)
                return jax.nn.one_hot(cell, self.num_cells)

            def to_points(self, x):
                return x  # one point in each cell

            def from_points(self, values):
                return values
    """

    dim: eqx.AbstractVar[int]
    weights: eqx.AbstractVar[Float[Array, " n"]]

    @property
    @abstractmethod
    def size(self) -> int:
        """Number n of rows of a state."""

    @property
    @abstractmethod
    def grid(self) -> np.ndarray:
        """The q parameters s at which fields along the curve are evaluated, evenly spread."""

    @abstractmethod
    def parameters(self, count: int) -> np.ndarray:
        """So many parameters, evenly spread over the domain: of points that are given without."""

    @abstractmethod
    def basis(self, s: ArrayLike) -> Float[Array, "m n"]:
        """The values φ_i(s_j), one column for each function."""

    @abstractmethod
    def to_points(self, x: Float[Array, "n *dim"]) -> Float[Array, "q *dim"]:
        """The points of the curve at the parameters `grid`."""

    @abstractmethod
    def from_points(self, values: Float[Array, "q ..."]) -> Float[Array, "n ..."]:
        """The coefficients of a field from its values at the points; trailing axes are kept."""

    def inner(self, x: Float[Array, "n *dim"], y: Float[Array, "n *dim"]) -> Float[Array, ""]:
        """⟨x, y⟩ = Σ_i w_i x_i · y_i."""
        x = self._state(x)
        y = self._state(y, "y")
        # `jax.vmap` of a constructor gives weights an axis more, which would broadcast.
        require(
            jnp.ndim(self.weights) == 1,
            f"`weights` must be of shape ({self.size},); got {jnp.shape(self.weights)}. For a "
            "batch of spaces, `jax.vmap` the function that uses them.",
        )
        return jnp.sum(rows(self.weights.astype(x.dtype), x) * x * y)

    def squared_norm(self, x: Float[Array, "n *dim"]) -> Float[Array, ""]:
        """‖x‖², smooth everywhere."""
        return self.inner(x, x)

    def norm(self, x: Float[Array, "n *dim"]) -> Float[Array, ""]:
        """‖x‖. Its gradient at x = 0, where it has a corner, is taken as 0."""
        return safe_sqrt(self.squared_norm(x))

    def evaluate(self, x: Float[Array, "n *dim"], s: ArrayLike) -> Float[Array, "m *dim"]:
        """The points x(s_j) of the curve."""
        x = self._state(x)
        # A GPU would round the factors of a product to 10 bits.
        return jnp.matmul(self.basis(s).astype(x.dtype), x, precision="highest")

    def project(
        self, values: Float[Array, "m *dim"], s: ArrayLike | None = None
    ) -> Float[Array, "n *dim"]:
        """The curve of this space that is nearest to given points, by least squares.

        **Arguments:**

        - `values`: points of a curve, (m, dim), at least as many as a state has rows. (The curve
          through fewer landmarks is `refine` from their own space.)
        - `s`: their parameters, (m,); `parameters(m)` if left out, for curves equispaced from 0 on.

        **Returns:** the state; where the points leave it open (repeated parameters), the one of
        least norm.
        """
        values = floating(values, "values")
        require(
            self._fits(values.shape[1:]) and values.shape[0] >= self.size,
            f"`values` must be at least {self.size} points of dimension {self.dim}, one a row; "
            f"got shape {values.shape}. Fewer points become a curve by `refine` from `Landmarks` "
            "of their number; for a batch, use `jax.vmap`.",
        )
        require_finite(
            values, "values", "Missing points are left out, with `s` for those that are there."
        )
        basis = self.basis(self.parameters(values.shape[0]) if s is None else s)
        require(
            basis.shape[0] == values.shape[0],
            f"`s` must have one parameter for each of {values.shape[0]} points; got shape "
            f"{basis.shape[:1]}.",
        )
        # By singular values: parameters may be repeated, where normal equations are singular.
        found = jnp.linalg.lstsq(basis.astype(values.dtype), as_columns(values))[0]
        return found.reshape(self.size, *values.shape[1:])

    def refine(self, x: Float[Array, "n *dim"], finer: "AbstractSpace") -> Float[Array, "m *dim"]:
        """The same curve as a state of another space that is at least as fine, of either kind.

        A coarser space gets what its `from_points` makes of the curve: its points, or projected
        coefficients.
        """
        # Through the points of the finer space, where its coefficients are sums over a grid.
        require_instance(
            finer, AbstractSpace, "finer", "a space, such as `FourierBasis(num_modes, dim)`"
        )
        require(
            finer.dim == self.dim,
            f"`finer` must hold curves in R^{self.dim}; got a space of dimension {finer.dim}.",
        )
        return finer.from_points(self.evaluate(x, finer.grid))

    def _state(self, x: ArrayLike, name: str = "x") -> Float[Array, "n *dim"]:
        """A state, or `ValueError`: one row too few would broadcast."""
        x = floating(x, name)
        require(
            x.shape[:1] == (self.size,) and self._fits(x.shape[1:]),
            f"`{name}`, a state of this space, must have shape ({self.size}, {self.dim}); got "
            f"{x.shape}. For a batch, use `jax.vmap`.",
        )
        return x

    def _fits(self, trailing: tuple[int, ...]) -> bool:
        """Whether values are in R^dim by their trailing axis, which those in R need not have."""
        return trailing == (self.dim,) or (trailing == () and self.dim == 1)

    def _field(self, values: ArrayLike) -> Float[Array, "q ..."]:
        """The values of a field at the points of `grid`."""
        values = floating(values, "values")
        num_points = len(self.grid)
        require(
            values.shape[:1] == (num_points,),
            f"`values` must have a row for each of {num_points} points; got shape {values.shape}.",
        )
        return values


def equispaced(n: int) -> np.ndarray:
    """n parameters 2π i / n."""
    return 2 * np.pi * np.arange(n) / n
