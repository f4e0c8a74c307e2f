"""Functions by their coefficients in an orthonormal basis of eigenfunctions of the Laplacian."""

from abc import abstractmethod
from math import sqrt
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from .._checks import floating, known_number, positive_integer, require, require_finite
from ._base import AbstractSpace, equispaced


def waves(s: ArrayLike, frequencies: np.ndarray, ndim: int = 1) -> tuple[Any, Any, Any]:
    """cos k s and sin k s, `(..., frequencies)`, and s.

    In NumPy and double precision unless s is traced: single precision loses digits in cos ks for a
    large k.
    """
    converted = floating(s, "s")
    xp: Any = jnp if isinstance(converted, Tracer) else np
    # From what the user gave, not from `converted`, which may be rounded already.
    s = converted if xp is jnp else np.asarray(s, float)
    what = "a vector of parameters" if ndim == 1 else "parameters (m, 2), a pair in each row"
    good = s.ndim == ndim and (ndim == 1 or s.shape[1] == 2)
    require(good, f"`s` must be {what}; got shape {s.shape}.")
    require_finite(converted, "s")
    angles = s[..., None] * xp.asarray(frequencies, s.dtype).reshape((1,) * ndim + (-1,))
    return xp.cos(angles), xp.sin(angles), s


def fourier_functions(s: ArrayLike, num_modes: int, ndim: int = 1) -> Any:
    """1, √2 cos s, √2 sin s, √2 cos 2s, ... at s, `(..., 2 num_modes + 1)`."""
    cosines, sines, s = waves(s, np.arange(1, num_modes + 1), ndim)
    xp = np if isinstance(s, np.ndarray) else jnp
    # interleaved, cosine and sine of one frequency side by side, so that more modes are rows behind
    both: Any = xp.stack([cosines, sines], axis=-1).reshape(*cosines.shape[:-1], 2 * num_modes)
    one: Any = xp.ones_like(s)
    return xp.concatenate([one[..., None], sqrt(2) * both], axis=-1)


class AbstractBasis(AbstractSpace):
    """Functions by n coefficients in a basis that is orthonormal in L² of a domain of mass 1.

    The H-norm is the Euclidean norm of the coefficients. Fields are evaluated at q points of the
    domain, `grid`: with Φ the (q, n) values of the basis there, points are Φ x and the coefficients
    of a field f are Φᵀ f / q, Φᵀ Φ / q = I. Here are even functions on a circle:

        class EvenBasis(nb.AbstractBasis):
            num_modes: int = eqx.field(static=True)
            dim: int = eqx.field(static=True)
            num_quadrature: int = eqx.field(static=True)  # more than 2 num_modes

            @property
            def size(self):
                return self.num_modes + 1

            @property
            def laplacian(self):
                return -(jnp.arange(self.size) ** 2.0)

            def parameters(self, count):
                return 2 * np.pi * np.arange(count) / count

            def functions(self, s):
                frequency = jnp.arange(self.size)
                norm = jnp.where(frequency == 0, 1.0, jnp.sqrt(2))
                return norm * jnp.cos(jnp.outer(s, frequency))
    """

    num_quadrature: eqx.AbstractVar[int]

    @property
    @abstractmethod
    def laplacian(self) -> Float[Array, " n"]:
        """The eigenvalues of the Laplacian, none positive: ν Δ is the diagonal `ν * laplacian`."""

    @abstractmethod
    def functions(self, s: ArrayLike) -> Any:
        """The values φ_i(s_j), in NumPy unless s is traced."""

    @property
    def grid(self) -> np.ndarray:
        return self.parameters(self.num_quadrature)

    @property
    def weights(self) -> Float[Array, " n"]:
        """Ones: the basis is orthonormal."""
        return jnp.ones(self.size)

    def basis(self, s: ArrayLike) -> Float[Array, "m n"]:
        return jnp.asarray(self.functions(s))

    def to_points(self, x: Float[Array, "n *dim"]) -> Float[Array, "q *dim"]:
        return self.evaluate(x, self.grid)

    def from_points(self, values: Float[Array, "q ..."]) -> Float[Array, "n ..."]:
        """Φᵀ f / q."""
        values = self._field(values)
        # A product with a matrix and no FFT: m and q are small, and every basis does it alike.
        projection = self.functions(self.grid).T / len(self.grid)
        projection = jnp.asarray(projection, values.dtype)
        return jnp.tensordot(projection, values, axes=1, precision="highest")

    def _quadrature(self, num_quadrature: int | None, default: int, least: int, rule: str) -> int:
        """The number of points, checked."""
        count = positive_integer(
            default if num_quadrature is None else num_quadrature, "num_quadrature"
        )
        require(
            count >= least,
            f"`num_quadrature` must be at least {rule} = {least}, or the functions are not "
            f"orthonormal on the grid; got {num_quadrature}.",
        )
        return count


class FourierBasis(AbstractBasis):
    """Closed curves of finite bandwidth, or periodic functions: coefficients of 2 num_modes + 1
    functions in the order

        1, √2 cos s, √2 sin s, √2 cos 2s, √2 sin 2s, ..., √2 cos ms, √2 sin ms      (m = num_modes),

    s in [0, 2π), orthonormal in L²(ds / 2π). The q points are equispaced.

    **Arguments:**

    - `num_modes`: m, the highest frequency.
    - `dim`: dimension of the space in which the curve lies; 1 for a function.
    - `num_quadrature`: q, at least 2m + 1. With the default max(4m, 32) the coefficients of a field
      that is quadratic in the curve are exact.
    """

    num_modes: int = eqx.field(static=True)
    dim: int = eqx.field(static=True)
    num_quadrature: int = eqx.field(static=True)

    def __init__(self, num_modes: int, dim: int, *, num_quadrature: int | None = None):
        self.num_modes = positive_integer(num_modes, "num_modes")
        self.dim = positive_integer(dim, "dim")
        # A square of the curve has frequencies up to 2m. On 4m points they are confused with those
        # from 2m on, none of which is in the basis.
        default = max(4 * self.num_modes, 32)
        self.num_quadrature = self._quadrature(
            num_quadrature, default, self.size, "2 num_modes + 1"
        )

    @property
    def size(self) -> int:
        return 2 * self.num_modes + 1

    @property
    def laplacian(self) -> Float[Array, " n"]:
        return jnp.asarray(-(_frequencies(self.num_modes) ** 2))

    def parameters(self, count: int) -> np.ndarray:
        return equispaced(count)

    def functions(self, s: ArrayLike) -> Any:
        return fourier_functions(s, self.num_modes)


class AbstractIntervalBasis(AbstractBasis):
    """Waves on [0, length] of up to num_modes half waves, orthonormal in L²(ds / length).

    The least number of half waves is `lowest`. The q points are midpoints of q equal parts.

    **Arguments:**

    - `num_modes`: m, the highest number of half waves.
    - `dim`: number of values at a point; 1 for a function.
    - `length`: of the interval.
    - `num_quadrature`: q, at least m + 1. With the default max(2m + 2, 32) the coefficients of a
      field that is cubic in the function are exact (a quadratic field of sines is no finite sum of
      sines).
    """

    num_modes: int = eqx.field(static=True)
    dim: int = eqx.field(static=True)
    length: float = eqx.field(static=True)
    num_quadrature: int = eqx.field(static=True)
    lowest: eqx.AbstractClassVar[int]

    def __init__(
        self, num_modes: int, dim: int, *, length: float = 1.0, num_quadrature: int | None = None
    ):
        self.num_modes = positive_integer(num_modes, "num_modes")
        self.dim = positive_integer(dim, "dim")
        self.length = known_number(length, "length", "a positive number", lambda value: value > 0)
        default = max(2 * self.num_modes + 2, 32)
        self.num_quadrature = self._quadrature(
            num_quadrature, default, self.num_modes + 1, "num_modes + 1"
        )

    @property
    def size(self) -> int:
        return self.num_modes + 1 - self.lowest

    @property
    def laplacian(self) -> Float[Array, " n"]:
        return jnp.asarray(-(self._wave_numbers**2))

    @property
    def _wave_numbers(self) -> np.ndarray:
        return np.pi / self.length * np.arange(self.lowest, self.num_modes + 1)

    def parameters(self, count: int) -> np.ndarray:
        # Midpoints: sines and cosines of different numbers are orthogonal on these, to the last
        # digit, as in the discrete transforms of type II.
        return self.length * (np.arange(count) + 0.5) / count


class SineBasis(AbstractIntervalBasis):
    """Functions on [0, length] that vanish at its ends (Dirichlet): coefficients of num_modes
    functions

        √2 sin(π s / length), √2 sin(2π s / length), ..., √2 sin(mπ s / length)    (m = num_modes).

    **Arguments:** those of `AbstractIntervalBasis`.
    """

    lowest: ClassVar[int] = 1

    def functions(self, s: ArrayLike) -> Any:
        return sqrt(2) * waves(s, self._wave_numbers)[1]


class CosineBasis(AbstractIntervalBasis):
    """Functions on [0, length] without slope at its ends (Neumann): coefficients of num_modes + 1
    functions

        1, √2 cos(π s / length), ..., √2 cos(mπ s / length)      (m = num_modes).

    **Arguments:** those of `AbstractIntervalBasis`.
    """

    lowest: ClassVar[int] = 0

    def functions(self, s: ArrayLike) -> Any:
        # the constant has norm 1 without √2
        scale = np.where(np.arange(self.size) == 0, 1.0, sqrt(2))
        cosines: Any = waves(s, self._wave_numbers)[0]
        return cosines * scale.astype(cosines.dtype)[None]


class FourierSquare(AbstractBasis):
    """Functions on [0, 2π)², periodic in both directions: coefficients of (2 num_modes + 1)²
    products of functions

        φ_i(s) φ_j(t), φ those of `FourierBasis`, row i (2 num_modes + 1) + j of a state,

    orthonormal in L²(ds dt / 4π²). The points are a grid, `num_quadrature` in each direction.

    **Arguments:** those of `FourierBasis`. Parameters are pairs, (m, 2).
    """

    num_modes: int = eqx.field(static=True)
    dim: int = eqx.field(static=True)
    num_quadrature: int = eqx.field(static=True)

    def __init__(self, num_modes: int, dim: int, *, num_quadrature: int | None = None):
        self.num_modes = positive_integer(num_modes, "num_modes")
        self.dim = positive_integer(dim, "dim")
        least = 2 * self.num_modes + 1
        default = max(4 * self.num_modes, 8)
        self.num_quadrature = self._quadrature(num_quadrature, default, least, "2 num_modes + 1")

    @property
    def size(self) -> int:
        return (2 * self.num_modes + 1) ** 2

    @property
    def laplacian(self) -> Float[Array, " n"]:
        squares = _frequencies(self.num_modes) ** 2
        return jnp.asarray(-(squares[:, None] + squares[None, :]).reshape(-1))

    @property
    def grid(self) -> np.ndarray:
        return self.parameters(self.num_quadrature**2)

    def parameters(self, count: int) -> np.ndarray:
        # Points in rows, as a field on a square grid is flattened.
        side = round(sqrt(count))
        require(
            side**2 == count,
            f"`s` must be given, (m, 2), for points that are no square grid; got {count} points.",
        )
        along = equispaced(side)
        return np.stack(np.meshgrid(along, along, indexing="ij"), axis=-1).reshape(count, 2)

    def functions(self, s: ArrayLike) -> Any:
        values = fourier_functions(s, self.num_modes, ndim=2)
        # (points, 2 directions, functions): all products of one function of each direction
        return (values[:, 0, :, None] * values[:, 1, None, :]).reshape(len(values), self.size)


def _frequencies(num_modes: int) -> np.ndarray:
    """0, 1, 1, 2, 2, ..., of the functions of a Fourier basis."""
    return (np.arange(2 * num_modes + 1.0) + 1) // 2
