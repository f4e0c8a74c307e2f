"""Representations of the noise of a Kunita flow: factors σ(x) of the covariance of a Gaussian field at given points.

The field has covariance a(x, x'), the convolution of the flow's kernel with itself. Each representation gives σ with
σσᵀ = a at the points: exactly (landmark), up to a truncated tail and a wrap-around (spectral), up to a quadrature
error (grid).
"""

import abc
import itertools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .._checks import as_float, positive_integer, require, require_finite, require_positive
from .._linalg import add, cholesky, safe_sqrt
from ..kernels import AbstractKernel

_LOST = 0.5
"""A wrong part of a(x, x) from which on spectral noise is NaN; at the edge of a box half of a(x, x) is lost."""


class AbstractNoise(eqx.Module):
    """How the noise field of a Kunita flow is represented."""

    fixed_in_space: eqx.AbstractClassVar[bool]
    """Fields fixed in space, whose variance a(x, x) is constant: Itô and Stratonovich readings coincide."""

    @abc.abstractmethod
    def factor(
        self, kernel: AbstractKernel | None, covariance: AbstractKernel, points: Float[Array, "q d"]
    ) -> Float[Array, "q k"]:
        """σ at the points, one column per driving noise."""

    def factor_and_covariance(self, kernel, covariance, points) -> tuple[Float[Array, "q k"], Float[Array, "q q"]]:
        """σ and σσᵀ at the points."""
        sigma = self.factor(kernel, covariance, points)
        return sigma, sigma @ sigma.T

    def misfit(self, kernel, covariance, points: Float[Array, "q d"]) -> Float[Array, ""]:
        """By what part of a(x, x) the law at the points is wrong because they are too wide or too near an edge."""
        return jnp.zeros((), points.dtype)

    def room(self, kernel, covariance, points: np.ndarray) -> str:
        """Where points must lie, in words and numbers, and the cure."""
        raise NotImplementedError

    def error(self, kernel, covariance, dim: int, points: Float[Array, "s q d"] | None) -> dict[str, Array]:
        """What the representation gets wrong, relative to a(x, x): at the worst of s states, or for any state."""
        return {}


class LandmarkNoise(AbstractNoise):
    """Noise attached to the landmarks: the Cholesky factor of their covariance, n noises per coordinate.

    **Arguments:** `jitter`: added to the diagonal, relative to a(x, x); by default 1e-5 in single and 1e-10 in double
    precision, which keeps the factorisation of close landmarks finite.
    """

    jitter: Array | None
    fixed_in_space = False

    def __init__(self, jitter=None):
        self.jitter = None if jitter is None else as_float(jitter, "jitter")
        if self.jitter is not None:
            require(
                self.jitter.ndim == 0 and jnp.isfinite(self.jitter) & (self.jitter >= 0),
                f"`jitter` must be a number from 0 on, relative to the variance; got {jitter}. 1e-6 is large.",
            )

    def factor(self, kernel, covariance, points):
        return self.factor_and_covariance(kernel, covariance, points)[0]

    def factor_and_covariance(self, kernel, covariance, points):
        K = covariance.matrix(points, points)
        jitter = self.jitter
        if jitter is None:
            jitter = jnp.asarray(1e-5 if K.dtype == jnp.float32 else 1e-10, K.dtype)
        variance = covariance.variance.astype(K.dtype)
        K = add(K, jitter.astype(K.dtype) * variance)
        none = variance == 0  # an amplitude that underflows
        factor = cholesky(jnp.where(none, jnp.eye(len(K), dtype=K.dtype), K))
        return jnp.where(none, 0.0, factor), K


class SpectralNoise(AbstractNoise):
    """Random Fourier series on a torus of period P: over the lattice ω ∈ (2π/P) Z^d, one of each pair ±ω,

        σ_ω(x) = √(2 q̂(ω)/P^d) (cos ω·x, sin ω·x),      σ_0 = √(q̂(0)/P^d)

    with q̂ the Fourier transform of the covariance. No factorisation; the noise does not depend on the number of points.

    **Arguments:**

    - `num_modes`: largest frequency per axis; (2 num_modes + 1)^dim noises per coordinate.
    - `period`: P, which must exceed the extent of the shapes along each axis: the wrap-around is a(P − extent). By
      default `diameter + 8.6 length_scale` for the Gaussian kernel's length scale (wrap-around 1e-8). Where the
      wrap-around exceeds half of a(x, x) the noise is NaN.
    - `diameter`: of the shapes that the flow may reach, used by the default period.
    """

    num_modes: int = eqx.field(static=True)
    period: Array | None
    diameter: Array
    fixed_in_space = True

    def __init__(self, num_modes: int = 12, period=None, diameter=4.0):
        self.num_modes = positive_integer(num_modes, "num_modes")
        self.period = None if period is None else as_float(period, "period")
        self.diameter = as_float(diameter, "diameter")
        require_positive(self.diameter, "diameter", "Give the largest distance of two points that is expected.")
        require(self.diameter.ndim == 0, f"`diameter` must be one number; got shape {self.diameter.shape}.")
        if self.period is not None:
            require_positive(self.period, "period", "Give the side of a box that the shapes stay well inside.")
            require(self.period.ndim == 0, f"`period` must be one number for all axes; got shape {self.period.shape}.")

    def _period(self, kernel, covariance):
        if self.period is not None:
            return self.period
        known = covariance if kernel is None else kernel
        if not hasattr(known, "length_scale"):
            raise ValueError("`period` must be given to SpectralNoise: this kernel has no single length scale.")
        length_scale = known.length_scale / jnp.sqrt(2.0) if kernel is None else known.length_scale
        return self.diameter + 8.6 * length_scale

    def _lattice(self, dim: int) -> np.ndarray:
        """One of each pair ±ω, the origin first."""
        axis = range(-self.num_modes, self.num_modes + 1)
        half = [w for w in itertools.product(axis, repeat=dim) if w > (0,) * dim]
        return np.array([(0,) * dim, *half], float)

    def factor(self, kernel, covariance, points):
        fits = self.misfit(kernel, covariance, points) < _LOST
        return jnp.where(fits, self._series(kernel, covariance, points), jnp.nan)

    def _series(self, kernel, covariance, points):
        dim = points.shape[1]
        period = self._period(kernel, covariance)
        omega = jnp.asarray(self._lattice(dim), points.dtype) * (2 * jnp.pi / period)
        scale = safe_sqrt(covariance.spectral_density(omega, dim) / period**dim)  # it underflows
        scale = jnp.concatenate([scale[:1], jnp.sqrt(2.0) * scale[1:]])
        phase = points @ omega.T
        return jnp.concatenate([scale[None] * jnp.cos(phase), (scale[None] * jnp.sin(phase))[:, 1:]], axis=1)

    def misfit(self, kernel, covariance, points):
        extent = jnp.max(jnp.max(points, axis=0) - jnp.min(points, axis=0))
        return self._wrap_around(kernel, covariance, points.shape[1], lax.stop_gradient(extent))

    def room(self, kernel, covariance, points):
        extent = np.max(np.ptp(points, axis=0))
        period = self._period(kernel, covariance)
        return (
            f"its extent along an axis, {extent:.4g}, must stay below the `period` of `SpectralNoise`, {period:.4g}, "
            "by several length scales of the covariance. Give "
            f"`SpectralNoise(num_modes, diameter={1.5 * extent:.2g})` with more modes in proportion and without a "
            "`period`, or scale the shapes"
        )

    def _wrap_around(self, kernel, covariance, dim: int, extent) -> Array:
        """The covariance of two points at the ends of a shape with each other's periodic image."""
        period = self._period(kernel, covariance)
        gap = jnp.maximum(period - extent.astype(period.dtype), 0)
        ends = gap * np.eye(2, dim, k=-1, dtype=gap.dtype)
        values = covariance.matrix(ends[:1], ends)[0]
        none = values[0] == 0  # an amplitude that underflows
        return lax.select(none, jnp.zeros_like(values[1]), values[1] / jnp.where(none, 1.0, values[0]))

    def error(self, kernel, covariance, dim, points):
        """The truncated `tail` (variance missing at a point), and the `wrap_around`, at the given diameter or for the
        states."""
        origin = jnp.zeros((1, dim))
        variance = covariance.matrix(origin, origin)[0, 0]
        factor = self._series(kernel, covariance, origin)
        if points is None:
            wrap_around = self._wrap_around(kernel, covariance, dim, self.diameter)
        else:
            wrap_around = jnp.max(jax.vmap(lambda p: self.misfit(kernel, covariance, p))(points))
        return {"tail": 1 - jnp.sum(factor**2) / variance, "wrap_around": wrap_around}


class GridNoise(AbstractNoise):
    """Quadrature of ∫ k(x, y) dW(y) on the cells of a box, σ_y(x) = k(x, y) √|cell|.

    The weight is the square root of the cell's volume: without it the noise grows as the grid is refined.
    Right for points at least about three length scales inside the box; NaN outside of it.

    **Arguments:** `lower`, `upper`: corners of the box, scalars or `(dim,)`; `num_cells`: cells per axis.
    """

    lower: Array
    upper: Array
    num_cells: int = eqx.field(static=True)
    fixed_in_space = True

    def __init__(self, lower=-3.0, upper=3.0, num_cells: int = 24):
        self.lower, self.upper = as_float(lower, "lower"), as_float(upper, "upper")
        require_finite(self.lower, "lower")
        require_finite(self.upper, "upper")
        shapes = {self.lower.shape, self.upper.shape} - {()}
        require(
            len(shapes) < 2 and all(len(shape) == 1 for shape in shapes),
            f"`lower` and `upper` must be numbers or corners (dim,) of a box; got shapes {self.lower.shape} and "
            f"{self.upper.shape}.",
        )
        require(jnp.all(self.lower < self.upper), f"`lower` must be below `upper`; got {lower} and {upper}.")
        self.num_cells = positive_integer(num_cells, "num_cells")

    def factor(self, kernel, covariance, points):
        sigma = self._quadrature(kernel, points, self.num_cells)
        inside = jnp.all((points >= self.lower.astype(points.dtype)) & (points <= self.upper.astype(points.dtype)))
        return jnp.where(inside, sigma, jnp.nan)

    def _quadrature(self, kernel, points, num_cells: int):
        if kernel is None:
            raise ValueError(
                '`noise="grid"` needs the flow\'s `kernel`; with `covariance=` use "landmark" or "spectral".'
            )
        dim = points.shape[1]
        corners = {self.lower.shape, self.upper.shape}
        require(
            corners <= {(), (dim,)},
            f"`lower` and `upper` must be numbers or corners ({dim},) of a box; got shapes {sorted(corners)}.",
        )
        width = jnp.broadcast_to((self.upper - self.lower) / num_cells, (dim,))
        index = np.array(list(itertools.product(range(num_cells), repeat=dim)), float) + 0.5
        cells = jnp.broadcast_to(self.lower, (1, dim)) + jnp.asarray(index, points.dtype) * width[None]
        return kernel.matrix(points, cells) * jnp.sqrt(jnp.prod(width))

    def misfit(self, kernel, covariance, points):
        # of cells half as wide: a coarse grid, whose error is of either sign, is not an edge
        variance = jnp.sum(self._quadrature(kernel, points, 2 * self.num_cells) ** 2, axis=1)
        return jnp.maximum(jnp.max(1 - variance / covariance.variance.astype(variance.dtype)), 0)

    def room(self, kernel, covariance, points):
        corners = [np.array2string(np.asarray(c), precision=4) for c in (self.lower, self.upper)]
        low, high = (np.array2string(f(points, axis=0), precision=4) for f in (np.min, np.max))
        return (
            f"its points, from {low} to {high}, must lie about three length scales inside the box of `GridNoise`, from "
            f"{corners[0]} to {corners[1]}. Give `GridNoise(lower, upper, num_cells)` a larger one, with cells no "
            "wider than the length scale, or move and scale the shapes"
        )

    def error(self, kernel, covariance, dim, points):
        """At the points of the states: the variance lost at the `edge` of the box, and the whole error of the
        `quadrature` of a(x, x)."""
        if points is None:
            return {}
        points = points.reshape(-1, dim)
        found = jnp.sum(self._quadrature(kernel, points, self.num_cells) ** 2, axis=1)
        quadrature = jnp.max(jnp.abs(1 - found / covariance.variance.astype(found.dtype)))
        return {"edge": self.misfit(kernel, covariance, points), "quadrature": quadrature}


NOISES: dict[str, Callable[[], AbstractNoise]] = {
    "landmark": LandmarkNoise,
    "spectral": SpectralNoise,
    "grid": GridNoise,
}
