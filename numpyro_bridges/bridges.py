"""Guided bridges: an SDE conditioned on what is seen later, driven by standard normal noise."""

import functools
from collections.abc import Callable
from typing import NamedTuple, TypeVar, cast

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray
from numpy.typing import ArrayLike

from ._checks import as_float, concrete, require, require_finite, require_instance, require_key
from ._linalg import apply, columns, congruence, full_precision, promote, varying_like
from ._types import RealScalar, State
from .conditioning import AbstractCondition, GaussianMessage, Observation, Target
from .guiding import (
    AbstractGuide,
    AbstractPlan,
    FrozenGuide,
    GuidedStep,
    GuidedTerm,
    default_guide,
    exact_message,
    levy_area,
    reach,
    retrace_reach,
    travel_continuous,
)
from .sdes import AbstractSDE, Flattened, Frame, TimeGrid, law_of_end, still_frame, time_grid

Method = TypeVar("Method", bound=Callable)


class _PureMethod:
    """Binds to a partial function, which `jax.jit` takes as it is.

    A bound method of equinox is a module, hashed by its leaves, and arrays have no hash; a partial
    function is hashed by its identity.
    """

    def __init__(self, method):
        self.method = method
        self.__doc__ = method.__doc__

    def __get__(self, instance, owner=None):
        if instance is None:
            return self.method
        return functools.update_wrapper(functools.partial(self.method, instance), self.method)


def _pure_method(method: Method) -> Method:
    # for type checkers and the documentation it is the method still
    return cast(Method, _PureMethod(method))


class Problem(NamedTuple):
    """A bridge as it is computed: displacements from a frame, times that have elapsed."""

    frame: Frame
    condition: AbstractCondition
    seen: Observation
    reference: State
    ts: Float[Array, " K+1"]


class GuidedBridge(eqx.Module):
    """The process X on [t0, t1] from x0, conditioned on its end state, driven by standard normal
    noise.

    `path(noise)` and `log_weight(noise)` are pure functions; with z ~ N(0, I),

        E[exp(log_weight(z))] = p(condition | x0)

    exactly for the time-discretised model (any guide, any number of steps), and the paths weighted
    by exp(log_weight) have the law of the conditioned process.

    **Arguments:**

    - `sde`: an `AbstractSDE`.
    - `condition`: `match.at(v)` or a `CylinderSet`.
    - `x0`: `(n, dim)` or `(n,)`.
    - `t1`, `t0`: the interval, in the time units of the SDE; t0 is 0 unless given.
    - `num_steps`, or `ts`: the number of steps of the default grid, or an increasing grid
      `(K + 1,)` from t0 to t1. The default is uniform, and graded towards t1, t = s(2 − s/T), where
      the end state is pinned. A grid whose steps vanish in the precision used is refused.
    - `guide`: by default `FrozenGuide()` where a is constant, `GeodesicGuide()` for a Kunita flow
      and for other states of more than 64 numbers, whose drift is not linearised, `RecedingGuide()`
      where a depends on the state otherwise. The first and the last have `rounds=2` for a
      `SemilinearSDE`.
    - `solver`: by default the guided step with its exact discrete weight. An Itô diffrax solver
      steps the guided drift instead, with the continuous-time weight: consistent as dt → 0, biased
      at fixed dt, and no target for MCMC. A Stratonovich solver is refused unless both readings of
      the SDE coincide.

    **Errors:** `ValueError` for shapes, grids, data and combinations that cannot be meant.
    """

    sde: AbstractSDE
    condition: AbstractCondition
    x0: State
    grid: TimeGrid
    clock: Float[Array, ""]
    guide: AbstractGuide
    solver: diffrax.AbstractSolver
    flat: "GuidedBridge | None"
    """Of flattened states: the one that is computed where the condition is approximated."""

    def __init__(
        self,
        sde: AbstractSDE,
        condition: AbstractCondition,
        *,
        x0: ArrayLike,
        t1: RealScalar | None = None,
        t0: RealScalar | None = None,
        num_steps: int | None = None,
        ts=None,
        guide: AbstractGuide | None = None,
        solver: diffrax.AbstractSolver | None = None,
    ):
        require(
            isinstance(condition, AbstractCondition),
            "`condition` must be a condition, such as `InexactMatch(variance).at(v)`; got "
            f"{type(condition).__name__}.",
        )
        require_instance(sde, AbstractSDE, "sde", "an SDE, such as `LinearSDE(drift, diffusion)`")
        x0 = as_float(x0, "x0")
        require(
            x0.ndim in (1, 2) and x0.size,
            f"`x0` must be one state, (n, dim) or (n,); got shape {x0.shape}. Use vmap for a "
            "batch.",
        )
        require_finite(x0, "x0")
        grid = time_grid(t0, t1, num_steps, ts, graded=condition.exact)
        # A user's functions are frozen before anything else calls them, even a check of shapes.
        sde = sde.closed(grid.elapsed[0], x0)
        sde.check_state(x0)
        x0 = sde.start(x0)
        condition = condition.closed(x0)
        condition.check(sde, x0)
        clock = grid.clock(sde, x0)
        # The law of the end is a pass over the grid, made only by a condition that asks for it.
        condition = condition.anchored(sde, lambda: law_of_end(sde, x0, clock + grid.elapsed))
        if guide is None:
            guide = default_guide(sde, x0)
            if solver is not None and isinstance(guide, FrozenGuide):
                # The default may have rounds, which have no continuous weight.
                guide = FrozenGuide()
        require_instance(guide, AbstractGuide, "guide", "a guide, such as `FrozenGuide()`")
        self.sde = sde
        self.condition = condition
        self.x0 = x0
        self.grid = grid
        self.clock = clock
        self.flat = None
        self.solver = GuidedStep() if solver is None else solver
        if condition.is_approximated and x0.ndim == 2:
            # The approximation sees the columns of a state together, and the maps of this package
            # act on each column alike. So all is computed for states of one column; this bridge
            # only reshapes, and the guide is checked and closed by the other.
            flat = Flattened(sde, x0.shape[1])
            self.guide = guide
            self.flat = GuidedBridge(
                flat, condition, x0=x0.reshape(-1), ts=grid, guide=guide, solver=solver
            )
            sde.check_end(lambda: condition.reference(sde, x0))
            return
        guide.check(sde, x0)
        self.guide = guide.closed(sde, x0, grid.elapsed)
        self._check_solver()
        if condition.exact:
            self._check_exact()
        sde.check_end(lambda: self.end()[1])
        sde.check_error(lambda: condition.observation(sde, x0).factor, grid.elapsed[-1])

    def _check_solver(self):
        name = type(self.solver).__name__
        require(
            isinstance(self.solver, diffrax.AbstractItoSolver)
            or self.sde.ito_is_stratonovich(self.x0),
            f"`solver` must be an Itô solver (diffrax.Euler, diffrax.ItoMilstein); got {name}. "
            "Guided proposals and their weights are Itô statements, and this SDE's Stratonovich "
            "reading is another process.",
        )
        require(
            isinstance(
                self.solver, (diffrax.AbstractItoSolver, diffrax.AbstractStratonovichSolver)
            ),
            "`solver` must be a diffrax solver for SDEs, such as `diffrax.Euler()`; got "
            f"{self.solver!r}.",
        )
        if not self._is_discrete:
            self._check_continuous()

    def _check_continuous(self):
        """The guide has one auxiliary process, and it fits an exact end."""
        frame, _, seen, reference, ts = self.problem()
        auxiliary = self.guide.auxiliary_process(frame.sde, reference, ts[-1])
        if not self.condition.exact:
            return
        a = congruence(seen.operator, frame.sde.covariance(ts[-1], reference))
        a_aux = congruence(seen.operator, auxiliary.covariance(ts[-1], reference))
        # One may be a number or a diagonal where the other is a matrix.
        ndim = max(a.ndim, a_aux.ndim)
        m = apply(seen.operator, reference).shape[0]
        gap = jnp.max(jnp.abs(promote(a, ndim, m) - promote(a_aux, ndim, m)))
        # Of a mismatch neither ESS nor k̂ gives a sign: it must be refused here. What is equal but
        # for rounding in single precision passes.
        require(
            gap <= 1e-5 * jnp.max(jnp.abs(a)),
            "`auxiliary` must match the SDE at the observed end, L ã(T) Lᵀ = L a(T, v) "
            "Lᵀ, for the continuous weight of an exact match: they differ by "
            f"{concrete(gap)}, which gives finite and wrong weights. Use `FrozenGuide()` "
            "without an auxiliary, the default solver, or an inexact match.",
        )

    def _check_exact(self):
        seen, _ = self.end()
        ts = self.grid.elapsed
        # A step of the last one's length, from x0: where the last one begins is random.
        law = self.sde.transition(self.clock, self.clock + (ts[-1] - ts[-2]), self.x0)
        S = congruence(seen.operator, law.covariance)
        if concrete(S) is None:
            # A traced one cannot be refused: its log weight is −inf or NaN, see `ExactMatch`.
            return
        pivots = jnp.diagonal(jnp.linalg.cholesky(S)) if S.ndim == 2 else jnp.sqrt(S)
        scale = jnp.sqrt(jnp.max(jnp.abs(S)))
        require(
            # of variances 1e-14: a singular matrix has pivots of rounding
            jnp.all(pivots > 1e-7 * scale),
            "`condition` is an exact match, which needs noise in every observed direction, "
            "and the covariance of the last step, L a Lᵀ dt, is singular: an observed "
            "component has no noise of its own. Use `InexactMatch` with a small variance.",
        )

    @property
    def _is_discrete(self) -> bool:
        return isinstance(self.solver, GuidedStep)

    @property
    def ts(self) -> Array | np.ndarray:
        """The grid `(K + 1,)`, from t0 to t1."""
        return self.grid.ts

    @property
    def shown_ts(self) -> Float[Array, " K+1"]:
        """The grid as the SDE sees it: times since t0 where it does not depend on the time."""
        return self.clock + self.grid.elapsed

    @property
    def num_steps(self) -> int:
        """Number of steps K."""
        return self.grid.num_steps

    @property
    def noise_shape(self) -> tuple[int, int, int]:
        """(num_steps, k, dim): k noises per coordinate; one row more where the condition draws."""
        k = self.sde.noise_size(self.x0)
        if not self._is_discrete and issubclass(levy_area(self.solver), diffrax.SpaceTimeLevyArea):
            k = 2 * k  # the second half drives the area, see `GridNoise`
        num_rows = self.num_steps + self.condition.num_extra_noises
        return num_rows, k, columns(self.x0)

    def with_guide(self, guide: AbstractGuide) -> "GuidedBridge":
        """The same bridge, led by another guide: the same estimand."""
        return GuidedBridge(
            self.sde, self.condition, x0=self.x0, ts=self.grid, guide=guide, solver=self.solver
        )

    @_pure_method
    def path(self, noise: Float[Array, "K k dim"]) -> Float[Array, "K+1 n *dim"]:
        """The states at `ts`, from x0: of the conditioned law, if weighted by exp(log weight)."""
        return self._run(noise)[0]

    @_pure_method
    def log_weight(self, noise: Float[Array, "K k dim"]) -> Float[Array, ""]:
        """Ψ, log h̃(t0, x0) included. NaN after a numerical failure."""
        return self._run(noise)[1]

    @_pure_method
    def path_and_log_weight(
        self, noise: Float[Array, "K k dim"]
    ) -> tuple[Float[Array, "K+1 n *dim"], Float[Array, ""]]:
        """Both from one pass."""
        return self._run(noise)

    def _driving(self, noise):
        noise = as_float(noise, "noise").astype(self.x0.dtype)
        require(
            jnp.shape(noise) == self.noise_shape,
            f"`noise` must have shape {self.noise_shape}, one noise for one path; got "
            f"{jnp.shape(noise)}. Use vmap for a batch.",
        )
        return noise

    def _split(self, noise):
        """Rows that choose the target, and rows that drive the steps, shaped like states."""
        noise = self._driving(noise)
        noise = noise[..., 0] if self.x0.ndim == 1 else noise
        extra = self.condition.num_extra_noises
        return noise[:extra], noise[extra:]

    def _drawn(self, extra) -> "GuidedBridge":
        """With what the rows of extra noise choose of the condition."""
        condition = self.condition.drawn(extra)
        if condition is self.condition:
            return self
        return eqx.tree_at(lambda b: b.condition, self, condition)

    def end(self) -> tuple[Observation, State]:
        """What is seen of the end state, and a state that meets the condition."""
        seen = self.condition.observation(self.sde, self.x0)
        free = self.x0
        ts = self.shown_ts
        # Differences of `shown_ts` would lose digits at a large t0.
        dt = jnp.diff(self.grid.elapsed)

        def without_noise(x, step):
            t, dt = step
            return self.sde.transition(t, t + dt, x).mean, None

        # What the condition leaves open of the end state, a part or a choice inside a set, is taken
        # from where the process goes without noise.
        if seen.operator.ndim or self.condition.num_extra_noises:
            start = varying_like(free, self.sde, ts, dt)
            free, _ = jax.lax.scan(without_noise, start, (ts[:-1], dt))
        reference = self.condition.reference(self.sde, free)
        return seen, reference

    def problem(self, x: State | None = None, since: RealScalar = 0.0) -> Problem:
        """What is computed, for a path from x at the time `since`, which has elapsed; from the
        start if not given.

        In displacements from a state that meets the condition, what is exactly seen keeps its
        digits to the end.
        """
        seen, end = self.end()
        x = self.x0 if x is None else x
        if self._is_discrete and self.guide.moves:
            # Times before `since` have come when the path begins: the origin has not moved at them.
            left = jnp.maximum(self.grid.elapsed, since) - since
            frame = self.sde.frame(x, end, left, self.clock)
        else:
            frame = still_frame(self.sde, x, end, self.grid.elapsed, self.clock)
        condition = self.condition.displaced(apply(seen.operator, end))
        reference = jnp.zeros_like(end)  # `end`, as a displacement from itself
        return Problem(frame, condition, seen, reference, self.grid.elapsed)

    def observed(self) -> State:
        """The value that is observed; `ValueError` for a set."""
        require(
            self.condition.num_extra_noises == 0,
            "`condition` is a set, which has no observed value.",
        )
        # A datum is the target whatever the law of what is seen: any law will do.
        return self.condition.target(self.x0, jnp.ones(()), jnp.zeros((0,))).value

    def _before_the_end(self, t, x) -> tuple[Array, State]:
        """The time that has elapsed at t, and x, checked."""
        x = as_float(x, "x")
        require(
            x.shape == self.x0.shape,
            f"`x` must be one state, {self.x0.shape}; got shape {x.shape}. Use vmap.",
        )
        elapsed = self.grid.since(t)
        require(elapsed.ndim == 0, f"`t` must be one time; got shape {elapsed.shape}. Use vmap.")
        require(
            (elapsed >= 0) & (elapsed < self.grid.elapsed[-1]),
            f"`t` must lie in [{self.ts[0]}, {self.ts[-1]}), before the end; got {t}.",
        )
        return elapsed, x

    @_pure_method
    def log_h(self, t: RealScalar, x: State) -> Float[Array, ""]:
        """log h̃(t, x), t before t1: log density of the datum, or probability of the set, from x."""
        return self._log_h_and_score(*self._before_the_end(t, x))[0]

    @_pure_method
    def score(self, t: RealScalar, x: State) -> State:
        """∇ log h̃(t, x), the guide's covariance held fixed; a learned guide's network is in it.

        Where the path is pulled, before a(x) acts on it.
        """
        return self._log_h_and_score(*self._before_the_end(t, x))[1]

    @_pure_method
    def scores(self, path: Float[Array, "K+1 n *dim"]) -> Float[Array, "K n *dim"]:
        """∇ log h̃ at the grid times but the last, from the states of a path: one plan for all."""
        path = as_float(path, "path").astype(self.x0.dtype)
        shape = (self.num_steps + 1, *self.x0.shape)
        require(
            path.shape == shape,
            f"`path` must have shape {shape}; got {path.shape}. Use vmap for a batch.",
        )
        return self._scores(path)

    @eqx.filter_jit
    @full_precision
    def _log_h_and_score(self, since, x: State) -> tuple[Float[Array, ""], State]:
        if self.flat is not None:
            value, score = self.flat._log_h_and_score(since, x.reshape(-1))
            return value, score.reshape(x.shape)
        problem = self.problem(x, since)
        start = problem.frame.start
        if not self._is_discrete:
            return self._value_and_score(problem, None, None, since, start)
        # 0, `since`, and the grid, of which earlier times become `since`: their steps have no
        # length and change nothing. So one program serves all times, with the number of steps
        # static, and entry 1 of the plan is the forecast at `since`.
        ts = jnp.concatenate([problem.ts[:1], jnp.maximum(problem.ts, since)])
        plan = self.plan(self.guide, problem, ts)
        entry = jax.tree.map(lambda a: a[1], plan.steps)
        return self._value_and_score(problem, plan, entry, since, start)

    @eqx.filter_jit
    @full_precision
    def _scores(self, path):
        if self.flat is not None:
            return self.flat._scores(path.reshape(len(path), -1)).reshape(-1, *self.x0.shape)
        problem = self.problem()
        ts = self.grid.elapsed[:-1]
        y = path[:-1] - problem.frame.origins[:-1]
        if not self._is_discrete:
            return jax.vmap(lambda t, y: self._value_and_score(problem, None, None, t, y)[1])(ts, y)
        plan = self.plan(self.guide, problem)
        along = jax.vmap(lambda entry, t, y: self._value_and_score(problem, plan, entry, t, y)[1])
        return along(plan.steps, ts, y)

    def _message(self, problem: Problem, plan, entry, t, y: State) -> GaussianMessage:
        """The guide's forecast of what is seen, a displacement, from y."""
        frame, _, seen, reference, ts = problem
        # Only operator, shift and factor are asked for: the condition knows its datum.
        blank = jnp.zeros_like(apply(seen.operator, y))
        if plan is None:
            auxiliary = self.guide.auxiliary_process(frame.sde, reference, ts[-1])
            return exact_message(auxiliary, seen, t, ts[-1], y, blank)
        return plan.message(entry, frame.sde, t, y, blank)

    def _value_and_score(self, problem, plan, entry, t, y) -> tuple[Float[Array, ""], State]:
        # Outside of what is differentiated: its covariance, which may depend on y, is held fixed.
        message = self._message(problem, plan, entry, t, y)

        def log_h(y):
            mean = apply(message.operator, y) + message.shift
            return problem.condition.log_value(mean, message.factor)

        value, score = jax.value_and_grad(log_h)(y)
        if plan is not None:
            score = score + plan.correction(entry, y)
        return value + problem.seen.log_scale, score

    def _target(self, problem: Problem, plan, extra) -> Target:
        start = problem.frame.start
        if extra.shape[0] == 0:
            # Without a draw the law is not looked at, and the forecast at t0 need not be computed.
            return problem.condition.target(start, jnp.ones(()), extra)
        message = self._start(problem, plan)
        mean = apply(message.operator, start) + message.shift
        return problem.condition.target(mean, message.factor, extra)

    def _start(self, problem: Problem, plan) -> GaussianMessage:
        """The forecast at t0."""
        entry = None if plan is None else jax.tree.map(lambda a: a[0], plan.steps)
        return self._message(problem, plan, entry, problem.ts[0], problem.frame.start)

    def _plan(self, problem: Problem) -> AbstractPlan | None:
        """`None` for a diffrax solver."""
        if not self._is_discrete:
            return None
        return self.plan(self.guide, problem)

    def plan(self, guide: AbstractGuide, problem: Problem, ts: Array | None = None) -> AbstractPlan:
        """A guide's plan for the grid, or for one with the same end."""
        frame, _, seen, reference, grid = problem
        observed = apply(seen.operator, reference)
        # Of a still frame, whose origin is the end at all times: a guide that looks at `start`
        # does not let the frame move.
        start = self.x0 - frame.origins[-1]
        guide = guide.prepared(frame.sde, seen, observed, reference, grid, start)
        return guide.plan(frame.sde, seen, reference, grid if ts is None else ts)

    @eqx.filter_jit
    @full_precision
    def _run(self, noise):
        if self.flat is not None:
            path, log_weight = self.flat._run(self._driving(noise).reshape(self.flat.noise_shape))
            return path.reshape(-1, *self.x0.shape), log_weight
        extra, noise = self._split(noise)
        # What is drawn comes before the plan, which is made for the observation that it chooses.
        self = self._drawn(extra)
        problem = self.problem()
        frame, _, seen, reference, ts = problem
        plan = self._plan(problem)
        target = self._target(problem, plan, extra)
        v = target.value
        if plan is None:
            auxiliary = self.guide.auxiliary_process(frame.sde, reference, ts[-1])
            path, log_weight = travel_continuous(
                frame.sde, auxiliary, self.solver, seen, ts, frame.start, noise, v
            )
        else:
            path, log_weight = reach(frame.sde, plan, seen, ts, frame.start, noise, v)
        path = frame.origins[1:] + path
        if self.condition.exact:
            # What is seen is met to the last digit, which the sum with the origin rounds.
            path = path.at[-1].set(self.condition.reference(self.sde, path[-1]))
        # Ψ is that of the steps, of the choice of the target (a set), and of the condition over
        # the observation by which it led the path (an approximated one).
        log_weight = log_weight + target.log_weight + self.condition.correction(self.sde, path[-1])
        return jnp.concatenate([self.x0[None], path]), log_weight

    @full_precision
    def guided_terms(
        self, noise: Float[Array, "K k dim"]
    ) -> tuple[GuidedTerm, Float[Array, " K"], Float[Array, "K+1 n *dim"]]:
        """What `diffrax.diffeqsolve` solves by `GuidedStep()`: every step but the last, onto the
        observation.

            terms, ts, origins = bridge.guided_terms(noise)
            start = (bridge.x0 - origins[0], 0.0)
            diffrax.diffeqsolve(terms, nb.GuidedStep(), ts[0], ts[-1], None, start,
                                stepsize_controller=diffrax.StepTo(ts))

        **Returns:** the terms, times that have elapsed, `(K,)`, and the origins of which states are
        displacements, at all times of the grid. The solution is the displacement of the last state
        but one, and its log weight.

        **Errors:** `ValueError` for a set, whose target is drawn, and for a bridge with another
        `solver`.
        """
        require(self._is_discrete, "`guided_terms` needs the guided step: the default `solver`.")
        require(
            self.flat is None,
            "`guided_terms` are of the bridge `flat`, whose states are flattened: this condition "
            "is approximated.",
        )
        _, noise = self._split(noise)
        problem = self.problem()
        frame, condition, _, _, ts = problem
        require(
            condition.num_extra_noises == 0,
            "`condition` is a set, whose target `guided_terms` does not draw.",
        )
        plan = self._plan(problem)
        assert plan is not None
        observed = self._target(problem, plan, noise[:0]).value
        terms = GuidedTerm.of(frame.sde, plan, observed, ts[:-1], noise[:-1])
        return terms, ts[:-1], frame.origins

    def noise_from_path(
        self, path: Float[Array, "K+1 n *dim"], key: PRNGKeyArray | None = None
    ) -> Float[Array, "K k dim"]:
        """The noise with `path(noise) = path`, for a path that starts at x0 and meets the
        condition.

        Where several noises give the same path (more noises than states, an exactly observed end)
        the part that the path leaves free is drawn with `key`, from its law under the model; it is
        0 without a key. The path is given by its states, whose digits limit those of the noise: in
        single precision, near an exact end, there may be few.

        **Errors:** `ValueError` for a path that does not start at x0, or whose end is not the exact
        datum or outside the set.
        """
        require(self._is_discrete, "`noise_from_path` needs the guided step: the default `solver`.")
        path = as_float(path, "path").astype(self.x0.dtype)
        shape = (self.num_steps + 1, *self.x0.shape)
        require(path.shape == shape, f"`path` must have shape {shape}; got {path.shape}.")
        if key is not None:
            require_key(key)
        self._check_ends(path)
        return self._retrace(path, key)

    def _check_ends(self, path):
        """A path of another bridge has other ends."""
        # to single precision, in which the path may have been kept
        near = 1e-6 * jnp.max(jnp.abs(path))
        start = jnp.max(jnp.abs(path[0] - self.x0))
        require(
            start <= near,
            f"`path` must start at `x0`; its first state is {concrete(start)} away from it. Use "
            "the bridge from there.",
        )
        if self.condition.exact:
            end = jnp.max(jnp.abs(path[-1] - self.condition.reference(self.sde, path[-1])))
            require(
                end <= near,
                f"`path` must end where `condition` is met; its last state is {concrete(end)} "
                "away from there. Use the bridge to what is seen of its end.",
            )

    @eqx.filter_jit
    @full_precision
    def _retrace(self, path, key):
        if self.flat is not None:
            return self.flat._retrace(path.reshape(len(path), -1), key).reshape(self.noise_shape)
        if self.condition.is_approximated and self.condition.num_extra_noises:
            # The scale τ at which this path was led cannot be read off it: it is drawn from its law
            # given the path, and then the bridge is the one of that scale.
            key_draw, key = (None, None) if key is None else jr.split(key)
            shape = (1, self.noise_shape[1], *self.x0.shape[1:])
            self = self._drawn(self.condition.draw_of(path[-1], shape, key_draw))
        problem = self.problem()
        frame, condition, seen, _, ts = problem
        plan = self._plan(problem)
        assert plan is not None
        # The frame's own start may have digits that the difference of states has lost.
        y = (path - frame.origins).at[0].set(frame.start)
        if seen.exact:
            observed = apply(seen.operator, y[-1])  # a point of a set, too, is where the path ends
        else:
            observed = self._target(problem, plan, jnp.zeros((0,))).value
        z = retrace_reach(frame.sde, plan, seen, ts, y, observed, key)
        if condition.num_extra_noises:
            message = self._start(problem, plan)
            mean = apply(message.operator, frame.start) + message.shift
            row = condition.noise_from_target(mean, message.factor, observed)
            # A set of few rows reads the beginning of a row of k noises; the rest has no effect.
            unread = z.shape[1] - row.shape[1]
            row = jnp.pad(row, [(0, 0), (0, unread)] + [(0, 0)] * (z.ndim - 2))
            z = jnp.concatenate([row, z])
        return z.reshape(self.noise_shape)
