"""Guided bridges: an SDE conditioned on what is seen at a later time, as a function of standard normal noise."""

import functools
from collections.abc import Callable
from typing import TypeVar, cast

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from ._checks import as_float, concrete, require, require_finite, require_instance
from ._linalg import apply, congruence, full_precision, promote, varying_like
from ._types import RealScalar, State
from .conditioning import AbstractCondition, GaussianMessage, Observation, Target
from .guiding import (
    AbstractGuide,
    GridNoise,
    GuidedStep,
    arrive,
    default_guide,
    exact_message,
    levy_area,
    retrace,
    time_grid,
    travel,
    travel_continuous,
)
from .sdes import AbstractSDE

Method = TypeVar("Method", bound=Callable)


class _PureMethod:
    """Binds to a partial function, which `jax.jit` takes as it is: equinox's bound methods hash their arrays."""

    def __init__(self, method):
        self.method, self.__doc__ = method, method.__doc__

    def __get__(self, instance, owner=None):
        if instance is None:
            return self.method
        return functools.update_wrapper(functools.partial(self.method, instance), self.method)


def _pure_method(method: Method) -> Method:
    return cast(Method, _PureMethod(method))


class GuidedBridge(eqx.Module):
    """The process X on [t0, t1] from x0, conditioned on its end state, driven by standard normal noise.

    `path(noise)` and `log_weight(noise)` are pure functions; with z ~ N(0, I),

        E[exp(log_weight(z))] = p(condition | x0)

    exactly for the time-discretised model (any guide, any number of steps), and the paths weighted by exp(log_weight)
    have the law of the conditioned process.

    **Arguments:**

    - `sde`: an `AbstractSDE`.
    - `condition`: `match.at(v)` or a `CylinderSet`.
    - `x0`: `(n, dim)` or `(n,)`.
    - `t1`, `t0`: the interval, in the time units of the SDE.
    - `num_steps`, or `ts`: the number of steps of the default grid, or an increasing grid `(K + 1,)` from t0 to t1. The
      default is uniform, and graded towards t1, t = s(2 − s/T), where the end state is pinned.
    - `guide`: by default `RecedingGuide()` where a depends on the state and `FrozenGuide()` where it is constant.
    - `solver`: by default the guided step with its exact discrete weight. An Itô diffrax solver steps the guided drift
      instead, with the continuous-time weight: consistent as dt → 0, biased at fixed dt, and no target for MCMC. A
      Stratonovich solver is refused unless both readings of the SDE coincide.

    **Errors:** `ValueError` for shapes, grids, data and combinations that cannot be meant.
    """

    sde: AbstractSDE
    condition: AbstractCondition
    x0: State
    ts: Float[Array, " K+1"]
    guide: AbstractGuide
    solver: diffrax.AbstractSolver

    def __init__(
        self,
        sde: AbstractSDE,
        condition: AbstractCondition,
        *,
        x0: State,
        t1: RealScalar | None = None,
        t0: RealScalar = 0.0,
        num_steps: int | None = None,
        ts=None,
        guide: AbstractGuide | None = None,
        solver: diffrax.AbstractSolver | None = None,
    ):
        require(
            isinstance(condition, AbstractCondition),
            f"`condition` must be a condition, such as `InexactMatch(variance).at(v)`; got {type(condition).__name__}.",
        )
        require_instance(sde, AbstractSDE, "sde", "an SDE, such as `LinearSDE(drift, diffusion)`")
        x0 = as_float(x0, "x0")
        require(
            x0.ndim in (1, 2) and x0.size,
            f"`x0` must be one state, (n, dim) or (n,); got shape {x0.shape}. Use vmap for a batch.",
        )
        require_finite(x0, "x0")
        sde.check_state(x0)
        condition.check(sde, x0)
        if guide is None:
            guide = default_guide(sde, x0)
        require_instance(guide, AbstractGuide, "guide", "a guide, such as `FrozenGuide()`")
        guide.check(sde, x0)
        self.sde, self.condition, self.x0, self.guide = sde, condition, x0, guide
        self.ts = time_grid(t0, t1, num_steps, ts, graded=condition.exact)
        self.solver = GuidedStep() if solver is None else solver
        self._check_solver()
        if condition.exact:
            self._check_exact()

    def _check_solver(self):
        name = type(self.solver).__name__
        require(
            isinstance(self.solver, diffrax.AbstractItoSolver) or self.sde.ito_is_stratonovich(self.x0),
            f"`solver` must be an Itô solver (diffrax.Euler, diffrax.ItoMilstein); got {name}. Guided proposals and "
            "their weights are Itô statements, and this SDE's Stratonovich reading is another process.",
        )
        require(
            isinstance(self.solver, (diffrax.AbstractItoSolver, diffrax.AbstractStratonovichSolver)),
            f"`solver` must be a diffrax solver for SDEs, such as `diffrax.Euler()`; got {self.solver!r}.",
        )
        if not self._is_discrete:
            seen, reference = self.end()
            auxiliary = self.guide.auxiliary_process(self.sde, reference, self.ts[-1])
            if self.condition.exact:
                a = congruence(seen.operator, self.sde.covariance(self.ts[-1], reference))
                a_aux = congruence(seen.operator, auxiliary.covariance(self.ts[-1], reference))
                ndim, m = max(a.ndim, a_aux.ndim), apply(seen.operator, reference).shape[0]
                gap = jnp.max(jnp.abs(promote(a, ndim, m) - promote(a_aux, ndim, m)))
                require(
                    gap <= 1e-5 * jnp.max(jnp.abs(a)),
                    "`auxiliary` must match the SDE at the observed end, L ã(T) Lᵀ = L a(T, v) Lᵀ, for the continuous "
                    f"weight of an exact match: they differ by {concrete(gap)}, which gives finite and wrong weights. "
                    "Use `FrozenGuide()` without an auxiliary, the default solver, or an inexact match.",
                )

    def _check_exact(self):
        seen, _ = self.end()
        dt = self.ts[-1] - self.ts[-2]
        S = congruence(seen.operator, self.sde.transition(self.ts[0], self.ts[0] + dt, self.x0).covariance)
        if concrete(S) is not None:
            pivots = jnp.linalg.cholesky(S) if S.ndim == 2 else jnp.sqrt(S)
            pivots = jnp.diagonal(pivots) if S.ndim == 2 else pivots
            scale = jnp.sqrt(jnp.max(jnp.abs(S)))
            require(
                jnp.all(pivots > 1e-10 * scale),
                "`condition` is an exact match, which needs noise in every observed direction, and the covariance of "
                "the last step, L a Lᵀ dt, is singular: an observed component has no noise of its own. Use "
                "`InexactMatch` with a small variance.",
            )

    @property
    def _is_discrete(self) -> bool:
        return isinstance(self.solver, GuidedStep)

    @property
    def num_steps(self) -> int:
        """Number of steps K."""
        return self.ts.shape[0] - 1

    @property
    def noise_shape(self) -> tuple[int, int, int]:
        """(num_steps, k, dim): k noises per coordinate. A `CylinderSet` has one row more, to draw its point."""
        k = self.sde.noise_size(self.x0)
        if not self._is_discrete and issubclass(levy_area(self.solver), diffrax.SpaceTimeLevyArea):
            k = 2 * k
        return self.num_steps + self.condition.num_extra_noises, k, self.x0.shape[1] if self.x0.ndim == 2 else 1

    def with_guide(self, guide: AbstractGuide) -> "GuidedBridge":
        """The same bridge, led by another guide: the same estimand."""
        return GuidedBridge(self.sde, self.condition, x0=self.x0, ts=self.ts, guide=guide, solver=self.solver)

    @_pure_method
    def path(self, noise: Float[Array, "K k dim"]) -> Float[Array, "K+1 n *dim"]:
        """The states at `ts`, the first being x0. Weighted by exp(log_weight(noise)) it has the conditioned law."""
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

    def _split(self, noise):
        """Rows that choose the target, rows that drive the steps; columns dropped for vector states."""
        require(
            jnp.shape(noise) == self.noise_shape,
            f"`noise` must have shape {self.noise_shape}, one noise for one path; got {jnp.shape(noise)}. "
            "Use vmap for a batch.",
        )
        noise = as_float(noise, "noise").astype(self.x0.dtype)
        noise = noise[..., 0] if self.x0.ndim == 1 else noise
        extra = self.condition.num_extra_noises
        return noise[:extra], noise[extra:]

    def end(self) -> tuple[Observation, State]:
        """What is seen of the end state, and a state that meets the condition."""
        seen = self.condition.observation(self.sde, self.x0)
        free = self.x0

        def drift_step(x, times):
            return x + (times[1] - times[0]) * self.sde.drift(times[0], x), None

        if seen.operator.ndim or self.condition.num_extra_noises:  # part of the end state is open
            start = varying_like(free, self.sde, self.ts)
            free, _ = jax.lax.scan(drift_step, start, (self.ts[:-1], self.ts[1:]))
        reference = self.condition.reference(self.sde, free)
        return seen, reference

    def observed(self) -> State:
        """The value that is observed; `ValueError` for a set."""
        require(self.condition.num_extra_noises == 0, "`condition` is a set, which has no observed value.")
        return self._target(jnp.zeros((0,))).value

    @full_precision
    def _forecast(self, t, x: State, observed: State) -> tuple[GaussianMessage, State]:
        """The guide's forecast of what is seen from x at the grid time at or below t, and what it adds to its score."""
        seen, reference = self.end()
        if not self._is_discrete:
            auxiliary = self.guide.auxiliary_process(self.sde, reference, self.ts[-1])
            return exact_message(auxiliary, seen, t, self.ts[-1], x, observed), jnp.zeros_like(x)
        plan = self.guide.plan(self.sde, seen, reference, self.ts)
        k = GridNoise(ts=self.ts, noise=self.x0).index(t)
        step = jax.tree.map(lambda a: a[k], plan.steps)
        return plan.message(step, self.sde, self.ts[k], x, observed), plan.correction(step, x)

    def _target(self, extra) -> Target:
        seen = self.condition.observation(self.sde, self.x0)
        if extra.shape[0] == 0:
            return self.condition.target(self.x0, jnp.ones(()), extra)
        message, _ = self._forecast(self.ts[0], self.x0, jnp.zeros_like(apply(seen.operator, self.x0)))
        return self.condition.target(apply(message.operator, self.x0) + message.shift, message.factor, extra)

    def _before_the_end(self, t, x) -> State:
        """x, checked with t."""
        x = as_float(x, "x")
        require(x.shape == self.x0.shape, f"`x` must be one state, {self.x0.shape}; got shape {x.shape}. Use vmap.")
        require(
            jnp.all((t >= self.ts[0]) & (t < self.ts[-1])),
            f"`t` must lie in [{self.ts[0]}, {self.ts[-1]}), before the end; got {t}.",
        )
        return x

    @_pure_method
    def log_h(self, t: RealScalar, x: State) -> Float[Array, ""]:
        """log h̃(t, x) of the guide, t before t1: log density of the datum, or log probability of the set, from x."""
        x = self._before_the_end(t, x)
        seen = self.condition.observation(self.sde, x)
        message, _ = self._forecast(t, x, jnp.zeros_like(apply(seen.operator, x)))
        return self.condition.log_value(apply(message.operator, x) + message.shift, message.factor) + seen.log_scale

    @_pure_method
    def score(self, t: RealScalar, x: State) -> State:
        """∇ log h̃(t, x), the guide's covariance held fixed: where the path is pulled, before a(x) acts on it.

        A learned guide's network is in it.
        """
        x = self._before_the_end(t, x)
        seen = self.condition.observation(self.sde, x)
        message, correction = self._forecast(t, x, jnp.zeros_like(apply(seen.operator, x)))

        def log_h(y):
            return self.condition.log_value(apply(message.operator, y) + message.shift, message.factor)

        return jax.grad(log_h)(x) + correction

    @eqx.filter_jit
    @full_precision
    def _run(self, noise):
        extra, noise = self._split(noise)
        seen, reference = self.end()
        target = self._target(extra)
        v = target.value
        if not self._is_discrete:
            auxiliary = self.guide.auxiliary_process(self.sde, reference, self.ts[-1])
            path, log_weight = travel_continuous(self.sde, auxiliary, self.solver, seen, self.ts, self.x0, noise, v)
        else:
            plan = self.guide.plan(self.sde, seen, reference, self.ts)
            path, x, log_weight = travel(self.sde, plan, self.ts, self.x0, noise[:-1], v)
            end, log_density = arrive(self.sde, seen, self.ts, x, noise[-1], v)
            path, log_weight = jnp.concatenate([path, end[None]]), log_weight + log_density
        return jnp.concatenate([self.x0[None], path]), log_weight + target.log_weight

    @eqx.filter_jit
    @full_precision
    def noise_from_path(
        self, path: Float[Array, "K+1 n *dim"], key: PRNGKeyArray | None = None
    ) -> Float[Array, "K k dim"]:
        """The noise with `path(noise) = path`, for a path that starts at x0 and meets the condition.

        Where several noises give the same path (more noises than states, an exactly observed end) the part that the
        path leaves free is drawn with `key`, from its law under the model; it is 0 without a key.
        """
        require(self._is_discrete, "`noise_from_path` needs the guided step: the default `solver`.")
        path = as_float(path, "path").astype(self.x0.dtype)
        shape = (self.num_steps + 1, *self.x0.shape)
        require(path.shape == shape, f"`path` must have shape {shape}; got {path.shape}.")
        seen, reference = self.end()
        plan = self.guide.plan(self.sde, seen, reference, self.ts)
        if seen.exact:
            observed = apply(seen.operator, path[-1])
        else:
            observed = self.observed()
        z = retrace(self.sde, plan, seen, self.ts, path, observed, key)
        if self.condition.num_extra_noises:
            message, _ = self._forecast(self.ts[0], self.x0, jnp.zeros_like(observed))
            mean = apply(message.operator, self.x0) + message.shift
            row = self.condition.noise_from_target(mean, message.factor, observed)
            row = jnp.pad(row, [(0, 0), (0, z.shape[1] - row.shape[1])] + [(0, 0)] * (z.ndim - 2))
            z = jnp.concatenate([row, z])
        return z.reshape(self.noise_shape)
