"""The weight of a tree: messages go up, guided paths come down.

What is seen below a node is told to the branch above it by a Gaussian message

    h(x) = exp(c + Fᵀ(x − o) − ½ (x − o)ᵀ H (x − o)),

o being the node's anchor, near which coefficients are linearised. Where branches meet messages are multiplied: H, F and
c are added, the normalising constants too. A branch is guided like a bridge: one that leads to an end by the
observation there, one that leads to an inner node by its message, which is an observation R x + N(0, I) with R Rᵀ = Hᵀ.
With every step of every branch guided by some q,

    Ψ = Σ_branches Σ_k [log p − log q](x_{k+1} | x_k) + Σ_{seen nodes} log p(v | x),
    E exp Ψ = p(all data | x_root),

exactly for the time-discretised model: messages of inner nodes only guide, so approximating them costs variance and no
bias. Where the process is linear and the messages are its own, Ψ is the same number for every noise: the message at the
root.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from .._linalg import apply, cholesky, full_precision, solve_lower, varying_like
from .._types import State
from ..conditioning import AbstractCondition, GaussianMessage, Observation
from ..guiding import AbstractGuide, AbstractPlan, FrozenGuide, arrive, default_guide, follow, retrace, travel
from ..sdes import AbstractSDE, BrownianMotion, Displaced
from ._root import Root
from ._schedule import Schedule, schedule
from ._tree import Tree

_LOG_2PI = 1.8378770664093453
_NUGGET = 1e-12
"""Added to the diagonal of a message, relative to its largest entry: what is not seen at all has no information."""


class Information(NamedTuple):
    """log h(y) = c + Fᵀy − ½ yᵀHy of a displacement y from the anchor; columns share H."""

    H: Float[Array, "n n"]
    F: State
    c: Float[Array, ""]

    def __add__(self, other):  # type: ignore[override]
        return Information(*(a + b for a, b in zip(self, other, strict=True)))

    def as_observation(self) -> tuple[Observation, State, Float[Array, ""]]:
        """The same as an observation w = R y + N(0, I), and the log density that it has too much."""
        n, dtype = self.H.shape[0], self.H.dtype
        nugget = _NUGGET if dtype == jnp.float64 else 1e-6
        diagonal = jnp.diagonal(self.H)
        R = cholesky(self.H + nugget * jnp.max(diagonal) * jnp.eye(n, dtype=dtype))
        w = solve_lower(R, self.F)
        excess = -0.5 * jnp.sum(w * w) - 0.5 * self.F.size * _LOG_2PI
        return Observation(R.T, jnp.ones((), dtype), jnp.zeros((), dtype)), w, self.c - excess


def nothing(like: State) -> Information:
    """The message of no data."""
    n = like.shape[0]
    return Information(jnp.zeros((n, n), like.dtype), jnp.zeros_like(like), jnp.zeros((), like.dtype))


class Branch(NamedTuple):
    """One branch, or many along a leading axis: what is known of it before any message."""

    length: Array
    clock: Array
    anchor: State
    """A state near which coefficients are linearised: where the branch is expected to end."""
    parent_anchor: State


class UpwardPass(NamedTuple):
    """What the way up leaves for the way down."""

    plans: AbstractPlan
    """Of the branches to inner nodes, in the order of the schedule."""
    observations: Observation
    data: State
    ends: "Led"
    at_root: Information


class Led(NamedTuple):
    """How the branches to the ends are led, along a leading axis."""

    plan: AbstractPlan
    seen: Observation
    observed: State
    ts: Array


class TreeProblem(eqx.Module):
    """A tree, what is seen of it, and how its paths are led."""

    sde: AbstractSDE
    guide: AbstractGuide
    root: Root
    branches: Branch
    conditions: AbstractCondition
    """One for each seen node, along a leading axis."""
    parents: tuple[int, ...] = eqx.field(static=True)
    observed: tuple[int, ...] = eqx.field(static=True)
    num_steps: int = eqx.field(static=True)
    schedule: Schedule = eqx.field(static=True)

    @classmethod
    def of(cls, sde, guide, root: Root, tree: Tree, conditions: AbstractCondition, num_steps: int, t0) -> "TreeProblem":
        """With every anchor at the root: for linear processes, for simulation, and before `anchored`."""
        x0 = root.x0
        guide = default_guide(sde, x0) if guide is None else guide
        observed = tuple(dict.fromkeys(tree.observed))
        walk = schedule(tree.parents, observed)
        above = np.array(tree.parents[1:])
        clock = jnp.zeros_like(tree.lengths)
        if not sde.is_autonomous(x0):
            clock = t0 + tree.depths[above]

        at_root = jnp.broadcast_to(x0, (tree.num_nodes - 1, *x0.shape))
        branches = Branch(tree.lengths, clock, at_root, at_root)
        return cls(sde, guide, root, branches, conditions, tree.parents, observed, num_steps, walk)

    def anchored(self, t0) -> "TreeProblem":
        """With anchors where a Brownian motion would be, given the data; a linear process needs none."""
        if self.sde.has_exact_transition:
            return self
        a = self.sde.covariance(t0, self.x0)
        variance = jnp.mean(jnp.diagonal(a)) if a.ndim == 2 else jnp.mean(a)
        walker = BrownianMotion(jnp.where(variance > 0, variance, 1.0), space=self.sde.space)
        rough = replace(self, sde=walker, guide=FrozenGuide(), num_steps=1)
        active = np.array(self.schedule.active)
        still = jnp.zeros((rough.num_noises, *self.x0.shape), self.x0.dtype)
        paths, _ = rough.down(rough.up(), still)
        anchors = jnp.broadcast_to(self.x0, (len(self.parents), *self.x0.shape)).at[active].set(paths[:, -1])
        anchors = anchors.at[0].set(paths[0, 0])
        above = np.array(self.parents[1:])
        branches = self.branches._replace(anchor=anchors[1:], parent_anchor=anchors[above])
        return replace(self, root=replace(self.root, anchor=anchors[0]), branches=branches)

    @property
    def x0(self) -> State:
        """The state at the root, or its prior mean."""
        return self.root.x0

    @property
    def num_root_rows(self) -> int:
        """Rows of noise in front of those of the branches."""
        return self.root.num_rows(self.sde.noise_size(self.x0))

    @property
    def num_noises(self) -> int:
        """Rows of noise."""
        return self.num_root_rows + len(self.schedule.active) * self.num_steps

    @property
    def is_exact(self) -> bool:
        """Whether the messages are those of the process itself, so that Ψ depends on no noise."""
        frozen = isinstance(self.guide, FrozenGuide) and self.guide.auxiliary is None
        return self.sde.has_exact_transition and frozen

    @full_precision
    def log_weight(self, noise: Float[Array, "steps k *dim"]) -> Float[Array, ""]:
        """Ψ."""
        up = self.up()
        return self.log_evidence(up) if self.is_exact else self.down(up, noise)[1]

    @full_precision
    def paths(self, noise: Float[Array, "steps k *dim"]) -> Float[Array, "branches K+1 n *dim"]:
        """States along every branch that has noise, in preorder."""
        return self.down(self.up(), noise)[0]

    def at_nodes(self, paths: Float[Array, "branches K+1 n *dim"]) -> Float[Array, "nodes n *dim"]:
        """The states of all nodes, from those along the branches; NaN for nodes that lead to nothing seen."""
        states = jnp.full((len(self.parents), *self.x0.shape), jnp.nan, paths.dtype)
        root = paths[0, 0]  # the first branch, in preorder, starts there
        return states.at[np.array(self.schedule.active)].set(paths[:, -1]).at[0].set(root)

    @full_precision
    def noise_from_paths(self, paths, key: PRNGKeyArray) -> Float[Array, "steps k *dim"]:
        """The noise with `paths(noise) = paths`; what they leave free of it is drawn with the key."""
        up, walk = self.up(), self.schedule
        place = {node: i for i, node in enumerate(walk.active)}

        def inner(branch, plan, seen, w, path, key):
            ts = self._grid(branch.length, False)
            return retrace(self._edge(branch), plan, seen, ts, path - branch.anchor, w, key)

        def end(led, branch, path, key):
            plan, seen, observed, ts = led
            y = path - branch.anchor
            observed = apply(seen.operator, y[-1]) if seen.exact else observed
            return retrace(self._edge(branch), plan, seen, ts, y, observed, key)

        key_root, key = jr.split(key)
        keys = jr.split(key, len(walk.active))
        at_inner, at_ends = ([place[node] for node in nodes] for nodes in (walk.inner, walk.ends))
        own, others = (_picked((paths, keys), rows) for rows in (at_inner, at_ends))
        z = jax.vmap(end)(up.ends, self._of(walk.ends), *others)
        noise = jnp.zeros((len(walk.active), *z.shape[1:]), z.dtype).at[np.array(at_ends)].set(z)
        if at_inner:
            branches = self._of(walk.inner)
            z = jax.vmap(inner)(branches, up.plans, up.observations, up.data, *own)
            noise = noise.at[np.array(at_inner)].set(z)
        at_root = self.root.noise_of(up.at_root, paths[0, 0], noise.shape[2], key_root)
        return jnp.concatenate([at_root, noise.reshape(-1, *noise.shape[2:])])

    @full_precision
    def simulate(self, noise: Float[Array, "steps k *dim"]) -> Float[Array, "branches K+1 n *dim"]:
        """Unconditioned paths along every branch that has noise, in preorder."""
        walk = self.schedule
        at_root, noise = noise[: self.num_root_rows], noise[self.num_root_rows :]
        noise = noise.reshape(len(walk.active), self.num_steps, *noise.shape[1:])
        states = jnp.broadcast_to(self.root.prior(at_root), (len(self.parents), *self.x0.shape))

        def step(states, inputs):
            node, parent, branch, is_end, z = inputs
            x, edge = states[parent], self._edge(branch)
            ts = jnp.where(is_end, self._grid(branch.length, self.conditions.exact), self._grid(branch.length, False))

            def move(y, inputs):
                s, t, z = inputs
                law = edge.transition(s, t, y)
                y = law.mean + apply(law.factor, z)
                return y, y

            _, path = jax.lax.scan(move, x - branch.anchor, (ts[:-1], ts[1:], z))
            path = jnp.concatenate([x[None], branch.anchor + path])
            return states.at[node].set(path[-1]), path

        nodes = np.array(walk.active)
        is_end = np.isin(nodes, walk.ends)
        inputs = nodes, np.array(self.parents)[nodes], self._of(walk.active), is_end, noise
        return jax.lax.scan(step, states, inputs)[1]

    def _grid(self, length, graded: bool):
        s = np.linspace(0.0, 1.0, self.num_steps + 1)
        s = s * (2 - s) if graded else s
        return length * jnp.asarray(s, self.x0.dtype)

    def _rows(self, nodes: Sequence[int]) -> AbstractCondition:
        """The conditions of some seen nodes."""
        row = {node: i for i, node in enumerate(self.observed)}
        return _picked(self.conditions, [row[node] for node in nodes])

    def _of(self, nodes: Sequence[int]) -> Branch:
        return _picked(self.branches, [node - 1 for node in nodes])

    def _anchors(self, nodes: Sequence[int]) -> Float[Array, "nodes n *dim"]:
        """Of some nodes, the root among them."""
        return jnp.concatenate([self.root.anchor[None], self.branches.anchor])[np.array(nodes, int)]

    def _edge(self, branch: Branch) -> Displaced:
        return Displaced(self.sde, branch.anchor, branch.clock)

    def _start_message(self, plan, branch: Branch, observed: State) -> Information:
        """What the branch tells its parent, as a displacement from the parent's anchor."""
        entry = jax.tree.map(lambda a: a[0], plan.steps)
        between = branch.parent_anchor - branch.anchor
        zero = jnp.zeros((), self.x0.dtype)
        message = plan.message(entry, self._edge(branch), zero, between, observed)
        shift = message.shift + apply(message.operator, between)
        message = GaussianMessage(message.operator, shift, message.factor, observed, message.log_scale)
        return _information(message, self.x0)

    def _seen(self, condition: AbstractCondition, anchor: State) -> tuple[Observation, State]:
        """What is seen of a node, a displacement from its anchor."""
        seen = condition.observation(self.sde, self.x0)
        displaced = condition.displaced(apply(seen.operator, anchor))
        extra = jnp.zeros((0,), self.x0.dtype)
        return seen, displaced.target(self.x0, jnp.ones((), self.x0.dtype), extra).value

    def _led(self, condition, branch: Branch) -> Led:
        seen, observed = self._seen(condition, branch.anchor)
        ts = self._grid(branch.length, condition.exact)
        plan = self.guide.plan(self._edge(branch), seen, jnp.zeros_like(self.x0), ts)
        return Led(plan, seen, observed, ts)

    def _message_of_end(self, led: Led, branch: Branch) -> Information:
        message = self._start_message(led.plan, branch, led.observed)
        return message._replace(c=message.c + led.seen.log_scale)

    def _own_messages(self, ends: Led) -> Information:
        """For each node of the tree what is seen at it and at the ends that hang on it."""
        schedule, count = self.schedule, len(self.parents)
        nodes = schedule.ends
        above = np.array(self.parents)[list(nodes)]
        messages = jax.vmap(self._message_of_end)(ends, self._of(nodes))
        blank = nothing(self.x0)
        totals = jax.tree.map(lambda a: jnp.zeros((count, *a.shape), a.dtype), blank)
        totals = jax.tree.map(lambda a, b: a.at[above].add(b), totals, messages)
        inside = [node for node in (0, *schedule.inner) if node in self.observed]
        if inside:

            def one(condition, anchor):
                seen, observed = self._seen(condition, anchor)
                shift = jnp.zeros_like(observed)
                factor = seen.factor if seen.factor is not None else jnp.zeros((), self.x0.dtype)
                message = GaussianMessage(seen.operator, shift, factor, observed, seen.log_scale)
                return _information(message, self.x0)

            own = jax.vmap(one)(self._rows(inside), self._anchors(inside))
            totals = jax.tree.map(lambda a, b: a.at[np.array(inside)].add(b), totals, own)
        return totals

    def up(self) -> UpwardPass:
        """Messages, from the ends to the root."""
        schedule = self.schedule
        ends = jax.vmap(self._led)(self._rows(schedule.ends), self._of(schedule.ends))
        own = self._own_messages(ends)
        blank = nothing(self.x0)
        kept = jax.tree.map(lambda a: jnp.zeros((schedule.num_slots + 1, *a.shape), a.dtype), blank)
        kept = varying_like(kept, self.sde, self.branches, own)
        order = schedule.inner[::-1]

        def step(kept, inputs):
            own, branch, slot, parent_slot, first = inputs
            below = jax.tree.map(lambda a: jnp.where(slot < schedule.num_slots, a[slot], 0.0), kept)
            total = own + below
            seen, w, c = total.as_observation()
            ts = self._grid(branch.length, False)
            plan = self.guide.plan(self._edge(branch), seen, jnp.zeros_like(self.x0), ts)
            message = self._start_message(plan, branch, w)
            message = message._replace(c=message.c + c)
            kept = jax.tree.map(
                lambda a, b: a.at[parent_slot].set(jnp.where(first, 0.0, a[parent_slot]) + b), kept, message
            )
            return kept, (plan, seen, w)

        inputs = (
            _picked(own, order),
            self._of(order),
            np.array(schedule.slot[::-1], int),
            np.array(schedule.parent_slot[::-1], int),
            np.array(schedule.first[::-1], bool),
        )
        kept, (plans, observations, data) = jax.lax.scan(step, kept, inputs)
        plans, observations, data = jax.tree.map(lambda a: jnp.flip(a, 0), (plans, observations, data))
        at_root = jax.tree.map(lambda a, b: a[0] + b[0], own, kept)
        return UpwardPass(plans, observations, data, ends, at_root)

    def log_evidence(self, up: UpwardPass) -> Float[Array, ""]:
        """The message at the root under its prior: the log likelihood itself where the process is linear."""
        return self.root.log_evidence(up.at_root)

    def down(self, up: UpwardPass, noise: Float[Array, "steps k *dim"]):
        """States of every active node's branch `(active, K + 1, n, dim)`, and Ψ."""
        schedule, K = self.schedule, self.num_steps
        place = {node: i for i, node in enumerate(schedule.active)}
        at_root, noise = noise[: self.num_root_rows], noise[self.num_root_rows :]
        root, root_weight = self.root.posterior(up.at_root, at_root)
        noise = noise.reshape(len(schedule.active), K, *noise.shape[1:])
        inner, ends = schedule.inner, schedule.ends
        at_inner = np.array([place[node] for node in inner], int)
        at_ends = np.array([place[node] for node in ends], int)
        states = jnp.zeros((schedule.num_slots + 1, *self.x0.shape), self.x0.dtype)
        states = varying_like(states.at[0].set(root), self.sde, self.branches, up, noise)

        def step(states, inputs):
            branch, plan, seen, w, z, slot, parent_slot = inputs
            x = states[parent_slot]
            ts = self._grid(branch.length, False)
            path, log_weight = follow(self._edge(branch), plan, seen, ts, x - branch.anchor, z, w)
            path = jnp.concatenate([x[None], branch.anchor[None] + path])
            return states.at[slot].set(path[-1]), (path, log_weight)

        inputs = (
            self._of(inner), up.plans, up.observations, up.data, noise[at_inner],
            np.array(schedule.slot, int), np.array(schedule.parent_slot, int),
        )  # fmt: skip
        _, (inner_paths, inner_weights) = jax.lax.scan(step, states, inputs)
        known = jnp.concatenate([root[None], inner_paths[:, -1]])
        number = {0: 0} | {node: i + 1 for i, node in enumerate(inner)}
        starts = known[np.array([number[self.parents[node]] for node in ends])]

        def end(led, branch, x, z):
            plan, seen, observed, ts = led
            sde, y = self._edge(branch), x - branch.anchor
            path, y, log_weight = travel(sde, plan, ts, y, z[:-1], observed)
            last, log_density = arrive(sde, seen, ts, y, z[-1], observed)
            path = branch.anchor[None] + jnp.concatenate([path, last[None]])
            return jnp.concatenate([x[None], path]), log_weight + log_density

        end_paths, end_weights = jax.vmap(end)(up.ends, self._of(ends), starts, noise[at_ends])
        paths = jnp.zeros((len(schedule.active), K + 1, *self.x0.shape), self.x0.dtype)
        paths = paths.at[at_ends].set(end_paths).at[at_inner].set(inner_paths)
        log_weight = root_weight + jnp.sum(inner_weights) + jnp.sum(end_weights)
        return paths, log_weight + self._log_density_inside(known)

    def _log_density_inside(self, states):
        """Log density of what is seen at the root and at inner nodes, given their states."""
        inner = (0, *self.schedule.inner)
        chosen = [i for i, node in enumerate(inner) if node in self.observed]
        if not chosen:
            return jnp.zeros((), self.x0.dtype)

        def one(condition, x):
            seen = condition.observation(self.sde, x)
            return condition.log_value(apply(seen.operator, x), seen.factor) + seen.log_scale

        rows = self._rows([inner[i] for i in chosen])
        return jnp.sum(jax.vmap(one)(rows, states[np.array(chosen)]))


def _picked(tree, rows: Sequence[int]):
    """Some rows of every array; a scan or a map over none of them is none."""
    return jax.tree.map(lambda a: a[np.array(rows, int)], tree)


def _information(message: GaussianMessage, like: State) -> Information:
    H, F, c = message.information(like.shape[0])
    return Information(H, F.reshape(like.shape), c)
