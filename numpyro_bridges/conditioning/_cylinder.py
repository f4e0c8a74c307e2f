"""Cylinder sets: the first coordinates of the end state in intervals, half-lines, points, or free.

A path that is conditioned on a set is led to a point drawn inside it. The point is drawn from the guide's own Gaussian
law of what is seen, N(μ, N Nᵀ) with N lower triangular, truncated one coordinate after the other (Genz 1992, the GHK
simulator): w_i is a normal truncated to the interval that the earlier coordinates leave, and with r the density of the
draw

    P(X_T ∈ Γ) = E[p(v | x0) / r(v)],      p / r = (p / N(v; μ, N Nᵀ)) Π_i P_i,

P_i being the probability of that interval. All paths end in Γ. Where the guide's law is exact and its covariance
diagonal, the weight is the product of the P_i, the same number for every noise.
"""

from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from .._checks import as_float, concrete, require, require_finite
from .._linalg import promote, varying_like
from .._types import State, Structured
from ..sdes import AbstractSDE
from ._base import AbstractCondition, AbstractMatch, Observation, Target, lift
from ._normal import _LOG_SQRT_2PI, log_interval_probability, truncated_quantile, truncated_quantile_inverse


class CylinderSet(AbstractCondition):
    """The event that lower ≤ X_T ≤ upper, coordinate by coordinate.

    Its evidence is the probability of the set (a density in the coordinates that are pinned to a point).

    **Arguments:**

    - `lower`, `upper`: `(N, dim)`, or `(N,)` for plain vectors, or scalars broadcast to it, for the first N ≤ n rows of
      the state: values at points or coefficients of an orthonormal basis. An infinite bound leaves that side free;
      equal bounds pin the coordinate. Rows that are known to be free are left out.
    """

    lower: State
    upper: State
    rows: tuple[int, ...] = eqx.field(static=True)
    exact: ClassVar[bool] = True
    num_extra_noises: ClassVar[int] = 1

    def __init__(self, lower, upper):
        lower, upper = as_float(lower, "lower"), as_float(upper, "upper")
        shapes = lower.shape, upper.shape
        require(
            shapes[0] == shapes[1] or () in shapes,
            f"`lower` and `upper` must have one shape, or one of them be a scalar; got {shapes[0]} and {shapes[1]}.",
        )
        lower, upper = jnp.broadcast_arrays(lower, upper)
        require(lower.ndim >= 1, "`lower` and `upper` must have one row per coordinate, (N,) or (N, dim); got scalars.")
        low, high = concrete(lower), concrete(upper)
        if low is not None and high is not None:
            require(
                not (np.isnan(low).any() or np.isnan(high).any()),
                f"`lower` and `upper` must not be NaN; got {low} and {high}. Use ±inf for a free side.",
            )
            bad = ~((low <= high) & (low < np.inf) & (high > -np.inf))
            require(
                not bad.any(),
                f"`lower` must not exceed `upper`, or the set is empty; got {low[bad][:1]} above {high[bad][:1]} in "
                f"{int(bad.sum())} entries. Exchange them.",
            )
            seen = (np.isfinite(low) | np.isfinite(high)).reshape(len(low), -1).any(1)
            rows = np.flatnonzero(seen) if seen.any() else np.arange(1)
        else:
            rows = np.arange(lower.shape[0])
        self.rows = tuple(int(i) for i in rows)
        self.lower, self.upper = lower[rows], upper[rows]

    def check(self, sde, x):
        n = x.shape[0]
        require(
            max(self.rows) < n and self.lower.shape[1:] == x.shape[1:],
            f"`lower` and `upper` must have a row for each of at most {n} rows of a state {x.shape}, (N, dim) or (N,) "
            f"like it; got rows of shape {self.lower.shape[1:]}, the last not free being number {max(self.rows)}.",
        )

    def observation(self, sde, x):
        n = x.shape[0]
        rows = jnp.eye(n, dtype=x.dtype)[np.array(self.rows)]
        operator = jnp.ones((), x.dtype) if self.rows == tuple(range(n)) else rows
        return Observation(operator, None, jnp.zeros((), x.dtype))

    def reference(self, sde, x):
        low, high = self.lower.astype(x.dtype), self.upper.astype(x.dtype)
        return lift(self.observation(sde, x).operator, x, jnp.clip(x[np.array(self.rows)], low, high))

    def _scan(self, mean: State, factor: Structured, choose: Callable[..., Array], driver: State):
        """Coordinate after coordinate: its standardised interval, the value chosen in it, its log weight."""
        m = mean.shape[0]
        lower, upper = self.lower.astype(mean.dtype), self.upper.astype(mean.dtype)

        def one(low: Array, high: Array, center: Array, z: Array, scale: Array):
            low, high = _standardise(low, center, scale), _standardise(high, center, scale)
            pinned = low == high
            w = jnp.where(pinned, low, choose(z, jnp.where(pinned, -1.0, low), jnp.where(pinned, 1.0, high)))
            chosen = log_interval_probability(low, high) + 0.5 * w * w + _LOG_SQRT_2PI + jnp.log(scale)
            return w, jnp.where(pinned, 0.0, chosen)

        if factor.ndim < 2:
            d = jnp.broadcast_to(factor, (m,)) if mean.ndim == 1 else jnp.broadcast_to(factor, (m,))[:, None]
            return one(lower, upper, mean, driver, d)

        def step(w, i):
            w_i, log_weight = one(lower[i], upper[i], mean[i] + factor[i] @ w, driver[i], factor[i, i])
            return w.at[i].set(w_i), log_weight

        start = varying_like(jnp.zeros_like(mean), mean, factor, driver, lower, upper)
        return jax.lax.scan(step, start, jnp.arange(m))

    def log_value(self, law_mean, law_factor):
        """In product form: coordinates independent given the state."""
        scale = law_factor if law_factor.ndim < 2 else jnp.linalg.norm(law_factor, axis=1)
        scale = scale[:, None] if scale.ndim and law_mean.ndim == 2 else scale
        low, high = _standardise(self.lower, law_mean, scale), _standardise(self.upper, law_mean, scale)
        pinned = low == high
        density = -0.5 * low**2 - _LOG_SQRT_2PI - jnp.log(scale)
        inside = log_interval_probability(jnp.where(pinned, -1.0, low), jnp.where(pinned, 1.0, high))
        return jnp.sum(jnp.where(pinned, density, inside))

    def target(self, law_mean, law_factor, noise):
        m = law_mean.shape[0]
        w, log_weights = self._scan(law_mean, law_factor, truncated_quantile, noise[0, :m])
        d: Array = law_factor[:, None] if law_factor.ndim == 1 and w.ndim == 2 else law_factor
        value = law_mean + (law_factor @ w if law_factor.ndim == 2 else d * w)
        low, high = self.lower.astype(value.dtype), self.upper.astype(value.dtype)
        return Target(jnp.clip(value, low, high), jnp.sum(log_weights))

    def noise_from_target(self, law_mean, law_factor, seen):
        m = law_mean.shape[0]
        factor = promote(law_factor, 2, m)
        w = jnp.linalg.solve(factor, seen - law_mean)
        scale = jnp.diagonal(factor) if seen.ndim == 1 else jnp.diagonal(factor)[:, None]
        center = seen - scale * w
        low, high = _standardise(self.lower, center, scale), _standardise(self.upper, center, scale)
        pinned = low == high
        z = truncated_quantile_inverse(w, jnp.where(pinned, -jnp.inf, low), jnp.where(pinned, jnp.inf, high))
        return z[None]


def _standardise(bound: State, mean: State, scale: State) -> State:
    """(bound − mean)/scale, with finite gradients where the bound is infinite."""
    infinite = jnp.isinf(bound)
    return jnp.where(infinite, bound, (jnp.where(infinite, 0.0, bound) - mean) / scale)


class IntervalCensored(AbstractMatch):
    """Each coordinate is seen only as the number of the bin that it falls into.

    **Arguments:** `cuts`: increasing cut points `(c,)`; bin 0 is below the first, bin c above the last.

    `at(bins)` is the `CylinderSet` of these bins.
    """

    cuts: Array
    exact: ClassVar[bool] = True

    def __init__(self, cuts):
        self.cuts = as_float(cuts, "cuts")
        value = concrete(self.cuts)
        require(
            self.cuts.ndim == 1 and self.cuts.size >= 1,
            f"`cuts` must be a vector of cut points; got shape {self.cuts.shape}.",
        )
        require_finite(self.cuts, "cuts", "The outer bins are open without it.")
        require(value is None or np.all(np.diff(value) > 0), f"`cuts` must increase; got {value}. Sort them.")

    def at(self, observed) -> AbstractCondition:
        bins = as_float(observed, "observed")
        value = concrete(bins)
        require(
            value is None or np.all((value == np.round(value)) & (value >= 0) & (value <= self.cuts.size)),
            f"`observed` must hold bin numbers from 0 to {self.cuts.size}; got {value}. Values are put into bins by "
            "`numpy.searchsorted(cuts, values)`.",
        )
        bins = bins.astype(int)
        infinity = jnp.full((1,), jnp.inf, self.cuts.dtype)
        edges = jnp.concatenate([-infinity, self.cuts, infinity])
        return CylinderSet(edges[bins], edges[bins + 1])

    def sample(self, key: PRNGKeyArray, sde: AbstractSDE, x: State) -> Array:
        return jnp.searchsorted(self.cuts, x).astype(x.dtype)

    def check_density(self) -> None:
        pass
