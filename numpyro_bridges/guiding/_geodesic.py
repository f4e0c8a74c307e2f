"""A guide that follows geodesics: a step of Newton's method from the straight line towards one.

For small noise −log h is the energy of the path that the Hamiltonian

    H(x, p) = pᵀ b(x) + ½ pᵀ a(x) p,        x' = ∂H/∂p,        p' = −∂H/∂x

leads from x to what is observed: for a flow, a geodesic of the metric a⁻¹. The receding guide
freezes a, so its path is a straight line. Its momentum p at x_k is that of such a path nearly;
where it leads, (x̂, p̂) at the end, tells how far it misses v,

    v − L x̂ − Σ λ̂,      p̂ = Lᵀ λ̂,      Σ the covariance of the error,

and the target is moved by a part of it. What is seen of a state beyond the end, as at the inner
nodes of trees, is seen at a later time: there the path ends.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from .._checks import as_float, require
from .._linalg import apply, compose, filled, solve_positive, transpose, without_variance
from .._types import State, Structured
from ..sdes import AbstractSDE, SemilinearSDE
from ._few_noises import LowRank
from ._guides import AbstractGuide, AbstractPlan, FrozenGuide, RecedingGuide, RecedingPlan


class GeodesicGuide(AbstractGuide):
    """`RecedingGuide` with its target corrected, at every step, towards the geodesic to what is
    observed.

    It costs about two receding steps and is worth it where the metric bends paths, as in flows
    whose displacements are not small beside the length scale: the guide for shapes. Where a is
    constant this is `FrozenGuide`.

    **Arguments:**

    - `correction`: γ, the part of the correction that is made, from 0 to 1. A full one overshoots
      on rough paths.
    - `end_weight`: as for `RecedingGuide`.

    A correction longer than what is left to go is damped, so that no path is lost.
    """

    correction: Structured
    receding: RecedingGuide

    def __init__(self, correction=0.75, end_weight=0.2):
        self.correction = as_float(correction, "correction")
        require(
            (self.correction.ndim == 0) and (0 <= self.correction) & (self.correction <= 1),
            f"`correction` must be a number from 0 to 1; got {correction}.",
        )
        self.receding = RecedingGuide(end_weight)

    @property
    def moves(self):
        return True

    def follows(self, sde, seen, reference):
        return self.receding.follows(sde, seen, reference)

    def plan(self, sde, seen, reference, ts, beyond=0.0):
        receding = self.receding.plan(sde, seen, reference, ts, beyond)
        if not isinstance(receding, RecedingPlan):
            return receding  # where a is constant a straight line is the geodesic
        steps = (receding.steps, ts[:-1], ts[-1] + beyond - ts[:-1])
        return _GeodesicPlan(steps, receding, sde, self.correction)


class _GeodesicPlan(AbstractPlan):
    steps: Any
    """The receding plan's entry, the time, and the time left"""
    receding: RecedingPlan
    sde: AbstractSDE
    correction_part: Structured

    def steer(self, step, transition, dt, x, observed):
        entry, t, left = step
        steering = self.receding.steer(entry, transition, dt, x, observed)
        # The geodesic starts where the step does. Its momentum is that of the steering, whose
        # factors then serve both.
        start = (entry[0], t - dt, left + dt)
        miss = self._miss(start, steering.r, steering.solve, x, observed)
        return steering.moved(self.correction_part * miss)

    def message(self, step, sde, t, x, observed):
        # The uncorrected one: its value is a density of the datum, as that of a moved one is not.
        return self.receding.message(step[0], sde, t, x, observed)

    def correction(self, step, x):
        entry, t, left = step
        operator, shift, covariance = self.receding.forecast(entry, self.sde.noise(t, x))
        solve = _solver(covariance)
        # In displacements what is observed is 0.
        r = -shift - apply(operator, x)
        miss = self._miss((entry[0], t, left), r, solve, x, jnp.zeros_like(shift))
        # A target that is moved by δ moves the score by Lᵀ S⁻¹ δ.
        return apply(transpose(operator), solve(self.correction_part * miss))

    def _miss(self, start, r: State, solve: Callable[[State], State], x: State, observed: State):
        """By how much the path of the receding momentum misses what is observed.

        r and S, of which `solve` is the inverse, are those of the receding forecast.
        """
        flow, t, left = start
        # λ = S⁻¹ r of the receding guide, and its momentum p = Λᵀ λ, the score
        momentum = solve(r)
        to_go = jnp.sum(r * momentum)

        def hamiltonian(x, p):
            return jnp.sum(p * self.sde.drift(t, x)) + self.sde.energy(t, x, p)

        slopes = jax.grad(hamiltonian, (0, 1))
        L = self.receding.seen.operator
        p = apply(transpose(compose(L, flow)), momentum)
        # One midpoint step over all the time left: x' = ∂H/∂p, p' = −∂H/∂x. A guide need not be
        # exact, and what the step leaves out costs variance, no bias.
        dp, dx = slopes(x, p)
        dp, dx = slopes(x + 0.5 * left * dx, p - 0.5 * left * dp)
        x = x + left * dx
        p = p - left * dp
        # λ̂ with p̂ = Lᵀ λ̂, row by row; of a general L, whose rows p̂ may have left, λ is kept.
        error = self.receding.seen.covariance
        if L.ndim < 2:
            momentum = apply(jnp.where(L == 0, 0.0, 1 / jnp.where(L == 0, 1.0, L)), p)
        miss = observed - apply(L, x) - apply(error, momentum)
        # Damped where it is longer than the way to go, both in the metric S⁻¹. At the target there
        # is no way to go: the double `where` keeps 0/0 out of the derivative.
        ratio = jnp.sum(miss * solve(miss)) / jnp.where(to_go > 0, to_go, 1.0)
        excess = jnp.where(to_go > 0, ratio, 0.0)
        return miss / (1 + (0.5 * excess) ** 2)


def _solver(covariance: Structured | LowRank) -> Callable[[State], State]:
    """Its inverse."""
    if isinstance(covariance, LowRank):
        return covariance.solve
    # What has no variance is forecast exactly, or out of reach: any variance may stand for it.
    return partial(solve_positive, filled(covariance, without_variance(covariance)))


def default_guide(sde: AbstractSDE, x: State) -> AbstractGuide:
    """`FrozenGuide()` where a is constant, `RecedingGuide()` where the linearised drift is a
    matrix, `GeodesicGuide()` for a flow and for other states too large for one.

    With a drift, geodesics are no better than the linearised drift; with a strong one they are
    worse. A semilinear equation is linearised along a path, in two rounds.
    """
    rounds = 2 if isinstance(sde, SemilinearSDE) else 0
    if sde.has_constant_covariance(x):
        return FrozenGuide(rounds=rounds)
    # B is a number for flows, and for states too large for a Jacobian, whose drift no guide knows.
    # Only its shape is asked for: nothing is computed, and traced parameters will do.
    operator = jax.eval_shape(lambda: sde.linearised_drift(jnp.zeros((), x.dtype), x)[0])
    return GeodesicGuide() if operator.ndim == 0 and rounds == 0 else RecedingGuide(rounds=rounds)
