"""In which order a tree's branches are walked, and where what is still needed is kept meanwhile.

Branches are walked in rounds: on the way down those of a round start at nodes of earlier ones, the
way up is the reverse. Within rounds of few places the order is depth first, the largest subtree
last. A node is then needed no more when its last subtree begins, and not many more than log₂(number
of nodes) of them are kept at a time: memory and derivatives cost no more than the branches,
whatever the shape.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

# places of a round, all of which are computed, and held in memory, at once
_MAX_WIDTH = 32
_MAX_IDLE = 0.5
"""Places of rounds that are left empty, relative to those that are taken."""


class Schedule(NamedTuple):
    """Static numbers. *Ends* are nodes below which nothing is seen, *inner* nodes the others."""

    ends: tuple[int, ...]
    """Nodes at the ends, in preorder."""
    inner: tuple[int, ...]
    """Inner nodes but the root, in the order of the way down."""
    active: tuple[int, ...]
    """Nodes but the root that have something seen below or at them, in preorder: those that have
    noise.
    """
    rounds: tuple[tuple[int, ...], ...]
    """For each round of the way down the places in `inner` of its nodes."""
    num_slots: int
    slot: tuple[int, ...]
    """For each node of `inner` where its state is kept, `num_slots` where nothing inner hangs on
    it.
    """
    parent_slot: tuple[int, ...]
    """For each node of `inner` where its parent's state is kept; that of the root is in slot 0."""

    def places(self) -> tuple[np.ndarray, np.ndarray]:
        """`rounds` as an array, padded with the first of each round, and which are nodes."""
        width = max(map(len, self.rounds), default=1)
        # a place of no node repeats a real one: it computes finite numbers, which are not used
        filled = [nodes + nodes[:1] * (width - len(nodes)) for nodes in self.rounds]
        lengths = np.array([len(nodes) for nodes in self.rounds], int)
        taken = np.arange(width) < lengths[:, None]
        # reshaped for a tree without inner nodes, which has no round
        return np.array(filled, int).reshape(-1, width), taken


def schedule(parents: Sequence[int], observed: Sequence[int]) -> Schedule:
    """The schedule of a tree in preorder."""
    count = len(parents)
    above = np.array(parents)
    needed = np.zeros(count, bool)
    needed[list(observed)] = True
    size = np.ones(count, int)
    # in preorder a node comes after its parent: backwards, a subtree is complete at its root
    for node in range(count - 1, 0, -1):
        needed[above[node]] |= needed[node]
        size[above[node]] += size[node]
    active = np.array([node for node in range(1, count) if needed[node]], int)
    has_child = np.isin(np.arange(count), above[active])
    ends = active[~has_child[active]]
    # inner ones only: branches to ends need no order, and are walked all at once
    children: dict[int, list[int]] = {node: [] for node in range(count)}
    for node in active[has_child[active]]:
        children[int(above[node])].append(int(node))

    rounds = _rounds(_heavy_last(children, size), parents)
    order = [node for nodes in rounds for node in nodes]
    place = {node: i for i, node in enumerate(order)}
    places = [tuple(map(place.__getitem__, nodes)) for nodes in rounds]
    slot_of, num_slots = _slots(rounds, parents, children)
    return Schedule(
        tuple(ends.tolist()),
        tuple(order),
        tuple(active.tolist()),
        tuple(places),
        num_slots,
        # `num_slots` is no place: states have none there, messages one that stays 0
        tuple(slot_of.get(node, num_slots) for node in order),
        # a place is used again only after its readers, so it is the parent's when it is read
        tuple(slot_of[parents[node]] for node in order),
    )


def _heavy_last(children: dict[int, list[int]], size: np.ndarray) -> list[int]:
    """Inner nodes depth first, of siblings that with the largest subtree last."""
    order = []
    waiting = [0]
    while waiting:
        node = waiting.pop()
        if node:
            order.append(node)
        # the last of the stack is the next: the largest goes to its bottom
        waiting.extend(sorted(children[node], key=lambda child: -size[child]))
    return order


def _rounds(order: Sequence[int], parents: Sequence[int]) -> list[list[int]]:
    """Nodes that are walked together: as many as can be without many empty places."""
    width = 1
    rounds = [[node] for node in order]
    while 2 * width <= _MAX_WIDTH:
        wider = _rounds_of(2 * width, order, parents)
        # a chain has one node in each round: wider ones would only repeat it
        if 2 * width * len(wider) > (1 + _MAX_IDLE) * len(order):
            break
        width *= 2
        rounds = wider
    return rounds


def _rounds_of(width: int, order: Sequence[int], parents: Sequence[int]) -> list[list[int]]:
    """Each node in the first round after its parent's that has a place."""
    round_of = {0: -1}
    rounds = []
    first_free = 0
    for node in order:
        # its parent's state must have been written
        number = max(round_of[parents[node]] + 1, first_free)
        while number < len(rounds) and len(rounds[number]) == width:
            number += 1
        if number == len(rounds):
            rounds.append([])
        rounds[number].append(node)
        round_of[node] = number
        while first_free < len(rounds) and len(rounds[first_free]) == width:
            first_free += 1
    return rounds


def _slots(rounds, parents, children) -> tuple[dict[int, int], int]:
    """For each node with inner children a place until these have read it."""
    slot_of = {0: 0}
    taken = 1
    free = []
    remaining = {node: len(own) for node, own in children.items()}
    for nodes in rounds:
        # a round reads all before it writes, so that its own parents' places can be used again
        for node in nodes:
            parent = parents[node]
            remaining[parent] -= 1
            if not remaining[parent] and parent:  # the root's place is its own
                free.append(slot_of[parent])
        for node in nodes:
            if children[node]:
                slot_of[node] = free.pop() if free else taken
                taken = max(taken, slot_of[node] + 1)
    return slot_of, taken
