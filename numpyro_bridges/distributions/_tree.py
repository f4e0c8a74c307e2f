"""The law of what is seen of a diffusion along the branches of a tree.

`sample` simulates from the root and observes the nodes that are seen. `log_prob(v)`, with standard normal noise z
bound, is the log weight Ψ of guided paths along all branches (`trees/_sweep.py`), so that

    E[exp log_prob(v | z)] = p(v | x0),    z ~ N(0, I).

A bridge is the tree with one branch, a time series is a chain.
"""

from collections import Counter

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import ArrayLike

from .._checks import as_float, positive_integer, require, require_finite, require_instance, words
from .._types import RealScalar, State
from ..conditioning import AbstractMatch, fused
from ..guiding import AbstractGuide
from ..sdes import AbstractSDE, as_covariance
from ..trees import Root, Tree, TreeProblem, schedule
from ._batch import as_shape, find_batched, one_of
from ._endpoint import check_law, close_parts, names_of, seen_shape
from ._noise_driven import AbstractNoiseDriven


class _Settings(eqx.Module):
    """What is known of a law before tracing."""

    num_steps: int = eqx.field(static=True)
    per_row: tuple[str, ...] = eqx.field(static=True)


class DiffusionTree(AbstractNoiseDriven):
    """The law of observations at the seen nodes of a tree, of a diffusion that starts at the root.

        law = DiffusionTree(flow, x0, InexactMatch(1e-4), tree=tree, num_steps=10)
        nb.sample("tips", law, obs=tree.rows(shapes))

    Daughters of a node start where their mother ended and go their own ways; what is not seen says nothing and costs
    nothing.

    **Arguments:**

    - `sde`: an `AbstractSDE`, in the units of time of the tree's lengths.
    - `x0`: the state at the root, `(n, dim)` or `(n,)`; with a `root_covariance` the mean of its prior.
    - `root_covariance`: C of the prior N(x0, C) of the state at the root, `()`, `(n,)` (a diagonal) or `(n, n)`, acting
      on each coordinate column; left out, the root is at x0. It is marginalised, exactly where the SDE is linear.
    - `match`: how a node is seen, the same for all, or one for each row of data with `per_row=("match",)`: every array
      with an axis `(m,)` in front, as `jax.vmap` of a constructor returns it. So each row has an error of its own, or
      its own `mask` of an `InexactMatch`. Rows of one node are independent given its state: the variance of the match
      is then the variation within species.
    - `tree`: a `Tree`. Its lengths may be parameters.
    - `num_steps`: steps on each branch; 1 unless given where the SDE has its exact transition (`LinearSDE`,
      `BrownianMotion`).
    - `t0`: the time at the root.
    - `guide`: as for `GuidedBridge`, for every branch.
    - `batch_shape`, `batched`: several trees with parts of their own, as for `DiffusionEndpoint`.

    **Shapes:** `event_shape` is `(m, ...)`, one observation for each entry of `tree.observed`; data come in that order
    by `tree.rows`. The noise has shape `(branches * num_steps, k, dim)`, branches in preorder, those alone that lead to
    something seen. With a prior of the root ⌈n / k⌉ rows are in front.

    For a linear SDE with the default guide the density does not depend on the noise: it is the likelihood.

    **Errors:** `ValueError` as for `DiffusionEndpoint`, for `IntervalCensored`, for an exact match of an inner node
    or of a node with several rows, and for a seen root that has no prior.
    """

    def __init__(
        self,
        sde: AbstractSDE,
        x0: State,
        match: AbstractMatch,
        *,
        tree: Tree,
        num_steps: int | None = None,
        t0: RealScalar = 0.0,
        guide: AbstractGuide | None = None,
        root_covariance: ArrayLike | None = None,
        per_row: tuple[str, ...] = (),
        batch_shape: tuple[int, ...] = (),
        batched: tuple[str, ...] | None = None,
        validate_args: bool | None = None,
    ):
        require_instance(match, AbstractMatch, "match", "a model of observation, such as `InexactMatch(variance)`")
        match.check_density()
        x0 = as_float(x0, "x0")
        require_finite(x0, "x0")
        require_instance(sde, AbstractSDE, "sde", "an SDE, such as `LinearSDE(drift, diffusion)`")
        require_instance(tree, Tree, "tree", "a `Tree`, such as `Tree.from_newick(text)`")
        if guide is not None:
            require_instance(guide, AbstractGuide, "guide", "a guide, such as `FrozenGuide()`")
        require(
            root_covariance is not None or 0 not in tree.observed,
            "`tree` must not have its root among the seen nodes: `x0` is where it is. Give it a prior by "
            "`root_covariance`.",
        )
        require(any(tree.observed), "`tree` must have a seen node besides its root, which no branch leads to.")
        prior = None if root_covariance is None else as_covariance(root_covariance, "root_covariance")
        own = names_of(per_row) or ()
        require(set(own) <= {"match"}, f"`per_row` may hold 'match'; got {per_row}.")
        require(
            num_steps is not None or sde.has_exact_transition,
            "`num_steps` must be given, for every branch: this SDE is stepped by Euler's scheme.",
        )
        settings = _Settings(positive_integer(1 if num_steps is None else num_steps, "num_steps"), own)
        batch_shape = as_shape(batch_shape, "batch_shape")
        declared = names_of(batched)
        start = as_float(t0, "t0")
        require(start.ndim == 0, f"`t0` must be one time; got shape {start.shape}.")
        parts = {"sde": sde, "x0": x0, "match": match, "guide": guide, "tree": tree, "t0": start, "settings": settings}
        parts["root_covariance"] = prior
        names = find_batched(parts, batch_shape, declared, _check)
        one = one_of(parts, names, batch_shape, (0,) * len(batch_shape))
        datum = jnp.zeros((len(tree.observed), *seen_shape(_of_one_node(one))))
        _check_condition(one, datum)
        close_parts(parts, one, names, len(batch_shape), jnp.linspace(0.0, 1.0, settings.num_steps + 1))
        branches = len(schedule(tree.parents, tree.observed).active)
        columns = one["x0"].shape[1] if one["x0"].ndim == 2 else 1
        k = one["sde"].noise_size(one["x0"])
        noise_shape = (_root(one).num_rows(k) + branches * settings.num_steps, k, columns)
        super().__init__(
            parts, names, declared is not None, batch_shape, datum.shape, noise_shape, validate_args, ("t0",)
        )

    @property
    def tree(self) -> Tree:
        """The tree of the law."""
        return self.parts["tree"]

    def path(self, observed):
        """Paths to `observed` that the bound noise drives, batch axes and then `(branches, num_steps + 1, n, dim)`.

        Branches in preorder, those that lead to something seen; the first state of each is the last of its parent's.
        NaN where the law is masked.
        """
        return self._paths_to(observed, _paths)

    def nodes(self, observed):
        """States of all nodes of the tree, given `observed` and the bound noise: ancestors among them.

        Batch axes and then `(num_nodes, n, dim)`, `(num_nodes, n)` for vector states, in the order of `tree.names`: the
        root first, node i at i. Nodes that lead to nothing seen have no noise and are NaN, all where the law is masked.
        """
        return self._paths_to(observed, _nodes)

    @staticmethod
    def _observe(parts, key):
        return _simulated(parts, key)[0]

    @staticmethod
    def _simulate(parts, key):
        seen, paths = _simulated(parts, key)
        noise = _problem(parts, seen).noise_from_paths(paths, jr.fold_in(key, 2))
        return seen, noise if noise.ndim == 3 else noise[..., None]

    @staticmethod
    def _log_weight(parts, value, noise):
        return _problem(parts, value).log_weight(_driving(parts, noise))

    @staticmethod
    def _placeholder(parts, value):
        return _simulated(parts, jr.key(0))[0].astype(value.dtype)

    @staticmethod
    def _check_data(parts, values):
        """Row by row, each by its own match where they have some."""
        own = "match" in parts["settings"].per_row
        for i, row in enumerate(np.swapaxes(values, 0, 1)):
            match = jax.tree.map(lambda a, i=i: a[i], parts["match"]) if own else parts["match"]
            for value in row:
                match.at(value)


def _of_one_node(parts):
    """The parts of the law of one node."""
    own = parts["settings"].per_row
    return {name: jax.tree.map(lambda a: a[0], part) if name in own else part for name, part in parts.items()}


def _check(parts):
    """Raises unless the parts make one law."""
    rows = len(parts["tree"].observed)
    for name in parts["settings"].per_row:
        for leaf in jax.tree.leaves(parts[name]):
            require(
                leaf.ndim > 0 and leaf.shape[0] == rows,
                f"`{name}` is in `per_row`, so every array of it must have {rows} rows, one for each row of data; got "
                f"shape {leaf.shape}. Build it by `jax.vmap`.",
            )
    check_law(_of_one_node(parts))
    prior, n = parts["root_covariance"], parts["x0"].shape[0]
    require(
        prior is None or prior.ndim == 0 or prior.shape[0] == n,
        f"`root_covariance` must be a number, ({n},) or ({n}, {n}), as the state has {n} rows; got {words(prior)}.",
    )


def _check_condition(parts, datum):
    tree, condition = parts["tree"], _of_one_node(parts)["match"].at(datum[0])
    require(
        condition.num_extra_noises == 0,
        "`match` must see a value at each node, such as `InexactMatch(variance)`: branches are not led to sets.",
    )
    if not condition.exact:
        return
    twice = len(tree.observed) - len(set(tree.observed))
    require(
        not twice,
        f"`match` must have an error where nodes have several rows, and {twice} rows are of nodes that have one "
        "already: use an `InexactMatch`, of the variance within species.",
    )
    inner = [node for node in tree.observed if node not in tree.tips]
    require(
        not inner,
        f"`match` must have an error where inner nodes are seen, and {len(inner)} of the seen nodes are no tips: use "
        "an `InexactMatch` of a small variance.",
    )


def _problem(parts, value) -> TreeProblem:
    """What is weighed."""
    return _unled(parts, value).anchored(parts["t0"])


def _unled(parts, value) -> TreeProblem:
    match, sde, x0, tree = parts["match"], parts["sde"], parts["x0"], parts["tree"]
    own, steps = "match" in parts["settings"].per_row, parts["settings"].num_steps
    sizes = tuple(Counter(tree.observed).values())
    if max(sizes) > 1:
        conditions = fused(match, value, sizes, own, sde, x0)
    else:
        conditions = jax.vmap(lambda match, v: match.at(v), in_axes=(0 if own else None, 0))(match, value)
    return TreeProblem.of(sde, parts["guide"], _root(parts), tree, conditions, steps, parts["t0"])


def _root(parts) -> Root:
    return Root.of(parts["x0"], parts["root_covariance"])


def _driving(parts, noise):
    """Noise as the sweep takes it: a vector state has no columns."""
    return noise[..., 0] if parts["x0"].ndim == 1 else noise


def _paths(parts, value, noise):
    return _problem(parts, value).paths(_driving(parts, noise))


def _nodes(parts, value, noise):
    problem = _problem(parts, value)
    return problem.at_nodes(problem.paths(_driving(parts, noise)))


def _simulated(parts, key):
    """What is seen, and the paths of the branches that lead to it."""
    key_path, key_seen = jr.split(key)
    tree, sde, match, own = parts["tree"], parts["sde"], parts["match"], parts["settings"].per_row
    blank = jnp.zeros((len(tree.observed), *seen_shape(_of_one_node(parts))), parts["x0"].dtype)
    problem = _unled(parts, blank)
    x0 = problem.x0
    shape = (problem.num_noises, sde.noise_size(x0), *x0.shape[1:])
    paths = problem.simulate(jr.normal(key_path, shape, x0.dtype))
    ends = problem.at_nodes(paths)[np.array(tree.observed)]
    keys = jr.split(key_seen, len(ends))
    draw = jax.vmap(lambda match, key, x: match.sample(key, sde, x), in_axes=(0 if "match" in own else None, 0, 0))
    return draw(match, keys, ends), paths
