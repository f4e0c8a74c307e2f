"""Weighted clouds of paths, and what their points say of the score of the density that they
represent.

Let the density of y_j be the marginal of ∏ exp ℓ_i(y_i, y_{i+1}). Moving y_{j+1} by δ and y_j by ρ
δ in the integral,

    ∇log p(y_{j+1}) = E[g_{j+1} | y_{j+1}],    g_{j+1} = ∇_{y_{j+1}} ℓ_j + ρ_j (g_j + ∇_{y_j} ℓ_j),

for any number ρ_j. With ρ = 0 this is the target of denoising score matching, whose noise grows as
the step shrinks; for Brownian motion ρ_j = j/(j + 1) gives −(y_j − y_0)/(σ² t_j), without noise. ρ
is the least squares coefficient, found in a cloud of its own.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, Float, PRNGKeyArray

from .._linalg import apply, cholesky, promote, transpose
from .._types import State
from ..bridges import GuidedBridge
from ..conditioning import ExactMatch, GaussianMessage, gaussian_log_density
from ..guiding import AbstractGuide, Unguided, default_guide
from ..sdes import Transition
from ._reversed import ReversedSDE


class Cloud(eqx.Module):
    """Points and targets `(K, B, n, dim)`, weights `(K, B)` that add to 1 at each time, and ρ
    `(K,)`.

    Along the grid of the bridge that it trains, but for its end.
    """

    x: Array
    score: Array
    weights: Float[Array, "K B"]
    rho: Float[Array, " K"]


def adjoint_cloud(bridge: GuidedBridge, key: PRNGKeyArray, size: int, rho=None) -> Cloud:
    """h(t, ·) of a bridge: the reversed process from what is observed, weighted by exp ∫ c."""
    key_start, key = jr.split(key)
    reverse = ReversedSDE(bridge.sde, bridge.shown_ts[-1])
    seen, v = bridge.end()
    start = jnp.broadcast_to(v, (size, *v.shape))
    factor = seen.factor
    if factor is not None:
        noise = jr.normal(key_start, start.shape, start.dtype)
        start = start + jax.vmap(lambda z: apply(factor, z))(noise)

    def law(times, y):
        return reverse.transition(reverse.clock - times[1], reverse.clock - times[0], y)

    def log_weight(times, y):
        return (times[1] - times[0]) * reverse.rate(reverse.clock - times[1], y)

    def log_pair(times, y, new):
        return log_density(law(times, y), new) + log_weight(times, y)

    return _cloud(bridge, key, start, _drawn(law), log_pair, log_weight, rho)


def reversal_cloud(
    bridge: GuidedBridge, guide: AbstractGuide, key: PRNGKeyArray, size: int, rho=None
) -> Cloud:
    """h(t, ·) of a bridge, at points of its conditioned paths: time reversals, led to x0 by a guide
    of their own.
    """
    key_start, key_path, key = jr.split(key, 3)
    starts = ends(bridge, key_start, size)

    def path(end, key):
        back = reversed_bridge(bridge, end, guide)
        return back.path(jr.normal(key, back.noise_shape, end.dtype))

    paths = jnp.moveaxis(jax.vmap(path)(starts, jr.split(key_path, size))[:, ::-1], 1, 0)

    def log_pair(times, y, new):
        return log_density(bridge.sde.transition(times[0], times[1], new), y)

    def no_weight(times, y):
        return jnp.zeros((), y.dtype)

    return _cloud(
        bridge,
        key,
        paths[-1],
        lambda times, y, key, given: given,
        log_pair,
        no_weight,
        rho,
        paths[:-1],
    )


def ends(bridge: GuidedBridge, key: PRNGKeyArray, size: int) -> Array:
    """End states of the conditioned process: a guide's, resampled by their weights."""
    seen, v = bridge.end()
    if seen.exact and seen.operator.ndim == 0:
        return jnp.broadcast_to(v, (size, *v.shape))
    if isinstance(bridge.guide, Unguided):  # whose weights would leave few
        bridge = bridge.with_guide(default_guide(bridge.sde, v))
    key_noise, key_resample = jr.split(key)
    noise = jr.normal(key_noise, (size, *bridge.noise_shape), bridge.x0.dtype)
    paths, log_weights = jax.vmap(bridge.path_and_log_weight)(noise)
    return paths[:, -1][_systematic(key_resample, jax.nn.softmax(log_weights))]


def forward_cloud(bridge: GuidedBridge, key: PRNGKeyArray, size: int, rho=None) -> Cloud:
    """p(t, ·) of an SDE from x0; `bridge` is the reversed one, which is conditioned on x0."""
    assert isinstance(bridge.sde, ReversedSDE)
    sde, clock, x0 = bridge.sde.sde, bridge.sde.clock, bridge.end()[1]

    def law(times, y):
        return sde.transition(clock - times[1], clock - times[0], y)

    def log_pair(times, y, new):
        return log_density(law(times, y), new)

    def no_weight(times, y):
        return jnp.zeros((), y.dtype)

    start = jnp.broadcast_to(x0, (size, *x0.shape))
    return _cloud(bridge, key, start, _drawn(law), log_pair, no_weight, rho)


def reversed_bridge(
    bridge: GuidedBridge, end: State, guide: AbstractGuide | None = None
) -> GuidedBridge:
    """The reversed process from the end of a bridge, conditioned on x0, on the mirrored grid."""
    shown, elapsed = bridge.shown_ts, bridge.grid.elapsed
    reverse = ReversedSDE(bridge.sde, shown[-1])
    match = ExactMatch().at(bridge.x0)
    return GuidedBridge(reverse, match, x0=end, ts=elapsed[-1] - elapsed[::-1], guide=guide)


def log_density(transition: Transition, y: State) -> Float[Array, ""]:
    """log N(y; mean, covariance)."""
    factor = cholesky(promote(transition.covariance, 1, y.shape[0]))
    return gaussian_log_density(y - transition.mean, factor)


def _drawn(law: Callable) -> Callable:
    def advance(times, y, key, given):
        transition = law(times, y)
        return transition.mean + apply(
            transition.factor, jr.normal(key, _noise_shape(transition, y), y.dtype)
        )

    return advance


def _noise_shape(transition: Transition, y: State):
    return jax.eval_shape(lambda: apply(transpose(transition.factor), y)).shape


def _cloud(bridge, key, y, advance, log_pair, log_weight, rho, given=None) -> Cloud:
    """Particles y `(B, n, dim)` from the end of the bridge's grid to its start.

    `advance(times, y, key, given)` moves one, `log_pair(times, y, new)` is ℓ, `log_weight(times,
    y)` what it gains; `times` are the step's in the order of the grid. Resampled where less than
    half are effective.
    """
    size, seen = y.shape[0], bridge.end()[0]
    start_moves = not seen.exact
    g = jax.vmap(lambda x: _observed_score(bridge, x))(y) if start_moves else jnp.zeros_like(y)
    moves = jnp.ones(bridge.num_steps, y.dtype).at[-1].set(1.0 if start_moves else 0.0)

    def step(carry, inputs):
        y, g, logits = carry
        t0, t1, key, moves, rho, given = inputs
        key_move, key_resample = jr.split(key)
        times, keys = (t0, t1), jr.split(key_move, size)
        new = jax.vmap(advance, (None, 0, 0, 0))(times, y, keys, given)
        pull, push = jax.vmap(jax.grad(log_pair, (1, 2)), (None, 0, 0))(times, y, new)
        logits = logits + jax.vmap(log_weight, (None, 0))(times, y)
        weights, past = jax.nn.softmax(logits), g + pull
        if rho is None:
            rho = _coefficient(
                jax.vmap(lambda x, s: whiten(bridge, t0, x, s)), weights, new, push, past
            )
        rho = moves * rho
        g = push + rho * past
        poor = 1 / jnp.sum(weights**2) < size / 2
        chosen = jnp.where(poor, _systematic(key_resample, weights), jnp.arange(size))
        return (new[chosen], g[chosen], jnp.where(poor, 0.0, logits)), Cloud(new, g, weights, rho)

    ts = bridge.shown_ts
    entries = (ts[:-1], ts[1:], jr.split(key, bridge.num_steps), moves, rho, given)
    return jax.lax.scan(step, (y, g, jnp.zeros(size, y.dtype)), entries, reverse=True)[1]


def whiten(bridge: GuidedBridge, t, x: State, score: State) -> State:
    """σᵀ s, whose square is |s|²_a."""
    return apply(transpose(bridge.sde.diffusion(t, x)), score)


def _observed_score(bridge: GuidedBridge, x: State) -> State:
    """∇_x log p(v | x)."""
    seen, _ = bridge.end()
    v = bridge.observed()
    assert seen.factor is not None  # an exact observation has no density
    return GaussianMessage(seen.operator, jnp.zeros_like(v), seen.factor, v, seen.log_scale).score(
        x
    )


def _coefficient(norm, weights, x, push, past) -> Float[Array, ""]:
    """The ρ from 0 to 1 that makes push + ρ past smallest."""
    push, past = norm(x, push), norm(x, past)
    w = weights.reshape(-1, *[1] * (push.ndim - 1))
    return jnp.clip(
        -jnp.sum(w * push * past) / jnp.maximum(jnp.sum(w * past * past), 1e-30), 0.0, 1.0
    )


def _systematic(key, weights) -> Array:
    """Indices drawn in proportion to the weights, with one uniform number."""
    size = weights.shape[0]
    points = (jr.uniform(key, (), weights.dtype) + jnp.arange(size, dtype=weights.dtype)) / size
    return jnp.clip(jnp.searchsorted(jnp.cumsum(weights), points), 0, size - 1).astype(int)
