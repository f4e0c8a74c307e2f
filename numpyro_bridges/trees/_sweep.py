"""The weight of a tree: messages go up, guided paths come down.

What is seen below a node is told to the branch above it by a Gaussian message

    h(x) = exp(c + Fᵀ(x − o) − ½ (x − o)ᵀ H (x − o)),

o being the node's anchor, near which coefficients are linearised. Where branches meet messages are
multiplied: H, F and c are added, the normalising constants too. A branch is guided like a bridge:
one that leads to an end by the observation there, one that leads to an inner node by its message,
which is an observation Rᵀ x + N(0, I) with R Rᵀ = H. A guide that follows the state is told of a
mean at a later time instead (`_told.py`). With every step of every branch guided by some q,

    Ψ = Σ_branches Σ_k [log p − log q](x_{k+1} | x_k) + Σ_{seen nodes} log p(v | x),
    E exp Ψ = p(all data | x_root),

exactly for the time-discretised model: messages of inner nodes only guide, so approximating them
costs variance and no bias. Where the process is linear and the messages are its own, Ψ is the same
number for every noise: the message at the root.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from .._linalg import apply, full_precision, promote, rows, varying_like
from .._types import State
from ..conditioning import AbstractCondition, GaussianMessage, Observation, lift
from ..guiding import (
    AbstractGuide,
    AbstractPlan,
    FrozenGuide,
    default_guide,
    reach,
    retrace,
    retrace_reach,
    travel,
)
from ..sdes import AbstractSDE, AffineStep, BrownianMotion, Displaced
from ._information import Information
from ._root import Root
from ._schedule import Schedule, schedule
from ._told import Part, as_seen, earlier, told_by
from ._tree import Tree


class Branch(NamedTuple):
    """One branch, or many along a leading axis: what is known of it before any message."""

    length: Array
    clock: Array
    anchor: State
    """A state near which coefficients are linearised: where the branch is expected to end."""
    parent_anchor: State
    own: AbstractSDE | None = None
    """The arrays of an SDE of its own; `None` where all branches have the same."""
    steps: AffineStep | None = None
    """For a guide that is frozen, the process linearised, on the grid of an inner branch."""


class UpwardPass(NamedTuple):
    """What the way up leaves for the way down."""

    plans: AbstractPlan
    """Of the branches to inner nodes, in the order of the schedule."""
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
    """Of all branches; where they have their own, of one of them, for what they have in common."""
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
    def of(
        cls, sde, guide, root: Root, tree: Tree, conditions, num_steps: int, t0, own
    ) -> "TreeProblem":
        """With every anchor at the root: for linear processes, for simulation, and before
        `anchored`.

        `own`: the SDEs of all branches along a leading axis, `sde` being one of them, or `None`.
        """
        x0 = root.x0
        guide = default_guide(sde, x0) if guide is None else guide
        # a node of several rows has one condition, in which they are fused
        observed = tuple(dict.fromkeys(tree.observed))
        walk = schedule(tree.parents, observed)
        above = np.array(tree.parents[1:])
        # every branch counts its own time from 0, which keeps the digits of its steps
        clock = jnp.zeros_like(tree.lengths)
        if not sde.is_autonomous(x0):
            clock = t0 + tree.depths[above]

        at_root = jnp.broadcast_to(x0, (tree.num_nodes - 1, *x0.shape))
        branches = Branch(tree.lengths, clock, at_root, at_root, eqx.filter(own, eqx.is_array))
        return cls(sde, guide, root, branches, conditions, tree.parents, observed, num_steps, walk)

    def anchored(self, t0) -> "TreeProblem":
        """With anchors, where they are needed, at the mean of a Brownian motion given the data."""
        # a linear process is the same near every state; a guide that follows is told of means
        if self.sde.has_exact_transition or self.follows:
            return self
        walker = self._walker(None, t0)
        own = self.branches.own
        own = None if own is None else jax.vmap(lambda own: self._walker(own, t0))(own)
        branches = self.branches._replace(own=own)
        # Gaussian and exact with one step a branch: without noise, paths pass through the means
        rough = replace(self, sde=walker, guide=FrozenGuide(), num_steps=1, branches=branches)
        active = np.array(self.schedule.active)
        still = jnp.zeros((rough.num_noises, *self.x0.shape), self.x0.dtype)
        paths, _ = rough.down(rough.up(), still)
        # nodes without data keep the root's: no path goes there
        anchors = jnp.broadcast_to(self.x0, (len(self.parents), *self.x0.shape))
        anchors = anchors.at[active].set(paths[:, -1])
        anchors = anchors.at[0].set(paths[0, 0])
        above = np.array(self.parents[1:])
        branches = self.branches._replace(anchor=anchors[1:], parent_anchor=anchors[above])
        return replace(self, root=replace(self.root, anchor=anchors[0]), branches=branches)

    def _walker(self, own: AbstractSDE | None, t0) -> BrownianMotion:
        """As fast as a branch's process is at the root."""
        a = self._sde_of(own).covariance(t0, self.x0)
        variance = jnp.mean(jnp.diagonal(a)) if a.ndim == 2 else jnp.mean(a)
        # any speed puts the anchors somewhere between the data; 0 would be a singular covariance
        return BrownianMotion(jnp.where(variance > 0, variance, 1.0), space=self.sde.space)

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
    def noise_shape(self) -> tuple[int, ...]:
        """Of what `log_weight` takes."""
        return self.num_noises, self.sde.noise_size(self.x0), *self.x0.shape[1:]

    def with_guide(self, guide: AbstractGuide) -> "TreeProblem":
        """Led otherwise, by a guide that follows if this one does."""
        return replace(self, guide=guide)

    @property
    def follows(self) -> bool:
        """Whether a node's data are told by a mean, for the guide's covariances to follow."""
        # κ is a time under one covariance, and branches with SDEs of their own have several
        if self.branches.own is not None:
            return False
        # a static property, which is the same for all branches and conditions
        branch = jax.tree.map(lambda a: a[0], self.branches)
        seen = jax.tree.map(lambda a: a[0], self.conditions).observation(self.sde, self.x0)
        return self.guide.follows(self._edge(branch), seen, jnp.zeros_like(self.x0))

    @property
    def is_exact(self) -> bool:
        """Whether the messages are those of the process itself, so that Ψ depends on no noise."""
        frozen = isinstance(self.guide, FrozenGuide) and self.guide.auxiliary is None
        return self.sde.has_exact_transition and frozen and not self.conditions.is_approximated

    @full_precision
    def log_weight(self, noise: Float[Array, "steps k *dim"]) -> Float[Array, ""]:
        """Ψ."""
        up = self.up()
        # where Ψ depends on no noise the way down would add its rounding and its time
        return self.log_evidence(up) if self.is_exact else jnp.sum(self.down(up, noise)[1])

    @full_precision
    def log_weights(self, noise: Float[Array, "steps k *dim"]) -> Float[Array, " blocks"]:
        """Ψ as a sum over the root, where it varies, and the branches that have noise, in preorder.

        Each term depends on the noise down to its end.
        """
        up = self.up()
        if self.is_exact:
            blocks = len(self.schedule.active) + (self.num_root_rows > 0)
            # one term has it all, so that the sum has no rounding
            return jnp.zeros((blocks,), self.x0.dtype).at[0].set(self.log_evidence(up))
        return self.down(up, noise)[1]

    @full_precision
    def log_likelihoods(self, noise: Float[Array, "steps k *dim"]) -> Float[Array, " seen"]:
        """For each seen node log p(v | x), or, at an end, the terms of what leads to it alone."""
        schedule = self.schedule
        place = {node: i for i, node in enumerate(schedule.active)}
        at_inner = np.array([place[node] for node in schedule.inner], int)
        paths, log_weights = self.down(self.up(), noise)
        states = jnp.concatenate([paths[:1, 0], paths[at_inner, -1]])
        densities = self._log_density_inside(states)
        by_node = jnp.zeros((len(self.parents),), self.x0.dtype)
        ends = self._leads_to(schedule.active)
        # behind the term of the root, where it has one
        by_node = by_node.at[ends].add(log_weights[-len(ends) :])
        # what leads to an inner node leads on to others: of it the density of the datum alone
        by_node = by_node.at[np.array((0, *schedule.inner))].set(densities)
        return by_node[np.array(self.observed)]

    def _leads_to(self, nodes: Sequence[int]) -> np.ndarray:
        """For each active node the last one below it to which nothing but its branch leads."""
        last = {}
        above = Counter(self.parents[node] for node in nodes)
        # backwards, so that a node knows what is below it
        for node in reversed(nodes):
            last.setdefault(node, node)
            parent = self.parents[node]
            # a node without data and with one branch below it is a mere division of that
            if above[parent] == 1 and parent not in self.observed:
                last[parent] = last[node]
        return np.array([last[node] for node in nodes])

    @property
    def grids(self) -> Float[Array, "branches K+1"]:
        """Times since its start of every branch that has noise, in preorder."""
        nodes = np.array(self.schedule.active)
        lengths = self.branches.length[nodes - 1]
        # only ends are pinned, and with an exact condition all of them
        exact = np.isin(nodes, self.schedule.ends) & self.conditions.exact
        graded = jax.vmap(lambda t: self._grid(t, True))(lengths)
        plain = jax.vmap(lambda t: self._grid(t, False))(lengths)
        return jnp.where(exact[:, None], graded, plain)

    @full_precision
    def paths(self, noise: Float[Array, "steps k *dim"]) -> Float[Array, "branches K+1 n *dim"]:
        """States along every branch that has noise, in preorder."""
        return self.down(self.up(), noise)[0]

    def at_nodes(self, paths: Float[Array, "branches K+1 n *dim"]) -> Float[Array, "nodes n *dim"]:
        """The states of all nodes, from those along branches; NaN where nothing seen is below."""
        states = jnp.full((len(self.parents), *self.x0.shape), jnp.nan, paths.dtype)
        root = paths[0, 0]  # the first branch, in preorder, starts there
        return states.at[np.array(self.schedule.active)].set(paths[:, -1]).at[0].set(root)

    @full_precision
    def noise_from_paths(self, paths, key: PRNGKeyArray) -> Float[Array, "steps k *dim"]:
        """The noise with `paths(noise) = paths`; what they leave free is drawn with the key."""
        # paths are known, so that all branches of a kind are one `vmap`, with no order among them
        up = self.up()
        walk = self.schedule
        place = {node: i for i, node in enumerate(walk.active)}

        def inner(branch, plan, w, path, key):
            ts = self._grid(branch.length, False)
            plan = self.guide.whole(plan)
            return retrace(self._edge(branch), plan, ts, path - branch.anchor, w, key)

        def end(led, branch, path, key):
            plan, seen, observed, ts = led
            plan = self.guide.whole(plan)
            y = path - branch.anchor
            # the path's own end: the datum less the anchor may differ from it by rounding
            observed = apply(seen.operator, y[-1]) if seen.exact else observed
            return retrace_reach(self._edge(branch), plan, seen, ts, y, observed, key)

        key_root, key = jr.split(key)
        keys = jr.split(key, len(walk.active))
        at_inner = [place[node] for node in walk.inner]
        at_ends = [place[node] for node in walk.ends]
        own, others = (_picked((paths, keys), rows) for rows in (at_inner, at_ends))
        z = jax.vmap(end)(up.ends, self._of(walk.ends), *others)
        noise = jnp.zeros((len(walk.active), *z.shape[1:]), z.dtype).at[np.array(at_ends)].set(z)
        if at_inner:
            branches = self._of(walk.inner)
            z = jax.vmap(inner)(branches, up.plans, up.data, *own)
            noise = noise.at[np.array(at_inner)].set(z)
        at_root = self.root.noise_of(up.at_root, paths[0, 0], noise.shape[2], key_root)
        return jnp.concatenate([at_root, noise.reshape(-1, *noise.shape[2:])])

    @full_precision
    def simulate(self, noise: Float[Array, "steps k *dim"]) -> Float[Array, "branches K+1 n *dim"]:
        """Unconditioned paths along every branch that has noise, in preorder."""
        walk = self.schedule
        at_root = noise[: self.num_root_rows]
        noise = noise[self.num_root_rows :]
        noise = noise.reshape(len(walk.active), self.num_steps, *noise.shape[1:])
        states = jnp.broadcast_to(self.root.prior(at_root), (len(self.parents), *self.x0.shape))

        # branch after branch in preorder: simulation is rare, and needs no schedule
        def step(states, inputs):
            node, parent, branch, is_end, z = inputs
            x = states[parent]
            edge = self._edge(branch)
            ts = jnp.where(
                is_end,
                self._grid(branch.length, self.conditions.exact),
                self._grid(branch.length, False),
            )

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
        # steps shrink towards an end that is pinned, where the guiding drift grows
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
        return Displaced(self._sde_of(branch.own), branch.anchor, branch.clock)

    def _sde_of(self, own: AbstractSDE | None) -> AbstractSDE:
        return self.sde if own is None else eqx.combine(own, self.sde)

    def _inner_grid(self, branch: Branch) -> Array:
        """Times that give a plan an entry at the end too: there the last step is led as well."""
        ts = self._grid(branch.length, False)
        return jnp.concatenate([ts, ts[-1:]])

    def _inner_plan(
        self, branch: Branch, seen: Observation, observed: State, reference: State, *beyond
    ):
        edge = self._edge(branch)
        ts = self._inner_grid(branch)
        # known before any message, see `_with_steps`
        if branch.steps is not None:
            assert isinstance(self.guide, FrozenGuide)
            return self.guide.plan(edge, seen, reference, ts, branch.steps)
        guide = self._prepared(branch, seen, observed, reference, ts)
        return guide.plan(edge, seen, reference, ts, *beyond).bare()

    def _prepared(
        self, branch: Branch, seen: Observation, observed: State, reference: State, ts
    ) -> AbstractGuide:
        start = branch.parent_anchor - branch.anchor
        return self.guide.prepared(self._edge(branch), seen, observed, reference, ts, start)

    def _with_steps(self, branches: Branch) -> Branch:
        """Inner branches with what is known before any message, in one program for all."""
        guide = self.guide
        # other guides have no such steps, and rounds linearise where the messages lead
        if not isinstance(guide, FrozenGuide) or guide.rounds:
            return branches
        here = jnp.zeros_like(self.x0)

        def of(branch):
            steps = guide.steps(self._edge(branch), here, self._grid(branch.length, False))
            one = jnp.ones((), here.dtype)
            n = len(here)
            operator = promote(one, steps.operator.ndim - 1, n)
            # from the end to the end, the last two times of `_inner_grid`: nothing moves
            still = AffineStep(operator, here, promote(0 * one, steps.covariance.ndim - 1, n))
            return jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), steps, still)

        steps = jax.vmap(of)(branches)
        return branches._replace(steps=steps)

    def _start_message(self, plan, branch: Branch, observed: State) -> Information:
        """What the branch tells its parent, as a displacement from the parent's anchor."""
        # the plan's entry at the branch's start has all of the branch before it
        entry = jax.tree.map(lambda a: a[0], plan.steps)
        # the branch's states are displacements from its own anchor: y = between + y_parent, so
        # that v − (L y + s) = v − (L y_parent + s + L between)
        between = branch.parent_anchor - branch.anchor
        zero = jnp.zeros((), self.x0.dtype)
        message = plan.message(entry, self._edge(branch), zero, between, observed)
        shift = message.shift + apply(message.operator, between)
        message = GaussianMessage(
            message.operator, shift, message.factor, observed, message.log_scale
        )
        return Information.of(message, self.x0)

    def _seen(self, condition: AbstractCondition, anchor: State) -> tuple[Observation, State]:
        """What is seen of a node, a displacement from its anchor."""
        # of a node's own SDE an observation needs the space only, which all have in common
        seen = condition.observation(self.sde, self.x0)
        displaced = condition.displaced(apply(seen.operator, anchor))
        # a condition that is no set leads to its datum, whatever the law and the noise
        extra = jnp.zeros((0,), self.x0.dtype)
        return seen, displaced.target(self.x0, jnp.ones((), self.x0.dtype), extra).value

    def _led(self, condition, branch: Branch) -> Led:
        seen, observed = self._seen(condition, branch.anchor)
        ts = self._grid(branch.length, condition.exact)
        here = jnp.zeros_like(self.x0)
        # without anchors of its own a guide that follows is linearised at the datum
        reference = lift(seen.operator, here, observed) if self.follows else here
        guide = self._prepared(branch, seen, observed, reference, ts)
        plan = guide.plan(self._edge(branch), seen, reference, ts)
        return Led(plan.bare(), seen, observed, ts)

    def up(self) -> UpwardPass:
        """Messages, from the ends to the root."""
        ends = jax.vmap(self._led)(self._rows(self.schedule.ends), self._of(self.schedule.ends))
        return self._up_with_means(ends) if self.follows else self._up_with_messages(ends)

    def _up_with_messages(self, ends: Led) -> UpwardPass:
        """Each branch by the guide's own message of the one before."""

        def of_end(led, branch):
            message = self._start_message(led.plan, branch, led.observed)
            # a plan is of N(v; L x, Σ): constants of the condition are added here
            return message._replace(c=message.c + led.seen.log_scale)

        def of_node(condition, anchor):
            seen, observed = self._seen(condition, anchor)
            # `DiffusionTree` refuses exact data of inner nodes: the 0 is never used
            factor = seen.factor if seen.factor is not None else jnp.zeros((), self.x0.dtype)
            return Information.told_by(seen, observed, factor, self.x0)

        def joined(total, branch):
            # the sum at a node, as an observation of it, is what its branch is led by
            seen, w, c = total.as_observation()
            plan = self._inner_plan(branch, seen, w, jnp.zeros_like(self.x0))
            message = self._start_message(plan, branch, w)
            return message._replace(c=message.c + c), (plan, w)

        messages = jax.vmap(of_end)(ends, self._of(self.schedule.ends))
        own = self._own_messages(messages, of_node)
        inner = self._with_steps(self._of(self.schedule.inner))
        at_root, (plans, data) = self._summed_up(own, joined, inner)
        return UpwardPass(plans, data, ends, at_root)

    def _up_with_means(self, ends: Led) -> UpwardPass:
        """Each branch by the mean of what is seen below, whatever the covariance there."""
        first = jax.tree.map(lambda a: a[0], self.branches)
        zero = jnp.zeros((), self.x0.dtype)
        # a₀, of all branches: that of the process at the root, where all anchors are
        part = Part.of(*self._edge(first).noise(zero, jnp.zeros_like(self.x0)))
        like = part.of_state(self.x0)

        def of_end(led, branch):
            return told_by(part.seen(led.seen), led.observed, branch.length, part.a, like)

        def of_node(condition, anchor):
            seen, observed = self._seen(condition, anchor)
            return told_by(part.seen(seen), observed, zero, part.a, like)

        def joined(total, branch):
            return earlier(total, branch.length, part.a), total

        def led(total, branch):
            seen, value, beyond, reference = as_seen(total, part.a, everything)
            seen = part.known(seen)
            reference = part.lifted(reference)
            return self._inner_plan(branch, seen, value, reference, beyond), value

        # for each end the identity, or fewer directions than ever are seen
        everything = ends.seen.operator.ndim == 1 or part.basis is not None
        inner = self._of(self.schedule.inner)
        messages = jax.vmap(of_end)(ends, self._of(self.schedule.ends))
        own = self._own_messages(messages, of_node)
        at_root, totals = self._summed_up(own, joined, inner)
        # the way up needs no plan, so that all are made at once, outside of the loop
        plans, data = jax.vmap(led)(totals, inner)
        return UpwardPass(plans, data, ends, part.message(at_root.information))

    def _own_messages(self, messages, of_node):
        """For each node what is told by its own data and by the ends that hang on it."""
        schedule = self.schedule
        count = len(self.parents)
        above = np.array(self.parents)[list(schedule.ends)]
        # products of messages are sums of H, F and c; those of one parent add up at its place
        totals = jax.tree.map(
            lambda a: jnp.zeros((count, *a.shape[1:]), a.dtype).at[above].add(a), messages
        )
        inside = [node for node in (0, *schedule.inner) if node in self.observed]
        if inside:
            own = jax.vmap(of_node)(self._rows(inside), self._anchors(inside))
            totals = jax.tree.map(lambda a, b: a.at[np.array(inside)].add(b), totals, own)
        return totals

    def _summed_up(self, own, joined, branches: Branch):
        """The sum of what is told at the root, and what `joined` makes of it at inner nodes, as the
        schedule has them.

        `joined(total, branch)` gives what the node's branch, one of `branches`, tells its parent,
        and what is kept.
        """
        schedule = self.schedule
        places, taken = schedule.places()
        # a place more, always 0, is read by nodes on which nothing inner hangs
        kept = jax.tree.map(
            lambda a: jnp.zeros((schedule.num_slots + 1, *a.shape[1:]), a.dtype), own
        )
        kept = varying_like(kept, self.sde, self.branches, own)

        def step(kept, inputs):
            own, branch, slot, parent_slot, taken = inputs
            message, out = jax.vmap(joined)(
                jax.tree.map(lambda a, b: a + b[slot], own, kept), branch
            )
            is_read = jnp.zeros((schedule.num_slots + 1,), bool).at[slot].set(True)

            def renewed(a: Array, b: Array) -> Array:
                # emptied first: what a node of the round has read may be the place of another's
                # parent
                unread = jnp.where(rows(is_read, a), 0.0, a)
                return unread.at[parent_slot].add(jnp.where(rows(taken, b), b, 0.0))

            return jax.tree.map(renewed, kept, message), out

        slots = np.array(schedule.slot, int), np.array(schedule.parent_slot, int)
        of_inner = _picked(own, schedule.inner), branches, *slots
        inputs = *_picked(of_inner, places), taken
        # one loop over rounds, whose program does not grow with the tree; up is down reversed
        kept, out = jax.lax.scan(step, kept, inputs, reverse=True)
        # place 0 is that of the root
        return jax.tree.map(lambda a, b: a[0] + b[0], own, kept), _picked_out(out, schedule)

    def log_evidence(self, up: UpwardPass) -> Float[Array, ""]:
        """The message at the root under its prior: the log likelihood where all is linear."""
        return self.root.log_evidence(up.at_root)

    def down(self, up: UpwardPass, noise: Float[Array, "steps k *dim"]):
        """States of every active node's branch `(active, K + 1, n, dim)`, and the terms of Ψ, one
        for each block.

        Blocks are the branches, behind the root where it varies.
        """
        schedule = self.schedule
        K = self.num_steps
        place = {node: i for i, node in enumerate(schedule.active)}
        at_root = noise[: self.num_root_rows]
        noise = noise[self.num_root_rows :]
        root, root_weight = self.root.posterior(up.at_root, at_root)
        noise = noise.reshape(len(schedule.active), K, *noise.shape[1:])
        inner = schedule.inner
        ends = schedule.ends
        at_inner = np.array([place[node] for node in inner], int)
        at_ends = np.array([place[node] for node in ends], int)
        places, taken = schedule.places()
        states = jnp.zeros((schedule.num_slots, *self.x0.shape), self.x0.dtype)
        states = varying_like(states.at[0].set(root), self.sde, self.branches, up, noise)

        def inner_branch(branch, plan, w, z, x):
            ts = self._grid(branch.length, False)
            plan = self.guide.whole(plan)
            path, _, log_weight = travel(self._edge(branch), plan, ts, x - branch.anchor, z, w)
            return jnp.concatenate([x[None], branch.anchor[None] + path]), log_weight

        def step(states, inputs):
            (branch, plan, w, z), slot, parent_slot = inputs
            path, log_weight = jax.vmap(inner_branch)(branch, plan, w, z, states[parent_slot])
            states = states.at[slot].set(path[:, -1], mode="drop", unique_indices=True)
            return states, (path, log_weight)

        # first the inner branches, in rounds: each starts where the one above it has ended
        of_inner = self._of(inner), up.plans, up.data, noise[at_inner]
        slot = np.array(schedule.slot, int)[places]
        parent_slot = np.array(schedule.parent_slot, int)[places]
        # behind the last slot, where JAX drops what is written; a place each, since they must
        # differ for `unique_indices`
        nowhere = schedule.num_slots + np.arange(places.shape[1])
        slot = np.where(taken & (slot < schedule.num_slots), slot, nowhere)
        _, out = jax.lax.scan(step, states, (_picked(of_inner, places), slot, parent_slot))
        inner_paths, inner_weights = _picked_out(out, schedule)
        # then the branches to ends, of which nothing hangs: all at once
        known = jnp.concatenate([root[None], inner_paths[:, -1]])
        number = {0: 0} | {node: i + 1 for i, node in enumerate(inner)}
        starts = known[np.array([number[self.parents[node]] for node in ends])]

        def end(led, branch, x, z):
            plan, seen, observed, ts = led
            plan = self.guide.whole(plan)
            path, log_weight = reach(
                self._edge(branch), plan, seen, ts, x - branch.anchor, z, observed
            )
            return jnp.concatenate([x[None], branch.anchor[None] + path]), log_weight

        end_paths, end_weights = jax.vmap(end)(up.ends, self._of(ends), starts, noise[at_ends])
        if self.conditions.is_approximated:
            # a path is led by a Gaussian approximation, and weighed by what is seen
            correction = jax.vmap(lambda condition, x: condition.correction(self.sde, x))
            end_weights = end_weights + correction(self._rows(ends), end_paths[:, -1])
        paths = jnp.zeros((len(schedule.active), K + 1, *self.x0.shape), self.x0.dtype)
        paths = paths.at[at_ends].set(end_paths).at[at_inner].set(inner_paths)
        # `reach` has weighed the data of ends; those of other nodes are added to their branch
        densities = self._log_density_inside(known)
        log_weights = jnp.zeros((len(schedule.active),), self.x0.dtype).at[at_ends].set(end_weights)
        log_weights = log_weights.at[at_inner].set(inner_weights + densities[1:])
        if self.num_root_rows:
            log_weights = jnp.concatenate([root_weight[None] + densities[:1], log_weights])
        return paths, log_weights

    def _log_density_inside(self, states):
        """Log density of the data of the root and inner nodes given the states; 0 without data."""
        inner = (0, *self.schedule.inner)
        chosen = [i for i, node in enumerate(inner) if node in self.observed]
        if not chosen:
            return jnp.zeros((len(inner),), self.x0.dtype)

        def one(condition, x):
            # the law of what is seen of x: mean L x, and the error of observation
            seen = condition.observation(self.sde, x)
            log_density = condition.log_value(apply(seen.operator, x), seen.factor) + seen.log_scale
            return log_density + condition.correction(self.sde, x)

        rows = self._rows([inner[i] for i in chosen])
        densities = jax.vmap(one)(rows, states[np.array(chosen)])
        return jnp.zeros((len(inner),), self.x0.dtype).at[np.array(chosen)].set(densities)


def _picked(tree, rows):
    """Some rows of every array; a scan or a map over none of them is none."""
    return jax.tree.map(lambda a: a[np.array(rows, int)], tree)


def _picked_out(by_round, schedule: Schedule):
    """For each inner node what its round gave, in the order of the schedule."""
    places, taken = schedule.places()
    # where in the flattened rounds the nodes are, by their number in `inner`
    at = np.flatnonzero(taken)[np.argsort(places[taken])]
    # no −1: an array may be empty, as the context of a learned guide is that has none
    return jax.tree.map(lambda a: a.reshape(places.size, *a.shape[2:])[at], by_round)
