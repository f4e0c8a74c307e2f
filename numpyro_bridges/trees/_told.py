"""What is seen below a node, for guides whose covariances follow the state.

A guide that follows wants of a node what it wants of an observation, and beside it the time beyond: a law

    value = L x + N(0, Σ + κ L a Lᵀ)

of the state x, for whatever covariance a the process has where a path is. With a = a₀ frozen, messages of a Brownian
motion give H = Lᵀ (Σ + κ L a₀ Lᵀ)⁻¹ L and F = H x̂. The part κ is the time to the tips of a tree on which nothing but
branches counts, where the tips' errors are at most the true ones; parallel sums of positive matrices are monotone, so
what is left, Σ, is a covariance:

- everything seen:      L = 1,    Σ = H⁻¹ − κ a₀,       value H⁻¹ F;
- some of it:           L = Rᵀ,   Σ = 1 − κ Rᵀ a₀ R,    value R⁻¹ F,     R Rᵀ = H.

A subtree is a tip whose branch is longer (Felsenstein 1973), and Σ is its error. a₀ is one for the tree.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from .._linalg import add, cholesky, congruence, diagonal, promote, solve_lower
from .._types import State, Structured
from ..conditioning import GaussianMessage, Observation

_KEPT = 0.01
"""The part of κ a that does not follow: rounding, of whatever precision, is less than it and so leaves a covariance."""


class Told(NamedTuple):
    """Sums over branches that meet, and over what is seen of a node."""

    H: Float[Array, "n n"]
    F: State
    rate: Float[Array, ""]
    """1/κ."""

    def __add__(self, other):  # type: ignore[override]
        return Told(*(a + b for a, b in zip(self, other, strict=True)))


def nothing_told(like: State) -> Told:
    """The sums over nothing."""
    n = like.shape[0]
    return Told(jnp.zeros((n, n), like.dtype), jnp.zeros_like(like), jnp.zeros((), like.dtype))


def told_by(seen: Observation, observed: State, time: Array, a: Structured, n: int) -> Told:
    """What an observation tells of the state, of n rows, a time before."""
    factor = cholesky(add(seen.covariance, time * congruence(seen.operator, a)))
    H, F = _information(seen, factor, observed, n)
    if seen.exact:
        return Told(H, F, 1 / time)
    error, _ = _information(seen, seen.factor, observed, n)
    # κ a for the κ of which this is the rate is no more than the error, for whatever direction
    rate = jnp.trace(error) * jnp.sum(diagonal(a, n))
    return Told(H, F, _after(rate, time))


def _information(seen, factor, observed, n):
    message = GaussianMessage(seen.operator, jnp.zeros_like(observed), factor, observed, jnp.zeros((), factor.dtype))
    H, F, _ = message.information(n)
    return H, F.reshape((n, *observed.shape[1:]))


def _after(rate, time):
    """1/(κ + t)."""
    return rate / (1 + time * rate)


class Seen(NamedTuple):
    """What is told as an observation of the node."""

    seen: Observation
    value: State
    beyond: Array
    """κ."""
    reference: State
    """A state that agrees with it."""


def as_seen(told: Told, a: Structured, everything: bool) -> Seen:
    """`everything`: whether all of every state is seen."""
    n, dtype = told.F.shape[0], told.F.dtype
    eye = jnp.eye(n, dtype=dtype)
    R = cholesky(told.H + _nugget(told.H))
    value = solve_lower(R, told.F)
    mean = solve_lower(R, value, transposed=True)
    kappa = jnp.where(told.rate > 0, 1 / jnp.where(told.rate > 0, told.rate, 1.0), 0.0)
    if everything:
        inverse = solve_lower(R, eye)
        operator, value, whole = jnp.ones((), dtype), mean, inverse.T @ inverse
    else:
        operator, whole = R.T, eye
    kappa = (1 - _KEPT) * kappa
    error = whole - kappa * promote(congruence(operator, a), 2, n)
    found = jnp.all(jnp.isfinite(cholesky(lax.stop_gradient(error))))  # and where it does not, nothing follows
    factor = cholesky(jnp.where(found, error, whole))
    return Seen(Observation(operator, factor, jnp.zeros((), dtype)), value, jnp.where(found, kappa, 0.0), mean)


def earlier(told: Told, time: Array, a: Structured) -> Told:
    """What is told of a node tells of the state a time before."""
    n = told.F.shape[0]
    R = cholesky(told.H + _nugget(told.H))
    one = jnp.ones((), told.F.dtype)
    factor = cholesky(jnp.eye(n, dtype=told.F.dtype) + time * promote(congruence(R.T, a), 2, n))
    H, F = _information(Observation(R.T, one, 0 * one), factor, solve_lower(R, told.F), n)
    return Told(H, F, _after(told.rate, time))


def _nugget(H):
    """What is not seen at all has no information; to rounding."""
    relative = 1e-12 if H.dtype == jnp.float64 else 1e-6
    return relative * jnp.max(jnp.diagonal(H)) * jnp.eye(H.shape[0], dtype=H.dtype)
