"""Cylinder sets: the first coordinates of the end state in intervals, half-lines, points, or free.

A path that is conditioned on a set is led to a point drawn inside it. The point is drawn from the
guide's own Gaussian law of what is seen, N(μ, N Nᵀ) with N lower triangular, truncated one
coordinate after the other (Genz 1992, the GHK simulator): w_i is a normal truncated to the interval
that the earlier coordinates leave, and with r the density of the draw

    P(X_T ∈ Γ) = E[p(v | x0) / r(v)],      p / r = (p / N(v; μ, N Nᵀ)) Π_i P_i,

P_i being the probability of that interval. All paths end in Γ. Where the guide's law is exact and
its covariance diagonal, the weight is the product of the P_i, the same number for every noise.
"""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from .._checks import as_float, known, require, require_finite
from .._linalg import solve_lower, varying_like
from .._types import State, Structured
from ..sdes import AbstractSDE
from ._base import AbstractCondition, AbstractMatch, Observation, Target, lift
from ._normal import (
    _LOG_SQRT_2PI,
    log_interval_probability,
    truncated_quantile,
    truncated_quantile_inverse,
)


class CylinderSet(AbstractCondition):
    """The event that lower ≤ X_T ≤ upper, coordinate by coordinate.

    Its evidence is the probability of the set (a density in the coordinates that are pinned to a
    point).

    **Arguments:**

    - `lower`, `upper`: `(N, dim)`, or `(N,)` for plain vectors, or scalars broadcast to it, for the
      first N ≤ n rows of the state: values at points or coefficients of an orthonormal basis. An
      infinite bound leaves that side free; equal bounds pin the coordinate, and unequal ones never
      do, be they closer than single precision tells apart. Rows whose bounds are known to be
      infinite, inside a traced function too, are left out. Bounds that are traced themselves keep
      all their rows: the same probability, from other paths.

    **Errors:** `ValueError` where `lower` exceeds `upper`, for NaN and for no rows. A traced
    `lower` above `upper` weighs −inf, the set being empty; a traced NaN weighs NaN.
    """

    lower: State
    upper: State
    lost: State
    rows: tuple[int, ...] = eqx.field(static=True)
    exact: ClassVar[bool] = True
    num_extra_noises: ClassVar[int] = 1

    def __init__(self, lower, upper):
        # As the user gave them, before they are rounded: what is pinned, what is free and how wide
        # an interval is are asked of these.
        low = known(lower, "lower")
        high = known(upper, "upper")
        lower = as_float(lower, "lower")
        upper = as_float(upper, "upper")
        shapes = lower.shape, upper.shape
        require(
            shapes[0] == shapes[1] or () in shapes,
            f"`lower` and `upper` must have one shape, or one of them be a scalar; got {shapes[0]} "
            f"and {shapes[1]}.",
        )
        lower, upper = jnp.broadcast_arrays(lower, upper)
        require(
            lower.ndim >= 1,
            "`lower` and `upper` must have one row per coordinate, (N,) or (N, dim); got scalars.",
        )
        require(
            lower.size >= 1,
            f"`lower` and `upper` must bound at least one coordinate; got shape {lower.shape}.",
        )
        rows = np.arange(lower.shape[0])
        lost = jnp.zeros_like(lower)
        if low is not None and high is not None:
            low, high = np.broadcast_arrays(low, high)
            rows = _bounded_rows(low, high)
            lost = jnp.asarray(_lost_width(low, high, lower.dtype), lower.dtype)
        # Static: how many rows are seen is the shape of an observation.
        self.rows = tuple(int(i) for i in rows)
        self.lower = lower[rows]
        self.upper = upper[rows]
        self.lost = lost[rows]

    def check(self, sde, x):
        n = x.shape[0]
        require(
            max(self.rows) < n and self.lower.shape[1:] == x.shape[1:],
            f"`lower` and `upper` must have a row for each of at most {n} rows of a state "
            f"{x.shape}, (N, dim) or (N,) like it; got rows of shape {self.lower.shape[1:]}, the "
            f"last not free being number {max(self.rows)}.",
        )

    def observation(self, sde, x):
        n = x.shape[0]
        rows = jnp.eye(n, dtype=x.dtype)[np.array(self.rows)]
        # All rows are the identity, a scalar: elementwise work, not products with a matrix.
        operator = jnp.ones((), x.dtype) if self.rows == tuple(range(n)) else rows
        # A path is led to a point of the set, which it meets exactly.
        return Observation(operator, None, jnp.zeros((), x.dtype))

    def reference(self, sde, x):
        low = self.lower.astype(x.dtype)
        high = self.upper.astype(x.dtype)
        nearest = jnp.clip(x[np.array(self.rows)], low, high)
        return lift(self.observation(sde, x).operator, x, nearest)

    def displaced(self, shift):
        # `lost` is of the width, which a shift leaves as it is.
        def bounds(box):
            return box.lower, box.upper

        return eqx.tree_at(bounds, self, (self.lower - shift, self.upper - shift))

    def _bounds(self, like: State) -> tuple[State, State, State, Array]:
        """Bounds and lost width in the precision of a state, and which coordinates are pinned."""
        # Asked before the bounds are rounded, which may make close ones equal.
        pinned = (self.lower == self.upper) & (self.lost == 0)
        lower, upper, lost = (a.astype(like.dtype) for a in (self.lower, self.upper, self.lost))
        return lower, upper, lost, pinned

    def _scan(self, mean: State, factor: Structured, driver: State) -> tuple[State, State]:
        """Coordinate after coordinate: the value chosen in its interval, and its log weight."""
        m = mean.shape[0]
        bounds = self._bounds(mean)

        def one(interval: tuple[Array, ...], center: Array, z: Array, scale: Array):
            """A coordinate that is N(center, scale²) given those before it."""
            low, high, lost, pinned = interval
            empty = scale == 0
            scale = jnp.where(empty, 1.0, scale)
            drawn = truncated_quantile(z, *_free_where(pinned, low, high), center, scale, lost)
            value = jnp.where(pinned, low, jnp.where(empty, jnp.clip(center, low, high), drawn))
            w = (value - center) / scale
            inside = log_interval_probability(*_free_where(pinned, low, high), center, scale, lost)
            # −log r of the draw: r = N(value; center, scale²) / P. A pinned coordinate is not
            # drawn, and its density is in the weight of the path.
            chosen = inside + 0.5 * w * w + _LOG_SQRT_2PI + jnp.log(scale)
            # a value without variance is outside the set, or inside, where its choice has no
            # density
            chosen = jnp.where(empty, jnp.where(value == center, jnp.nan, -jnp.inf), chosen)
            return value, jnp.where(pinned, 0.0, chosen), w

        if factor.ndim < 2:  # independent coordinates, all at once
            value, log_weight, _ = one(bounds, mean, driver, _column(factor, mean))
            return value, log_weight

        def step(w, i):
            # Of w the entries from i on are 0 still: N w is what earlier coordinates have moved.
            interval = tuple(a[i] for a in bounds)
            value, log_weight, w_i = one(interval, mean[i] + factor[i] @ w, driver[i], factor[i, i])
            return w.at[i].set(w_i), (value, log_weight)

        start = varying_like(jnp.zeros_like(mean), mean, factor, driver, *bounds)
        return jax.lax.scan(step, start, jnp.arange(m))[1]

    def log_value(self, law_mean, law_factor):
        """In product form: coordinates independent given the state."""
        lower, upper, lost, pinned = self._bounds(law_mean)
        # The probability of a box under dependence has no closed form: its marginals stand for it.
        scale = law_factor if law_factor.ndim < 2 else jnp.linalg.norm(law_factor, axis=1)
        scale = _column(scale, law_mean)
        w = (jnp.where(pinned, lower, 0.0) - law_mean) / scale
        density = -0.5 * w * w - _LOG_SQRT_2PI - jnp.log(scale)
        inside = log_interval_probability(*_free_where(pinned, lower, upper), law_mean, scale, lost)
        return jnp.sum(jnp.where(pinned, density, inside))

    def target(self, law_mean, law_factor, noise):
        value, log_weights = self._scan(law_mean, law_factor, noise[0, : law_mean.shape[0]])
        impossible = jnp.any(log_weights == -jnp.inf)  # whatever the others weigh
        return Target(value, jnp.where(impossible, -jnp.inf, jnp.sum(log_weights)))

    def noise_from_target(self, law_mean, law_factor, seen):
        lower, upper, lost, pinned = self._bounds(seen)
        center = law_mean
        scale = law_factor
        if law_factor.ndim == 2:
            # w = N⁻¹ (v − μ) is known, all at once, and v_i = center_i + N_ii w_i.
            scale = _column(jnp.diagonal(law_factor), seen)
            center = seen - scale * solve_lower(law_factor, seen - law_mean)
        scale = _column(scale, seen)
        return truncated_quantile_inverse(
            seen, *_free_where(pinned, lower, upper), center, scale, lost
        )[None]


def _bounded_rows(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Rows with a finite bound, of bounds that are known; the first if there is none."""
    require(
        not (np.isnan(low).any() or np.isnan(high).any()),
        f"`lower` and `upper` must not be NaN; got {low} and {high}. Use ±inf for a free side.",
    )
    bad = ~((low <= high) & (low < np.inf) & (high > -np.inf))
    require(
        not bad.any(),
        f"`lower` must not exceed `upper`, or the set is empty; got {low[bad][:1]} above "
        f"{high[bad][:1]} in {int(bad.sum())} entries. Exchange them.",
    )
    seen = (np.isfinite(low) | np.isfinite(high)).reshape(len(low), -1).any(1)
    return np.flatnonzero(seen) if seen.any() else np.arange(1)


def _lost_width(low: np.ndarray, high: np.ndarray, dtype) -> np.ndarray:
    """What high − low loses where both are rounded to `dtype`; 0 where one of them is infinite."""
    finite = np.isfinite(low) & np.isfinite(high)
    low = np.where(finite, low, 0.0)
    high = np.where(finite, high, 0.0)
    return (high - low) - (high.astype(dtype) - low.astype(dtype)).astype(float)


def _free_where(pinned: Array, lower: Array, upper: Array) -> tuple[Array, Array]:
    """Bounds that are harmless where a coordinate is pinned."""
    return jnp.where(pinned, -jnp.inf, lower), jnp.where(pinned, jnp.inf, upper)


def _column(d: Structured, x: State) -> Structured:
    """A scalar or diagonal shaped to scale the rows of x."""
    return d[:, None] if d.ndim == 1 and x.ndim == 2 else d


class IntervalCensored(AbstractMatch):
    """Each coordinate is seen only as the number of the bin that it falls into.

    **Arguments:** `cuts`: increasing cut points `(c,)`; bin 0 is below the first, bin c above the
    last.

    `at(bins)` is the `CylinderSet` of these bins.
    """

    cuts: Array
    lost: Array
    exact: ClassVar[bool] = True

    def __init__(self, cuts):
        value = known(cuts, "cuts")
        self.cuts = as_float(cuts, "cuts")
        require(
            self.cuts.ndim == 1 and self.cuts.size >= 1,
            f"`cuts` must be a vector of cut points; got shape {self.cuts.shape}.",
        )
        require_finite(self.cuts, "cuts", "The outer bins are open without it.")
        self.lost = jnp.zeros((self.cuts.size + 1,), self.cuts.dtype)
        if value is not None:
            require(np.all(np.diff(value) > 0), f"`cuts` must increase; got {value}. Sort them.")
            lost = _lost_width(value[:-1], value[1:], self.cuts.dtype)
            self.lost = self.lost.at[1:-1].set(jnp.asarray(lost, self.cuts.dtype))

    def at(self, observed) -> AbstractCondition:
        """The set of the bins `observed`; a traced number that is none of a bin weighs NaN."""
        value = known(observed, "observed")
        numbers = as_float(observed, "observed")
        count = self.cuts.size
        require(
            numbers.size > 0 and numbers.ndim > 0,
            "`observed` must have one bin number per coordinate, (N,) or (N, dim); got shape "
            f"{numbers.shape}.",
        )
        require(
            value is None or np.all((value == np.round(value)) & (value >= 0) & (value <= count)),
            f"`observed` must hold bin numbers from 0 to {count}; got {value}. Values are put "
            "into bins by `numpy.searchsorted(cuts, values)`.",
        )
        bins = jnp.clip(numbers, 0, count).astype(int)
        infinity = jnp.full((1,), jnp.inf, self.cuts.dtype)
        edges = jnp.concatenate([-infinity, self.cuts, infinity])
        is_bin = numbers == bins.astype(numbers.dtype)
        lower = jnp.where(is_bin, edges[bins], jnp.nan)
        upper = jnp.where(is_bin, edges[bins + 1], jnp.nan)
        box = CylinderSet(lower, upper)
        # The set sees cut points that are rounded already; what that lost was kept with the cuts.
        return eqx.tree_at(lambda box: box.lost, box, self.lost[bins])

    def sample(self, key: PRNGKeyArray, sde: AbstractSDE, x: State) -> Array:
        return jnp.searchsorted(self.cuts, x).astype(x.dtype)

    def check_density(self) -> None:
        pass
