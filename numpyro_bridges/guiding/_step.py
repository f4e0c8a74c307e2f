"""The guided step, a diffrax solver of the pair (state, log weight), and driving noise on a grid.

Each state is drawn from the model's own transition conditioned on the guide's forecast; the log
weight is the exact discrete ratio.
"""

from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._linalg import apply, safe_sqrt
from .._types import RealScalar, State
from ..sdes import AbstractSDE
from ._guides import AbstractPlan


class GridNoise(diffrax.AbstractBrownianPath):
    """Standard normal noise on a grid as a Brownian path; between grid times a lookup, √dt z_k, no
    interpolation.

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
        dt = t1 - t0
        z = self.noise[self.index(jnp.asarray(t0))]
        if not issubclass(self.levy_area, diffrax.SpaceTimeLevyArea):
            # a branch of a tree may have no length, where √dt has no derivative
            return safe_sqrt(dt) * z
        z, area = jnp.split(z, 2)
        W = jnp.sqrt(dt) * z
        # H is independent of W and N(0, dt/12): the mean distance of the path from its chord.
        H = jnp.sqrt(dt / 12) * area
        return diffrax.SpaceTimeLevyArea(dt=dt, W=W, H=H) if use_levy else W


class GuidedTerm(diffrax.AbstractTerm):
    """What `GuidedStep` steps: an SDE, a plan (`step(t0)`: its entry at the step's end), the
    target, noise.

    The product with a step's noise is what the step leads to, not an increment: near an exact end,
    to which states are displacements, sums of increments would lose its digits.
    """

    sde: AbstractSDE
    plan: AbstractPlan
    step: Callable[[Any], Any]
    observed: State
    control: diffrax.AbstractPath

    @classmethod
    def of(
        cls, sde: AbstractSDE, plan: AbstractPlan, observed: State, ts: Array, noise: Array
    ) -> "GuidedTerm":
        """On a grid, each of whose times has an entry in the plan."""
        control = GridNoise(ts=ts, noise=noise)

        def step(t0):
            return jax.tree.map(lambda a: a[control.index(t0) + 1], plan.steps)

        return cls(sde, plan, step, observed, control)

    # diffrax forms increments as prod(vf(t, y), contr(t0, t1)). A guided step is not bilinear, so
    # `vf` hands on the pair itself and `contr` all that else is needed; `prod` does the step.

    def vf(self, t, y, args):
        return y

    def contr(self, t0, t1, **kwargs):
        dt = t1 - t0
        # Steering takes z, not an increment √dt z; a step may have no length.
        z = self.control.evaluate(t0, t1) / jnp.sqrt(jnp.where(dt == 0, 1.0, dt))
        return t0, t1, z, self.step(t0)

    def prod(self, vf, control):
        x, log_weight = vf
        t0, t1, z, planned = control
        transition = self.sde.transition(t0, t1, x)
        steering = self.plan.steer(planned, transition, t1 - t0, x, self.observed)
        u, step_weight = steering.drive(z)
        return transition.mean + apply(transition.factor, u), log_weight + step_weight


class GuidedStep(diffrax.AbstractItoSolver):
    """The model's transition, conditioned on the guide's forecast; adds the exact log weight.

    Nothing blows up as the observation noise vanishes or dt · a · H grows.
    """

    term_structure: ClassVar = GuidedTerm
    interpolation_cls: ClassVar = diffrax.LocalLinearInterpolation

    def order(self, terms):
        return None  # of ODEs, which it does not solve

    def strong_order(self, terms):
        return 0.5

    def init(self, terms, t0, t1, y0, args):
        return None

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        y1 = terms.prod(terms.vf(t0, y0, args), terms.contr(t0, t1))
        return y1, None, dict(y0=y0, y1=y1), None, diffrax.RESULTS.successful

    def func(self, terms, t0, y0, args):
        raise NotImplementedError("A guided step has a Gaussian law and no vector field.")
