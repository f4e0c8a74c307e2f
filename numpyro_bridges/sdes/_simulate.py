"""The time-discretised model, unconditioned: its paths, and the law of their end."""

import jax
import jax.numpy as jnp
from numpy.typing import ArrayLike

from .._checks import as_float, floating, require, require_instance
from .._linalg import add, apply, columns, congruence, full_precision, varying_like
from .._types import State, Structured
from ._base import AbstractSDE, Displaced
from ._grid import given_grid


@full_precision
def simulate(sde: AbstractSDE, x0: ArrayLike, ts: ArrayLike, noise: ArrayLike) -> State:
    """A path of the model, unconditioned.

    **Arguments:** `x0` `(n, dim)`; `ts` `(K + 1,)`; `noise` `(K, k, dim)`, standard normal.

    **Returns:** `(K + 1, n, dim)`, the first state being `x0`.
    """
    require_instance(sde, AbstractSDE, "sde", "an SDE, such as `LinearSDE(drift, diffusion)`")
    x0 = floating(x0, "x0")
    grid = given_grid(ts)
    require(
        x0.ndim in (1, 2) and x0.size > 0,
        f"`x0` must be one state, (n, dim) or (n,); got shape {x0.shape}. Use vmap for a batch.",
    )
    noise = as_float(noise, "noise").astype(x0.dtype)
    times = grid.elapsed.astype(x0.dtype)
    sde = sde.closed(times[0], x0)
    sde.check_state(x0)
    x0 = sde.start(x0)
    shape = (times.shape[0] - 1, sde.noise_size(x0), columns(x0))
    # A vector state is driven by vectors, or by columns as a bridge is.
    allowed = (shape, shape[:2]) if x0.ndim == 1 else (shape,)
    require(
        jnp.shape(noise) in allowed,
        f"`noise` must have shape {shape}, one row per step; got {jnp.shape(noise)}. Use vmap for "
        "a batch.",
    )
    # Displacements from the start: steps that are short beside the state keep their digits in the
    # sum.
    displaced = Displaced(sde, x0, grid.clock(sde, x0).astype(x0.dtype))

    def step(y, inputs):
        t0, t1, z = inputs
        law = displaced.transition(t0, t1, y)
        y = law.mean + apply(law.factor, z.reshape(z.shape[: y.ndim]))
        return y, y

    start = varying_like(jnp.zeros_like(x0), displaced, times, noise)
    _, path = jax.lax.scan(step, start, (times[:-1], times[1:], noise))
    return jnp.concatenate([x0[None], x0[None] + path])


def law_of_end(sde: AbstractSDE, x0: State, ts) -> tuple[State, Structured]:
    """Mean and covariance `(n, n)` of the end state, the SDE linearised along its path without
    noise.

    **Arguments:** `ts` `(K + 1,)`: times as the SDE sees them.
    """
    ts = jnp.asarray(ts, x0.dtype)

    def step(carry, inputs):
        # x' ~ N(m(x), Φ S Φᵀ + C), the mean by the model's own step
        x, S = carry
        t0, t1 = inputs
        linear = sde.linearised_step(t0, t1, x)
        S = add(congruence(linear.operator, S), linear.covariance)
        return (sde.transition(t0, t1, x).mean, S), None

    # A full matrix from the start: the carry of a scan keeps its shape.
    n = x0.shape[0]
    start = varying_like((x0, jnp.zeros((n, n), x0.dtype)), sde, ts)
    end, _ = jax.lax.scan(step, start, (ts[:-1], ts[1:]))
    return end
