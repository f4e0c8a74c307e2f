"""A learned guide: a network on top of another guide.

With h̃ the guide's and h the true function, the network is to be

    s(t, x) = ∇log h(t, x) − ∇log h̃(t, x),

what the guide lacks; the part of ∇log h that is singular near the end is the guide's. In a step z ~
N(0, I) becomes z + √dt σᵀ s before it is guided, and the log weight gains log N(z + √dt σᵀ s; 0, I)
− log N(z; 0, I): exact whatever the network says (Yang, van der Meulen and Sommer 2025).
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._checks import require, require_instance, words
from .._closed import Closed, close
from .._linalg import apply, diagonal, transpose
from .._types import Noise, State, Structured
from ..conditioning import GaussianMessage
from ..spaces import Landmarks
from ._guides import AbstractGuide, AbstractPlan
from ._steering import AbstractSteering, DriftSteering, log_ratio

Context = Callable[[Any], Array]


class LearnedSteering(AbstractSteering):
    """z + shift, steered by `base`. `held` equals `shift`: it is what enters the density (see
    `ScoreGuide.held`).
    """

    base: AbstractSteering
    shift: Noise
    held: Noise

    def mean(self):
        return self.base.drive(self.shift)[0]

    def drive(self, z):
        moved = z + self.shift
        u, log_weight = self.base.drive(moved)
        return u, log_weight + log_ratio(z + (self.shift - self.held), moved)

    def inverse(self, u):
        return self.base.inverse(u) - self.shift


class Standard(eqx.Module):
    """How what a network sees is standardised: x̂ = (x − v)/scale, v̂ = (v − centre)/spread, and θ̂
    alike.

    `scale` and `spread` are `(n, dim)`, or numbers for `Landmarks`, where v̂ is centred at its own
    mean instead: the network then sees neither a translation nor the number of points. `duration`
    is that of the training.
    """

    duration: Float[Array, ""]
    scale: Array
    centre: Array
    spread: Array
    context_mean: Float[Array, " c"]
    context_scale: Float[Array, " c"]

    def target(self, v: State, pooled: bool) -> Float[Array, "n dim"]:
        """v̂."""
        centre = jnp.mean(v, axis=0, keepdims=True) if pooled else self.centre
        return (v - centre) / self.spread


def _context(function: Any) -> Any:
    good = function is None or callable(function)
    require(good, f"`context` must be a function of the SDE, or None; got {words(function)}.")
    return function


class ScoreGuide(AbstractGuide):
    """Another guide, corrected by a network.

    `numpyro_bridges.scores.fit` trains one, `fit_tree` one for all branches of a tree.

    **Arguments:**

    - `guide`: the guide that is corrected; `Unguided()` to learn all of ∇log h.
    - `network`: an `equinox.Module` or function `network(t, x, v, theta)`, shaped like x `(n,
      dim)`: `t` from 0 to 1, `x` the displacement from the target and `v` the target, standardised,
      `theta` `(c,)` the standardised context, of size 0 if there is none. Its output in units of
      1/√(T ā), ā the mean of the diagonal of a at the target, times the weights of the space, is s.
      On a tree the target is what the branch leads to, and 1 − t the time left until it is seen, as
      a part of the tree's height.
    - `standard`: how its input is standardised.
    - `context`: `context(sde)`, the parameters that the network sees, `(c,)`; `None` if it was
      trained for one SDE.
    - `history`: of the training: `update`, `loss`, `bound` (E log w held out), `ess` (of it, a
      fraction), `seconds`, `kept` (1 where the network was better than those before); at the end
      `gain` and `gain_error`, of the bound over that of the guide alone, see `scores.fit`.
    - `held`: a copy of the network with its gradient stopped, in training: the gradient of log w by
      the network is then by the path alone (Roeder, Wu and Duvenaud 2017), which has no noise where
      the guide is perfect.
    """

    guide: AbstractGuide
    network: Callable
    standard: Standard
    context: Context | None = eqx.field(static=True, default=None, converter=_context)
    history: dict[str, Array] = eqx.field(default_factory=dict)
    held: Callable | None = None
    programs: tuple[Closed | None, Closed | None] = eqx.field(init=False, default=(None, None))
    """Network and context as one bridge holds them, where they are functions that may read more
    than their leaves.
    """

    def __check_init__(self):
        require_instance(self.guide, AbstractGuide, "guide", "a guide, such as `RecedingGuide()`")
        require(
            callable(self.network),
            f"`network` must be a function (t, x, v, theta); got {words(self.network)}.",
        )
        require_instance(
            self.standard,
            Standard,
            "standard",
            "a `Standard`, which `numpyro_bridges.scores.fit` makes",
        )
        good = self.held is None or callable(self.held)
        require(good, f"`held` must be a network, or None; got {words(self.held)}.")
        require_instance(self.history, Mapping, "history", "a dictionary of arrays")

    def check(self, sde, x):
        self.guide.check(sde, x)
        scale = self.standard.scale.shape
        shape = x.shape if x.ndim == 2 else (*x.shape, 1)
        require(
            scale in ((), shape),
            f"`guide` was trained for states {scale}; got a state {x.shape}. Only landmarks may "
            "change their number.",
        )

    def closed(self, sde, x, ts):
        context = None if self.context is None else close(self.context, sde)
        network = None
        if jax.tree_util.all_leaves((self.network,)):  # a plain function
            v = x.reshape(x.shape[0], -1)
            theta = jnp.zeros(0 if context is None else context.shape, x.dtype)
            network = close(self.network, ts[0], v, v, theta)
        closed = replace(self, guide=self.guide.closed(sde, x, ts))
        object.__setattr__(closed, "programs", (network, context))
        return closed

    def prepared(self, sde, seen, observed, reference, ts, start):
        prepared = replace(
            self, guide=self.guide.prepared(sde, seen, observed, reference, ts, start)
        )
        object.__setattr__(prepared, "programs", self.programs)
        return prepared

    def follows(self, sde, seen, reference):
        return self.guide.follows(sde, seen, reference)

    def plan(self, sde, seen, reference, ts, *beyond):
        _, context = self.programs
        # `beyond`, the time from the end until the state is seen, is for a base that follows
        base = self.guide.plan(sde, seen, reference, ts, *beyond)
        left = ts[-1] + sum(beyond) - ts[:-1]
        n = reference.shape[0]
        dtype = reference.dtype
        weights = jnp.ones(n, dtype) if sde.space is None else sde.space.weights.astype(dtype)
        a = diagonal(sde.covariance(ts[-1], reference), n)
        unit = weights * jnp.sqrt(jnp.sum(weights) / jnp.sum(weights * a) / self.standard.duration)
        pooled = isinstance(sde.space, Landmarks)
        theta = jnp.zeros(0, dtype)
        context = self.context if context is None else context
        if context is not None:
            theta = (context(sde.sde) - self.standard.context_mean) / self.standard.context_scale
        v = reference.reshape(n, -1)
        target = self.standard.target(v + sde.origin.reshape(v.shape), pooled)
        inputs = v, target, theta
        network = self._program
        return ScorePlan((base.steps, left), base, network, self.held, self.standard, unit, inputs)

    def whole(self, plan):
        assert isinstance(plan, ScorePlan)
        base = self.guide.whole(plan.base)
        return replace(plan, base=base, network=self._program, held=self.held)

    @property
    def _program(self) -> Callable:
        """The network as a bridge holds it, or as it was given."""
        network, _ = self.programs
        return self.network if network is None else network


class ScorePlan(AbstractPlan):
    """The base guide's plan, and what the network needs."""

    steps: tuple[Any, Float[Array, " K"]]
    base: AbstractPlan
    network: Any
    held: Any
    standard: Standard
    unit: Float[Array, " n"]
    fixed: tuple[Array, Array, Array]

    def bare(self):
        return replace(self, base=self.base.bare(), network=None, held=None)

    def inputs(self, left, x: State) -> tuple[Array, Array, Array, Array]:
        """What the network sees at x, a time `left` before the end."""
        v, target, theta = self.fixed
        x = (x.reshape(v.shape) - v) / self.standard.scale
        return 1 - left / self.standard.duration, x, target, theta

    def score(self, output, x: State) -> State:
        """s from the network's output."""
        return (self.unit[:, None] * output).reshape(x.shape)

    def steer(self, step, transition, dt, x, observed):
        planned, left = step
        inputs = self.inputs(left + dt, x)
        factor = transpose(transition.factor)
        shift = apply(factor, self.score(self.network(*inputs), x))
        held = shift if self.held is None else apply(factor, self.score(self.held(*inputs), x))
        return LearnedSteering(self.base.steer(planned, transition, dt, x, observed), shift, held)

    def message(self, step, sde, t, x, observed):
        return self.base.message(step[0], sde, t, x, observed)

    def correction(self, step, x):
        return self.base.correction(step[0], x) + self.score(
            self.network(*self.inputs(step[1], x)), x
        )


class Unguided(AbstractGuide):
    """No guide, h̃ = 1: paths of the SDE itself, weighted by the density of what is seen."""

    def plan(self, sde, seen, reference, ts):
        return _UnguidedPlan(ts[:-1], 0 * seen.operator, -apply(seen.operator, sde.origin))


class _UnguidedPlan(AbstractPlan):
    steps: Float[Array, " K"]
    operator: Structured
    shift: State

    def steer(self, step, transition, dt, x, observed):
        return DriftSteering(jnp.zeros_like(apply(transpose(transition.factor), x)))

    def message(self, step, sde, t, x, observed):
        one = jnp.ones((), x.dtype)
        return GaussianMessage(self.operator, self.shift, one, observed, 0 * one)
