"""Guided bridges: an SDE conditioned on what is seen at a later time, as a function of standard normal noise."""

import functools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from ._checks import as_float, concrete, require, require_finite
from ._linalg import apply, congruence
from ._types import RealScalar, State
from .conditioning import AbstractCondition, Target
from .guiding import (
    AbstractGuide,
    FrozenGuide,
    GaussianSteering,
    GridNoise,
    GuidedStep,
    GuidedTerm,
    RecedingGuide,
    continuous_terms,
    exact_message,
    weight_rate,
)
from .sdes import AbstractSDE, Transition


_MAX_KEPT = 128
"""Largest n whose Cholesky factors, three n × n matrices a step, are kept for the reverse pass and not computed again."""


class GuidedBridge(eqx.Module):
    """The process X on [t0, t1] from x0, conditioned on its end state, driven by standard normal noise.

    `path(noise)` and `log_weight(noise)` are pure functions; with z ~ N(0, I),

        E[exp(log_weight(z))] = p(condition | x0)

    exactly for the time-discretised model (any guide, any number of steps), and the paths weighted by exp(log_weight) have the
    law of the conditioned process.

    **Arguments:**

    - `sde`: an `AbstractSDE`.
    - `condition`: `match.at(v)` or a `CylinderSet`.
    - `x0`: `(n, dim)` or `(n,)`.
    - `t1`, `t0`: the interval, in the time units of the SDE.
    - `num_steps`, or `ts`: the number of steps of the default grid, or an increasing grid `(K + 1,)` from t0 to t1. The default
      is uniform, and graded towards t1, t = s(2 − s/T), where the end state is pinned.
    - `guide`: by default `RecedingGuide()` where a depends on the state and `FrozenGuide()` where it is constant.
    - `solver`: by default the guided step with its exact discrete weight. An Itô diffrax solver steps the guided drift instead,
      with the continuous-time weight: consistent as dt → 0, biased at fixed dt, and no target for MCMC. A Stratonovich solver
      is refused unless both readings of the SDE coincide.

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
        x0 = as_float(x0, "x0")
        require(
            x0.ndim in (1, 2), f"`x0` must be one state, (n, dim) or (n,); got shape {x0.shape}. Use vmap for a batch."
        )
        require_finite(x0, "x0")
        sde.check_state(x0)
        condition.check(sde, x0)
        if guide is None:
            guide = FrozenGuide() if sde.has_constant_covariance(x0) else RecedingGuide()
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
            f"`solver` must be an Itô solver (diffrax.Euler, diffrax.ItoMilstein); got {name}. Guided proposals and their weights "
            "are Itô statements, and this SDE's Stratonovich reading is another process.",
        )
        require(
            isinstance(self.solver, (diffrax.AbstractItoSolver, diffrax.AbstractStratonovichSolver)),
            f"`solver` must be a solver for SDEs; got {name}.",
        )
        if not self._is_discrete:
            seen, reference, _ = self._end()
            auxiliary = self.guide.auxiliary_process(self.sde, reference, self.ts[-1])
            if self.condition.exact:
                a = congruence(seen.operator, self.sde.covariance(self.ts[-1], reference))
                a_aux = congruence(seen.operator, auxiliary.covariance(self.ts[-1], reference))
                gap = jnp.max(jnp.abs(a - a_aux)) if a.ndim == a_aux.ndim else jnp.inf
                require(
                    gap <= 1e-5 * jnp.max(jnp.abs(a)),
                    "`auxiliary` must match the SDE at the observed end, L ã(T) Lᵀ = L a(T, v) Lᵀ, for the continuous weight of an "
                    f"exact match: they differ by {concrete(gap)}, which gives finite and wrong weights. "
                    "Use `FrozenGuide()` without an auxiliary, the default solver, or an inexact match.",
                )

    def _check_exact(self):
        seen, _, _ = self._end()
        dt = self.ts[-1] - self.ts[-2]
        S = congruence(seen.operator, self.sde.transition(self.ts[0], self.ts[0] + dt, self.x0).covariance)
        if concrete(S) is not None:
            pivots = jnp.linalg.cholesky(S) if S.ndim == 2 else jnp.sqrt(S)
            pivots = jnp.diagonal(pivots) if S.ndim == 2 else pivots
            scale = jnp.sqrt(jnp.max(jnp.abs(S)))
            require(
                jnp.all(pivots > 1e-10 * scale),
                "an exact match needs noise in every observed direction, and the covariance of the last step, L a Lᵀ dt, is "
                "singular: an observed component has no noise of its own. Use `InexactMatch` with a small variance.",
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
        """(num_steps, k, dim): k noises per coordinate. A `CylinderSet` has one row more, which draws the point in the set."""
        k = self.sde.noise_size(self.x0)
        if not self._is_discrete and issubclass(_levy_area(self.solver), diffrax.SpaceTimeLevyArea):
            k = 2 * k
        return self.num_steps + self.condition.num_extra_noises, k, self.x0.shape[1] if self.x0.ndim == 2 else 1

    def with_guide(self, guide: AbstractGuide) -> "GuidedBridge":
        """The same bridge, led by another guide: the same estimand."""
        return GuidedBridge(self.sde, self.condition, x0=self.x0, ts=self.ts, guide=guide, solver=self.solver)

    def path(self, noise: Float[Array, "K k dim"]) -> Float[Array, "K+1 n *dim"]:
        """The states at `ts`, the first being x0. Weighted by exp(log_weight(noise)) it has the conditioned law."""
        return self._run(noise)[0]

    def log_weight(self, noise: Float[Array, "K k dim"]) -> Float[Array, ""]:
        """Ψ, log h̃(t0, x0) included. NaN after a numerical failure."""
        return self._run(noise)[1]

    def path_and_log_weight(
        self, noise: Float[Array, "K k dim"]
    ) -> tuple[Float[Array, "K+1 n *dim"], Float[Array, ""]]:
        """Both from one pass."""
        return self._run(noise)

    def _split(self, noise):
        """Rows that choose the target, rows that drive the steps; columns dropped for vector states."""
        require(
            jnp.shape(noise) == self.noise_shape,
            f"`noise` must have shape {self.noise_shape}, one noise for one path; got {jnp.shape(noise)}. Use vmap for a batch.",
        )
        noise = as_float(noise, "noise").astype(self.x0.dtype)
        noise = noise[..., 0] if self.x0.ndim == 1 else noise
        extra = self.condition.num_extra_noises
        return noise[:extra], noise[extra:]

    def _end(self):
        """What is seen, a state that meets it, and the guide's plan, or None where a diffrax solver steps."""
        seen = self.condition.observation(self.sde, self.x0)
        free = self.x0

        def drift_step(x, times):
            return x + (times[1] - times[0]) * self.sde.drift(times[0], x), None

        if seen.operator.ndim or self.condition.num_extra_noises:  # part of the end state is open
            free, _ = jax.lax.scan(drift_step, free, (self.ts[:-1], self.ts[1:]))
        reference = self.condition.reference(self.sde, free)
        plan = self.guide.plan(self.sde, seen, reference, self.ts) if self._is_discrete else None
        return seen, reference, plan

    def _message(self, t, x: State, observed: State):
        """The guide's forecast of what is seen from x at the grid time at or below t."""
        seen, reference, plan = self._end()
        if plan is None:
            auxiliary = self.guide.auxiliary_process(self.sde, reference, self.ts[-1])
            return exact_message(auxiliary, seen, t, self.ts[-1], x, observed)
        k = GridNoise(self.ts, self.x0).index(t)
        return plan.message(jax.tree.map(lambda a: a[k], plan.steps), self.sde, self.ts[k], x, observed)

    def _target(self, extra) -> Target:
        seen = self.condition.observation(self.sde, self.x0)
        if extra.shape[0] == 0:
            return self.condition.target(self.x0, jnp.ones(()), extra)
        message = self._message(self.ts[0], self.x0, jnp.zeros_like(apply(seen.operator, self.x0)))
        return self.condition.target(apply(message.operator, self.x0) + message.shift, message.factor, extra)

    def log_h(self, t: RealScalar, x: State) -> Float[Array, ""]:
        """log h̃(t, x) of the guide, t before t1: the log density of the datum, or log probability of the set, from x."""
        x = as_float(x, "x")
        seen = self.condition.observation(self.sde, x)
        message = self._message(t, x, jnp.zeros_like(apply(seen.operator, x)))
        return self.condition.log_value(apply(message.operator, x) + message.shift, message.factor) + seen.log_scale

    def score(self, t: RealScalar, x: State) -> State:
        """∇ log h̃(t, x), the guide's covariance held fixed: where the path is pulled, before a(x) acts on it."""
        x = as_float(x, "x")
        seen = self.condition.observation(self.sde, x)
        message = self._message(t, x, jnp.zeros_like(apply(seen.operator, x)))
        return jax.grad(lambda y: self.condition.log_value(apply(message.operator, y) + message.shift, message.factor))(
            x
        )

    @eqx.filter_jit
    def _run(self, noise):
        extra, noise = self._split(noise)
        seen, reference, plan = self._end()
        target = self._target(extra)
        start = (self.x0, jnp.zeros((), self.x0.dtype))
        if plan is None:
            path, log_weight = self._run_continuous(noise, seen, reference, target, start)
        else:
            path, log_weight = self._run_discrete(noise, seen, plan, target, start)
        return jnp.concatenate([self.x0[None], path]), log_weight + target.log_weight

    def _run_discrete(self, noise, seen, plan, target, start):
        @functools.partial(jax.checkpoint, prevent_cse=False, policy=_kept(self.x0))
        def step(y, inputs):
            t0, t1, z, planned = inputs
            control = GridNoise(jnp.stack([t0, t1]), z[None])
            terms = GuidedTerm(self.sde, plan, lambda _: planned, target.value, control)
            y, *_ = self.solver.step(terms, t0, t1, y, None, None, False)
            return y, y[0]

        planned = jax.tree.map(lambda a: a[1:], plan.steps)
        (x, log_weight), path = jax.lax.scan(step, start, (self.ts[:-2], self.ts[1:-1], noise[:-1], planned))
        transition, steering = self._last_step(x, seen, target)
        x = transition.mean + apply(transition.factor, steering.drive(noise[-1])[0])
        return jnp.concatenate([path, x[None]]), log_weight + steering.log_evidence() + seen.log_scale

    def _last_step(self, x, seen, target):
        """The step onto the observation itself: exact whatever guides."""
        transition = self.sde.transition(self.ts[-2], self.ts[-1], x)
        zero = jnp.zeros_like(target.value)
        return transition, GaussianSteering(transition, seen.operator, zero, seen.covariance, target.value)

    def _run_continuous(self, noise, seen, reference, target, start):
        t_end = self.ts[-1]
        auxiliary = self.guide.auxiliary_process(self.sde, reference, t_end)

        @jax.checkpoint
        def step(y, inputs):
            t0, t1, z = inputs
            control = GridNoise(jnp.stack([t0, t1]), z[None], _levy_area(self.solver))
            terms = continuous_terms(self.sde, auxiliary, seen, t_end, target.value, control)
            state = self.solver.init(terms, t0, t1, y, None)
            y, *_ = self.solver.step(terms, t0, t1, y, None, state, False)
            return y, y[0]

        free = self.num_steps if seen.factor is not None else self.num_steps - 1
        (x, log_weight), path = jax.lax.scan(step, start, (self.ts[:free], self.ts[1 : free + 1], noise[:free]))
        log_weight = log_weight + exact_message(auxiliary, seen, self.ts[0], t_end, self.x0, target.value).log_value(
            self.x0
        )
        if seen.factor is None:
            message = exact_message(auxiliary, seen, self.ts[-2], t_end, x, target.value)
            rate = weight_rate(self.sde, auxiliary, message, self.ts[-2], x)[1]
            log_weight = log_weight + (t_end - self.ts[-2]) * rate
            transition, steering = self._last_step(x, seen, target)
            k = self.sde.noise_size(self.x0)
            x = transition.mean + apply(transition.factor, steering.drive(noise[-1][:k])[0])
            path = jnp.concatenate([path, x[None]])
        return path, log_weight

    @eqx.filter_jit
    def noise_from_path(
        self, path: Float[Array, "K+1 n *dim"], key: PRNGKeyArray | None = None
    ) -> Float[Array, "K k dim"]:
        """The noise with `path(noise) = path`, for a path that starts at x0 and meets the condition.

        Where several noises give the same path (more noises than states, an exactly observed end) the part that the path leaves
        free is drawn with `key`, from its law under the model; it is 0 without a key.
        """
        require(self._is_discrete, "`noise_from_path` needs the guided step: the default `solver`.")
        shape = (self.num_steps + 1, *self.x0.shape)
        require(path.shape == shape, f"`path` must have shape {shape}; got {path.shape}.")
        path = path.astype(self.x0.dtype)
        seen, _, plan = self._end()
        assert plan is not None
        extra = self.condition.num_extra_noises
        free = jnp.zeros((self.num_steps, self.noise_shape[1], *self.x0.shape[1:]), path.dtype)
        end_free = free[0]
        if key is not None:
            key_free, key_end = jr.split(key)
            free, end_free = jr.normal(key_free, free.shape, path.dtype), jr.normal(key_end, end_free.shape, path.dtype)
        observed = apply(seen.operator, path[-1]) if seen.factor is None else self._target(jnp.zeros((0,))).value

        def step(x, x_next, t0, t1, planned, free):
            transition = self.sde.transition(t0, t1, x)
            steering = plan.steer(planned, transition, t1 - t0, x, observed)
            return steering.inverse(_driving_noise(transition, x_next, free))

        planned = jax.tree.map(lambda a: a[1:], plan.steps)
        z = jax.vmap(step)(path[:-2], path[1:-1], self.ts[:-2], self.ts[1:-1], planned, free[:-1])
        transition, steering = self._last_step(path[-2], seen, Target(observed, jnp.zeros(())))
        z_end = steering.inverse(_driving_noise(transition, path[-1], free[-1]))
        if seen.factor is None:
            z_end = z_end + steering.without_effect(end_free)
        z = jnp.concatenate([z, z_end[None]])
        if extra:
            message = self._message(self.ts[0], self.x0, jnp.zeros_like(observed))
            mean = apply(message.operator, self.x0) + message.shift
            row = self.condition.noise_from_target(mean, message.factor, observed)
            row = jnp.zeros((extra, *z.shape[1:]), z.dtype).at[:, : row.shape[1]].set(row)
            z = jnp.concatenate([row, z])
        return z.reshape(self.noise_shape)


def time_grid(
    t0: RealScalar, t1: RealScalar | None, num_steps: int | None, ts, *, graded: bool
) -> Float[Array, " K+1"]:
    """The user's grid, checked, or the default one: uniform, or graded towards t1 as t = s(2 − s/T)."""
    if ts is not None:
        require(num_steps is None, "Give `num_steps` or `ts`, not both.")
        ts = as_float(ts, "ts")
        require(
            ts.ndim == 1 and ts.shape[0] >= 2, f"`ts` must be a vector of at least two times; got shape {ts.shape}."
        )
        require_finite(ts, "ts")
        require(jnp.all(jnp.diff(ts) > 0), "`ts` must increase strictly. Sort it and remove repeated times.")
        require(
            t1 is None or jnp.abs(ts[-1] - t1) <= 1e-5 * jnp.abs(ts[-1] - ts[0]),
            f"`ts` must end at `t1`; got {t1} and {ts[-1]}.",
        )
        return ts
    require(t1 is not None and num_steps is not None, "Give `t1` and `num_steps`, or a grid `ts`.")
    require(
        isinstance(num_steps, (int, np.integer)) and not isinstance(num_steps, bool) and num_steps >= 1,
        f"`num_steps` must be a positive integer; got {num_steps!r}.",
    )
    t0, t1 = as_float(t0, "t0"), as_float(t1, "t1")
    require(
        t0.ndim == 0 and t1.ndim == 0,
        f"`t0` and `t1` must be one time each; got shapes {t0.shape} and {t1.shape}. Use vmap for a batch.",
    )
    require(
        jnp.isfinite(t0) & jnp.isfinite(t1) & (t1 > t0),
        f"`t1` must be finite and later than `t0`; got t0 = {t0}, t1 = {t1}.",
    )
    s = jnp.linspace(0.0, 1.0, int(num_steps) + 1)
    return t0 + (t1 - t0) * (s * (2 - s) if graded else s)


def _driving_noise(transition: Transition, x: State, free: State) -> State:
    """u with mean + σ u = x; where σ leaves a part of u free it is taken from `free`."""
    d = x - transition.mean
    factor = transition.factor
    if factor.ndim < 2:
        factor = factor if factor.ndim == 0 or d.ndim == 1 else factor[:, None]
        return jnp.where(factor == 0, free, d / jnp.where(factor == 0, 1.0, factor))
    pseudo_inverse = jnp.linalg.pinv(factor)
    return pseudo_inverse @ (d - factor @ free) + free


def _kept(x0: State):
    """What the reverse pass keeps of a step: its Cholesky factors, unless they would fill the memory."""
    few = x0.shape[0] <= _MAX_KEPT
    return lambda primitive, *_, **__: few and primitive.name == "cholesky"


def _levy_area(solver: diffrax.AbstractSolver) -> type:
    """What a solver needs to know of the driving path."""
    needed = getattr(solver, "minimal_levy_area", diffrax.AbstractBrownianIncrement)
    area = issubclass(needed, diffrax.AbstractSpaceTimeLevyArea)
    return diffrax.SpaceTimeLevyArea if area else diffrax.BrownianIncrement
