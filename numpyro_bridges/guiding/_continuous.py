"""The guided SDE in continuous time, for any Itô diffrax solver.

dX° = (b + a ∇log h̃) dt + σ dW with h̃ of one linear auxiliary process, and beside it the log
weight

    log h̃(t0, x0) + ∫ G dt,    G = (b − b̃)ᵀ r̃ − ½ tr[(a − ã)(H − r̃ r̃ᵀ)]:

consistent as dt → 0, biased at fixed dt, unbounded where dt · a · H is not small (Schauer et al.
2017).
"""

from collections.abc import Callable

import diffrax
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._linalg import (
    add,
    apply,
    columns,
    congruence,
    promote,
    semidefinite_cholesky,
    solve_lower,
    varying_like,
)
from .._types import RealScalar, State
from ..conditioning import GaussianMessage, Observation
from ..sdes import AbstractSDE, LinearSDE
from ._edge import arrive
from ._step import GridNoise


# A diffrax term of the pair (state, log weight): diffrax's own `ControlTerm` would ask for the
# matrix of both.
class _JointNoise(diffrax.AbstractTerm):
    """σ dW on the state, nothing on the log weight."""

    diffusion: Callable
    control: diffrax.AbstractPath

    def vf(self, t, y, args):
        return self.diffusion(t, y[0])

    def contr(self, t0, t1, **kwargs):
        return self.control.evaluate(t0, t1, **kwargs)

    def prod(self, vf, control):
        dx = apply(vf, control)
        return dx, jnp.zeros((), dx.dtype)


def exact_message(
    auxiliary: LinearSDE, seen: Observation, t, t1, x: State, observed: State
) -> GaussianMessage:
    """h̃(t, ·) of a linear process in continuous time."""
    # From t to the end in one step, so with X_T | x ~ N(Φ x + φ, C) the datum is
    # v ~ N(L Φ x + L φ, L C Lᵀ + Σ).
    step = auxiliary.exact_step(t, t1, x)
    operator = seen.operator
    n = x.shape[0]
    M = add(congruence(operator, step.covariance), seen.covariance)
    if operator.ndim == 0:
        flow = step.operator
    else:
        flow = promote(operator, 2, n) @ promote(step.operator, 2, n)
    shift = apply(operator, step.shift)
    return GaussianMessage(flow, shift, semidefinite_cholesky(M), observed, seen.log_scale)


def weight_rate(sde: AbstractSDE, auxiliary: LinearSDE, message: GaussianMessage, t, x: State):
    """The guided drift b + a r̃ and G = (b − b̃)ᵀ r̃ − ½ tr[(a − ã)(H − r̃ r̃ᵀ)], at (t, x)."""
    n = x.shape[0]
    b = sde.drift(t, x)
    r = message.score(x)
    a = sde.covariance(t, x)
    a_aux = auxiliary.covariance(t, x)
    excess = promote(a, 2, n) - promote(a_aux, 2, n)
    # H = Rᵀ R with R = P⁻¹ L: tr[(a − ã) H] = Σ (R (a − ã)) ∘ R, without H, and once per column.
    root = solve_lower(message.factor, promote(message.operator, 2, n))
    trace = columns(x) * jnp.sum((root @ excess) * root)
    by_drift = jnp.sum((b - auxiliary.drift(t, x)) * r)
    by_covariance = trace - jnp.sum(r * (excess @ r))
    return b + apply(a, r), by_drift - 0.5 * by_covariance


def continuous_terms(
    sde: AbstractSDE,
    auxiliary: LinearSDE,
    seen: Observation,
    t1: RealScalar,
    observed: State,
    control: diffrax.AbstractPath,
) -> diffrax.MultiTerm:
    """Terms of the guided SDE, with ∫ G dt as a second component of the solution."""

    def field(t, y, args):
        x, _ = y  # the log weight so far leads nothing
        message = exact_message(auxiliary, seen, t, t1, x, observed)
        return weight_rate(sde, auxiliary, message, t, x)

    return diffrax.MultiTerm(diffrax.ODETerm(field), _JointNoise(sde.diffusion, control))


def levy_area(solver: diffrax.AbstractSolver) -> type:
    """What a solver needs to know of the driving path."""
    # Euler and Milstein do not say; increments are all that they take.
    needed = getattr(solver, "minimal_levy_area", diffrax.AbstractBrownianIncrement)
    area = issubclass(needed, diffrax.AbstractSpaceTimeLevyArea)
    return diffrax.SpaceTimeLevyArea if area else diffrax.BrownianIncrement


def travel_continuous(
    sde: AbstractSDE,
    auxiliary: LinearSDE,
    solver: diffrax.AbstractSolver,
    seen: Observation,
    ts: Float[Array, " K+1"],
    x0: State,
    noise: Float[Array, "K k *dim"],
    observed: State,
) -> tuple[Float[Array, "K n *dim"], Float[Array, ""]]:
    """The states after x0 and the continuous log weight; an exactly observed end is pinned."""
    t_end = ts[-1]

    # Without the checkpoint the reverse pass would keep what the solver computes in every step.
    @jax.checkpoint
    def step(y, inputs):
        t0, t1, z = inputs
        # A path of this step alone: its time is found without a search in the grid.
        control = GridNoise(ts=jnp.stack([t0, t1]), noise=z[None], levy_area=levy_area(solver))
        terms = continuous_terms(sde, auxiliary, seen, t_end, observed, control)
        # What a solver keeps between steps, such as its last slope, is only to save work.
        state = solver.init(terms, t0, t1, y, None)
        y, *_ = solver.step(terms, t0, t1, y, None, state, False)
        return y, y[0]

    # h̃ of an exact end is singular there, so the solver stops one step before it.
    free = ts.shape[0] - 2 if seen.exact else ts.shape[0] - 1
    start = (x0, exact_message(auxiliary, seen, ts[0], t_end, x0, observed).log_value(x0))
    start = varying_like(start, sde, auxiliary, seen, ts, noise, observed)
    (x, log_weight), path = jax.lax.scan(step, start, (ts[:free], ts[1 : free + 1], noise[:free]))
    if seen.exact:
        # The last of ∫ G dt by its value before the step; the pinned state itself adds nothing.
        message = exact_message(auxiliary, seen, ts[-2], t_end, x, observed)
        _, rate = weight_rate(sde, auxiliary, message, ts[-2], x)
        log_weight = log_weight + (t_end - ts[-2]) * rate
        # The pin takes increments only, the first half of a noise that has a Lévy area.
        end, _ = arrive(sde, seen, ts, x, noise[-1][: sde.noise_size(x)], observed)
        path = jnp.concatenate([path, end[None]])
    return path, log_weight
