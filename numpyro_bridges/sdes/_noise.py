"""Representations of the noise of a Kunita flow: factors σ(x) of the covariance of a Gaussian field at given points.

The field has covariance a(x, x'), the convolution of the flow's kernel with itself. Each representation gives σ with
σσᵀ = a at the points: exactly (landmark), up to a truncated tail and a wrap-around (spectral), up to a quadrature
error (grid).
"""

import abc
import itertools
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._checks import as_float, positive_integer, require, require_finite, require_positive
from .._linalg import add, cholesky, safe_sqrt
from ..kernels import AbstractKernel


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
        K = add(K, jitter.astype(K.dtype) * covariance.variance.astype(K.dtype))
        return cholesky(K), K


class SpectralNoise(AbstractNoise):
    """Random Fourier series on a torus of period P: over the lattice ω ∈ (2π/P) Z^d, one of each pair ±ω,

        σ_ω(x) = √(2 q̂(ω)/P^d) (cos ω·x, sin ω·x),      σ_0 = √(q̂(0)/P^d)

    with q̂ the Fourier transform of the covariance. No factorisation; the noise does not depend on the number of points.

    **Arguments:**

    - `num_modes`: largest frequency per axis; (2 num_modes + 1)^dim noises per coordinate.
    - `period`: P, which must exceed the diameter of the shapes: the wrap-around is a(P − diameter). By default
      `diameter + 8.6 length_scale` for the Gaussian kernel's length scale (wrap-around 1e-8).
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
        dim = points.shape[1]
        period = self._period(kernel, covariance)
        omega = jnp.asarray(self._lattice(dim), points.dtype) * (2 * jnp.pi / period)
        scale = safe_sqrt(covariance.spectral_density(omega, dim) / period**dim)  # it underflows
        scale = jnp.concatenate([scale[:1], jnp.sqrt(2.0) * scale[1:]])
        phase = points @ omega.T
        return jnp.concatenate([scale[None] * jnp.cos(phase), (scale[None] * jnp.sin(phase))[:, 1:]], axis=1)

    def error(self, kernel, covariance, dim: int) -> dict[str, Array]:
        """What the representation leaves out, relative to a(x, x): the truncated `tail` (variance missing at a point)
        and the `wrap_around` (covariance with the nearest periodic image, at the given diameter)."""
        period = self._period(kernel, covariance)
        origin = jnp.zeros((1, dim))
        variance = covariance.matrix(origin, origin)[0, 0]
        factor = self.factor(kernel, covariance, origin)
        image = origin.at[0, 0].set(period - self.diameter)
        return {
            "tail": 1 - jnp.sum(factor**2) / variance,
            "wrap_around": covariance.matrix(origin, image)[0, 0] / variance,
        }


class GridNoise(AbstractNoise):
    """Quadrature of ∫ k(x, y) dW(y) on the cells of a box, σ_y(x) = k(x, y) √|cell|.

    The weight is the square root of the cell's volume: without it the noise grows as the grid is refined.
    Right for points at least about three length scales inside the box.

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
        width = jnp.broadcast_to((self.upper - self.lower) / self.num_cells, (dim,))
        index = np.array(list(itertools.product(range(self.num_cells), repeat=dim)), float) + 0.5
        cells = jnp.broadcast_to(self.lower, (1, dim)) + jnp.asarray(index, points.dtype) * width[None]
        return kernel.matrix(points, cells) * jnp.sqrt(jnp.prod(width))


NOISES: dict[str, Callable[[], AbstractNoise]] = {
    "landmark": LandmarkNoise,
    "spectral": SpectralNoise,
    "grid": GridNoise,
}
