"""Arithmetic on the log weights of importance samples.

Every function takes an array of log weights whose last axis runs over the particles, and reduces
that axis. A weight of zero (`-inf`) is a weight like any other. A NaN weight is a failure of
whatever computed it and makes the result NaN, so that it is never mistaken for a weight of zero; an
infinite weight does the same, except to the mean, which it makes infinite. What is no array of
numbers with a particle on that axis is a `ValueError`.
"""

import math
import operator
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._checks import floating, positive_integer, require, words


def log_mean_exp(log_weights: Float[Array, "..."], axis: int = -1) -> Float[Array, "..."]:
    """Log of the mean weight, the estimate of a log evidence: log (1/S) Σ exp(log_weights).

    **Arguments:**

    - `log_weights`: log weights of any magnitude.
    - `axis`: the axis of the S particles.

    **Returns:** the array without `axis`; `-inf` where every weight is zero.
    """
    require(hasattr(axis, "__index__"), f"`axis` must be the number of an axis; got {words(axis)}.")
    axis = operator.index(axis)
    return _log_mean_exp(_checked(log_weights, axis), axis)


def effective_sample_size(log_weights: Float[Array, "... S"]) -> Float[Array, "..."]:
    """How many equally weighted particles the weights are worth (Kish): (Σ w)² / Σ w².

    **Arguments:**

    - `log_weights`: log weights, particles along the last axis.

    **Returns:** a number between 1 and S, in particles; 0 where every weight is zero.
    """
    return _effective_sample_size(_checked(log_weights))


def standard_error(log_weights: Float[Array, "... S"]) -> Float[Array, "..."]:
    """Standard error of `log_mean_exp`, for weights that were drawn and for those that were not.

        error² = sd(w)² / (S mean(w)²) + missing²
        missing = σ n^κ / ((1 − κ)² S mean(w)),    κ = k̂ + (1 + max(k̂, 0)) / √n

    The first term is the delta method. It is small above all in those samples that have missed the
    tail, and so is k̂, which is why no bound on k̂ alone makes its intervals cover. The second is
    what the tail fitted by `pareto_k` to the n largest weights, of shape k̂ and scale σ, holds
    beyond the largest to be expected of n, σ n^κ / (1 − κ) / S, with its shape raised by one
    standard error; it is divided by 1 − κ once more, since near κ = 1 that part is as uncertain as
    it is large. Under light tails it is negligible.

    **Arguments:**

    - `log_weights`: log weights, particles along the last axis.

    **Returns:** the standard error in nats. `inf` where nothing can be said of it: where k̂ reaches
    `pareto_k_threshold`, κ reaches 1, no tail can be fitted, or every weight is zero. NaN for a
    single particle.
    """
    return _standard_error(_checked(log_weights))


def pareto_k(log_weights: Float[Array, "... S"]) -> Float[Array, "..."]:
    """Shape k̂ of the generalised Pareto distribution fitted to the largest weights.

    Moments of order 1/k and more are infinite: from k = 1/2 on the weights have no variance, from
    k = 1 on no mean. The estimate of their mean and its `standard_error` are reliable up to
    `pareto_k_threshold`.

    The tail is the ⌈min(S/5, 3 √S)⌉ largest weights, as exceedances over the next smaller one; its
    shape is the estimate of Zhang and Stephens, shrunk towards 1/2 as by ten further weights. All
    is kept in logarithms, so weights that differ by hundreds of nats still have a shape (a large
    one).

    **Arguments:**

    - `log_weights`: log weights, particles along the last axis.

    **Returns:** k̂. `-inf` where the largest weights are all equal: they are bounded, and harmless.
    `inf` where no shape can be fitted, with fewer than five weights above the cutoff: below 21
    particles, or with nearly all weights zero.

    **Source:** [@vehtari2024], [@zhang2009].
    """
    return _pareto_k(_checked(log_weights))


def quality(log_weights: Float[Array, "... S"]) -> tuple[Array, Array, Array]:
    """`standard_error`, `effective_sample_size` and `pareto_k` at once, the tail fitted once."""
    return _quality(_checked(log_weights))


def pareto_k_threshold(num_particles: int) -> float:
    """The k̂ from which on an estimate from so many particles is not to be relied on.

    0.7, beyond which no number of particles that can be had is enough; less where 1 is within one
    standard error of k̂ on a tail of n weights: min((√n − 1) / (√n + 1), 0.7), which is 0.7 from
    161 particles on.

    A lower bound is no safer: what passes it of heavier tails is the samples that have missed them.

    **Source:** [@vehtari2024] for 0.7.
    """
    root = math.sqrt(_tail_length(positive_integer(num_particles, "num_particles", 2)))
    return min((root - 1) / (root + 1), 0.7)


def _checked(log_weights, axis: int = -1) -> Array:
    log_weights = floating(log_weights, "log_weights")
    shape = log_weights.shape
    require(
        -len(shape) <= axis < len(shape) and shape[axis] > 0,
        f"`log_weights` must have at least one particle along axis {axis}; got shape {shape}.",
    )
    return log_weights


@partial(jax.jit, static_argnames="axis")
def _log_mean_exp(log_weights, axis):
    return jax.nn.logsumexp(log_weights, axis=axis) - math.log(log_weights.shape[axis])


@jax.jit
def _effective_sample_size(log_weights):
    weights = _relative(log_weights)
    squares = jnp.sum(weights**2, axis=-1)
    # 0/0, of weights that are all 0, is to be 0
    return jnp.sum(weights, axis=-1) ** 2 / jnp.where(squares == 0, 1.0, squares)


@jax.jit
def _standard_error(log_weights):
    return _error(log_weights, *_tail(log_weights))


@jax.jit
def _pareto_k(log_weights):
    return _tail(log_weights)[0]


@jax.jit
def _quality(log_weights):
    k, log_scale, n = _tail(log_weights)
    return _error(log_weights, k, log_scale, n), _effective_sample_size(log_weights), k


def _error(log_weights, k, log_scale, n):
    weights = _relative(log_weights)
    num_particles = weights.shape[-1]
    mean = jnp.mean(weights, axis=-1, keepdims=True)
    deviation = jnp.sqrt(jnp.sum((weights - mean) ** 2, axis=-1) / (num_particles - 1.0))
    mean = mean[..., 0]
    drawn = deviation / (jnp.where(mean == 0, 1.0, mean) * math.sqrt(num_particles))

    # log of σ n^κ / ((1 − κ)² S mean(w)), where S mean(w) is the sum of the weights
    raised = k + (1 + jnp.maximum(k, 0.0)) / jnp.sqrt(n)
    log_missing = log_scale + raised * jnp.log(n) - 2 * jnp.log1p(-raised)
    log_missing -= jax.nn.logsumexp(log_weights, axis=-1)
    missing = jnp.where(k == -jnp.inf, 0.0, jnp.exp(log_missing))
    threshold = pareto_k_threshold(num_particles) if num_particles > 1 else math.inf
    unknown = (k >= threshold) | (raised >= 1) | (mean == 0)
    # a NaN stays one
    return jnp.where(unknown & ~jnp.isnan(drawn), jnp.inf, jnp.sqrt(drawn**2 + missing**2))


def _relative(log_weights):
    """Weights relative to the largest; zero, not NaN, where all are zero."""
    log_weights = jnp.asarray(log_weights)
    largest = jnp.max(log_weights, axis=-1, keepdims=True)
    return jnp.exp(log_weights - jnp.where(largest == -jnp.inf, 0.0, largest))


def _tail_length(num_particles: int) -> int:
    return math.ceil(min(num_particles / 5, 3 * math.sqrt(num_particles)))


@partial(jnp.vectorize, signature="(s)->(),(),()")
def _tail(log_weights):
    """Shape k̂ of the tail, log of its scale σ, and the number n of weights above its cutoff."""
    num_particles = log_weights.shape[0]
    num_tail = _tail_length(num_particles)
    ordered = jnp.sort(log_weights)
    tail = ordered[num_particles - num_tail :]
    cutoff = ordered[max(num_particles - num_tail - 1, 0)]

    exceeds = tail > cutoff
    num_exceed = jnp.sum(exceeds)
    n = num_exceed.astype(log_weights.dtype)
    # log of the exceedances y = exp(tail) − exp(cutoff), ascending; ties with the cutoff come first
    log_y = tail + jnp.log1p(-jnp.exp(jnp.where(exceeds, cutoff - tail, -1.0)))
    log_y_max = log_y[-1]
    quartile = num_tail - num_exceed + jnp.maximum((num_exceed + 2) // 4 - 1, 0)
    log_y_quartile = log_y[jnp.minimum(quartile, num_tail - 1)]

    # The rate b = 1/max(y) − a/quartile(y), in units of 1/quartile(y), and the mean of log(1 − b
    # y), in a form that never overflows and, as b → 0, in one that stays proportional to b.
    def rate(log_a):
        return jnp.exp(log_y_quartile - log_y_max) - jnp.exp(log_a)

    def mean_log(log_a):
        step = rate(log_a) * jnp.exp(log_y - log_y_quartile)
        stable = jnp.logaddexp(
            log_a + log_y - log_y_quartile, jnp.log(-jnp.expm1(log_y - log_y_max))
        )
        terms = jnp.where(jnp.abs(step) < 0.5, jnp.log1p(-step), stable)
        return jnp.sum(jnp.where(exceeds, terms, 0.0)) / n

    # Zhang and Stephens: the posterior mean of b over a grid, weighted by the likelihood profile
    # n (log|b/k| − k), k(b) = mean log(1 − b y) being the shape that fits best with b. Here it is
    # the mean of a, linear in b. Constants do not matter to the weights.
    grid_size = 30 + math.isqrt(num_tail)
    grid = jnp.arange(1, grid_size + 1, dtype=log_weights.dtype) - 0.5
    log_a = jnp.log((jnp.sqrt(grid_size / grid) - 1) / 3)
    k = jax.vmap(mean_log)(log_a)
    log_likelihood = n * (jnp.log(jnp.abs(rate(log_a) / k)) - k)
    # a grid point at b = 0, where the likelihood is 0/0, is left to its neighbours
    log_likelihood = jnp.where(jnp.isfinite(log_likelihood), log_likelihood, -jnp.inf)
    log_a = jax.nn.logsumexp(log_a + jax.nn.log_softmax(log_likelihood))
    fitted = mean_log(log_a)
    # σ = −k/b, and the mean of y in the limit b → 0
    log_mean_y = jax.nn.logsumexp(log_y, where=exceeds) - jnp.log(n)
    log_scale = jnp.log(jnp.abs(fitted / rate(log_a))) + log_y_quartile
    log_scale = jnp.where(rate(log_a) == 0, log_mean_y, log_scale)
    fitted = (n * fitted + 5.0) / (n + 10.0)  # ten weights of shape 1/2

    ties = tail if num_tail >= 5 else ordered
    bounded = (ties[0] == ties[-1]) & (ties[0] > -jnp.inf)
    fitted = jnp.where(bounded, -jnp.inf, jnp.where(n < 5, jnp.inf, fitted))
    failed = jnp.any(jnp.isnan(log_weights)) | (ordered[-1] == jnp.inf)
    return jnp.where(failed, jnp.nan, fitted), log_scale, n
