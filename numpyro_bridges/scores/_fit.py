"""Training of learned guides: what is the same for every method, and the four methods.

- `residual`: the evidence bound E log w is maximised (Yang, van der Meulen and Sommer 2025).
- `matching`: score matching on weighted paths of the guide as it learns (Domingo-Enrich, Han, Amos,
  Bruna and Chen 2024).
- `adjoint`: score matching on the weighted reversed process from the observation (Baker, Schauer
  and Sommer 2025).
- `reversal`: score matching of the unconditioned process gives the time reversal; score matching on
  its paths gives the bridge (Heng, De Bortoli, Doucet and Thornton 2021), twice reversed.
"""

import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, PRNGKeyArray
from numpy.typing import ArrayLike

from .. import weights
from .._checks import as_path, choice, concrete, flag, require, require_instance, require_key, words
from .._devices import gather, mesh_for, spread
from .._linalg import apply, full_precision
from .._types import RealScalar, State
from ..bridges import GuidedBridge
from ..conditioning import AbstractCondition
from ..distributions import DiffusionTree
from ..guiding import (
    AbstractGuide,
    FrozenGuide,
    ScoreGuide,
    ScorePlan,
    Standard,
    Unguided,
    default_guide,
)
from ..sdes import AbstractSDE, BrownianMotion, LinearSDE
from ..spaces import Landmarks
from ..trees import TreeProblem
from ._clouds import (
    Cloud,
    adjoint_cloud,
    ends,
    forward_cloud,
    guided_cloud,
    reversal_cloud,
    reversed_bridge,
    whiten,
)
from ._networks import MLP, ROWWISE, PointNetwork, over_batch
from ._training import Loss, Training, train

_LEAST_HELD_OUT = 16  # independent differences: with fewer their standard error is itself unknown
_STRIDE = 0.5  # of clouds, in the largest displacement of the guide's paths
# of a cloud and of an update for one of a batch, in `matching`; problems
_PATHS = 4
_POINTS = 16
_MATCHED = 16

Draw = Callable[[PRNGKeyArray], tuple[AbstractSDE, AbstractCondition, State]]
DrawTree = Callable[[PRNGKeyArray], tuple[DiffusionTree, Array]]


class Problem(NamedTuple):
    """Bridges `draw(key)` that one network is to guide, or trees, and how it is trained."""

    draw: Callable[[PRNGKeyArray], Any]
    """A `GuidedBridge`, or a `TreeProblem`, which `residual` takes like one."""
    amortised: bool
    guide: ScoreGuide
    training: Training
    train: Callable
    mesh: Mesh | None = None
    stride: RealScalar = jnp.inf
    """Of the clouds, see `_clouds`."""
    knows_ess: bool = True
    """Whether the ESS of held-out paths says anything: of a tree a few weights have nearly all."""

    def spread(self, fn: Callable, size: int) -> Callable:
        """`fn` for a batch of a size; whole on each device where that has no equal shares."""
        whole = self.mesh is not None and size % self.mesh.size > 0
        return jax.vmap(fn) if whole else spread(fn, self.mesh)


@full_precision
def fit(
    sde: AbstractSDE,
    condition: AbstractCondition,
    *,
    x0: ArrayLike,
    t1: RealScalar | None = None,
    key: PRNGKeyArray,
    method: str = "residual",
    t0: RealScalar | None = None,
    num_steps: int | None = None,
    ts=None,
    guide: AbstractGuide | None = None,
    network: Callable | None = None,
    training: Training | None = None,
    draw: Draw | None = None,
    context: Callable[[Any], Array] | None = None,
    directory: str | Path | None = None,
    progress: bool = True,
    watch: Callable[[str, ScoreGuide], None] | None = None,
    mesh: Mesh | None = None,
) -> ScoreGuide:
    """Trains a network that corrects a guide, so that guide and network together are ∇log h.

        score = scores.fit(sde, condition, x0=x0, t1=1.0, key=key)
        bridge.with_guide(score)

    Its weights are exact whatever was learned, and what is returned is the best network met on
    held-out paths, the guide as it is included: training does not spoil a guide. Nor does it always
    help: `history["gain"]` is how far the evidence bound lies above that of the guide alone on the
    same held-out paths, in nats, and `history["gain_error"]` the standard error of that. Where the
    gain is within two of them a warning says so, and where the held-out paths are too few to tell.

    **Arguments:**

    - `sde`, `condition`, `x0`, `t1`, `t0`, `num_steps` (100 by default), `ts`: as for
      `GuidedBridge`.
    - `guide`: the guide that is corrected; by default that of `GuidedBridge`, or where a is
      constant and the drift not linear Brownian motion's, if that has the higher bound and the
      higher ESS on 256 paths. `Unguided()` learns all of ∇log h from nothing.
    - `method`: `"residual"` (any SDE and condition), `"matching"` or `"reversal"` (an observed
      value), or `"adjoint"` (an observation of the whole state); all but the first need noise in
      every direction.
    - `network`: `network(t, x, v, theta)`, see `ScoreGuide`; by default a `PointNetwork` for
      landmarks, an `MLP` else.
    - `training`: a `Training`.
    - `draw`: `draw(key)` gives `(sde, condition, x0)` like those given, for a guide that serves
      many of them: other parameters, targets or starts. `context(sde)`, `(c,)`, are the parameters
      that the network is told; it is always told the target.
    - `directory`: where training is saved at each look; the same call resumes from there, and
      another is refused.
    - `progress`: show a bar with the loss, the evidence bound and the ESS on held-out paths.
    - `watch`: `watch(name, guide)` is called at each look, with the guide as it then is and the
      history so far; `name` is the method's, or `"time reversal"` in the first pass of
      `"reversal"`.
    - `mesh`: the devices that share a batch and the held-out paths, as for
      `numpyro_bridges.spread`. With `draw` the problems of a batch are shared, where there are
      equal shares of them. Of a cloud, of all methods but `"residual"` without `draw`, they share
      the network's work, and each makes the cloud.

    **Errors:** `ValueError` for what a method cannot do, with the method that can. A loss that is
    not finite ends the training with a warning.
    """
    choice(method, "method", sorted(METHODS), "'residual' suits every bridge.")
    require_key(key)
    if ts is None and num_steps is None:
        num_steps = 100
    bridge = GuidedBridge(
        sde, condition, x0=x0, t1=t1, t0=t0, num_steps=num_steps, ts=ts, guide=guide
    )
    _refuse_flattened(bridge.flat is not None, "`condition`")
    training, progress, folder = _checked_settings(training, progress, directory, mesh)
    _check_functions(context, network, watch, draw, "(sde, condition, x0)")
    bridge = _better(bridge, key) if guide is None else bridge
    key_network, key_pilot, key_train = jr.split(key, 3)

    def draw_bridge(key):
        if draw is None:
            return bridge
        sde, condition, x0 = draw(key)
        return GuidedBridge(sde, condition, x0=x0, ts=bridge.grid, guide=bridge.guide)

    network = _network(network, bridge, context, key_network)
    start, stride = _untrained(
        network,
        draw_bridge,
        context,
        key_pilot,
        lambda bridge, noise: (bridge.path(noise), bridge.end()[1]),
        bridge.grid.elapsed[-1],
    )
    train = partial(
        _train, given=bridge, directory=folder, progress=progress, watch=watch, mesh=mesh
    )
    problem = Problem(draw_bridge, draw is not None, start, training, train, mesh, stride)
    return METHODS[method](problem, key_train)


@full_precision
def fit_tree(
    law: DiffusionTree,
    data: ArrayLike,
    *,
    key: PRNGKeyArray,
    network: Callable | None = None,
    training: Training | None = None,
    draw: DrawTree | None = None,
    context: Callable[[Any], Array] | None = None,
    directory: str | Path | None = None,
    progress: bool = True,
    watch: Callable[[str, ScoreGuide], None] | None = None,
    mesh: Mesh | None = None,
) -> ScoreGuide:
    """Trains a network that corrects the guide of a tree, one for all its branches.

        guide = scores.fit_tree(law, data, key=key)
        DiffusionTree(sde, x0, match, tree=tree, num_steps=10, guide=guide)

    By the method `"residual"` of `fit`: the evidence bound E Ψ over paths along all branches is
    maximised, and what a network has learned of a branch is told apart from the rest by the time
    left and by what the branch leads to. Weights are exact whatever was learned.

    **Arguments:**

    - `law`: a `DiffusionTree`, whose guide is the one that is corrected. `data`: as `obs=` takes
      them.
    - `draw`: `draw(key)` gives `(law, data)` on a tree of the same topology and with the same
      guide, for one that serves many: other parameters, lengths or data. `context(sde)`, `(c,)`,
      are the parameters that the network is told.
    - `network`, `training`, `directory`, `progress`, `watch`, `mesh`: as for `fit`. The networks
      that it has by default are those of `fit`.

    `history` is that of `fit` but for `ess`, which is NaN: of a tree a few weights have nearly all,
    and the bound alone says what was learned.

    **Errors:** `ValueError` for several trees at once and for data that do not fit.
    """
    require_instance(law, DiffusionTree, "law", "a `DiffusionTree`")
    require_key(key)
    training, progress, folder = _checked_settings(training, progress, directory, mesh)
    _check_functions(context, network, watch, draw, "(law, data)")
    tree = law.problem(data, "data")
    _refuse_flattened(tree.x0.ndim != law.parts["x0"].ndim, "the match of `law`")
    key_network, key_pilot, key_train = jr.split(key, 3)

    def draw_tree(key):
        if draw is None:
            return tree
        other, data = draw(key)
        return other.problem(data).with_guide(tree.guide)

    def ways(tree, noise):
        # with its end a path has what its branch leads to
        paths = tree.paths(noise)
        return paths, paths[:, -1]

    network = _network(network, tree, context, key_network)
    height = law.tree.height.astype(tree.x0.dtype)
    start, _ = _untrained(network, draw_tree, context, key_pilot, ways, height)
    train = partial(_train, given=tree, directory=folder, progress=progress, watch=watch, mesh=mesh)
    amortised = draw is not None
    problem = Problem(draw_tree, amortised, start, training, train, mesh, knows_ess=False)
    return residual(problem, key_train)


def _refuse_flattened(flat: bool, what: str) -> None:
    require(
        not flat,
        f"{what} is known by its density, for which states of several columns are flattened: a "
        "network of such states cannot be learned. Fit one for an `InexactMatch` near it, or use "
        "the default guide.",
    )


def _checked_settings(training, progress, directory, mesh) -> tuple[Training, bool, Path | None]:
    training = Training() if training is None else training
    require_instance(training, Training, "training", "a `Training(...)`")
    for name in ("batch_size", "held_out"):
        mesh_for(getattr(training, name), f"`{name}` of `training`", mesh)
    folder = None if directory is None else as_path(directory, "directory")
    return training, flag(progress, "progress"), folder


def _check_functions(context, network, watch, draw, drawn: str) -> None:
    for name, function, meant in (
        ("context", context, "of the SDE"),
        ("network", network, "(t, x, v, theta)"),
        ("draw", draw, f"of a key that gives {drawn}"),
        ("watch", watch, "(name, guide)"),
    ):
        good = function is None or callable(function)
        require(good, f"`{name}` must be a function {meant}; got {words(function)}.")


def _network(network, bridge: GuidedBridge | TreeProblem, context, key) -> Callable:
    """That which was given, or the default."""
    if network is not None:
        return network
    size = 0 if context is None else context(bridge.sde).shape[0]
    n, dim = bridge.x0.reshape(bridge.x0.shape[0], -1).shape
    if isinstance(bridge.sde.space, Landmarks):
        return PointNetwork(dim, size, key=key)
    return MLP((n, dim), size, key=key)


def _better(bridge: GuidedBridge, key: PRNGKeyArray, num_paths: int = 256) -> GuidedBridge:
    """With the default guide, or with one that knows no drift where that has the higher bound and
    the higher ESS.

    A drift linearised at the end misleads where it is not nearly linear on the way: paths between
    two wells.
    """
    known = isinstance(
        bridge.sde, (LinearSDE, BrownianMotion)
    ) or not bridge.sde.has_constant_covariance(bridge.x0)
    if known or bridge.condition.num_extra_noises or not _has_noise(bridge):
        return bridge
    noise = jr.normal(key, (num_paths, *bridge.noise_shape), bridge.x0.dtype)

    @eqx.filter_jit
    def judged(bridge):
        log_weights = jax.vmap(bridge.log_weight)(noise)
        return jnp.mean(log_weights), weights.effective_sample_size(log_weights)

    plain = bridge.with_guide(_driftless(bridge))
    bound, ess = judged(bridge)
    plain_bound, plain_ess = judged(plain)
    return plain if plain_bound > bound and plain_ess > ess else bridge


def residual(problem: Problem, key: PRNGKeyArray) -> ScoreGuide:
    """Maximises E log w."""
    key_judge, key = jr.split(key)

    def loss(network, key):
        def one(key):
            key_draw, key_noise = jr.split(key)
            bridge = problem.draw(key_draw)
            held = jax.tree.map(
                lambda a: jax.lax.stop_gradient(a) if eqx.is_array(a) else a, network
            )
            guide = replace(problem.guide, network=network, held=held)
            noise = jr.normal(key_noise, bridge.noise_shape, bridge.x0.dtype)
            return -bridge.with_guide(guide).log_weight(noise)

        size = problem.training.batch_size
        return jnp.mean(problem.spread(one, size)(jr.split(key, size))), network

    return problem.train(problem, loss, _judge(problem, key_judge), key, "residual")


def matching(problem: Problem, key: PRNGKeyArray) -> ScoreGuide:
    """Score matching on weighted paths of the guide as it learns, which are drawn anew then."""
    bridge = problem.draw(key)
    _need_noise(bridge, "matching")
    _need_value(bridge, "matching")
    key_judge, key = jr.split(key)
    draws = _MATCHED if problem.amortised else 1
    num_paths, num_points = (
        -(-n * problem.training.batch_size // draws) for n in (_PATHS, _POINTS)
    )
    num_paths = max(num_paths, _LEAST_HELD_OUT)  # their weights are among themselves

    def prepare(network, key):
        def one(key):
            key_draw, key_cloud = jr.split(key)
            bridge = problem.draw(key_draw)
            led = bridge.with_guide(replace(problem.guide, network=network))
            cloud = guided_cloud(led, key_cloud, num_paths)
            _, displacements, targets = _lacking(problem, network, bridge, cloud)
            return key_draw, displacements, cloud.x, targets, cloud.weights[0]

        return problem.spread(one, draws)(jr.split(key, draws))

    def rows(network, key, prepared):
        key_draw, displacements, states, targets, weights = prepared
        bridge = problem.draw(key_draw)
        plan = _plan(problem, network, bridge)
        key_step, key_path = jr.split(key)
        k = jr.choice(key_step, bridge.num_steps, (num_points,), p=jnp.diff(bridge.grid.elapsed))
        i = jr.choice(key_path, weights.size, (num_points,), p=weights)
        states = states[k, i]
        targets = targets[k, i]
        ts = bridge.shown_ts[k]

        def error(output):
            def one(t, x, f, target):
                return jnp.sum(whiten(bridge, t, x, plan.score(f, x) - target) ** 2)

            return jnp.mean(jax.vmap(one)(ts, states, output, targets))

        return jax.vmap(plan.inputs, (0, 0), ROWWISE)(plan.steps[1][k], displacements[k, i]), error

    loss = _regression(problem, rows, draws)
    return problem.train(
        problem, loss, _judge(problem, key_judge), key, "matching", prepare=prepare
    )


def adjoint(problem: Problem, key: PRNGKeyArray) -> ScoreGuide:
    """Score matching on the reversed process from the observation."""
    bridge = problem.draw(key)
    _need_noise(bridge, "adjoint")
    seen, _ = bridge.end()
    whole = bridge.condition.num_extra_noises == 0 and seen.operator.ndim == 0
    whole = whole and (seen.factor is None or bool(jnp.all(jnp.isfinite(seen.factor))))
    require(
        whole,
        "`method='adjoint'` starts at an observation of the whole state; this condition leaves a "
        "part of it free. Use `method='residual'`.",
    )
    key_judge, key_pilot, key = jr.split(key, 3)
    make = partial(adjoint_cloud, stride=problem.stride)
    loss = _regression(
        problem, _clouds(problem, make, _coefficients(problem, make, key_pilot)), _draws(problem)
    )
    return problem.train(problem, loss, _judge(problem, key_judge), key, "adjoint")


def reversal(problem: Problem, key: PRNGKeyArray) -> ScoreGuide:
    """Score matching of the unconditioned process, and of its reversals from the observation."""
    bridge = problem.draw(key)
    _need_noise(bridge, "reversal")
    _need_value(bridge, "reversal")
    key_standard, key_pilots, key_judges, key_first, key_second = jr.split(key, 5)
    key_pilot, key_pilot_2 = jr.split(key_pilots)
    key_judge, key_judge_2 = jr.split(key_judges)

    def draw_back(key, guide):
        key_draw, key_end = jr.split(key)
        bridge = problem.draw(key_draw)
        return reversed_bridge(bridge, ends(bridge, key_end, 1)[0], guide(bridge))

    context = problem.guide.context
    network = problem.guide.network
    start, stride = _untrained(
        network,
        problem.draw,
        context,
        key_standard,
        lambda bridge, noise: (bridge.path(noise), bridge.x0),
        bridge.grid.elapsed[-1],
    )
    forward = partial(forward_cloud, stride=stride)
    start = replace(start, context=None if context is None else lambda sde: context(sde.sde))
    unguided = isinstance(bridge.guide, Unguided)
    draws = [
        partial(draw_back, guide=g)
        for g in ([lambda _: Unguided()] if unguided else [_linearised, _driftless])
    ]
    rho = _coefficients(problem._replace(draw=draws[0]), forward, key_pilot)

    def candidate(draw) -> tuple[Problem, Loss, Callable]:
        back = problem._replace(draw=draw, guide=replace(start, guide=draw(key).guide))
        loss = _regression(back, _clouds(back, forward, rho), _draws(back))

        @eqx.filter_jit
        def judge(network):
            value = -loss(network, key_judge)[0]
            return value, value, jnp.full((), jnp.nan)

        return back, loss, judge

    back, loss, judge = max(map(candidate, draws), key=lambda found: float(found[2](network)[0]))
    reverse = problem.train(back, loss, judge, key_first, "time reversal")

    def cloud(bridge, key, size, rho=None):
        return reversal_cloud(bridge, reverse, key, size, rho, stride=problem.stride)

    rho = _coefficients(problem, cloud, key_pilot_2)
    loss = _regression(problem, _clouds(problem, cloud, rho), _draws(problem))
    found = problem.train(problem, loss, _judge(problem, key_judge_2), key_second, "reversal")
    seconds = found.history["seconds"] + reverse.history["seconds"][-1]
    return replace(found, history=found.history | {"seconds": seconds})


def _linearised(bridge: GuidedBridge) -> AbstractGuide:
    return default_guide(bridge.sde, bridge.x0)


def _driftless(bridge: GuidedBridge) -> AbstractGuide:
    """Better than the linearised one where the drift turns within the reach of the paths."""
    return FrozenGuide(BrownianMotion(bridge.sde.covariance(bridge.clock, bridge.x0)))


METHODS = {"residual": residual, "matching": matching, "adjoint": adjoint, "reversal": reversal}


def _train(
    problem: Problem,
    loss,
    judge,
    key,
    name,
    *,
    given,
    directory,
    progress,
    watch,
    mesh,
    prepare=None,
) -> ScoreGuide:
    def guide(network, history):
        return replace(problem.guide, network=network, history=history)

    def judged(network):
        return gather(judge(network))

    file = None if directory is None else directory / f"{name.replace(' ', '_')}.eqx"
    network, history = train(
        problem.guide.network,
        loss,
        judged,
        key,
        problem.training,
        name=name,
        file=file,
        problem=(given, problem.guide.standard),
        progress=progress,
        watch=None
        if watch is None
        else lambda network, history: watch(name, guide(network, history)),
        mesh=mesh,
        prepare=prepare,
    )
    return guide(network, history | _gain(name, judged(problem.guide.network), judged(network)))


def _gain(name: str, before, after) -> dict[str, Array]:
    """What training has brought on held-out paths, by what is judged before and after it; a warning
    if nothing.
    """
    if len(before) == 3:  # a time reversal is not a guide, and has no paths of its own
        return {}
    differences = np.asarray(after[3] - before[3], float)
    gain = np.mean(differences)
    few = differences.size < _LEAST_HELD_OUT
    error = np.nan if few else np.std(differences, ddof=1) / np.sqrt(differences.size)
    ess, ess_before = (100 * float(found[2]) for found in (after, before))
    bounds = f"its bound is {gain:.2g} ± {error:.1g} nats above the guide's"
    if np.isfinite(ess):
        bounds += f", its ESS {ess:.3g} % ({ess_before:.3g} %)"
    # of a guide that fails any network is a gain
    failed = not np.isfinite(before[1]) and np.isfinite(after[1])
    if bool(before[0] == jnp.inf):
        said = (
            "brought nothing: the weights of the guide are equal to rounding, and there is "
            "nothing to learn"
        )
    elif not np.any(differences):
        said = (
            "brought nothing: no network was better than the guide alone, which is kept as it was"
        )
    elif few:
        said = (
            f"may have brought nothing: {differences.size} independent held-out differences are "
            f"too few to tell, and {_LEAST_HELD_OUT} are needed. Increase `Training(held_out=...)`"
        )
    elif not (gain > 2 * error or failed):
        said = (
            f"brought nothing: {bounds} on held-out paths. Use the guide alone, or train longer or "
            "otherwise"
        )
    else:
        said = ""
    if said:
        warnings.warn(f"{name} {said}.", stacklevel=2)
    return {"gain": jnp.asarray(gain), "gain_error": jnp.asarray(error)}


def _coefficients(problem: Problem, make: Callable[..., Cloud], key: PRNGKeyArray) -> Array:
    """ρ of score matching on clouds."""

    @jax.jit
    def one(key):
        key_draw, key_cloud = jr.split(key)
        return make(problem.draw(key_draw), key_cloud, 256).rho

    rho = jnp.mean(jnp.stack([one(k) for k in jr.split(key, _draws(problem))]), axis=0)
    return jnp.zeros_like(rho) if problem.training.one_step else rho


def _draws(problem: Problem) -> int:
    """Problems in a batch of clouds."""
    return 4 if problem.amortised else 1


def _clouds(problem: Problem, make: Callable[..., Cloud], rho: Array) -> Callable:
    """Rows of all points of a cloud that is drawn for each update."""
    size = -(-problem.training.batch_size // _draws(problem))

    def rows(network, key):
        key_draw, key_cloud = jr.split(key)
        bridge = problem.draw(key_draw)
        cloud = make(bridge, key_cloud, size, rho)
        plan, displacements, targets = _lacking(problem, network, bridge, cloud)
        each_inputs = jax.vmap(plan.inputs, (None, 0), ROWWISE)
        t, x, v, theta = jax.vmap(each_inputs, (0, 0), ROWWISE)(plan.steps[1], displacements)

        def error(output):
            def one(t, x, f, target):
                return jnp.sum(whiten(bridge, t, x, plan.score(f, x) - target) ** 2)

            output = output.reshape(*t.shape, *output.shape[1:])
            squares = jax.vmap(jax.vmap(one, (None, 0, 0, 0)))(
                bridge.shown_ts[:-1], cloud.x, output, targets
            )
            dt = jnp.diff(bridge.grid.elapsed)
            return jnp.sum(dt[:, None] * cloud.weights * squares) / jnp.sum(dt)

        return (t.ravel(), x.reshape(t.size, *x.shape[2:]), v, theta), error

    return rows


def _lacking(
    problem: Problem, network, bridge: GuidedBridge, cloud: Cloud
) -> tuple[ScorePlan, Array, Array]:
    """The plan, the points of a cloud as displacements, and what the guide lacks there, g − ∇log
    h̃.
    """
    led = bridge.problem()
    frame, _, seen, _, ts = led
    plan = _plan(problem, network, bridge)
    observed = bridge.observed() - apply(seen.operator, frame.origins[-1])
    displacements = cloud.x - frame.origins[:-1, None]

    def lacking(step, t, x, g):
        base = plan.base.message(step[0], frame.sde, t, x, observed).score(x)
        return g - base - plan.base.correction(step[0], x)

    each = jax.vmap(jax.vmap(lacking, (None, None, 0, 0)))
    return plan, displacements, each(plan.steps, ts[:-1], displacements, cloud.score)


def _plan(problem: Problem, network, bridge: GuidedBridge) -> ScorePlan:
    guide = replace(problem.guide, network=network)
    plan = bridge.plan(guide, bridge.with_guide(guide).problem())
    assert isinstance(plan, ScorePlan)
    return plan


def _regression(problem: Problem, rows: Callable, draws: int) -> Loss:
    """The loss of score matching, ∫ E |s − (g − ∇log h̃)|²_a dt / T.

    `rows(network, key, *prepared)` are the inputs of the network and the loss as a function of its
    outputs; `prepared` has an entry for each of the problems that are drawn.
    """

    def loss(network, key, *prepared):
        if draws == 1:
            (t, x, v, theta), error = rows(network, key, *jax.tree.map(lambda a: a[0], prepared))
            output, network = over_batch(network, t, x, v, theta, problem.spread)
            return error(output), network

        def one(key, *prepared):
            inputs, error = rows(network, key, *prepared)
            return error(jax.vmap(network, ROWWISE)(*inputs))

        return jnp.mean(problem.spread(one, draws)(jr.split(key, draws), *prepared)), network

    return loss


def _judge(problem: Problem, key: PRNGKeyArray):
    """E log w, and the ESS fraction, on held-out paths; and its independent parts, of which it is
    the mean.

    Weights that do not vary are a perfect guide's: value ∞. Noises come in pairs z, −z: what is of
    first order in the network then cancels from the bound. A pair is a part, or all of one problem
    where there are several.
    """
    draws = 16 if problem.amortised else 1
    half = -(-problem.training.held_out // (2 * draws))
    over_paths = partial(problem.spread, size=2 * half)
    over_draws = jax.vmap
    if problem.amortised:
        over_paths = jax.vmap
        over_draws = partial(problem.spread, size=draws)

    @eqx.filter_jit
    def judge(network):
        def one(key):
            key_draw, key_noise = jr.split(key)
            bridge = problem.draw(key_draw).with_guide(replace(problem.guide, network=network))
            noise = jr.normal(key_noise, (half, *bridge.noise_shape), bridge.x0.dtype)
            log_weights = over_paths(bridge.log_weight)(jnp.concatenate([noise, -noise]))
            known = problem.knows_ess
            ess = weights.effective_sample_size(log_weights) / (2 * half) if known else jnp.nan
            pairs = (log_weights[:half] + log_weights[half:]) / 2
            return pairs, ess, jnp.std(log_weights)

        pairs, ess, deviation = over_draws(one)(jr.split(key, draws))
        parts = jnp.mean(pairs, axis=1) if problem.amortised else pairs[0]
        bound = jnp.mean(parts)
        ess = jnp.mean(ess)
        value = jnp.where(jnp.isfinite(bound), bound, -jnp.inf)
        perfect = jnp.all(deviation < jnp.sqrt(jnp.finfo(deviation.dtype).eps))
        value = jnp.where(perfect, jnp.inf, value)
        return value, bound, ess, parts

    return judge


def _untrained(
    network, draw, context, key, ways, duration, num_paths: int = 64
) -> tuple[ScoreGuide, Array]:
    """The guide with its network as it is, standardised on paths of the guide that it corrects.

    `ways(bridge, noise)` are its path `(K + 1, n, dim)` and the v of which x − v is the
    displacement, or several with an axis in front. And the stride of clouds, `_STRIDE` times the
    largest displacement of these paths.
    """
    bridge = draw(key)
    n, dim = bridge.x0.reshape(bridge.x0.shape[0], -1).shape

    def one(key):
        key_draw, key_noise = jr.split(key)
        bridge = draw(key_draw)
        path, v = ways(bridge, jr.normal(key_noise, bridge.noise_shape, bridge.x0.dtype))
        theta = jnp.zeros(0) if context is None else context(bridge.sde)
        v = v.reshape(-1, 1, n, dim)
        return path.reshape(len(v), -1, n, dim) - v, v, theta

    away, v, theta = jax.jit(jax.vmap(one))(jr.split(key, num_paths))
    lost = int(jnp.sum(~jnp.all(jnp.isfinite(away), axis=(1, 2, 3, 4))))
    require(
        lost == 0,
        f"`sde` must have paths that stay finite, and {lost} of {num_paths} led by the guide do "
        "not: its drift "
        "explodes, or a step is too long for it. Increase `num_steps`, or give another `guide`.",
    )
    pooled = isinstance(bridge.sde.space, Landmarks)
    largest = jnp.max(jnp.abs(away))
    away = jnp.mean(away**2, axis=(0, 1, 2))
    if pooled:
        centre = jnp.zeros(())
        width = jnp.sqrt(jnp.mean((v - jnp.mean(v, axis=3, keepdims=True)) ** 2))
        away = jnp.mean(away)
    else:
        centre = jnp.mean(v, axis=(0, 1, 2))
        width = jnp.std(v, axis=(0, 1, 2))
        width = jnp.where(width > 1e-6 * (1 + jnp.abs(centre)), width, 1.0)
    scale = jnp.sqrt(away)
    scale = jnp.where(scale > 1e-6 * jnp.max(scale), scale, 1.0)
    deviation = jnp.std(theta, axis=0)
    still = np.flatnonzero(deviation <= 1e-6 * jnp.abs(jnp.mean(theta, axis=0)))
    require(
        still.size == 0,
        f"`context` must vary over what is drawn, and its number {still[:1]} is "
        f"{theta[0, still[:1]]} in all of "
        f"{num_paths} problems: a network cannot learn from it. Leave it out, or let `draw` vary "
        "it.",
    )
    standard = Standard(duration, scale, centre, width, jnp.mean(theta, axis=0), deviation)
    guide = ScoreGuide(bridge.guide, network, standard, context)
    _check_output(guide, bridge)
    return guide, _STRIDE * largest


def _check_output(guide: ScoreGuide, bridge: GuidedBridge) -> None:
    """`ValueError` where a network does not fit states shaped like those of the bridge."""
    shape = bridge.x0.reshape(bridge.x0.shape[0], -1).shape
    state = jnp.zeros(shape, bridge.x0.dtype)
    inputs = (jnp.zeros((), state.dtype), state, state, guide.standard.context_mean)
    words = (
        f"takes (t, x, v, theta) with x and v {shape} and theta {inputs[3].shape}, and returns "
        "an array like x"
    )
    try:
        found = jax.eval_shape(lambda: guide.network(*inputs))
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"`network` must be a function that {words}; called so it says: {error}."
        ) from error
    output = getattr(found, "shape", None)
    require(
        output == shape,
        f"`network` must be a function that {words}; it returned {output or found}.",
    )


def _need_value(bridge: GuidedBridge, method: str) -> None:
    require(
        bridge.condition.num_extra_noises == 0,
        f"`method={method!r}` needs an observed value, and this condition is a set. Use "
        "`method='residual'`.",
    )


def _need_noise(bridge: GuidedBridge, method: str) -> None:
    require(
        _has_noise(bridge),
        f"`method={method!r}` needs noise in every direction, and a(t0, x0) is singular. Use "
        "`method='residual'`.",
    )


def _has_noise(bridge: GuidedBridge) -> bool:
    """Whether there is noise in every direction at the start, as far as that is known."""
    a = bridge.sde.covariance(bridge.clock, bridge.x0)
    if concrete(a) is None:
        return True
    pivots = jnp.diagonal(jnp.linalg.cholesky(a)) if a.ndim == 2 else jnp.atleast_1d(a)
    return bool(jnp.all(pivots > 0))
