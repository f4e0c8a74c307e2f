"""Guides: how a path is led to what is observed.

`guide.plan(...)` does what depends on the parameters and the grid only, once; the plan's `steer` is
the cheap work of one step. A guide may know the parameters, the data and the path so far, never
later noise.

The backward filter in covariance form: with the auxiliary process's steps x' ~ N(Φ x + φ, C) and
v = L x_K + N(0, Σ), the forecast of v from x_k is N(Λ_k x_k + s_k, M_k),

    Λ_K = L,  s_K = 0,  M_K = Σ;
    Λ_k = Λ_{k+1} Φ_k,   s_k = s_{k+1} + Λ_{k+1} φ_k,   M_k = M_{k+1} + Λ_{k+1} C_k Λ_{k+1}ᵀ.
"""

import abc
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._checks import as_float, known, positive_integer, require, require_instance
from .._linalg import (
    add,
    apply,
    compose,
    congruence,
    promote,
    rows,
    safe_sqrt,
    semidefinite_cholesky,
    varying_like,
)
from .._types import RealScalar, State, Structured
from ..conditioning import GaussianMessage, Observation
from ..sdes import AbstractSDE, AffineStep, BrownianMotion, Displaced, LinearSDE, Transition
from ._few_noises import Errors, LowRank, NoiseSteering, are_few
from ._steering import AbstractSteering, DriftSteering, GaussianSteering

_MAX_DENSE = 16
"""Largest n for which the receding guide keeps a drift's full matrix, and not its diagonal only."""


class AbstractPlan(eqx.Module):
    """What a guide has prepared for a grid.

    `steps` is a pytree of arrays with a leading axis, one entry per grid time but the last. A loop
    hands `steer` the entry of the time at which its step ends. `AbstractGuide` has an example.
    """

    steps: eqx.AbstractVar[Any]

    @abc.abstractmethod
    def steer(
        self, step: Any, transition: Transition, dt: RealScalar, x: State, observed: State
    ) -> AbstractSteering:
        """Steering of a step from x, `step` being the entry of `steps` at the step's end."""

    @abc.abstractmethod
    def message(
        self, step: Any, sde: AbstractSDE, t: RealScalar, x: State, observed: State
    ) -> GaussianMessage:
        """h̃(t, ·) as the guide sees it at x, `step` being the entry of `steps` at time t."""

    def correction(self, step: Any, x: State) -> State:
        """What the guide adds to the score of its message: a learned guide's network."""
        return jnp.zeros_like(x)

    def bare(self) -> "AbstractPlan":
        """Without what it shares with all plans of its guide, of which a tree would hold a copy for
        each branch. `AbstractGuide.whole` gives it back.
        """
        return self


class AbstractGuide(eqx.Module):
    """A way to lead paths to what is observed. A subclass gives `plan`.

    Any plan gives unbiased weights; one that forecasts the observation better gives weights of less
    spread. A plan may know parameters, data and the path so far, never later noise. This one
    freezes the covariance halfway between a start, which it holds, and the observed end:

        class HalfwayGuide(nb.AbstractGuide):
            start: Array

            def plan(self, sde, seen, reference, ts):
                halfway = 0.5 * (self.start - sde.origin + reference)
                steps = jax.vmap(sde.linearised_step, (0, 0, None))(ts[:-1], ts[1:], halfway)
                return HalfwayPlan(backward_filter(steps, seen))

        class HalfwayPlan(AbstractPlan):
            steps: tuple  # Λ, s and M at the grid times but the last

            def steer(self, step, transition, dt, x, observed):
                return GaussianSteering(transition, *step, observed)

            def message(self, step, sde, t, x, observed):
                operator, shift, covariance = step
                factor = jnp.linalg.cholesky(covariance)
                return GaussianMessage(operator, shift, factor, observed, jnp.zeros(()))
    """

    @abc.abstractmethod
    def plan(self, sde: Displaced, seen: Observation, reference: State, ts) -> AbstractPlan:
        """Prepare for a grid.

        **Arguments:** `sde`: the process of displacements y = x − `sde.origin`, in the time that
        has elapsed, of the SDE `sde.sde`. `reference`: the displacement of a state that meets the
        condition, 0. `ts` `(K + 1,)`: times that have elapsed. What is observed is a displacement
        too, of L x from L `sde.origin`.

        States that a guide holds are put into place by `state - sde.origin`, other SDEs by
        `sde.alongside(other)`.
        """

    @property
    def moves(self) -> bool:
        """Whether it may plan for displacements from a moving origin, whose `sde` has no `origin`.

        So if it holds no states, and no process but the SDE's own.
        """
        # A guide that says nothing gets a still origin: what it holds can be put into place.
        return False

    def prepared(
        self, sde: Displaced, seen: Observation, observed: State, reference: State, ts, start: State
    ) -> "AbstractGuide":
        """The guide for paths from `start`, a displacement too, of which `plan` is not told."""
        return self

    def follows(self, sde: Displaced, seen: Observation, reference: State) -> bool:
        """Whether its covariances follow the state, that of what comes after the end too.

        `plan` then takes `beyond`, the time after the end until the state is seen: the process goes
        on from there.
        """
        return False

    def whole(self, plan: AbstractPlan) -> AbstractPlan:
        """A plan of this guide that was made `bare`."""
        return plan

    def check(self, sde: AbstractSDE, x: State) -> None:
        """`ValueError` where the guide does not fit states shaped like x."""
        return None

    def closed(self, sde: AbstractSDE, x: State, ts) -> "AbstractGuide":
        """The same guide for one bridge, with what a user's functions read frozen as it is now."""
        return self

    def auxiliary_process(self, sde: Displaced, reference: State, t1: RealScalar) -> LinearSDE:
        """The linear process whose h̃ is an exact h-transform, for the continuous-time weight."""
        raise ValueError(
            "the continuous weight (a diffrax `solver`) needs a guide with one auxiliary process, "
            f"since it weighs the path by that process's generator; {type(self).__name__} has "
            "none. Use `guide=FrozenGuide(...)`."
        )


class _FrozenPlan(AbstractPlan):
    steps: tuple[Structured, State, Structured]
    """Λ, s and M."""
    exact: bool = eqx.field(static=True)

    def steer(self, step, transition, dt, x, observed):
        operator, shift, covariance = step
        return GaussianSteering(transition, operator, shift, covariance, observed, self.exact)

    def message(self, step, sde, t, x, observed):
        operator, shift, covariance = step
        # M may be singular: of an exact observation a part may be forecast without variance.
        factor = semidefinite_cholesky(covariance)
        return GaussianMessage(operator, shift, factor, observed, jnp.zeros((), x.dtype))


class FrozenGuide(AbstractGuide):
    """The backward filter of one linear auxiliary process, computed once per parameter value.

    **Arguments:**

    - `auxiliary`: a `LinearSDE` or `BrownianMotion`; by default the SDE itself, linearised.
    - `rounds`: how often it is linearised along a path. With 0 it is linearised at the observed
      end, for all times. The first round has the straight line from the start to the end, each
      further one the path that the guide of the round before leads without noise. Two are the
      default of a `SemilinearSDE`, and worth a trial wherever a drift is not linear: they help
      where the conditioned process stays near one path, and harm where it may cross an obstacle at
      any time. A diffrax `solver` knows no rounds.

    The auxiliary process is stepped by the SDE's own scheme, so that an auxiliary process equal to
    the SDE gives the same log weight for every noise. Schauer, van der Meulen and van Zanten
    (2017); Mider, Schauer and van der Meulen (2021). Rounds are those of the iterated extended
    Kalman smoother (Bell 1994).
    """

    auxiliary: AbstractSDE | None
    rounds: int = eqx.field(static=True)
    way: "Way | None"

    def __init__(self, auxiliary: AbstractSDE | None = None, *, rounds: int = 0):
        require(
            auxiliary is None or isinstance(auxiliary, (LinearSDE, BrownianMotion)),
            f"`auxiliary` must be a LinearSDE or a BrownianMotion, whose messages are Gaussian; "
            f"got {type(auxiliary).__name__}.",
        )
        self.rounds = positive_integer(rounds, "rounds", least=0)
        require(
            auxiliary is None or self.rounds == 0,
            f"`rounds` linearise the SDE itself, and `auxiliary` is linear; got rounds={rounds}. "
            "Give one of the two.",
        )
        self.auxiliary = auxiliary
        self.way = None

    def check(self, sde, x):
        if self.auxiliary is not None:
            try:
                self.auxiliary.check_state(x)
            except ValueError as e:
                raise ValueError(
                    f"`auxiliary` must have the states of the SDE, {x.shape}: {e}"
                ) from e

    @property
    def moves(self):
        # The way of a round is of states, which a moving origin would have to carry along.
        return self.auxiliary is None and self.rounds == 0

    def prepared(self, sde, seen, observed, reference, ts, start):
        return smoothed(self, sde, seen, observed, reference, ts, start)

    def plan(self, sde, seen, reference, ts, steps: AffineStep | None = None):
        if steps is None:
            steps = self.steps(sde, reference, ts)
            is_number = steps.operator.ndim == 1  # the first axis is that of the steps
            if is_number and self._has_the_noise_of_the_end(sde, reference):
                sigma, a = sde.noise(ts[-1], reference)
                if is_low_rank(sigma, seen):
                    # the covariance of the end bridges all the time left: no matrix of all values
                    end = _End(jnp.ones((), reference.dtype), a)
                    return accumulated_plan(steps, seen, reference, ts, sigma, end)
        return _FrozenPlan(backward_filter(steps, seen), seen.exact)

    def _has_the_noise_of_the_end(self, sde: Displaced, reference: State) -> bool:
        """Whether every step has the σ of the end, times √dt."""
        other = self.auxiliary is not None or self.way is not None
        # of displacements from a moving origin a linear process is one itself
        process = sde.sde if isinstance(sde, Displaced) else sde
        euler = isinstance(process, BrownianMotion) or not process.has_exact_transition
        return euler and not other and sde.is_autonomous(reference)

    def steps(self, sde: Displaced, reference: State, ts) -> AffineStep:
        """The steps of the auxiliary process, of which a plan may be told if they are known."""
        auxiliary = self.auxiliary
        if auxiliary is None:
            return linearised_steps(sde, reference, ts, self.way)
        return jax.vmap(lambda s, t: sde.auxiliary_step(auxiliary, s, t, reference))(
            ts[:-1], ts[1:]
        )

    def auxiliary_process(self, sde, reference, t1):
        require(
            self.rounds == 0,
            "`rounds` of a guide change what is linear at every step, and the continuous weight "
            f"(a diffrax `solver`) needs one linear process; got rounds={self.rounds}. Use "
            "`guide=FrozenGuide()`.",
        )
        process = sde if self.auxiliary is None else sde.alongside(self.auxiliary)
        B, beta = process.linearised_drift(t1, reference)
        return LinearSDE(B, process.diffusion(t1, reference), beta)


class Way(NamedTuple):
    """States near which a process is linearised, displacements, at the starts of steps."""

    ts: Array
    states: State

    def at(self, ts) -> State:
        """The states at other times, by linear interpolation."""
        # `jnp.interp` is for numbers; and a grid may have steps of no length, as in trees.
        after = jnp.clip(jnp.searchsorted(self.ts, ts, side="right"), 1, len(self.ts) - 1)
        before = self.ts[after - 1]
        length = self.ts[after] - before
        part = jnp.clip((ts - before) / jnp.where(length > 0, length, 1.0), 0.0, 1.0)
        first = self.states[after - 1]
        second = self.states[after]
        return first + rows(part, first) * (second - first)


def linearised_steps(sde: Displaced, reference: State, ts, way: Way | None) -> AffineStep:
    """The steps of an SDE, linearised at one state or along a way."""
    if way is None:
        return jax.vmap(lambda s, t: sde.linearised_step(s, t, reference))(ts[:-1], ts[1:])
    return jax.vmap(sde.linearised_step)(ts[:-1], ts[1:], way.at(ts[:-1]))


def smoothed(
    guide, sde: Displaced, seen: Observation, observed: State, reference: State, ts, start: State
):
    """A guide of some `rounds` with the way of its last one, a path that is led without noise.

    A path that is lost, numbers that are not finite, leaves the way as it was.
    """
    if guide.rounds == 0:
        return guide
    # The first way is the straight line, at the starts of steps.
    ts = jnp.asarray(ts)
    duration = ts[-1] - ts[0]
    part = ((ts[:-1] - ts[0]) / jnp.where(duration > 0, duration, 1.0)).astype(start.dtype)
    line = start[None] + rows(part, start[None]) * (reference - start)[None]

    def along(states):
        way = Way(ts[:-1], states)
        return eqx.tree_at(lambda g: g.way, guide, way, is_leaf=lambda leaf: leaf is None)

    def another_round(states):
        # The plan is linearised along the old way; its own path, each step at the mean μ of the
        # steering, is the new one.
        plan = along(states).plan(sde, seen, reference, ts)

        def step(y, inputs):
            s, t, entry = inputs
            transition = sde.transition(s, t, y)
            steering = plan.steer(entry, transition, t - s, y, observed)
            return transition.mean + apply(transition.factor, steering.mean()), y

        ends = jax.tree.map(lambda a: a[1:], plan.steps)
        first = varying_like(start, sde, seen, observed, ts)
        # The step to the end has no entry in a plan, and no later step starts where it ends.
        last, path = jax.lax.scan(step, first, (ts[:-2], ts[1:-1], ends))
        path = jnp.concatenate([path, last[None]])
        return jnp.where(jnp.all(jnp.isfinite(path)), path, states)

    states = line
    # a loop of JAX within loops takes longer to compile than a second copy
    for _ in range(guide.rounds - 1):
        states = another_round(states)
    return along(states)


class RecedingPlan(AbstractPlan):
    """Flow, shift and accumulated time: a forecast, once the covariance at a state is known.

    With Ψ_k the linearised flow from time k to the end, the forecast from x at that time is

        v ~ N(L Ψ_k x + s_k, Σ + L S_k Lᵀ),    S_k = Σ_{j ≥ k} dt_j Ψ_{j+1} a Ψ_{j+1}ᵀ,

    a at the current state. S_k is linear in a, `_accumulated(κ_k, a)` with κ_k the sum of
    dt_j Ψ_{j+1} ⊗ Ψ_{j+1}: so what a plan holds does not depend on the path.
    """

    steps: tuple[Structured, State, Structured]
    """Ψ, s and κ."""
    seen: Observation
    end: "_End | None"
    """What is bridged by the covariance of the end."""
    few: Errors | None
    """Errors of what is observed, for few noises."""

    def forecast(
        self, step, here: tuple[Structured, Structured]
    ) -> tuple[Structured, State, Structured | LowRank]:
        """Operator, shift and covariance of what is observed, for a process of these σ and a."""
        flow, shift, kappa = step
        sigma, a = here
        L = self.seen.operator
        operator = compose(L, flow)
        w = jnp.zeros(()) if self.end is None else self.end.weight
        if self.few is not None:
            # By the factors L σ of both covariances: no matrix of all values is formed.
            low_rank = LowRank(self.few, w * kappa, compose(L, sigma), (1 - w) * kappa)
            return operator, shift, low_rank
        if self.end is not None:
            a = (1 - w) * a + w * self.end.covariance
        covariance = add(self.seen.covariance, congruence(L, _accumulated(kappa, a)))
        return operator, shift, covariance

    def steer(self, step, transition, dt, x, observed):
        # σ and a at x are those of the transition: the kernel matrix is computed once a step.
        forecast = self.forecast(step, per_time(transition, dt))
        return steered(transition, dt, *forecast, observed, self.seen.exact)

    def message(self, step, sde, t, x, observed):
        operator, shift, covariance = self.forecast(step, sde.noise(t, x))
        if isinstance(covariance, LowRank):
            covariance = covariance.dense()
        factor = semidefinite_cholesky(covariance)
        return GaussianMessage(operator, shift, factor, observed, jnp.zeros((), x.dtype))


class _End(NamedTuple):
    weight: Structured
    covariance: Structured


class RecedingGuide(AbstractGuide):
    """The backward filter with the covariance frozen at the current state and renewed at every
    step.

    The time left after step k is bridged by ã = a(x_k), the drift linearised at the observed end.
    Worth several nats in the spread of the log weight where a depends strongly on the state. Where
    a is constant this is `FrozenGuide`.

    **Arguments:**

    - `end_weight`: ã = (1 − end_weight) a(x_k) + end_weight a(reference). 0.2 helps on easy targets
      and harms on hard ones.
    - `rounds`: as for `FrozenGuide`: how often the drift is linearised along a path.
    """

    end_weight: Structured | None
    """`None` for a weight of 0 that is known."""
    rounds: int = eqx.field(static=True)
    way: Way | None

    def __init__(self, end_weight=0.0, *, rounds: int = 0):
        value = known(end_weight, "end_weight")
        weight = as_float(end_weight, "end_weight")
        require(
            (weight.ndim == 0) and (0 <= weight) & (weight <= 1),
            f"`end_weight` must be a number from 0 to 1; got {end_weight}.",
        )
        self.end_weight = None if value is not None and value == 0 else weight
        self.rounds = positive_integer(rounds, "rounds", least=0)
        self.way = None

    @property
    def moves(self):
        return self.rounds == 0

    def prepared(self, sde, seen, observed, reference, ts, start):
        return smoothed(self, sde, seen, observed, reference, ts, start)

    def follows(self, sde, seen, reference):
        if sde.has_constant_covariance(reference):
            return False
        # What comes after the end is told as a time, by which the covariance at the state is
        # multiplied: so of processes whose linearised flow is a number.
        flow = jax.eval_shape(
            lambda: sde.linearised_step(jnp.zeros(()), jnp.ones(()), reference).operator
        )
        return flow.ndim == 0

    def plan(self, sde, seen, reference, ts, beyond=0.0):
        if sde.has_constant_covariance(reference):
            return FrozenGuide().plan(
                sde, seen, reference, ts, linearised_steps(sde, reference, ts, self.way)
            )
        steps = linearised_steps(sde, reference, ts, self.way)
        operator = steps.operator
        shift = steps.shift
        n = reference.shape[0]
        ndim = operator.ndim - 1  # the first axis is that of the steps
        if ndim == 2 and n > _MAX_DENSE:
            # Ψ ⊗ Ψ of a full Ψ has n⁴ numbers. With the diagonal in its place the shift is
            # changed so that the step still agrees where it was linearised.
            kept = jnp.diagonal(operator, axis1=1, axis2=2)
            if self.way is None:
                near = jnp.broadcast_to(reference, shift.shape)
            else:
                near = self.way.at(ts[:-1])
            missing = jax.vmap(lambda full, d, y: full @ y - apply(d, y))(operator, kept, near)
            shift = shift + missing
            operator = kept
            ndim = 1

        steps = AffineStep(operator, shift, steps.covariance)
        sigma, a = sde.noise(ts[-1], reference)
        w = self.end_weight
        end = None if w is None else _End(w, a)
        return accumulated_plan(steps, seen, reference, ts, sigma, end, beyond)


def accumulated_plan(
    steps: AffineStep, seen: Observation, reference: State, ts, sigma, end: _End | None, beyond=0.0
) -> RecedingPlan:
    """Of a process with these linear steps, and with the covariance that a path has; `sigma` is
    that of the end.
    """
    ndim = steps.operator.ndim - 1

    def back(carry, inputs):
        """From the end of a step, whose Ψ is in the carry, to its start."""
        flow, total, kappa = carry
        phi, beta, dt = inputs
        # noise and shift of a step come at its end, the flow acts from its start
        kappa = kappa + dt * _square(flow)
        total = total + apply(compose(seen.operator, flow), beta)
        flow = compose(flow, phi)
        return (flow, total, kappa), (flow, total, kappa)

    one = promote(jnp.ones((), reference.dtype), ndim, reference.shape[0])
    # The carry of a scan keeps its shape, so `beyond`, a number, is given that of κ.
    beyond = beyond + jnp.zeros_like(_square(one))
    start = (one, jnp.zeros_like(apply(seen.operator, reference)), beyond)
    start = varying_like(start, seen, steps.operator, steps.shift, ts)
    inputs = steps.operator, steps.shift, jnp.diff(ts)
    _, planned = jax.lax.scan(back, start, inputs, reverse=True)
    errors = None
    # With a diagonal or full Ψ the sum over steps has a higher rank than σ.
    if is_low_rank(sigma, seen) and ndim == 0:
        assert seen.factor is not None
        errors = Errors.of(seen.factor, None if end is None else compose(seen.operator, sigma))
    return RecedingPlan(planned, seen, end, errors)


class DriftGuide(AbstractGuide):
    """Another guide's score as a drift: Euler steps of b + a ∇log h̃ instead of the conditional
    Gaussian step.

    The weight is still the exact discrete ratio. It overshoots where dt · a · H is not small, which
    the guided step does not.
    """

    guide: AbstractGuide

    def __check_init__(self):
        require_instance(self.guide, AbstractGuide, "guide", "a guide, such as `FrozenGuide()`")

    def check(self, sde, x):
        self.guide.check(sde, x)

    @property
    def moves(self):
        return self.guide.moves

    def closed(self, sde, x, ts):
        return DriftGuide(self.guide.closed(sde, x, ts))

    def prepared(self, sde, seen, observed, reference, ts, start):
        return DriftGuide(self.guide.prepared(sde, seen, observed, reference, ts, start))

    def plan(self, sde, seen, reference, ts):
        plan = self.guide.plan(sde, seen, reference, ts)
        return _DriftPlan(plan.steps, plan)

    def whole(self, plan):
        assert isinstance(plan, _DriftPlan)
        return _DriftPlan(plan.steps, self.guide.whole(plan.wrapped))

    def auxiliary_process(self, sde, reference, t1):
        return self.guide.auxiliary_process(sde, reference, t1)


class _DriftPlan(AbstractPlan):
    steps: Any
    wrapped: AbstractPlan

    def bare(self):
        return _DriftPlan(self.steps, self.wrapped.bare())

    def steer(self, step, transition, dt, x, observed):
        # The mean of the other's step, with the noise as it was: B = I.
        return DriftSteering(self.wrapped.steer(step, transition, dt, x, observed).mean())

    def message(self, step, sde, t, x, observed):
        return self.wrapped.message(step, sde, t, x, observed)

    def correction(self, step, x):
        return self.wrapped.correction(step, x)


def is_low_rank(sigma: Structured, seen: Observation) -> bool:
    """Whether fewer noises drive what is seen than it has values, whose errors are independent."""
    # A scalar σ has as many noises as rows, and 0 values are never too many.
    num_values = len(seen.operator if seen.operator.ndim else sigma) if sigma.ndim else 0
    return seen.factor is not None and seen.factor.ndim < 2 and are_few(sigma, num_values)


def per_time(transition: Transition, dt: RealScalar) -> tuple[Structured, Structured]:
    """σ and a of a step."""
    dt = jnp.where(dt == 0, 1.0, dt)  # a branch of a tree may have no length
    return transition.factor / jnp.sqrt(dt), transition.covariance / dt


def steered(
    transition: Transition,
    dt: RealScalar,
    operator: Structured,
    shift: State,
    covariance: Structured | LowRank | None,
    observed: State,
    may_be_empty: bool = False,
) -> GaussianSteering | NoiseSteering:
    """A step whose end is seen as N(operator x' + shift, covariance), in the smaller space."""
    if not isinstance(covariance, LowRank):
        return GaussianSteering(transition, operator, shift, covariance, observed, may_be_empty)
    r = observed - shift - apply(operator, transition.mean)
    # The step moves what is seen by √dt L σ u, and `covariance` has L σ: s = √dt.
    return NoiseSteering(covariance, safe_sqrt(dt), r)


def backward_filter(steps: AffineStep, seen: Observation) -> tuple[Structured, State, Structured]:
    """Λ_k, s_k and M_k at every grid time but the last, leading axis k."""
    first = jax.tree.map(lambda a: a[0], steps)
    n = first.shift.shape[0]
    start = (seen.operator, jnp.zeros_like(apply(seen.operator, first.shift)))

    def back(carry, step):
        operator, shift, M = carry
        shift = shift + apply(operator, step.shift)
        M = add(M, congruence(operator, step.covariance))
        carry = (compose(operator, step.operator), shift, M)
        return carry, carry

    # Λ and M begin as numbers or diagonals and may become matrices, but the carry of a scan keeps
    # its shape. Two steps, of shapes alone, reach the ranks that they end with: in the first Λ
    # takes that of Φ, in the second M that of Λ.
    shapes = jax.eval_shape(lambda: back((*start, seen.covariance), first)[0])
    shapes = jax.eval_shape(lambda s: back(s, first)[0], shapes)
    operator = promote(seen.operator, len(shapes[0].shape), n)
    carry = (operator, start[1], promote(seen.covariance, len(shapes[2].shape), start[1].shape[0]))
    return jax.lax.scan(back, varying_like(carry, seen, steps), steps, reverse=True)[1]


def _square(flow: Structured) -> Structured:
    """Ψ ⊗ Ψ, so that Ψ a Ψᵀ is `_accumulated(Ψ ⊗ Ψ, a)`."""
    if flow.ndim == 0:
        return flow * flow
    if flow.ndim == 1:
        return flow[:, None] * flow[None, :]
    return jnp.einsum("ia,jb->iajb", flow, flow)


def _accumulated(kappa: Structured, a: Structured) -> Structured:
    """Σ_j dt_j Ψ_j a Ψ_jᵀ from Σ_j dt_j Ψ_j ⊗ Ψ_j."""
    if kappa.ndim == 0:
        return kappa * a
    if kappa.ndim == 2:
        # Ψ is diagonal: (Ψ a Ψᵀ)_ij = Ψ_i a_ij Ψ_j.
        return kappa * a if a.ndim == 2 else jnp.diagonal(kappa) * a
    n = kappa.shape[0]
    return jnp.einsum("iajb,ab->ij", kappa, promote(a, 2, n))
