"""A rooted tree: topology and names are fixed, the lengths of its branches are parameters."""

import difflib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from os import PathLike
from typing import Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._checks import (
    as_float,
    concrete,
    flag,
    known_float,
    known_number,
    positive_integer,
    positive_integers,
    require,
    require_instance,
    words,
)
from ._newick import parse
from ._schedule import schedule


@runtime_checkable
class Named(Protocol):
    """A `Specimen`: landmarks and an identifier."""

    @property
    def id(self) -> str | None: ...

    @property
    def landmarks(self) -> np.ndarray: ...


class Tree(eqx.Module):
    """A rooted tree with a time along every branch.

    Nodes are numbered in preorder, the root being 0 and children in the order in which they were
    given. A process starts at the root: if there is time before the first split, the root has one
    child.

    - `parents`: for each node the number of its parent, −1 for the root.
    - `lengths`: `(num_nodes - 1,)`, that of the branch above node i at i − 1, in the units of time
      of the SDE. They are an array leaf, so that a prior on branch lengths or a clock is ordinary
      NumPyro: `tree.scaled(rates)`, `tree.with_lengths(lengths)`.
    - `names`: for each node its name, or `None`.
    - `observed`: numbers of the nodes that are seen, in preorder, one for each row of data: the
      tips unless said otherwise, see `observing`. A node of which there are several specimens is
      there as often.

    Made by `from_newick`, `from_parents`, `chain` and `star`.
    """

    lengths: Float[Array, " nodes-1"]
    parents: tuple[int, ...] = eqx.field(static=True)
    names: tuple[str | None, ...] = eqx.field(static=True)
    observed: tuple[int, ...] = eqx.field(static=True)

    def __init__(
        self,
        parents: Sequence[int],
        lengths: ArrayLike,
        names: Sequence[str | None] | None = None,
        observed: Sequence[int] | None = None,
    ):
        # parents first: all else is checked against the number of nodes
        self.parents = _as_parents(parents)
        self.names = _as_names(names, self.num_nodes)
        self.lengths = as_float(lengths, "lengths")
        self._check_lengths()
        self.observed = self.tips if observed is None else _as_observed(observed, self.num_nodes)

    def _check_lengths(self) -> None:
        shape = (self.num_nodes - 1,)
        require(
            self.lengths.shape == shape,
            f"`lengths` must be one for each branch, {shape}, that of the branch above node i at "
            f"i − 1; got shape {self.lengths.shape}.",
        )
        value = concrete(self.lengths)
        # traced lengths cannot be looked at
        if value is None:
            return
        bad = np.flatnonzero(~(np.isfinite(value) & (value >= 0)))
        if bad.size:
            node = int(bad[0]) + 1
            raise ValueError(
                "`lengths` must be finite and at least 0; the branch above "
                f"{self._in_words(node)} has {value[bad[0]]}. A length of 0 is a node that is "
                "where its parent is."
            )

    @classmethod
    def from_parents(
        cls,
        parents: Sequence[int],
        lengths: ArrayLike,
        names: Sequence[str | None] | None = None,
        observed: Sequence[int] | None = None,
    ) -> "Tree":
        """From nodes in any order.

        **Arguments:** `parents`: for each node the number of its parent, −1 for the root;
        `lengths`: for each node that of the branch above it, that of the root being ignored;
        `names`, `observed`: as of the class, by the same numbers.
        """
        order = _preorder(parents)
        place = {node: i for i, node in enumerate(order)}
        lengths = as_float(lengths, "lengths")
        require(
            lengths.shape == (len(order),),
            f"`lengths` must be one for each node, ({len(order)},), any number for the root; got "
            f"shape {lengths.shape}.",
        )
        own = _as_names(names, len(order))
        seen = None
        if observed is not None:
            seen = [place[node] for node in _as_observed(observed, len(order))]
        place[-1] = -1  # the parent of the root
        above = [place[int(parents[node])] for node in order]
        return cls(above, lengths[np.array(order[1:], int)], [own[node] for node in order], seen)

    @classmethod
    def from_newick(
        cls,
        source: str | PathLike,
        *,
        index: int | None = None,
        preserve_underscores: bool = True,
        unit_lengths: bool = False,
    ) -> "Tree":
        """From Newick or NEXUS text, or a file of it.

        Annotations in brackets are skipped, numbers in place of the names of inner nodes are
        supports and skipped too. A length at the root is time before the first split: the root then
        has one child.

        **Arguments:**

        - `source`: text, or a path.
        - `index`: which of several trees, from 0 on.
        - `preserve_underscores`: whether `Mus_musculus` without quotes is kept as it is written, or
          is `Mus musculus`, as the Newick standard has it.
        - `unit_lengths`: whether every branch has the length 1, whatever is written.

        **Errors:** `ValueError` with line and column of what is no Newick, and for missing and
        negative lengths, names that are given twice, and several trees without an `index`.
        """
        flag(unit_lengths, "unit_lengths")
        parents, lengths, names = parse(
            source, index, flag(preserve_underscores, "preserve_underscores")
        )
        if lengths[0]:  # the process starts before the first split
            parents = [-1, *(parent + 1 for parent in parents)]
            lengths = [0.0, *lengths]
            names = [None, *names]
        if unit_lengths:
            lengths = [1.0] * len(parents)
        # a tree of the topology alone, for its words: messages call a node by what is below it
        tree = cls(parents, np.ones(len(parents) - 1), names)
        missing = [node for node, length in enumerate(lengths) if length is None and node > 0]
        require(
            not missing,
            "every branch must have a length, since it is a time; the one above "
            f"{tree._in_words(missing[0]) if missing else ''} has none, {len(missing)} in all. "
            "Write them, or ask for `unit_lengths=True`.",
        )
        return cls(parents, np.array(lengths[1:], float), names)

    @classmethod
    def chain(cls, times: ArrayLike, names: Sequence[str | None] | None = None) -> "Tree":
        """A time series: nodes in a row, at `times` `(m,)` since the root, all of them seen."""
        times = _as_vector(times, "times")
        value = concrete(times)
        require(
            value is None or bool(np.all(np.diff(value, prepend=0.0) >= 0)),
            f"`times` must not decrease, from 0 at the root on; got {value}. Sort the data by "
            "time.",
        )
        count = times.size
        own = None if names is None else [None, *_as_names(names, count)]
        steps = jnp.diff(times, prepend=jnp.zeros((1,), times.dtype))
        return cls(range(-1, count), steps, own, range(1, count + 1))

    @classmethod
    def star(cls, lengths: ArrayLike, names: Sequence[str | None] | None = None) -> "Tree":
        """Tips that share the root and nothing else, at `lengths` `(m,)` from it."""
        lengths = _as_vector(lengths, "lengths")
        own = None if names is None else [None, *_as_names(names, lengths.size)]
        return cls([-1] + [0] * lengths.size, lengths, own)

    @property
    def num_nodes(self) -> int:
        return len(self.parents)

    @property
    def tips(self) -> tuple[int, ...]:
        """Numbers of the nodes without children."""
        inner = set(self.parents)
        return tuple(i for i in range(len(self.parents)) if i not in inner)

    @property
    def active(self) -> tuple[int, ...]:
        """Nodes but the root that lead to something seen: those whose branches have noise."""
        return schedule(self.parents, self.observed).active

    @property
    def observed_names(self) -> tuple[str | None, ...]:
        """Names of the nodes that are seen, in the order of the rows of data."""
        return tuple(self.names[i] for i in self.observed)

    @property
    def depths(self) -> Float[Array, " nodes"]:
        """For each node the time since the root."""
        # A cumulative sum from the root would be a loop over nodes. Pointer jumping takes log₂ as
        # many steps: each time twice as many branches are summed.
        depths = jnp.concatenate([jnp.zeros((1,), self.lengths.dtype), self.lengths])
        jump = np.maximum(self.parents, 0)
        for _ in range(int(np.ceil(np.log2(self.num_nodes)))):
            depths = depths + jnp.where(jump > 0, depths[jump], 0.0)
            jump = jump[jump]
        return depths

    @property
    def height(self) -> Float[Array, ""]:
        """The largest depth."""
        return jnp.max(self.depths)

    @property
    def ages(self) -> Float[Array, " nodes"]:
        """For each node the time before the latest one: 0 for tips of the present."""
        depths = self.depths
        return jnp.max(depths) - depths

    def _lineage(self, node: int) -> list[int]:
        """The node, its parent, and so on to the root."""
        lineage = [node]
        while lineage[-1] > 0:
            lineage.append(self.parents[lineage[-1]])
        return lineage

    def _end(self, node: int) -> int:
        """The number after the last node below a node: a subtree is one block."""
        end = node + 1
        while end < self.num_nodes and self.parents[end] >= node:
            end += 1
        return end

    def _in_words(self, node: int) -> str:
        """A node in words: by its name, or by tips below it."""
        name = self.names[node]
        if name is not None:
            return f"`{name}`"
        below = [self.names[tip] or str(tip) for tip in self.tips if node <= tip < self._end(node)]
        some = ", ".join(below[:3]) + (", ..." if len(below) > 3 else "")
        return f"node {node}, which leads to {some}"

    def with_lengths(self, lengths: ArrayLike) -> "Tree":
        """The same tree with other lengths, `(num_nodes - 1,)`."""
        return Tree(self.parents, lengths, self.names, self.observed)

    def scaled(self, rates: ArrayLike) -> "Tree":
        """Every length times a rate: a number, or `(num_nodes - 1,)` in the order of `lengths`."""
        rates = as_float(rates, "rates")
        require(
            rates.shape in ((), self.lengths.shape),
            f"`rates` must be one number, or one for each branch, {self.lengths.shape}; got shape "
            f"{rates.shape}. `tree.clade(...)` says which branches belong to a clade.",
        )
        require(
            jnp.all(jnp.isfinite(rates) & (rates >= 0)),
            f"`rates` must be finite and at least 0; got {words(concrete(rates))}. Lengths are "
            "times.",
        )
        return self.with_lengths(self.lengths * rates)

    def clade(self, *names: str, stem: bool = True) -> np.ndarray:
        """Which branches `(num_nodes - 1,)` lie below the last common ancestor of some nodes, as
        booleans.

        `stem`: whether the branch that leads to the ancestor is one of them.

            rates = jnp.where(tree.clade("Papilio ulysses", "Papilio polytes"), fast, slow)
        """
        numbers = [self._number(name) for name in names]
        require(
            len(numbers) > 0,
            "`names` must hold at least one name, of a node in the clade; got none.",
        )
        # in preorder the last common ancestor has the largest number, and a subtree is one block
        lineages = [set(self._lineage(node)) for node in numbers]
        ancestor = max(set.intersection(*lineages))
        first = ancestor if flag(stem, "stem") else ancestor + 1
        nodes = np.arange(1, self.num_nodes)
        return (nodes >= first) & (nodes < self._end(ancestor))

    def _number(self, name: str) -> int:
        if not isinstance(name, str) or name not in self.names:
            text = name if isinstance(name, str) else ""
            near = difflib.get_close_matches(text, self._known_names, n=3)
            hint = f" Near it: {', '.join(map(repr, near))}." if near else ""
            raise ValueError(
                f"`names` must be names of nodes of the tree; it has no {words(name)}.{hint}"
            )
        return self.names.index(name)

    @property
    def _known_names(self) -> list[str]:
        return [name for name in self.names if name is not None]

    def observing(self, names: Iterable[str]) -> "Tree":
        """The same tree of which the nodes of these names are seen, tips, inner nodes or fossils.

        What is not seen costs nothing and says nothing: a tip without data need not be pruned. A
        name that is given several times is a node of which there are as many rows of data, such as
        specimens of a species.
        """
        observed = [self._number(name) for name in _several(names)]
        return Tree(self.parents, self.lengths, self.names, observed)

    def pruned(self, names: Iterable[str]) -> "Tree":
        """The tree of these tips alone: branches that meet without a split become one.

        Its length is the sum of theirs.
        """
        wanted = {self._number(name) for name in _several(names)}
        inner = wanted - set(self.tips)
        require(
            not inner,
            f"`names` must be those of tips; {', '.join(self._in_words(i) for i in sorted(inner))} "
            "is no tip.",
        )
        needed = sorted(set().union(*(self._lineage(node) for node in wanted)))
        children = Counter(self.parents[node] for node in needed[1:])
        # the root stays, even with one child: the process starts there
        kept = [node for node in needed if node == 0 or node in wanted or children[node] > 1]
        place = {node: i for i, node in enumerate(kept)}
        parents = [-1]
        branches = []
        owners = []
        for node in kept[1:]:
            owner = place[node]
            above = node
            # all branches on the way up to the next kept node are one: a sum of lengths, which
            # may be traced, so that only numbers of branches are collected here
            while above == node or above not in place:
                branches.append(above - 1)
                owners.append(owner - 1)
                above = self.parents[above]
            parents.append(place[above])
        lengths = jnp.zeros((len(kept) - 1,), self.lengths.dtype)
        lengths = lengths.at[np.array(owners)].add(self.lengths[np.array(branches)])
        return Tree(parents, lengths, [self.names[node] for node in kept])

    def num_steps(self, longest: float, multiple: int = 2) -> tuple[int, ...]:
        """How many steps of equal length each branch needs so that none is longer, for
        `DiffusionTree(num_steps=)`.

        Numbers are multiples of `multiple`: branches are led in pieces of that many steps, and
        fewer pieces are faster.
        """
        longest = known_number(longest, "longest", "a positive number", lambda value: value > 0)
        multiple = positive_integer(multiple, "multiple")
        lengths = concrete(self.lengths)
        if lengths is None:
            raise ValueError(
                "`tree` must have lengths that are known, since programs have fixed numbers of "
                "steps; these are traced. Count the steps outside of the model, on a tree of "
                "typical lengths."
            )
        pieces = np.ceil(lengths / (multiple * longest) * (1 - 1e-9))  # not one more for rounding
        return tuple(int(multiple * max(count, 1)) for count in pieces)

    def divided(self, pieces: Sequence[int]) -> "Tree":
        """The same tree with its branches divided into equal pieces, `(num_nodes - 1,)` numbers of
        them.

        The nodes between are not seen and have no names. Node i becomes node `sum(pieces[:i])`.
        """
        counts = np.array(positive_integers(pieces, "pieces", self.num_nodes - 1, "branches"))
        # where nodes are now: the pieces of a branch come before its node, so preorder stays
        place = np.concatenate([[0], np.cumsum(counts)])
        parents = np.arange(-1, place[-1])  # a piece begins where the one before it ends
        # or, the first, where the branch does
        parents[1 + place[:-1]] = place[np.array(self.parents[1:], int)]
        names: list[str | None] = [None] * len(parents)
        for node, name in enumerate(self.names):
            names[place[node]] = name
        branch = np.repeat(np.arange(len(counts)), counts)
        lengths = (self.lengths / counts.astype(self.lengths.dtype))[branch]
        return Tree(parents, lengths, names, [int(place[node]) for node in self.observed])

    def rows(
        self,
        data: Mapping[str, ArrayLike] | Iterable[Named] | ArrayLike,
        names: Sequence[str] | None = None,
    ) -> np.ndarray:
        """Data in the order of the rows of `obs=`, `(len(observed), ...)`, matched by name.

        Rows of one node keep the order in which they were given.

        **Arguments:** `data`: `Specimen`s, by their `id`, or an array `(m, ...)` with its `names`;
        or arrays by name, that of a node with several rows having an axis of them in front.

        **Errors:** `ValueError` that lists the seen nodes without data, the data without a node and
        near spellings, and for other numbers of rows than `observed` has, and shapes that differ.
        """
        unnamed = [node for node in self.observed if self.names[node] is None]
        first = self._in_words(unnamed[0]) if unnamed else ""
        require(
            not unnamed,
            f"the seen nodes must have names to find their data by; {first} has none. Give the "
            "tree `names`, or arrange the rows by `tree.observed` yourself.",
        )
        seen = Counter(name for name in self.observed_names if name is not None)
        rows = _by_name(data, names, seen)
        # by name, never by position: a file in another order would be a wrong likelihood
        require(set(rows) == set(seen), _difference(list(seen), list(rows)))
        for name, count in seen.items():
            require(
                len(rows[name]) == count,
                f"the data have {len(rows[name])} rows of {name!r}, which the tree sees {count} "
                "times. `tree.observing(names)`, with a name for each row, makes several rows of "
                "a node; or average them.",
            )
        # in the order of `observed`, of which the counter has kept that of the names
        named = [(name, known_float(row, f"data['{name}']")) for name in seen for row in rows[name]]
        values = [value for _, value in named]
        odd = [(name, value.shape) for name, value in named if value.shape != values[0].shape]
        require(
            not odd,
            f"`data` must have one shape; {named[0][0]!r} has {values[0].shape} and "
            f"{odd[0][0] if odd else ''!r} has {odd[0][1] if odd else ''}.",
        )
        return np.stack(values)


def _as_vector(values: ArrayLike, name: str) -> Array:
    array = as_float(values, name)
    require(
        array.ndim == 1 and array.size > 0,
        f"`{name}` must be a vector, one number for each node but the root; got shape "
        f"{array.shape}.",
    )
    return array


def _as_parents(parents: Sequence[int]) -> tuple[int, ...]:
    """Numbers in preorder: each parent comes before its children, and a subtree is one block."""
    # the preorder of a tree in preorder is that which it has
    numbers = _preorder(parents)
    require(
        numbers == list(range(len(numbers))),
        "`parents` must be in preorder: the root first, each subtree in one block. "
        "`Tree.from_parents` takes nodes in any order.",
    )
    return tuple(int(parent) for parent in parents)


def _preorder(parents: Sequence[int]) -> list[int]:
    """Numbers of the nodes in preorder, children as they come; `ValueError` for what is no tree."""
    array = known_float(parents, "parents")
    count = array.size
    require(
        array.ndim == 1 and count > 1,
        "`parents` must be a vector, the number of the parent of each of at least two nodes; got "
        f"{words(parents)}.",
    )
    whole = (array == np.round(array)) & (array >= -1) & (array < count)
    require(
        bool(whole.all()),
        f"`parents` must be numbers of nodes, from 0 to {count - 1}, or −1 for the root; got "
        f"{array[~whole][:5]}.",
    )
    numbers = array.astype(int)
    roots = np.flatnonzero(numbers == -1)
    require(roots.size == 1, f"`parents` must have one root, of parent −1; got {roots.size}.")
    children: list[list[int]] = [[] for _ in range(count)]
    for node, parent in enumerate(numbers):
        if parent >= 0:
            children[parent].append(node)
    # a stack, since a recursion has no room for a chain of a thousand nodes
    order = []
    waiting = [int(roots[0])]
    while waiting:
        node = waiting.pop()
        order.append(node)
        waiting.extend(reversed(children[node]))
    # each node has one parent: what the root does not lead to is a circle
    lost = sorted(set(range(count)) - set(order))
    require(
        not lost, f"`parents` must lead to the root; those of the nodes {lost[:5]} run in a circle."
    )
    return order


def _as_names(names: Sequence[str | None] | None, count: int) -> tuple[str | None, ...]:
    if names is None:
        return (None,) * count
    several = isinstance(names, Iterable) and not isinstance(names, (str, bytes))
    own = tuple(names) if several else ()  # a text is iterable, and no list of names
    require(
        len(own) == count,
        f"`names` must be one for each of {count} nodes, None where there is none; got "
        f"{words(names)}.",
    )
    bad = [name for name in own if not (name is None or isinstance(name, str))]
    require(not bad, f"`names` must be texts, or None; got {words(bad[0]) if bad else ''}.")
    twice = [name for name, number in Counter(own).items() if number > 1 and name is not None]
    require(
        not twice,
        f"`names` must differ; {', '.join(map(repr, twice[:5]))} is given more than once.",
    )
    return own


def _as_observed(observed: Sequence[int], count: int) -> tuple[int, ...]:
    numbers = known_float(observed, "observed")
    good = numbers.ndim == 1 and numbers.size > 0
    require(
        good and bool(np.all((numbers == np.round(numbers)) & (numbers >= 0) & (numbers < count))),
        f"`observed` must be numbers of nodes, from 0 to {count - 1}; got {words(observed)}.",
    )
    return tuple(int(i) for i in np.sort(numbers))


def _several(names: Iterable[str]) -> list[str]:
    """At least one name, in a list."""
    several = isinstance(names, Iterable) and not isinstance(names, (str, bytes))
    own = list(names) if several else []
    require(len(own) > 0, f"`names` must be a list of names; got {words(names)}.")
    return own


def _by_name(data, names, seen: Counter[str]) -> dict[str, list]:
    """The rows of each name."""
    if isinstance(data, Mapping):
        require(names is None, "`names` belong to an array; `data` is a mapping by name.")
        return {
            name: _rows_of(data[name], name) if seen[name] > 1 else [data[name]] for name in data
        }
    if names is None:
        specimens = list(data) if isinstance(data, Iterable) else []
        for i, specimen in enumerate(specimens):
            require_instance(specimen, Named, f"data[{i}]", "a `Specimen`; an array needs `names=`")
        require(
            len(specimens) > 0,
            "`data` must be arrays by name, `Specimen`s, or an array with `names=`; got "
            f"{words(data)}.",
        )
        names = [specimen.id for specimen in specimens]
        data = [specimen.landmarks for specimen in specimens]
    names = _several(names)
    # a list of specimens' landmarks stays one: `rows` says which of them has another shape
    data = data if isinstance(data, list) else known_float(data, "data")
    require(
        len(names) == len(data),
        f"`names` must be one for each row of `data`, {len(data)}; got {len(names)}.",
    )
    rows: dict[str, list] = {}
    for name, row in zip(names, data, strict=True):
        rows.setdefault(name, []).append(row)
    return rows


def _rows_of(value, name: str) -> list:
    array = known_float(value, f"data['{name}']")
    require(
        array.ndim > 0,
        f"`data['{name}']` must have an axis of rows in front, since the tree sees this node "
        f"several times; got {words(value)}.",
    )
    return list(array)


def _difference(seen: list[str], given: list[str]) -> str:
    """What is wrong with the names, both sides, and what may be meant."""
    without = sorted(set(seen) - set(given))
    unknown = sorted(map(str, set(given) - set(seen)))  # as text: specimens may have no name
    lines = ["the names of the data and those of the seen nodes must be the same."]
    if without:
        lines.append(f"Without data: {', '.join(without)}.")
    if unknown:
        lines.append(f"Without a node: {', '.join(unknown)}.")
    near = {name: difflib.get_close_matches(name, without, n=1, cutoff=0.75) for name in unknown}
    pairs = [f"{name!r} for {match[0]!r}" for name, match in near.items() if match]
    if pairs:
        lines.append(f"Perhaps {', '.join(pairs)}?")
    if any(name.replace(" ", "_") in without for name in unknown):
        lines.append(
            "The tree keeps underscores: `Tree.from_newick(..., preserve_underscores=False)` reads "
            "blanks."
        )
    if without and not unknown:
        lines.append("Tips without data are left out by `tree.observing(data)`.")
    return " ".join(lines)
