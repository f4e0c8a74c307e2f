"""Representations of the noise of a Kunita flow: factors σ(x) of the covariance of a Gaussian field
at given points.

The field has covariance a(x, x'), the convolution of the flow's kernel with itself. Each
representation gives σ with σσᵀ = a at the points: exactly (landmark), up to what some of the points
do not tell of the others (control), up to a truncated tail and a wrap-around (spectral), up to a
quadrature error (grid).
"""

import abc
import bisect
import itertools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from .._checks import (
    as_float,
    concrete,
    known,
    known_float,
    known_number,
    positive_integer,
    require,
    require_finite,
    require_positive,
    words,
)
from .._linalg import (
    add,
    cholesky,
    half_square,
    safe_sqrt,
    solve_lower,
    solve_positive,
    varying_like,
)
from ..kernels import AbstractKernel

_LOST = 0.5
"""A wrong part of a(x, x) from which on noise is NaN; at the edge of a box half is lost."""

MOST_CONTROLS = 64
"""Number of controls, unless it is given: up to here all landmarks are."""


class AbstractNoise(eqx.Module):
    """How the noise field of a Kunita flow is represented."""

    fixed_in_space: eqx.AbstractClassVar[bool]
    """Fields fixed in space, whose variance a(x, x) is constant: Itô and Stratonovich readings
    coincide.
    """

    def chosen(self, points: Float[Array, "q d"]) -> "AbstractNoise":
        """For a flow that starts at these points."""
        return self

    def own_jitter(self, dtype) -> Array | None:
        """What is added to a(x, x), as a part of it; `None` where nothing is."""
        return None

    def factored_at(self, points: Float[Array, "q d"]) -> Array | np.ndarray | None:
        """Which points must be apart, since their covariance is factored; `None` if none."""
        return None

    def velocity(
        self, kernel, covariance, points: Float[Array, "q d"], moves: Float[Array, "q d"]
    ) -> Callable[[Float[Array, "s d"]], Float[Array, "s d"]]:
        """The field that moves the points like this, anywhere: of those that do, that of least
        noise.
        """
        u = jnp.linalg.lstsq(self.factor(kernel, covariance, points), moves)[0]
        return lambda others: self.factor(kernel, covariance, others) @ u

    @abc.abstractmethod
    def factor(
        self, kernel: AbstractKernel | None, covariance: AbstractKernel, points: Float[Array, "q d"]
    ) -> Float[Array, "q k"]:
        """σ at the points, one column per driving noise."""

    def factor_and_covariance(
        self, kernel, covariance, points
    ) -> tuple[Float[Array, "q k"], Float[Array, "q q"]]:
        """σ and σσᵀ at the points."""
        sigma = self.factor(kernel, covariance, points)
        return sigma, sigma @ sigma.T

    def misfit(self, kernel, covariance, points: Float[Array, "q d"]) -> Float[Array, ""]:
        """By what part of a(x, x) the law at the points is wrong because they are too wide or too
        near an edge.
        """
        return jnp.zeros((), points.dtype)

    def room(self, kernel, covariance, points: np.ndarray) -> str:
        """Where points must lie, in words and numbers, and the cure."""
        raise NotImplementedError

    def error(
        self, kernel, covariance, dim: int, points: Float[Array, "s q d"] | None
    ) -> dict[str, Array]:
        """What the representation gets wrong, relative to a(x, x): at the worst of s states, or for
        any state.
        """
        return {}


class LandmarkNoise(AbstractNoise):
    """Noise attached to the landmarks: the Cholesky factor of their covariance, n noises per
    coordinate.

    **Arguments:** `jitter`: added to the diagonal, relative to a(x, x); by default 1e-5 in single
    and 1e-10 in double precision, which keeps the factorisation of close landmarks finite.
    """

    jitter: Array | None
    fixed_in_space = False

    def __init__(self, jitter=None):
        self.jitter = None if jitter is None else as_float(jitter, "jitter")
        if self.jitter is not None:
            require(
                self.jitter.ndim == 0 and jnp.isfinite(self.jitter) & (self.jitter >= 0),
                f"`jitter` must be a number from 0 on, relative to the variance; got {jitter}. "
                "1e-6 is large.",
            )

    def own_jitter(self, dtype):
        if self.jitter is None:
            return jnp.asarray(1e-5 if dtype == jnp.float32 else 1e-10, dtype)
        return self.jitter.astype(dtype)

    def factored_at(self, points):
        return np.arange(len(points))

    def factor(self, kernel, covariance, points):
        return self.factor_and_covariance(kernel, covariance, points)[0]

    def factor_and_covariance(self, kernel, covariance, points):
        S, none, K = self.positive(covariance, points)
        return jnp.where(none, 0.0, cholesky(S)), K

    def velocity(self, kernel, covariance, points, moves):
        S, none, _ = self.positive(covariance, points)
        weights = solve_positive(S, moves)
        return lambda others: jnp.where(none, 0.0, covariance.matrix(others, points) @ weights)

    def positive(self, covariance, points) -> tuple[Array, Array, Array]:
        """A covariance that has an inverse, whether there is no noise at all, and the covariance
        itself.
        """
        K = covariance.matrix(points, points)
        variance = covariance.variance.astype(K.dtype)
        K = add(K, self.own_jitter(K.dtype) * variance)
        none = variance == 0  # an amplitude that underflows
        return jnp.where(none, jnp.eye(len(K), dtype=K.dtype), K), none, K


class ControlNoise(AbstractNoise):
    """Noise of some of the landmarks, the controls c, that moves with the flow and carries the
    others,

        σ(x) = a(x, c) a(c, c)^{-½},

    m noises per coordinate, whatever the number of landmarks. It is exact where all landmarks are
    controls. Elsewhere the field between controls is the mean that they tell, and lacks the
    variance a(x, x) − |σ(x)|², `flow.noise_error(x)`, which is small where they are nearer to each
    other than the length scale. It should be small beside the errors of what is observed.

    **Arguments:**

    - `num_points`: m; by default 64, or all landmarks where they are fewer.
    - `points`: `(m,)`, the indices of the controls. By default they are chosen from the start of a
      bridge, each as far from those before it as can be. Give them where the start is a parameter,
      for they should not move with it.
    - `jitter`: as for `LandmarkNoise`.

    `ControlNoise.within(tolerance, x, kernel)` finds how many are needed. An exact match can see no
    more rows than there are controls.
    """

    num_points: int | None = eqx.field(static=True)
    points: Array | None
    controls: LandmarkNoise
    fixed_in_space = False

    def __init__(self, num_points: int | None = None, *, points=None, jitter=None):
        require(num_points is None or points is None, "Give `num_points` or `points`, not both.")
        self.num_points = None if num_points is None else positive_integer(num_points, "num_points")
        self.points = None if points is None else _indices(points)
        self.controls = LandmarkNoise(jitter)

    @classmethod
    def within(
        cls,
        tolerance: float,
        x: Float[Array, "n d"],
        kernel: AbstractKernel | None = None,
        *,
        covariance: AbstractKernel | None = None,
        max_points: int = 512,
    ) -> "ControlNoise":
        """As few controls of a shape as miss no more than a part `tolerance` of a(x, x) at any
        landmark.

        **Arguments:** `kernel` or `covariance`: as of the flow, at the smallest length scale that
        is of interest.

        **Errors:** `ValueError` where it takes more than `max_points`.
        """
        tolerance = known_number(tolerance, "tolerance", "between 0 and 1", lambda t: 0 < t < 1)
        shape = known_float(x, "x")
        require(
            shape.ndim == 2 and shape.size,
            f"`x` must be a shape (n, dim); got shape {shape.shape}.",
        )
        require(
            (kernel is None) != (covariance is None),
            "Give either `kernel` or `covariance`, as to the flow.",
        )
        covariance = kernel.convolved(shape.shape[1]) if kernel is not None else covariance
        most = min(len(shape), positive_integer(max_points, "max_points"))
        order = np.asarray(farthest_points(jnp.asarray(shape), most))

        def missing(m: int) -> float:
            noise = cls(points=np.sort(order[:m]))
            return (
                float(noise.misfit(None, covariance, jnp.asarray(shape))) if m < len(shape) else 0.0
            )

        least = missing(most)
        require(
            least <= tolerance,
            f"`tolerance` must be within reach of {most} controls, which miss {least:.2g} of a(x, "
            f"x); got {tolerance}. Give a larger `max_points`, or a kernel with a longer length "
            "scale.",
        )
        m = bisect.bisect_left(range(1, most), True, key=lambda m: missing(m) <= tolerance) + 1
        return cls(points=np.sort(order[:m]))

    def chosen(self, points):
        if self.points is not None:
            known_points = concrete(self.points)
            last = -1 if known_points is None else int(known_points[-1])
            require(
                last < len(points),
                f"`points` of `ControlNoise` must be indices below {len(points)}; got "
                f"{words(last)}.",
            )
            return self
        order = farthest_points(lax.stop_gradient(points), self._count(len(points)))
        return eqx.tree_at(
            lambda noise: noise.points, self, jnp.sort(order), is_leaf=lambda leaf: leaf is None
        )

    def factored_at(self, points):
        index = self.chosen(points).points
        assert index is not None
        return index

    def own_jitter(self, dtype):
        return self.controls.own_jitter(dtype)

    def _count(self, n: int) -> int:
        m = min(n, MOST_CONTROLS) if self.num_points is None else self.num_points
        require(
            m <= n,
            f"`num_points` of `ControlNoise` must be at most the number of landmarks, {n}; got "
            f"{m}.",
        )
        return m

    def factor(self, kernel, covariance, points):
        sigma, missing = self._factor_and_missing(covariance, points)
        return jnp.where(missing < _LOST, sigma, jnp.nan)

    def _crossed(self, covariance, points) -> tuple[Array, Array, Array]:
        """a(c, c) with an inverse, whether there is no noise at all, and a(c, x)."""
        index = self.factored_at(points)
        S, none, K = self.controls.positive(covariance, points[index])
        # the controls move as landmarks do
        across = covariance.matrix(points[index], points).at[:, index].set(K)
        return S, none, across

    def _factor_and_missing(self, covariance, points) -> tuple[Array, Array]:
        """σ, and the part of a(x, x) that is missing at the worst point."""
        S, none, across = self._crossed(covariance, points)
        sigma = jnp.where(none, 0.0, solve_lower(cholesky(S), across).T)
        # 1 where there is none
        variance = covariance.variance.astype(sigma.dtype) + none.astype(sigma.dtype)
        told = jnp.min(jnp.sum(sigma**2, axis=1)) / variance
        return sigma, lax.select(none, jnp.zeros_like(told), jnp.maximum(1 - told, 0))

    def energy(self, covariance, points, p) -> Array:
        """½ Σ pᵀ σσᵀ p over columns, without σ."""
        S, none, across = self._crossed(covariance, points)
        return jnp.where(none, 0.0, half_square(S, across @ p))

    def velocity(self, kernel, covariance, points, moves):
        index = self.factored_at(points)
        return self.controls.velocity(kernel, covariance, points[index], moves[index])

    def misfit(self, kernel, covariance, points):
        return self._factor_and_missing(covariance, points)[1]

    def room(self, kernel, covariance, points):
        m = self._count(len(points)) if self.points is None else len(self.points)
        return (
            f"its {m} control landmarks are too far apart for the length scale of the covariance. "
            "Give `ControlNoise(num_points)` more of them, or the points; "
            "`ControlNoise.within(tolerance, x, kernel)` finds how many"
        )

    def error(self, kernel, covariance, dim, points):
        """At the points of the states, the variance that is `missing` at the worst of them."""
        if points is None:
            return {}
        chosen = self.chosen(points[0])
        return {
            "missing": jnp.max(jax.vmap(lambda p: chosen.misfit(kernel, covariance, p))(points))
        }


def farthest_points(points: Float[Array, "n d"], m: int) -> Int[Array, " m"]:
    """Indices of points, each as far as can be from those before it, the first from the mean."""

    def distances(p):
        return jnp.sum((points - p[None]) ** 2, axis=1)

    def step(nearest, _):
        index = jnp.argmax(nearest)
        return jnp.minimum(nearest, distances(points[index])), index

    first = jnp.argmax(distances(jnp.mean(points, axis=0)))
    start = varying_like(distances(points[first]), points)
    _, others = lax.scan(step, start, length=m - 1)
    return jnp.concatenate([first[None], others])


def _indices(points) -> Array:
    """Different rows of a shape, in increasing order."""
    value = known(points, "points")
    require(
        value is not None, "`points` must be known when the program is traced; got a traced array."
    )
    assert value is not None
    good = (
        value.ndim == 1 and value.size and np.all(value == np.round(value)) and np.all(value >= 0)
    )
    require(
        good and len(np.unique(value)) == len(value),
        f"`points` must be different indices of landmarks, (m,) from 0 on; got {words(points)}.",
    )
    return jnp.sort(jnp.asarray(value.astype(int)))


class SpectralNoise(AbstractNoise):
    """Random Fourier series on a torus of period P: over the lattice ω ∈ (2π/P) Z^d, one of each
    pair ±ω,

        σ_ω(x) = √(2 q̂(ω)/P^d) (cos ω·x, sin ω·x),      σ_0 = √(q̂(0)/P^d)

    with q̂ the Fourier transform of the covariance. No factorisation; the noise does not depend on
    the number of points.

    **Arguments:**

    - `num_modes`: largest frequency per axis; (2 num_modes + 1)^dim noises per coordinate.
    - `period`: P, which must exceed the extent of the shapes along each axis: the wrap-around is
      a(P − extent). By default `diameter + 8.6 length_scale` for the Gaussian kernel's length scale
      (wrap-around 1e-8). Where the wrap-around exceeds half of a(x, x) the noise is NaN.
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
        require_positive(
            self.diameter, "diameter", "Give the largest distance of two points that is expected."
        )
        require(
            self.diameter.ndim == 0,
            f"`diameter` must be one number; got shape {self.diameter.shape}.",
        )
        if self.period is not None:
            require_positive(
                self.period, "period", "Give the side of a box that the shapes stay well inside."
            )
            require(
                self.period.ndim == 0,
                f"`period` must be one number for all axes; got shape {self.period.shape}.",
            )

    def _period(self, kernel, covariance):
        if self.period is not None:
            return self.period
        known = covariance if kernel is None else kernel
        if not hasattr(known, "length_scale"):
            raise ValueError(
                "`period` must be given to SpectralNoise: this kernel has no single length scale."
            )
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
        return jnp.concatenate(
            [scale[None] * jnp.cos(phase), (scale[None] * jnp.sin(phase))[:, 1:]], axis=1
        )

    def misfit(self, kernel, covariance, points):
        extent = jnp.max(jnp.max(points, axis=0) - jnp.min(points, axis=0))
        return self._wrap_around(kernel, covariance, points.shape[1], lax.stop_gradient(extent))

    def room(self, kernel, covariance, points):
        extent = np.max(np.ptp(points, axis=0))
        period = self._period(kernel, covariance)
        return (
            f"its extent along an axis, {extent:.4g}, must stay below the `period` of "
            f"`SpectralNoise`, {period:.4g}, by several length scales of the covariance. Give "
            f"`SpectralNoise(num_modes, diameter={1.5 * extent:.2g})` with more modes in "
            "proportion and without a `period`, or scale the shapes"
        )

    def _wrap_around(self, kernel, covariance, dim: int, extent) -> Array:
        """The covariance of two points at the ends of a shape with each other's periodic image."""
        period = self._period(kernel, covariance)
        gap = jnp.maximum(period - extent.astype(period.dtype), 0)
        ends = gap * np.eye(2, dim, k=-1, dtype=gap.dtype)
        values = covariance.matrix(ends[:1], ends)[0]
        none = values[0] == 0  # an amplitude that underflows
        return lax.select(
            none, jnp.zeros_like(values[1]), values[1] / jnp.where(none, 1.0, values[0])
        )

    def error(self, kernel, covariance, dim, points):
        """The truncated `tail` (variance missing at a point), and the `wrap_around`, at the given
        diameter or for the states."""
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

    The weight is the square root of the cell's volume: without it the noise grows as the grid is
    refined. Right for points at least about three length scales inside the box; NaN outside of it.

    **Arguments:** `lower`, `upper`: corners of the box, scalars or `(dim,)`; `num_cells`: cells per
    axis.
    """

    lower: Array
    upper: Array
    num_cells: int = eqx.field(static=True)
    fixed_in_space = True

    def __init__(self, lower=-3.0, upper=3.0, num_cells: int = 24):
        self.lower = as_float(lower, "lower")
        self.upper = as_float(upper, "upper")
        require_finite(self.lower, "lower")
        require_finite(self.upper, "upper")
        shapes = {self.lower.shape, self.upper.shape} - {()}
        require(
            len(shapes) < 2 and all(len(shape) == 1 for shape in shapes),
            "`lower` and `upper` must be numbers or corners (dim,) of a box; got shapes "
            f"{self.lower.shape} and {self.upper.shape}.",
        )
        require(
            jnp.all(self.lower < self.upper),
            f"`lower` must be below `upper`; got {lower} and {upper}.",
        )
        self.num_cells = positive_integer(num_cells, "num_cells")

    def factor(self, kernel, covariance, points):
        sigma = self._quadrature(kernel, points, self.num_cells)
        inside = jnp.all(
            (points >= self.lower.astype(points.dtype))
            & (points <= self.upper.astype(points.dtype))
        )
        return jnp.where(inside, sigma, jnp.nan)

    def _quadrature(self, kernel, points, num_cells: int):
        if kernel is None:
            raise ValueError(
                '`noise="grid"` needs the flow\'s `kernel`; with `covariance=` use '
                '"landmark" or "spectral".'
            )
        dim = points.shape[1]
        corners = {self.lower.shape, self.upper.shape}
        require(
            corners <= {(), (dim,)},
            f"`lower` and `upper` must be numbers or corners ({dim},) of a box; got shapes "
            f"{sorted(corners)}.",
        )
        width = jnp.broadcast_to((self.upper - self.lower) / num_cells, (dim,))
        index = np.array(list(itertools.product(range(num_cells), repeat=dim)), float) + 0.5
        cells = (
            jnp.broadcast_to(self.lower, (1, dim)) + jnp.asarray(index, points.dtype) * width[None]
        )
        return kernel.matrix(points, cells) * jnp.sqrt(jnp.prod(width))

    def misfit(self, kernel, covariance, points):
        # of cells half as wide: a coarse grid, whose error is of either sign, is not an edge
        variance = jnp.sum(self._quadrature(kernel, points, 2 * self.num_cells) ** 2, axis=1)
        return jnp.maximum(jnp.max(1 - variance / covariance.variance.astype(variance.dtype)), 0)

    def room(self, kernel, covariance, points):
        corners = [np.array2string(np.asarray(c), precision=4) for c in (self.lower, self.upper)]
        low, high = (np.array2string(f(points, axis=0), precision=4) for f in (np.min, np.max))
        return (
            f"its points, from {low} to {high}, must lie about three length scales inside the box "
            f"of `GridNoise`, from {corners[0]} to {corners[1]}. Give `GridNoise(lower, upper, "
            "num_cells)` a larger one, with cells no wider than the length scale, or move and "
            "scale the shapes"
        )

    def error(self, kernel, covariance, dim, points):
        """At the points of the states: the variance lost at the `edge` of the box, and the whole
        error of the `quadrature` of a(x, x)."""
        if points is None:
            return {}
        points = points.reshape(-1, dim)
        found = jnp.sum(self._quadrature(kernel, points, self.num_cells) ** 2, axis=1)
        quadrature = jnp.max(jnp.abs(1 - found / covariance.variance.astype(found.dtype)))
        return {"edge": self.misfit(kernel, covariance, points), "quadrature": quadrature}


NOISES: dict[str, Callable[[], AbstractNoise]] = {
    "landmark": LandmarkNoise,
    "control": ControlNoise,
    "spectral": SpectralNoise,
    "grid": GridNoise,
}


def name_of(noise: AbstractNoise) -> str:
    """By which `KunitaFlow` knows it."""
    (name,) = [name for name, kind in NOISES.items() if kind is type(noise)] or [
        type(noise).__name__
    ]
    return name
