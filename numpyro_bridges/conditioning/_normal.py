"""Normal probabilities of intervals in log space, accurate and with finite gradients deep in the tails."""

from collections.abc import Callable
from typing import cast

import jax
import jax.numpy as jnp
from jax.scipy import special
from jax.scipy.special import ndtri
from jaxtyping import Array, Float

log_ndtr = cast(Callable[[Array], Array], special.log_ndtr)

_LOG_SQRT_2PI = 0.9189385332046727
_FAR = 1e4
"""Stands in for an infinite bound, in standard deviations."""


def _left(lower: Array, upper: Array, *others: Array):
    """The interval mirrored into the left half where it lies in the right one, and what else changes sign with it."""
    lower = jnp.where(lower == -jnp.inf, -_FAR, lower)
    upper = jnp.where(upper == jnp.inf, _FAR, upper)
    flip = lower + upper > 0
    sign = jnp.where(flip, -1.0, 1.0)
    return (sign, jnp.where(flip, -upper, lower), jnp.where(flip, -lower, upper), *(sign * o for o in others))


def log_interval_probability(lower: Float[Array, "..."], upper: Float[Array, "..."]) -> Float[Array, "..."]:
    """log(Φ(upper) − Φ(lower)); bounds may be infinite. −inf for an empty interval."""
    _, low, high = _left(lower, upper)
    top = log_ndtr(high)
    gap = jnp.where(high > low, log_ndtr(low) - top, -1.0)
    return jnp.where(high > low, top + jnp.log(-jnp.expm1(gap)), -jnp.inf)


@jax.custom_jvp
def _log_ndtri(log_p: Float[Array, "..."]) -> Float[Array, "..."]:
    """The normal quantile of exp(log_p), from the logarithm: finite where exp(log_p) underflows."""
    start = jnp.where(
        log_p > -5.0, ndtri(jnp.exp(jnp.maximum(log_p, -5.0))), -jnp.sqrt(jnp.maximum(-2.0 * log_p - 2.0, 1.0))
    )

    def newton(_, w):
        step = (log_ndtr(w) - log_p) * jnp.exp(log_ndtr(w) + 0.5 * w * w + _LOG_SQRT_2PI)
        return w - jnp.where(jnp.isfinite(step), step, 0.0)

    return jax.lax.fori_loop(0, 5, newton, start)


@_log_ndtri.defjvp
def _(primals, tangents):
    w = log_ndtri(primals[0])
    return w, tangents[0] * jnp.exp(log_ndtr(w) + 0.5 * w * w + _LOG_SQRT_2PI)


log_ndtri = cast(Callable[[Array], Array], _log_ndtri)


def truncated_quantile(
    z: Float[Array, "..."], lower: Float[Array, "..."], upper: Float[Array, "..."]
) -> Float[Array, "..."]:
    """The standard normal truncated to [lower, upper] at the quantile of z: monotone, the identity without bounds."""
    free = jnp.isinf(lower) & jnp.isinf(upper) & (lower < upper)
    sign, low, high, z_left = _left(jnp.where(free, -1.0, lower), jnp.where(free, 1.0, upper), z)
    log_p = jnp.logaddexp(log_ndtr(low) + log_ndtr(-z_left), log_ndtr(high) + log_ndtr(z_left))
    w = jnp.clip(log_ndtri(jnp.minimum(log_p, -jnp.finfo(z.dtype).tiny)), low, high)
    return jnp.where(free, z, sign * w)


def truncated_quantile_inverse(
    w: Float[Array, "..."], lower: Float[Array, "..."], upper: Float[Array, "..."]
) -> Float[Array, "..."]:
    """The z with `truncated_quantile(z, lower, upper) = w`."""
    free = jnp.isinf(lower) & jnp.isinf(upper) & (lower < upper)
    sign, low, high, w_left = _left(jnp.where(free, -1.0, lower), jnp.where(free, 1.0, upper), w)
    below = log_interval_probability(low, w_left) - log_interval_probability(low, high)
    above = log_interval_probability(w_left, high) - log_interval_probability(low, high)
    z = jnp.where(below < above, log_ndtri(below), -log_ndtri(above))
    return jnp.where(free, w, sign * z)
