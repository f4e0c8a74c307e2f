"""The law of what is seen of a diffusion along the branches of a tree.

`sample` simulates from the root and observes the nodes that are seen. `log_prob(v)`, with standard
normal noise z bound, is the log weight Ψ of guided paths along all branches (`trees/_sweep.py`), so
that

    E[exp log_prob(v | z)] = p(v | x0),    z ~ N(0, I).

A bridge is the tree with one branch, a time series is a chain.
"""

from collections import Counter
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array
from numpy.typing import ArrayLike

from .._checks import (
    as_float,
    concrete,
    positive_integer,
    positive_integers,
    require,
    require_finite,
    require_instance,
    words,
)
from .._linalg import promote, symmetric
from .._types import RealScalar
from ..conditioning import AbstractDensityMatch, AbstractMatch, fused
from ..guiding import AbstractGuide, default_guide
from ..sdes import AbstractSDE, Flattened, as_covariance, for_every_column
from ..trees import Root, Tree, TreeProblem
from ._batch import as_datum, as_shape, find_batched, one_of
from ._driving_noise import NoiseBlocks
from ._endpoint import check_law, close_parts, example, names_of
from ._noise_driven import AbstractNoiseDriven


class _Settings(eqx.Module):
    """What is known of a law before tracing."""

    num_steps: tuple[int, ...] = eqx.field(static=True)
    """On each branch of the tree."""
    per_row: tuple[str, ...] = eqx.field(static=True)
    per_edge: tuple[str, ...] = eqx.field(static=True)

    @property
    def steps_together(self) -> int:
        """Steps of every piece; a branch with more of them is a chain of pieces."""
        # a branch is an entry of arrays (branches, steps): the greatest common divisor of all
        # numbers of steps is the longest piece of which every branch is a whole number
        return int(np.gcd.reduce(self.num_steps))

    @property
    def pieces(self) -> np.ndarray:
        """Of each branch of the tree."""
        return np.array(self.num_steps) // self.steps_together


class DiffusionTree(AbstractNoiseDriven):
    """The law of observations at the seen nodes of a tree, of a diffusion that starts at the root.

        law = DiffusionTree(flow, x0, InexactMatch(1e-4), tree=tree, num_steps=10)
        nb.sample("tips", law, obs=tree.rows(shapes))

    Daughters of a node start where their mother ended and go their own ways; what is not seen says
    nothing and costs nothing.

    **Arguments:**

    - `sde`: an `AbstractSDE`, in the units of time of the tree's lengths; or one for each branch
      with `per_edge=("sde",)`, every array with an axis `(num_nodes - 1,)` in front, in the order
      of `tree.lengths`, as `jax.vmap` of a constructor returns it. They have one space.
    - `x0`: the state at the root, `(n, dim)` or `(n,)`; with a `root_covariance` the mean of its
      prior.
    - `root_covariance`: C of the prior N(x0, C) of the state at the root, `()`, `(n,)` (a diagonal)
      or `(n, n)`, acting on each coordinate column; left out, the root is at x0. It is
      marginalised, exactly where the SDE is linear.
    - `match`: how a node is seen, the same for all, or one for each row of data with
      `per_row=("match",)`: every array with an axis `(m,)` in front, as `jax.vmap` of a constructor
      returns it. So each row has an error of its own, or its own `mask` of an `InexactMatch`. Rows
      of one node are independent given its state: the variance of the match is then the variation
      within species.
    - `tree`: a `Tree`. Its lengths may be parameters.
    - `num_steps`: steps on each branch, one number, or `(num_nodes - 1,)` of them in the order of
      `tree.lengths`: `tree.num_steps(longest)` counts those that are in proportion to the lengths.
      1 unless given where the SDE has its exact transition (`LinearSDE`, `BrownianMotion`).
    - `t0`: the time at the root.
    - `guide`: as for `GuidedBridge`, for every branch.
    - `batch_shape`, `batched`: several trees with parts of their own, as for `DiffusionEndpoint`.

    **Shapes:** `event_shape` is `(m, ...)`, one observation for each entry of `tree.observed`; data
    come in that order by `tree.rows`. The noise has shape `(rows, k, dim)`, a row for each step,
    branches in preorder, those alone that lead to something seen. With a prior of the root ⌈n / k⌉
    rows are in front.

    For a linear SDE with the default guide the density does not depend on the noise: it is the
    likelihood.

    **Errors:** `ValueError` as for `DiffusionEndpoint`, for `IntervalCensored`, for an exact match
    of an inner node or of a node with several rows, and for a seen root that has no prior.
    """

    def __init__(
        self,
        sde: AbstractSDE,
        x0: ArrayLike,
        match: AbstractMatch,
        *,
        tree: Tree,
        num_steps: int | Sequence[int] | None = None,
        t0: RealScalar = 0.0,
        guide: AbstractGuide | None = None,
        root_covariance: ArrayLike | None = None,
        per_row: tuple[str, ...] = (),
        per_edge: tuple[str, ...] = (),
        batch_shape: tuple[int, ...] = (),
        batched: tuple[str, ...] | None = None,
        validate_args: bool | None = None,
    ):
        require_instance(
            match,
            AbstractMatch,
            "match",
            "a model of observation, such as `InexactMatch(variance)`",
        )
        match.check_density()
        x0 = as_float(x0, "x0")
        require_finite(x0, "x0")
        require_instance(sde, AbstractSDE, "sde", "an SDE, such as `LinearSDE(drift, diffusion)`")
        require_instance(tree, Tree, "tree", "a `Tree`, such as `Tree.from_newick(text)`")
        if guide is not None:
            require_instance(guide, AbstractGuide, "guide", "a guide, such as `FrozenGuide()`")
        require(
            root_covariance is not None or 0 not in tree.observed,
            "`tree` must not have its root among the seen nodes: `x0` is where it is. Give it a "
            "prior by `root_covariance`.",
        )
        require(
            any(tree.observed),
            "`tree` must have a seen node besides its root, which no branch leads to.",
        )
        prior = None
        if root_covariance is not None:
            prior = as_covariance(root_covariance, "root_covariance")
        own = names_of(per_row) or ()
        own_edges = names_of(per_edge) or ()
        require(set(own) <= {"match"}, f"`per_row` may hold 'match'; got {per_row}.")
        require(set(own_edges) <= {"sde"}, f"`per_edge` may hold 'sde'; got {per_edge}.")
        require(
            num_steps is not None or sde.has_exact_transition,
            "`num_steps` must be given, for every branch: this SDE is stepped by Euler's scheme.",
        )
        settings = _Settings(_counts(1 if num_steps is None else num_steps, tree), own, own_edges)
        batch_shape = as_shape(batch_shape, "batch_shape")
        declared = names_of(batched)
        start = as_float(t0, "t0")
        require(start.ndim == 0, f"`t0` must be one time; got shape {start.shape}.")
        parts = {
            "sde": sde,
            "x0": x0,
            "match": match,
            "guide": guide,
            "tree": tree,
            "t0": start,
            "settings": settings,
            "root_covariance": prior,
        }
        names = find_batched(parts, batch_shape, declared, _check)
        # the law of one node and one branch: what is the same on all of them is found by it
        one = _simplest(one_of(parts, names, batch_shape, (0,) * len(batch_shape)))
        datum = _examples(one)
        _check_condition(one, datum)
        # of any length: users' functions are traced on it, and only its shape counts
        ts = jnp.linspace(0.0, 1.0, settings.steps_together + 1)
        close_parts(parts, one, names, len(batch_shape), ts, own + own_edges)
        num_steps_in_all = sum(settings.num_steps[node - 1] for node in tree.active)
        columns = one["x0"].shape[1] if one["x0"].ndim == 2 else 1
        k = one["sde"].noise_size(one["x0"])
        noise_shape = (_root(one).num_rows(k) + num_steps_in_all, k, columns)
        super().__init__(
            parts,
            names,
            declared is not None,
            batch_shape,
            datum.shape,
            noise_shape,
            validate_args,
            ("t0",),
        )

    @property
    def tree(self) -> Tree:
        """The tree of the law."""
        return self.parts["tree"]

    @property
    def noise_blocks(self) -> NoiseBlocks:
        """The root, where it has a prior, and the branches that have noise, in preorder."""
        tree = self.tree
        num_steps = self.parts["settings"].num_steps
        branches = tree.active
        sizes = tuple(num_steps[node - 1] for node in branches)
        # rows in front of those of the branches, if any
        root = self._noise_shape[0] - sum(sizes)
        nodes = (0, *branches) if root else branches
        number = {node: i for i, node in enumerate(nodes)}
        # a branch at the root has the root's block above it, or none
        above = tuple(number.get(tree.parents[node], -1) for node in nodes)
        return NoiseBlocks((root, *sizes) if root else sizes, above)

    @property
    def times(self):
        """The times of `path`, `(branches, num_steps + 1)`, NaN behind the end of branches with
        fewer steps.

        With the batch axes in front where trees have their own.
        """
        if {"tree", "t0"}.isdisjoint(self._batched):
            return _times(self.parts)
        return self._over_batch(_times, self._full_shape)

    def log_prob_by_node(self, observed):
        """For each seen node a log likelihood of what is seen there, `(m,)` behind a batch, for
        leave-one-out.

        With S the states that a tip s does not lead to, z_s the noise of its branch and ψ_s the
        branch's term of `log_prob`, the joint density of parameters, states, noise and data is

            p(θ, S, other data) N(z_s; 0, I) exp ψ_s(z_s, S),    ∫ N(z_s; 0, I) exp ψ_s dz_s = p(v_s
            | S, θ),

        whatever the guide made of the noise of other branches, since they enter by their states. So
        the posterior mean of exp(-ψ_s) is 1 / p(v_s | all other data): ψ_s is what leave-one-out
        asks for, and log p(v_s | S, θ) itself for a linear SDE. The density given the state at the
        tip, log p(v_s | x_s), has the same mean, and its inverse an infinite variance where the
        error is small beside the branch; only what is seen of a node that leads to others has that,
        since all below depends on the state.
        """
        return self._log_prob_by(_by_node, (len(set(self.tree.observed)),), observed)

    def problem(self, observed, name: str = "observed") -> TreeProblem:
        """What is weighed, of one tree, for `scores.fit_tree`; `name` is that of `observed` in
        errors.
        """
        require(
            self.shape() == self.event_shape and not self._moved,
            f"`law` must be of one tree; it has batch shape {self._full_shape}.",
        )
        observed = as_datum(observed, name)
        self._check_value(observed, name)
        return _problem(self.parts, jnp.broadcast_to(observed, self.shape()))

    def path(self, observed):
        """Paths to `observed` that the bound noise drives, batch axes and then `(branches,
        num_steps + 1, n, dim)`.

        Branches in preorder, those that lead to something seen; the first state of each is the last
        of its parent's. NaN behind the end of a branch with fewer steps than others, and where the
        law is masked.
        """
        return self._paths_to(observed, _paths)

    def nodes(self, observed):
        """States of all nodes of the tree, given `observed` and the bound noise: ancestors among
        them.

        Batch axes and then `(num_nodes, n, dim)`, `(num_nodes, n)` for vector states, in the order
        of `tree.names`: the root first, node i at i. Nodes that lead to nothing seen have no noise
        and are NaN, all where the law is masked.
        """
        return self._paths_to(observed, _nodes)

    @staticmethod
    def _observe(parts, key):
        return _simulated(parts, key)[0]

    @staticmethod
    def _simulate(parts, key):
        seen, paths = _simulated(parts, key)
        # `_simulated` has split the key: folding in another number gives a third one
        noise = _problem(parts, seen).noise_from_paths(paths, jr.fold_in(key, 2))
        columns = parts["x0"].shape[1] if parts["x0"].ndim == 2 else 1
        return seen, noise.reshape(len(noise), -1, columns)

    @staticmethod
    def _log_weight(parts, value, noise):
        return _problem(parts, value).log_weight(_driving(parts, noise))

    @staticmethod
    def _log_weights(parts, value, noise):
        # the sweep has a term for each piece of a branch: blocks are whole branches
        terms = _problem(parts, value).log_weights(_driving(parts, noise))
        tree = parts["tree"]
        pieces = parts["settings"].pieces
        active = np.array(tree.active)
        branch = np.repeat(np.arange(len(active)), pieces[active - 1])
        root = len(terms) - len(branch)  # 1 where it has a prior
        block = np.concatenate([np.zeros(root, int), root + branch])
        return jnp.zeros((root + len(active),), terms.dtype).at[block].add(terms)

    @staticmethod
    def _placeholder(parts, value):
        # data that the law itself could have drawn, so that no weight is extreme
        return _simulated(parts, jr.key(0))[0].astype(value.dtype)

    @staticmethod
    def _check_data(parts, values):
        """Row by row, each by its own match where they have some."""
        own = "match" in parts["settings"].per_row
        for i, row in enumerate(np.swapaxes(values, 0, 1)):
            match = jax.tree.map(lambda a, i=i: a[i], parts["match"]) if own else parts["match"]
            for value in row:
                match.at(value)


def _counts(num_steps, tree: Tree) -> tuple[int, ...]:
    """Of each branch."""
    count = tree.num_nodes - 1
    several = isinstance(num_steps, (list, tuple)) or getattr(num_steps, "ndim", 0) > 0
    if several:
        return positive_integers(num_steps, "num_steps", count, "branches")
    return (positive_integer(num_steps, "num_steps"),) * count


def _examples(parts) -> Array:
    """Data for what is known before there are any; `parts` of the law of a node and a branch."""
    one = example(parts)
    return jnp.broadcast_to(one, (len(parts["tree"].observed), *one.shape))


def _simplest(parts):
    """The parts of the law of one node and one branch."""
    own = parts["settings"].per_row + parts["settings"].per_edge
    return {name: _first(part) if name in own else part for name, part in parts.items()}


def _first(part):
    return jax.tree.map(lambda a: a[0] if eqx.is_array(a) else a, part)


def _check(parts):
    """Raises unless the parts make one law."""
    tree = parts["tree"]
    settings = parts["settings"]
    for name in settings.per_row:
        _check_axis(parts[name], len(tree.observed), f"`{name}` is in `per_row`", "row of data")
    for name in settings.per_edge:
        _check_axis(parts[name], tree.num_nodes - 1, f"`{name}` is in `per_edge`", "branch")
        for value in map(concrete, jax.tree.leaves(parts[name].space)):
            require(
                value is None or np.all(value == value[:1]),
                f"`{name}` must have one space on all branches.",
            )
    check_law(_simplest(parts))
    prior = parts["root_covariance"]
    n = parts["x0"].shape[0]
    require(
        prior is None or prior.ndim == 0 or prior.shape[0] == n,
        f"`root_covariance` must be a number, ({n},) or ({n}, {n}), as the state has {n} rows; got "
        f"{words(prior)}.",
    )


def _check_axis(part, size, why, what):
    leaves = [leaf for leaf in jax.tree.leaves(part) if eqx.is_array(leaf)]
    require(len(leaves) > 0, f"{why}, and has no array to have one for each {what}: leave it out.")
    for leaf in leaves:
        require(
            leaf.ndim > 0 and leaf.shape[0] == size,
            f"{why}, so every array of it must have {size} rows, one for each {what}; got shape "
            f"{leaf.shape}. Build it by `jax.vmap`.",
        )


def _check_condition(parts, datum):
    tree = parts["tree"]
    condition = parts["match"].at(datum[0])
    # a set draws its target before the first step, when the state at the branch's start is known;
    # the sweep needs the target on its way up
    require(
        condition.num_extra_noises == 0 or condition.is_approximated,
        "`match` must see a value at each node, such as `InexactMatch(variance)`: branches are not "
        "led to sets.",
    )
    if not (condition.exact or condition.is_approximated):
        return
    twice = len(tree.observed) - len(set(tree.observed))
    require(
        not twice,
        f"`match` must have a Gaussian error where nodes have several rows, and {twice} rows are "
        "of nodes that have one already: use an `InexactMatch`, of the variance within species.",
    )
    # a pinned inner node would need the last step of its branch to be that of an end
    inner = [node for node in tree.observed if node not in tree.tips]
    require(
        not (condition.exact and inner),
        f"`match` must have an error where inner nodes are seen, and {len(inner)} of the seen "
        "nodes are no tips: use an `InexactMatch` of a small variance.",
    )


def _problem(parts, value) -> TreeProblem:
    """What is weighed."""
    return _unled(parts, value).anchored(parts["t0"])


def _unled(parts, value) -> TreeProblem:
    match = parts["match"]
    x0 = parts["x0"]
    tree = _divided(parts)
    settings = parts["settings"]
    sde = parts["sde"]
    sdes = None
    if "sde" in settings.per_edge:
        # a piece has the SDE of its branch
        pieces = settings.pieces
        branch = np.repeat(np.arange(len(pieces)), pieces)
        sdes = jax.tree.map(lambda a: a[branch] if eqx.is_array(a) else a, sde)
        sde = _first(sde)
    own = "match" in settings.per_row
    # `observed` is sorted, so that the rows of a node are neighbours
    sizes = tuple(Counter(tree.observed).values())
    if max(sizes) > 1:
        conditions = fused(match, value, sizes, own, sde, x0)
    else:
        at = jax.vmap(lambda match, v: match.at(v), in_axes=(0 if own else None, 0))
        conditions = at(match, value)
    if conditions.is_approximated:
        conditions = _anchored(parts, sde, tree, conditions)
    guide = parts["guide"]
    root = _root(parts)
    if _is_flat(parts):
        # the guide is that of the SDE itself: of the flattened one the default might be another
        guide = default_guide(sde, x0) if guide is None else guide
        dim = x0.shape[1]
        sde, sdes = (s if s is None else Flattened(s, dim) for s in (sde, sdes))
        factor = root.factor if root.factor is None else for_every_column(root.factor, dim)
        root = Root(x0.reshape(-1), factor, x0.reshape(-1))
    num_steps = settings.steps_together
    return TreeProblem.of(sde, guide, root, tree, conditions, num_steps, parts["t0"], sdes)


def _anchored(parts, sde: AbstractSDE, tree: Tree, conditions):
    """Conditions approximated near where a Brownian motion would be at each node, to lead paths."""
    x0 = parts["x0"]
    prior = parts["root_covariance"]
    n = x0.shape[0]
    # of x after a time t since the root: mean x0, covariance C + t a(x0)
    a = promote(sde.covariance(parts["t0"], x0), 2, n)
    at_root = jnp.zeros_like(a)
    if prior is not None:
        at_root = promote(symmetric(prior).astype(x0.dtype), 2, n)

    def anchored(condition, depth):
        return condition.anchored(sde, lambda: (x0, at_root + depth * a))

    # each node once, as the conditions are
    nodes = np.array(list(dict.fromkeys(tree.observed)))
    return jax.vmap(anchored)(conditions, tree.depths[nodes])


def _is_flat(parts) -> bool:
    """Whether what is computed has states that are those of the law, flattened."""
    # a user's density couples the columns of a state, which a map on the first axis cannot hold
    return isinstance(parts["match"], AbstractDensityMatch) and parts["x0"].ndim == 2


def _unflat(parts, states):
    """States as the law has them."""
    return states.reshape(*states.shape[:-1], *parts["x0"].shape) if _is_flat(parts) else states


def _divided(parts) -> Tree:
    """The tree with branches that all have the same number of steps."""
    pieces = parts["settings"].pieces
    return parts["tree"].divided(pieces) if np.any(pieces > 1) else parts["tree"]


def _along(parts, by_piece):
    """From `(pieces, steps together + 1, ...)`, at the states of pieces, to whole branches."""
    settings = parts["settings"]
    active = np.array(parts["tree"].active)
    together = settings.steps_together
    counts = np.array(settings.num_steps)[active - 1]
    pieces = settings.pieces[active - 1]
    first = np.cumsum(pieces) - pieces
    # the last state of a piece is the first of the next: of both it is taken once
    state = np.arange(max(counts) + 1)
    piece = np.maximum(state - 1, 0) // together  # that it is in or at the end of
    inside = state <= counts[:, None]
    # behind a branch's end any entry will do, and is NaN in the end
    found = by_piece[np.where(inside, first[:, None] + piece, 0), state - together * piece]
    return jnp.where(inside.reshape(inside.shape + (1,) * (found.ndim - 2)), found, jnp.nan)


def _root(parts) -> Root:
    return Root.of(parts["x0"], parts["root_covariance"])


def _driving(parts, noise):
    """Noise as the sweep takes it: a vector state has no columns."""
    if _is_flat(parts):
        return noise.reshape(len(noise), -1)
    return noise[..., 0] if parts["x0"].ndim == 1 else noise


def _by_node(parts, value, noise):
    return _problem(parts, value).log_likelihoods(_driving(parts, noise))


def _times(parts):
    tree = _divided(parts)
    starts = parts["t0"] + tree.depths[np.array(tree.parents)[list(tree.active)]]
    return _along(parts, starts[:, None] + _without_data(parts).grids)


def _without_data(parts) -> TreeProblem:
    """The problem of some data: for what does not depend on them."""
    return _unled(parts, _examples(_simplest(parts)).astype(parts["x0"].dtype))


def _paths(parts, value, noise):
    return _along(parts, _unflat(parts, _problem(parts, value).paths(_driving(parts, noise))))


def _nodes(parts, value, noise):
    problem = _problem(parts, value)
    paths = problem.paths(_driving(parts, noise))
    states = _unflat(parts, problem.at_nodes(paths))
    # of the nodes of the divided tree those that the tree has
    return states[np.concatenate([[0], np.cumsum(parts["settings"].pieces)])]


def _simulated(parts, key):
    """What is seen, and the paths of the branches that lead to it."""
    key_path, key_seen = jr.split(key)
    tree = _divided(parts)
    match = parts["match"]
    own = parts["settings"].per_row
    # in the problem's states, which may be flattened, so that paths can be led back by it
    problem = _without_data(parts)
    sde = problem.sde
    x0 = problem.x0
    paths = problem.simulate(jr.normal(key_path, problem.noise_shape, x0.dtype))
    # one state for each row: rows of one node have the same, and errors of their own
    ends = _unflat(parts, problem.at_nodes(paths)[np.array(tree.observed)])
    sde = parts["sde"] if "sde" not in parts["settings"].per_edge else _first(parts["sde"])
    keys = jr.split(key_seen, len(ends))
    draw = jax.vmap(
        lambda match, key, x: match.sample(key, sde, x),
        in_axes=(0 if "match" in own else None, 0, 0),
    )
    return draw(match, keys, ends), paths
