"""Weighted clouds of paths, and what their points say of the score of the density that they
represent.

Let the density of y_j be the marginal of ∏ exp ℓ_i(y_i, y_{i+1}). Moving y_{j+1} by δ and y_j by ρ
δ in the integral,

    ∇log p(y_{j+1}) = E[g_{j+1} | y_{j+1}],    g_{j+1} = ∇_{y_{j+1}} ℓ_j + ρ_j (g_j + ∇_{y_j} ℓ_j),

for any number ρ_j. With ρ = 0 this is the target of denoising score matching, whose noise grows as
the step shrinks; for Brownian motion ρ_j = j/(j + 1) gives −(y_j − y_0)/(σ² t_j), without noise. ρ
is the least squares coefficient, found in a cloud of its own.

Where a drift grows faster than linearly, reversed processes explode. Clouds are therefore of the
process that is killed where the drift alone would make a step longer than a `stride`, which its
bridges do not: a particle there has weight 0 and stays, until it is resampled; when none is left
there is nothing to learn from at earlier times. Inside, the score is that of the killed process,
which differs from the other by the paths that went so far and returned. To tame the drift instead
would change the score everywhere.
"""

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, Float, PRNGKeyArray

from .._linalg import apply, cholesky, promote, transpose
from .._types import RealScalar, State
from ..bridges import GuidedBridge
from ..conditioning import ExactMatch, GaussianMessage, gaussian_log_density
from ..guiding import AbstractGuide, Unguided, default_guide
from ..sdes import Transition
from ..weights import effective_sample_size
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


def adjoint_cloud(
    bridge: GuidedBridge, key: PRNGKeyArray, size: int, rho=None, *, stride: RealScalar = jnp.inf
) -> Cloud:
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

    return _cloud(bridge, key, start, _drawn(law), log_pair, log_weight, rho, stride=stride)


def reversal_cloud(
    bridge: GuidedBridge,
    guide: AbstractGuide,
    key: PRNGKeyArray,
    size: int,
    rho=None,
    *,
    stride: RealScalar = jnp.inf,
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

    ts = bridge.shown_ts
    each = jax.vmap(jax.vmap(partial(_within, bridge, stride=stride), (None, None, 0)))
    within = jnp.all(each(ts[:-1], jnp.diff(ts), paths[:-1]), axis=0)
    logits = jnp.where(within, 0.0, -jnp.inf)
    return _along(bridge, paths, logits, rho)


def guided_cloud(bridge: GuidedBridge, key: PRNGKeyArray, size: int, least: float = 0.125) -> Cloud:
    """h(t, ·) of a bridge, at points of its conditioned paths: the paths of its guide, by their
    weights.

    The weights are w^β, with β ≤ 1 as large as leaves a fraction `least` of the paths effective. At
    β = 1 the targets are those of the conditioned process, whatever the guide, and only then is
    ∇log h what is learned. Below it is something between, which serves to find a guide of a larger
    β. The ρ of each half of the paths is found in the other half, since targets are unbiased for
    numbers ρ that do not know them.
    """
    half = -(-size // 2)
    noise = jr.normal(key, (2 * half, *bridge.noise_shape), bridge.x0.dtype)
    paths, log_weights = jax.vmap(bridge.path_and_log_weight)(noise)
    logits = _tempered(log_weights, least)
    paths = jnp.moveaxis(paths, 1, 0)
    halves = [slice(None, half), slice(half, None)]
    first, second = (_along(bridge, paths[:, part], logits[part], None).rho for part in halves)
    clouds = [
        _along(bridge, paths[:, part], logits[part], rho)
        for part, rho in zip(halves, (second, first), strict=True)
    ]
    return Cloud(
        paths[:-1],
        jnp.concatenate([cloud.score for cloud in clouds], axis=1),
        jnp.broadcast_to(jax.nn.softmax(logits), (bridge.num_steps, 2 * half)),
        (first + second) / 2,
    )


def _tempered(log_weights: Float[Array, " B"], least: float) -> Float[Array, " B"]:
    """β log w, −∞ where it is not a number."""
    log_weights = jnp.where(jnp.isnan(log_weights), -jnp.inf, log_weights)
    log_weights = log_weights - jnp.max(log_weights)
    powers = jnp.geomspace(1.0, 1e-6, 128, dtype=log_weights.dtype)
    ess = jax.vmap(lambda power: effective_sample_size(power * log_weights))(powers)
    return powers[jnp.argmax(ess >= least * log_weights.size)] * log_weights


def _along(bridge: GuidedBridge, paths: Array, logits: Float[Array, " B"], rho) -> Cloud:
    """The cloud of paths of the SDE, `(K + 1, B, n, dim)`, of weights exp(logits)."""
    empty = jnp.isneginf(logits).reshape(-1, *[1] * bridge.x0.ndim)
    paths = jnp.where(empty, bridge.end()[1], paths)  # what has no weight need not be finite

    def log_pair(times, y, new):
        return log_density(bridge.sde.transition(times[0], times[1], new), y)

    def given(times, y, key, given):
        return given

    key = jr.key(0)  # nothing is drawn
    return _cloud(bridge, key, paths[-1], given, log_pair, _no_weight, rho, paths[:-1], logits)


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


def forward_cloud(
    bridge: GuidedBridge, key: PRNGKeyArray, size: int, rho=None, *, stride: RealScalar = jnp.inf
) -> Cloud:
    """p(t, ·) of an SDE from x0; `bridge` is the reversed one, which is conditioned on x0."""
    assert isinstance(bridge.sde, ReversedSDE)
    sde = bridge.sde.sde
    clock = bridge.sde.clock
    x0 = bridge.end()[1]

    def law(times, y):
        return sde.transition(clock - times[1], clock - times[0], y)

    def log_pair(times, y, new):
        return log_density(law(times, y), new)

    start = jnp.broadcast_to(x0, (size, *x0.shape))
    return _cloud(bridge, key, start, _drawn(law), log_pair, _no_weight, rho, stride=stride)


def reversed_bridge(
    bridge: GuidedBridge, end: State, guide: AbstractGuide | None = None
) -> GuidedBridge:
    """The reversed process from the end of a bridge, conditioned on x0, on the mirrored grid."""
    shown = bridge.shown_ts
    elapsed = bridge.grid.elapsed
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


def _no_weight(times, y):
    return jnp.zeros((), y.dtype)


def _noise_shape(transition: Transition, y: State):
    return jax.eval_shape(lambda: apply(transpose(transition.factor), y)).shape


def _within(bridge: GuidedBridge, t, dt, y: State, stride) -> Array:
    """Whether a state is one to learn from: a step of its drift is no longer than the stride."""
    step = jnp.max(jnp.abs(dt * bridge.sde.drift(t, y)))
    return jnp.all(jnp.isfinite(y)) & (step <= stride)


def _cloud(
    bridge,
    key,
    y,
    advance,
    log_pair,
    log_weight,
    rho,
    given=None,
    logits=None,
    stride: RealScalar = jnp.inf,
) -> Cloud:
    """Particles y `(B, n, dim)` from the end of the bridge's grid to its start.

    `advance(times, y, key, given)` moves one, `log_pair(times, y, new)` is ℓ, `log_weight(times,
    y)` what it gains; `times` are the step's in the order of the grid. Resampled where less than
    half are effective, but for paths that are given, `(K, B, n, dim)` before the end, and keep the
    weights exp(logits).
    """
    size = y.shape[0]
    seen = bridge.end()[0]
    start_moves = not seen.exact
    g = jax.vmap(lambda x: _observed_score(bridge, x))(y) if start_moves else jnp.zeros_like(y)
    moves = jnp.ones(bridge.num_steps, y.dtype).at[-1].set(1.0 if start_moves else 0.0)

    def step(carry, inputs):
        y, g, logits = carry
        t0, t1, key, moves, rho, given = inputs
        key_move, key_resample = jr.split(key)
        times = (t0, t1)
        keys = jr.split(key_move, size)
        new = jax.vmap(advance, (None, 0, 0, 0))(times, y, keys, given)
        within = jax.vmap(lambda y: _within(bridge, t0, t1 - t0, y, stride))(new)
        new = jnp.where(within.reshape(-1, *[1] * (y.ndim - 1)), new, y)
        pull, push = jax.vmap(jax.grad(log_pair, (1, 2)), (None, 0, 0))(times, y, new)
        gained: Array = logits + jax.vmap(log_weight, (None, 0))(times, y)
        logits = jnp.where(within, gained, -jnp.inf)
        weights = jnp.where(jnp.all(jnp.isneginf(logits)), 0.0, jax.nn.softmax(logits))
        past = g + pull
        if rho is None:
            rho = _coefficient(
                jax.vmap(lambda x, s: whiten(bridge, t0, x, s)), weights, new, push, past
            )
        rho = moves * rho
        g = push + rho * past
        found = Cloud(new, g, weights, rho)
        if given is not None:
            return (new, g, logits), found
        poor = jnp.sum(weights**2) > 2 / size
        chosen = jnp.where(poor, _systematic(key_resample, weights), jnp.arange(size))
        return (new[chosen], g[chosen], jnp.where(poor, 0.0, logits)), found

    ts = bridge.shown_ts
    entries = (ts[:-1], ts[1:], jr.split(key, bridge.num_steps), moves, rho, given)
    logits = jnp.zeros(size, y.dtype) if logits is None else logits
    return jax.lax.scan(step, (y, g, logits), entries, reverse=True)[1]


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
    push = norm(x, push)
    past = norm(x, past)
    w = weights.reshape(-1, *[1] * (push.ndim - 1))
    return jnp.clip(
        -jnp.sum(w * push * past) / jnp.maximum(jnp.sum(w * past * past), 1e-30), 0.0, 1.0
    )


def _systematic(key, weights) -> Array:
    """Indices drawn in proportion to the weights, with one uniform number."""
    size = weights.shape[0]
    points = (jr.uniform(key, (), weights.dtype) + jnp.arange(size, dtype=weights.dtype)) / size
    return jnp.clip(jnp.searchsorted(jnp.cumsum(weights), points), 0, size - 1).astype(int)
