"""Normal probabilities of intervals, and normals truncated to them, near or far, in log space.

An interval of N(mean, scale²) is mirrored until its middle is not negative and held, in standard
units, by its near end s and its width d, each by itself: s + d may round to s, and a probability is
of the size of d. With Mills' ratio m(t) = (1 − Φ(t))/φ(t),

    P = φ(s) I(s, d),      I(s, d) = ∫₀^d exp(−s v − v²/2) dv = m(s) − m(s + d) exp(−s d − d²/2)

has every digit however far out, log φ(s) being a square; a short I is a quadrature. Only where 0
lies well inside is P the complement of two tails. A draw s + u solves I(s, u) = p I(s, d), by
Newton's method in the cumulative hazard −log(1 − I(s, u)/m(s)), which is convex in u.
"""

from collections.abc import Callable
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy import special
from jax.scipy.special import ndtri
from jaxtyping import Array, ArrayLike, Float

log_ndtr = cast(Callable[[Array], Array], special.log_ndtr)

_LOG_SQRT_2PI = 0.9189385332046727
_LOG_2 = 0.6931471805599453
_ROOT_HALF = 0.7071067811865476
_ROOT_HALF_PI = 1.2533141373155003
_FAR = 12.0
"""Where Mills' ratio becomes its asymptotic series, in standard deviations."""
_SERIES = tuple(float(c) for c in np.cumprod([1.0, *range(-1, -23, -2)]))
"""The coefficients of the series, (−1)^k (2k − 1)!!."""
_BEYOND = 1e4
"""Standard deviations beyond every draw between two tails."""
_SHORT = 0.5
"""Up to which d (|s| + 1) an interval is integrated by quadrature."""
_ROOTS, _GAUSS = np.polynomial.legendre.leggauss(5)
_NODES = 0.5 + 0.5 * _ROOTS
_WEIGHTS = 0.5 * _GAUSS
"""Gauss–Legendre on [0, 1]."""


class _Mirrored(NamedTuple):
    """[s, s + d] or [−s − d, −s] by `sign`, s + d/2 ≥ 0; d: inf for a half-line, 0 if empty."""

    sign: Array
    s: Array
    d: Array
    free: Array


def _mirrored(
    lower: Array, upper: Array, mean: ArrayLike, scale: ArrayLike, lost: ArrayLike
) -> _Mirrored:
    no_lower = jnp.isinf(lower)
    no_upper = jnp.isinf(upper)
    # Infinite bounds are taken out before anything is computed of them: inf − inf is NaN, and so
    # is the slope of a number that is replaced only later.
    low = jnp.where(no_lower, 0.0, lower)
    high = jnp.where(no_upper, 0.0, upper)
    a = (low - mean) / scale
    b = (high - mean) / scale
    # From the bounds and not as b − a, which loses the digits of a narrow interval far out.
    d = jnp.where(no_lower | no_upper, jnp.inf, ((high - low) + lost) / scale)
    d = jnp.where((lower > upper) | (lower == jnp.inf) | (upper == -jnp.inf), 0.0, d)
    # to the right: a half-line to the left, and what has its middle left of 0
    flip = no_lower | (~no_upper & (a + b < 0))
    sign = jnp.where(flip, -1.0, 1.0).astype(a.dtype)
    return _Mirrored(sign, jnp.where(flip, -b, a), d, no_lower & no_upper & (lower < upper))


def _is_short(s: Array, d: Array) -> Array:
    return d * (jnp.abs(s) + 1) < _SHORT


def _one_sided(s: Array, d: Array) -> tuple[Array, Array, Array]:
    """Whether P is φ(s) I(s, d), on one side of 0 or short; s and d, harmless where it is not."""
    tail = (s >= 0) | _is_short(s, d)
    return tail, jnp.where(tail, s, 0.0), jnp.where(tail, d, 1.0)


def _mills(t: Array) -> Array:
    """m(t), for t ≥ −1."""
    # Each branch sees arguments of its own range: the other one's overflow would be NaN in slopes.
    near = jnp.minimum(t, _FAR)
    far = jnp.maximum(t, _FAR)
    # m(t) ~ (1/t) Σ_k c_k t^{−2k}, by Horner's scheme
    x = 1 / (far * far)
    total = jnp.zeros_like(far)
    for c in reversed(_SERIES):
        total = total * x + c
    ratio = _ROOT_HALF_PI * jnp.exp(0.5 * near * near) * special.erfc(near * _ROOT_HALF)
    return jnp.where(t < _FAR, ratio, total / far)


def _short_integral(s: Array, d: Array) -> Array:
    """I(s, d) where it is short, by quadrature."""
    # Python numbers, which keep the precision of s and d.
    total = jnp.zeros_like(d)
    for x, weight in zip(_NODES.tolist(), _WEIGHTS.tolist(), strict=True):
        v = x * d
        total = total + weight * jnp.exp(-v * (s + 0.5 * v))
    return d * total


def _integral(s: Array, d: Array) -> Array:
    """I(s, d), for s ≥ −1."""
    # The difference of a short interval's ends cancels; there the quadrature has every digit.
    short = _is_short(s, d)
    wide = jnp.where(short, 1.0, d)
    difference = _mills(s) - _mills(s + wide) * jnp.exp(-wide * (s + 0.5 * wide))
    return jnp.where(short, _short_integral(s, jnp.where(short, d, 0.0)), difference)


def _decay(s: Array, d: Array) -> tuple[Array, Array]:
    """φ(s + d)/φ(s), and that less 1, with finite derivatives for a half-line."""
    half_line = jnp.isinf(d)
    finite = jnp.where(half_line, 0.0, d)
    gap = finite * (s + 0.5 * finite)
    return jnp.where(half_line, 0.0, jnp.exp(-gap)), jnp.where(half_line, -1.0, jnp.expm1(-gap))


@jax.custom_jvp
def _log_integral(s: Float[Array, "..."], d: Float[Array, "..."]) -> Float[Array, "..."]:
    """log I(s, d), for s ≥ −1."""
    return jnp.log(_integral(s, d))


@_log_integral.defjvp
def _(primals: tuple[Array, ...], tangents: tuple[Array, ...]):
    # ∂I/∂d = φ(s + d)/φ(s), and ∂I/∂s = s I + φ(s + d)/φ(s) − 1 by parts.
    s, d = primals
    value = log_integral(s, d)
    decay, less = _decay(s, d)
    ratio = jnp.exp(-value)
    return value, (s + ratio * less) * tangents[0] + _times(ratio * decay, tangents[1], d)


log_integral = cast(Callable[[Array, Array], Array], _log_integral)


def _times(slope: Array, tangent: Array, d: Array) -> Array:
    """slope · tangent; 0 where a half-line has no far end to move."""
    return jnp.where(jnp.isinf(d), 0.0, slope) * tangent


@jax.custom_jvp
def _log_probability(s: Float[Array, "..."], d: Float[Array, "..."]) -> Float[Array, "..."]:
    """log P of [s, s + d], s + d/2 ≥ 0 and d > 0."""
    tail, start, width = _one_sided(s, d)
    # φ(s) I(s, d), or, where 0 lies well inside, 1 less the two tails
    inside = jnp.log(_integral(start, width))
    outside = 0.5 * (special.erfc(-s * _ROOT_HALF) + special.erfc((s + d) * _ROOT_HALF))
    complement = jnp.log1p(-jnp.where(tail, 0.0, outside))
    return jnp.where(tail, inside - 0.5 * s * s - _LOG_SQRT_2PI, complement)


@_log_probability.defjvp
def _(primals: tuple[Array, ...], tangents: tuple[Array, ...]):
    """Densities at both ends over P, and their difference where the interval moves as a whole."""
    s, d = primals
    value = log_probability(s, d)
    tail, start, width = _one_sided(s, d)
    inside = log_integral(start, width)
    # φ(s)/P; in a tail φ(s) cancels
    ratio = jnp.exp(jnp.where(tail, -inside, -0.5 * s * s - _LOG_SQRT_2PI - value))
    decay, less = _decay(s, d)
    return value, ratio * less * tangents[0] + _times(ratio * decay, tangents[1], d)


log_probability = cast(Callable[[Array, Array], Array], _log_probability)


def log_interval_probability(
    lower: Float[Array, "..."],
    upper: Float[Array, "..."],
    mean: ArrayLike = 0.0,
    scale: ArrayLike = 1.0,
    lost: ArrayLike = 0.0,
) -> Float[Array, "..."]:
    """log P(lower ≤ N(mean, scale²) ≤ upper); bounds may be infinite. −inf for an empty interval,
    NaN for NaN.

    `lost`: what upper − lower has lost by rounding of the bounds.
    """
    interval = _mirrored(jnp.asarray(lower), jnp.asarray(upper), mean, scale, lost)
    empty = interval.d <= 0
    value = log_probability(interval.s, jnp.where(empty, 1.0, interval.d))
    return jnp.where(interval.free, 0.0, jnp.where(empty, -jnp.inf, value))


@jax.custom_jvp
def _log_ndtri(log_p: Float[Array, "..."]) -> Float[Array, "..."]:
    """The normal quantile of exp(log_p), from the logarithm: finite where exp(log_p) underflows."""
    # Near, the quantile itself; far out log Φ(w) ≈ −w²/2. Newton's method does the rest, in the
    # logarithm, which is concave.
    start = jnp.where(
        log_p > -5.0,
        ndtri(jnp.exp(jnp.maximum(log_p, -5.0))),
        -jnp.sqrt(jnp.maximum(-2.0 * log_p - 2.0, 1.0)),
    )

    def newton(_, w):
        # d log Φ/dw = φ(w)/Φ(w)
        step = (log_ndtr(w) - log_p) * jnp.exp(log_ndtr(w) + 0.5 * w * w + _LOG_SQRT_2PI)
        return w - jnp.where(jnp.isfinite(step), step, 0.0)

    return jax.lax.fori_loop(0, 5, newton, start)


@_log_ndtri.defjvp
def _(primals: tuple[Array, ...], tangents: tuple[Array, ...]):
    w = log_ndtri(primals[0])
    return w, tangents[0] * jnp.exp(log_ndtr(w) + 0.5 * w * w + _LOG_SQRT_2PI)


log_ndtri = cast(Callable[[Array], Array], _log_ndtri)


def _past(s: Array, hazard: Array) -> Array:
    """The u ≥ 0 with −log(1 − I(s, u)/m(s)) = hazard, s ≥ −1.

    The left side is convex in u, so from above Newton's method is monotone.
    """
    # Its slope at u = 0 is 1/m(s), its second derivative there (1/m)(1/m − s): the root of that
    # parabola is the start.
    m = _mills(s)
    slope = 1 / m
    curvature = jnp.clip(slope * (slope - s), 0.3, 1.0)
    start = 2 * hazard / (slope + jnp.sqrt(slope * slope + 2 * curvature * hazard))

    def newton(_, u: Array):
        short = _is_short(s, u)
        end = _mills(s + u)
        share = _short_integral(s, jnp.where(short, u, 0.0)) / m
        far = u * (s + 0.5 * u) - jnp.log(end / m)
        value = jnp.where(short, -jnp.log1p(-share), far)
        # the slope at u is 1/m(s + u)
        return jnp.maximum(u - (value - hazard) * end, 0.0)

    return jax.lax.fori_loop(0, 5, newton, start)


@jax.custom_jvp
def _truncated(
    z: Float[Array, "..."], s: Float[Array, "..."], d: Float[Array, "..."]
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """w in [s, s + d] at the quantile of z, and w − s."""
    tail, start, width = _one_sided(s, d)
    # log Φ of ±∞ has no slope: what is beyond every draw stands for it.
    low = jnp.maximum(s, -_BEYOND)
    high = jnp.minimum(s + d, _BEYOND)
    log_below, log_above, *tails = log_ndtr(jnp.stack([z, -z, low, high, -low, -high]))

    # On one side of 0: the hazard −log(1 − p I(s, d)/m(s)), p = Φ(z). Where the share is large its
    # complement is a sum of two positive terms, (1 − p) + p φ(s + d) m(s + d)/φ(s) m(s).
    m = _mills(start)
    end = start + width
    share = jnp.exp(log_below) * _integral(start, width) / m
    log_rest = -width * (start + 0.5 * width) + jnp.log(
        _mills(jnp.where(jnp.isinf(end), 1.0, end)) / m
    )
    far = -jnp.logaddexp(log_above, log_below + log_rest)
    one_sided = jnp.where(share < 0.5, -jnp.log1p(-jnp.minimum(share, 0.5)), far)

    # With 0 well inside: log probabilities left and right of the draw, of the whole line. The
    # smaller one gives |w|, as a hazard from 0, of which the half-line has probability ½.
    left = jnp.logaddexp(log_above + tails[0], log_below + tails[1])
    right = jnp.logaddexp(log_above + tails[2], log_below + tails[3])
    two_sided = jnp.maximum(-jnp.minimum(left, right) - _LOG_2, 0.0)

    u = _past(start, jnp.where(tail, one_sided, two_sided))
    inner = jnp.where(right < left, u, -u)
    u = jnp.minimum(u, d)
    return jnp.where(tail, s + u, inner), jnp.where(tail, u, inner - s)


@_truncated.defjvp
def _(primals: tuple[Array, ...], tangents: tuple[Array, ...]):
    """φ(w) dw = φ(z) P dz + Φ(−z) φ(s) ds + Φ(z) φ(s + d) (ds + dd)."""
    z, s, d = primals
    dz, ds, dd = tangents
    w, u = truncated(z, s, d)
    tail, start, width = _one_sided(s, d)
    log_below, log_above = log_ndtr(jnp.stack([z, -z]))
    half_line = jnp.isinf(d)
    rest = jnp.where(half_line, 0.0, d - u)
    # log φ(s)/φ(w) and log φ(w)/φ(s + d), from u and not from w, whose square has lost digits
    rise = u * (s + 0.5 * u)
    fall = rest * (s + u + 0.5 * rest)

    inside = log_integral(start, width) + rise
    across = (
        log_probability(jnp.where(tail, -1.0, s), jnp.where(tail, 2.0, d))
        + _LOG_SQRT_2PI
        + 0.5 * w * w
    )
    by_z = jnp.exp(jnp.where(tail, inside, across) - 0.5 * z * z - _LOG_SQRT_2PI)
    # du = dw − ds: of ds the coefficient is Φ(−z) (φ(s)/φ(w) − 1) + Φ(z) (φ(s + d)/φ(w) − 1).
    at_near = jnp.where(
        rise < 1,
        jnp.exp(log_above) * jnp.expm1(jnp.minimum(rise, 1.0)),
        jnp.exp(log_above + rise) - jnp.exp(log_above),
    )
    at_far = jnp.exp(log_below) * jnp.where(half_line, -1.0, jnp.expm1(-fall))
    du = by_z * dz + (at_near + at_far) * ds + _times(jnp.exp(log_below - fall), dd, d)
    return (w, u), (du + ds, du)


truncated = cast(Callable[[Array, Array, Array], tuple[Array, Array]], _truncated)


def truncated_quantile(
    z: Float[Array, "..."],
    lower: Float[Array, "..."],
    upper: Float[Array, "..."],
    mean: ArrayLike = 0.0,
    scale: ArrayLike = 1.0,
    lost: ArrayLike = 0.0,
) -> Float[Array, "..."]:
    """N(mean, scale²) truncated to [lower, upper], at the quantile of z: increasing in z.

    mean + scale z without bounds.
    """
    interval = _mirrored(lower, upper, mean, scale, lost)
    sign = interval.sign
    s = interval.s
    d = jnp.where(interval.d <= 0, 1.0, interval.d)
    w, u = truncated(sign * z, s, d)
    # In a tail from the near end, whose digits the draw keeps; across 0 from the mean.
    near = jnp.where(sign > 0, lower, upper)
    near = jnp.where(jnp.isinf(near), 0.0, near)
    x = jnp.where(_one_sided(s, d)[0], near + sign * scale * u, mean + sign * scale * w)
    x = jnp.where(interval.free, mean + scale * z, x)
    # The clip repairs rounding and moves with nothing: the slope is that of x.
    inside = jax.lax.stop_gradient(jnp.clip(x, lower, upper))
    return inside + (x - jax.lax.stop_gradient(x))


def truncated_quantile_inverse(
    x: Float[Array, "..."],
    lower: Float[Array, "..."],
    upper: Float[Array, "..."],
    mean: ArrayLike = 0.0,
    scale: ArrayLike = 1.0,
    lost: ArrayLike = 0.0,
) -> Float[Array, "..."]:
    """The z with `truncated_quantile(z, ...) = x`."""
    interval = _mirrored(lower, upper, mean, scale, lost)
    sign = interval.sign
    s = interval.s
    d = jnp.where(interval.d <= 0, 1.0, interval.d)
    tail, start, width = _one_sided(s, d)
    near = jnp.where(sign > 0, lower, upper)
    far = jnp.where(sign > 0, upper, lower)
    near = jnp.where(jnp.isinf(near), 0.0, near)
    far_side = sign * (jnp.where(jnp.isinf(far), 0.0, far) - x)
    rest = jnp.where(jnp.isinf(d), jnp.inf, jnp.maximum((far_side + lost) / scale, 0.0))

    # On one side of 0: the parts of I(s, d) below x and above, each from its own end.
    u = jnp.where(tail, jnp.clip(sign * (x - near) / scale, 0.0, d), 0.5)
    total = log_integral(start, width)
    below = log_integral(start, u) - total
    above = log_integral(start + u, jnp.where(tail, rest, 0.5)) - u * (start + 0.5 * u) - total

    # Across 0: probabilities from end to x and from x to end.
    w = jnp.where(tail, 0.0, jnp.clip(sign * (x - mean) / scale, s, s + d))
    low = jnp.where(tail, -1.0, s)
    high = jnp.where(tail, 1.0, s + d)
    total = log_interval_probability(low, high)
    below = jnp.where(tail, below, log_interval_probability(low, w) - total)
    above = jnp.where(tail, above, log_interval_probability(w, high) - total)
    # By the smaller of both, whose logarithm has the digits.
    z = jnp.where(below < above, log_ndtri(below), -log_ndtri(above))
    return jnp.where(interval.free, (x - mean) / scale, sign * z)
