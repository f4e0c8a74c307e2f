"""In which order a tree's branches are walked, and where what is still needed is kept meanwhile.

Children are visited before their parents on the way up, after them on the way down, the largest subtree last on the way
down and so first on the way up. A node is then needed no more when its last subtree begins, and at most log₂(number of
nodes) of them are kept at a time: memory and derivatives cost no more than the branches, whatever the shape.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


class Schedule(NamedTuple):
    """Static numbers. *Ends* are nodes on which nothing that is seen hangs any more, *inner* ones the others."""

    ends: tuple[int, ...]
    """Nodes at the ends, in preorder."""
    inner: tuple[int, ...]
    """Inner nodes but the root, in the order of the way down."""
    active: tuple[int, ...]
    """Nodes but the root that have something seen below or at them, in preorder: those that have noise."""
    num_slots: int
    slot: tuple[int, ...]
    """For each node of `inner` where its state is kept, `num_slots` where nothing inner hangs on it."""
    parent_slot: tuple[int, ...]
    """For each node of `inner` where its parent's state is kept; that of the root is in slot 0."""
    first: tuple[bool, ...]
    """For each node of `inner` whether it is the first to reach its parent on the way up."""


def schedule(parents: Sequence[int], observed: Sequence[int]) -> Schedule:
    """The schedule of a tree in preorder."""
    count, above = len(parents), np.array(parents)
    needed = np.zeros(count, bool)
    needed[list(observed)] = True
    size = np.ones(count, int)
    for node in range(count - 1, 0, -1):
        needed[above[node]] |= needed[node]
        size[above[node]] += size[node]
    active = np.array([node for node in range(1, count) if needed[node]], int)
    has_child = np.isin(np.arange(count), above[active])
    ends = active[~has_child[active]]
    children: dict[int, list[int]] = {node: [] for node in range(count)}
    for node in active[has_child[active]]:
        children[int(above[node])].append(int(node))
    order = _heavy_last(children, size)
    slot_of, taken, free = {0: 0}, 1, []
    first, remaining = {}, {node: len(own) for node, own in children.items()}
    slots, parent_slots = [], []
    for node in order:
        parent = int(above[node])
        parent_slots.append(slot_of[parent])
        first[node] = remaining[parent] == 1  # the last on the way down
        remaining[parent] -= 1
        if not remaining[parent] and parent:  # the root's place is its own
            free.append(slot_of[parent])
        if children[node]:
            slot_of[node] = free.pop() if free else taken
            taken = max(taken, slot_of[node] + 1)
        slots.append(slot_of.get(node, -1))
    return Schedule(
        tuple(ends.tolist()),
        tuple(order),
        tuple(active.tolist()),
        taken,
        tuple(taken if slot < 0 else slot for slot in slots),
        tuple(parent_slots),
        tuple(first[node] for node in order),
    )


def _heavy_last(children: dict[int, list[int]], size: np.ndarray) -> list[int]:
    order, waiting = [], [0]
    while waiting:
        node = waiting.pop()
        if node:
            order.append(node)
        waiting.extend(sorted(children[node], key=lambda child: -size[child]))
    return order
