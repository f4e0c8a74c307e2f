"""The two ways to step a guided path, both diffrax solvers over the pair (state, log weight).

`GuidedStep` draws each state from the model's own transition conditioned on the guide's forecast; the log weight is the
exact discrete ratio. `continuous_terms` are the terms of the guided SDE dX° = (b + a ∇log h̃) dt + σ dW with the
continuous-time weight ∫ G dt beside it, for any Itô solver.
"""

from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._linalg import add, apply, cholesky, columns, congruence, promote, solve_lower
from .._types import RealScalar, State
from ..conditioning import GaussianMessage, Observation
from ..sdes import AbstractSDE, LinearSDE
from ._guides import AbstractPlan


class GridNoise(diffrax.AbstractBrownianPath):
    """Standard normal noise on a grid as a Brownian path; between grid times a lookup, √dt z_k, no interpolation.

    **Arguments:** `ts` `(K + 1,)`; `noise` `(K, k, dim)`, or `(K, 2k, dim)` where `levy_area` is
    `diffrax.SpaceTimeLevyArea`: the second half drives the area, H = √(dt/12) z.
    """

    ts: Float[Array, " K+1"]
    noise: Float[Array, "K k *dim"]
    levy_area: type = eqx.field(static=True, default=diffrax.BrownianIncrement)

    @property
    def t0(self):
        return self.ts[0]

    @property
    def t1(self):
        return self.ts[-1]

    def index(self, t: RealScalar) -> Array:
        """Number of the step that begins at t."""
        return jnp.clip(jnp.searchsorted(self.ts, t, side="right") - 1, 0, self.ts.shape[0] - 2)

    def evaluate(self, t0, t1=None, left=True, use_levy=False):
        t1 = t0 if t1 is None else t1
        dt, z = t1 - t0, self.noise[self.index(t0)]
        if not issubclass(self.levy_area, diffrax.SpaceTimeLevyArea):
            return jnp.sqrt(dt) * z
        z, area = jnp.split(z, 2)
        W = jnp.sqrt(dt) * z
        return diffrax.SpaceTimeLevyArea(dt=dt, W=W, H=jnp.sqrt(dt / 12) * area) if use_levy else W


class GuidedTerm(diffrax.AbstractTerm):
    """What `GuidedStep` steps: an SDE, a guide's plan at the step's end, the value to be led to, the noise of the step."""

    sde: AbstractSDE
    plan: AbstractPlan
    step: Callable[[RealScalar], Any]
    observed: State
    control: diffrax.AbstractPath

    def vf(self, t, y, args):
        raise NotImplementedError("A guided step has a Gaussian law and no vector field; use `GuidedStep()`.")

    def contr(self, t0, t1, **kwargs):
        return self.control.evaluate(t0, t1) / jnp.sqrt(t1 - t0)

    def prod(self, vf, control):
        raise NotImplementedError("A guided step has a Gaussian law and no vector field; use `GuidedStep()`.")


class GuidedStep(diffrax.AbstractItoSolver):
    """One step of the model's transition, conditioned on the guide's forecast; adds the step's exact log weight.

    Nothing blows up as the observation noise vanishes or dt · a · H grows.
    """

    term_structure: ClassVar = GuidedTerm
    interpolation_cls: ClassVar = diffrax.LocalLinearInterpolation

    def order(self, terms):
        return None

    def strong_order(self, terms):
        return 0.5

    def init(self, terms, t0, t1, y0, args):
        return None

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        x, log_weight = y0
        transition = terms.sde.transition(t0, t1, x)
        steering = terms.plan.steer(terms.step(t0), transition, t1 - t0, x, terms.observed)
        z = terms.contr(t0, t1)
        u, step_weight = steering.drive(z)
        y1 = (transition.mean + apply(transition.factor, u), log_weight + step_weight)
        return y1, None, dict(y0=y0, y1=y1), None, diffrax.RESULTS.successful

    def func(self, terms, t0, y0, args):
        raise NotImplementedError("A guided step has a Gaussian law and no vector field.")


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


def exact_message(auxiliary: LinearSDE, seen: Observation, t, t1, x: State, observed: State) -> GaussianMessage:
    """h̃(t, ·) of a linear process in continuous time."""
    step = auxiliary.exact_step(t, t1, x)
    operator, n = seen.operator, x.shape[0]
    M = congruence(operator, step.covariance)
    if seen.factor is not None:
        M = add(seen.covariance, M)
    flow = step.operator if operator.ndim == 0 else promote(operator, 2, n) @ promote(step.operator, 2, n)
    shift = apply(operator, step.shift)
    return GaussianMessage(flow, shift, cholesky(M), observed, seen.log_scale)


def weight_rate(sde: AbstractSDE, auxiliary: LinearSDE, message: GaussianMessage, t, x: State):
    """The guided drift b + a r̃ and G = (b − b̃)ᵀ r̃ − ½ tr[(a − ã)(H − r̃ r̃ᵀ)], at (t, x)."""
    n = x.shape[0]
    b, r = sde.drift(t, x), message.score(x)
    a, a_aux = sde.covariance(t, x), auxiliary.covariance(t, x)
    excess = promote(a, 2, n) - promote(a_aux, 2, n)
    root = solve_lower(message.factor, promote(message.operator, 2, n))
    trace = columns(x) * jnp.sum((root @ excess) * root)
    G = jnp.sum((b - auxiliary.drift(t, x)) * r) - 0.5 * (trace - jnp.sum(r * (excess @ r)))
    return b + apply(a, r), G


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
        return weight_rate(sde, auxiliary, exact_message(auxiliary, seen, t, t1, y[0], observed), t, y[0])

    return diffrax.MultiTerm(diffrax.ODETerm(field), _JointNoise(sde.diffusion, control))
