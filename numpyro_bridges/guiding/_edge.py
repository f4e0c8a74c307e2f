"""One edge: a path from a state to what is seen of its end, its log weight, and the way back from a
path to its noise.

`travel` takes steps led by a plan, as to an inner node of a tree; `arrive` takes the last step to
what is seen, onto the observation itself, exactly whatever guides; `reach` does both. `retrace` and
`retrace_reach` recover the noise.
"""

import functools

import jax
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, Float, PRNGKeyArray

from .._linalg import apply, compose, varying_like
from .._types import Noise, State
from ..conditioning import Observation
from ..sdes import AbstractSDE, Transition
from ._few_noises import Errors, LowRank, NoiseSteering
from ._guides import AbstractPlan, is_low_rank, per_time, steered
from ._steering import GaussianSteering
from ._step import GridNoise, GuidedStep, GuidedTerm

_MAX_KEPT = 64
"""Most noises with which the Cholesky factors of a step, some matrices of that size, are kept for
the reverse pass.
"""


def travel(
    sde: AbstractSDE,
    plan: AbstractPlan,
    ts: Float[Array, " K+1"],
    x0: State,
    noise: Float[Array, "K k *dim"],
    observed: State,
) -> tuple[Float[Array, "K n *dim"], State, Float[Array, ""]]:
    """The states after x0, the last by itself, and the log weight of the steps between the times.

    The plan has an entry for each of the times.
    """
    few = noise.shape[1] <= _MAX_KEPT

    # A step is computed again in the reverse pass, so that memory does not grow by all that it
    # makes, but for small Cholesky factors, its dearest part. `prevent_cse` guards against a
    # compiler that would undo this; inside a `scan` it need not, and would only cost.
    @functools.partial(
        jax.checkpoint,
        prevent_cse=False,
        policy=lambda primitive, *_, **__: few and primitive.name == "cholesky",
    )
    def step(y, inputs):
        t0, t1, z, planned = inputs
        # Terms of this step alone: `scan` has looked up its noise and its entry of the plan.
        control = GridNoise(ts=jnp.stack([t0, t1]), noise=z[None])
        terms = GuidedTerm(sde, plan, lambda _: planned, observed, control)
        y, *_ = GuidedStep().step(terms, t0, t1, y, None, None, False)
        return y, y[0]

    start = (x0, jnp.zeros((), x0.dtype))
    start = varying_like(start, sde, plan, ts, noise, observed)
    (x, log_weight), path = jax.lax.scan(step, start, (ts[:-1], ts[1:], noise, _ends(plan)))
    # x is path[-1], or x0 where there is no step.
    return path, x, log_weight


def arrive(
    sde: AbstractSDE,
    seen: Observation,
    ts: Float[Array, " K+1"],
    x: State,
    z: Noise,
    observed: State,
) -> tuple[State, Float[Array, ""]]:
    """The last state, and the log density of what is seen given the last but one."""
    transition, steering = _last_step(sde, seen, ts, x, observed)
    x = transition.mean + apply(transition.factor, steering.drive(z)[0])
    return x, steering.log_evidence() + seen.log_scale


def reach(
    sde: AbstractSDE,
    plan: AbstractPlan,
    seen: Observation,
    ts: Float[Array, " K+1"],
    x0: State,
    noise: Float[Array, "K k *dim"],
    observed: State,
) -> tuple[Float[Array, "K n *dim"], Float[Array, ""]]:
    """The states after x0, to an end that is seen, and the log weight.

    The plan has an entry for each time but the end's.
    """
    path, x, log_weight = travel(sde, plan, ts[:-1], x0, noise[:-1], observed)
    end, log_density = arrive(sde, seen, ts, x, noise[-1], observed)
    return jnp.concatenate([path, end[None]]), log_weight + log_density


def retrace(
    sde: AbstractSDE,
    plan: AbstractPlan,
    ts: Float[Array, " K+1"],
    path: Float[Array, "K+1 n *dim"],
    observed: State,
    key: PRNGKeyArray | None,
) -> Float[Array, "K k *dim"]:
    """The noise by which `travel` takes a path.

    What the path leaves free of it is drawn with `key`, and 0 without one.
    """

    # No step needs the noise of another, since all states are known: a `vmap` and no `scan`.
    def step(x, x_next, t0, t1, planned, free):
        transition = sde.transition(t0, t1, x)
        steering = plan.steer(planned, transition, t1 - t0, x, observed)
        return steering.inverse(_driving_noise(transition, x_next, free))

    free = _free_noise(sde, path[:-1], key)
    return jax.vmap(step)(path[:-1], path[1:], ts[:-1], ts[1:], _ends(plan), free)


def retrace_reach(
    sde: AbstractSDE,
    plan: AbstractPlan,
    seen: Observation,
    ts: Float[Array, " K+1"],
    path: Float[Array, "K+1 n *dim"],
    observed: State,
    key: PRNGKeyArray | None,
) -> Float[Array, "K k *dim"]:
    """The noise by which `reach` takes a path."""
    key_path, key_end = (None, None) if key is None else jr.split(key)
    z = retrace(sde, plan, ts[:-1], path[:-1], observed, key_path)
    x, end = path[-2:]
    # Two rows, for two kinds of freedom: what of u does not move the state, and what of z does not
    # move u.
    free, without_effect = _free_noise(sde, path[-2:], key_end)
    transition, steering = _last_step(sde, seen, ts, x, observed)
    last = steering.inverse(_driving_noise(transition, end, free))
    if isinstance(steering, GaussianSteering) and seen.exact:
        # u = μ + B z with a projection B: `inverse` has set the rest of z to 0.
        last = last + steering.without_effect(without_effect)
    return jnp.concatenate([z, last[None]])


def _free_noise(sde, states, key):
    shape = (states.shape[0], sde.noise_size(states[0]), *states.shape[2:])
    return jnp.zeros(shape, states.dtype) if key is None else jr.normal(key, shape, states.dtype)


def _ends(plan: AbstractPlan):
    """The plan's entries at the ends of steps."""
    return jax.tree.map(lambda a: a[1:], plan.steps)


def _last_step(sde, seen, ts, x, observed) -> tuple[Transition, GaussianSteering | NoiseSteering]:
    """The model's step to the end, and its steering by the observation itself, whatever guides."""
    transition = sde.transition(ts[-2], ts[-1], x)
    # None is exact to the steering, which then needs one factorisation and not two.
    covariance = None if seen.exact else seen.covariance
    dt = ts[-1] - ts[-2]
    if is_low_rank(transition.factor, seen):
        assert seen.factor is not None
        sigma, _ = per_time(transition, dt)
        # κ = λ = 0: after this step no time is left, and only the errors are between.
        none = jnp.zeros((), x.dtype)
        covariance = LowRank(Errors.of(seen.factor), none, compose(seen.operator, sigma), none)
    shift = jnp.zeros_like(observed)
    return transition, steered(
        transition, dt, seen.operator, shift, covariance, observed, seen.exact
    )


def _driving_noise(transition: Transition, x: State, free: Noise) -> Noise:
    """u with mean + σ u = x; where σ leaves a part of u free it is taken from `free`."""
    d = x - transition.mean
    factor = transition.factor
    if factor.ndim < 2:
        factor = factor if factor.ndim == 0 or d.ndim == 1 else factor[:, None]
        # the inner `where` keeps 0/0 out of the derivative
        return jnp.where(factor == 0, free, d / jnp.where(factor == 0, 1.0, factor))
    # σ⁺ d + (1 − σ⁺ σ) free: of the least norm, but for the null space of σ.
    pseudo_inverse = jnp.linalg.pinv(factor)
    return pseudo_inverse @ (d - factor @ free) + free
