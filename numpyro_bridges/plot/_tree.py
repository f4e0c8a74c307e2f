"""Drawings of trees, with shapes at their nodes."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .._checks import (
    flag,
    known_float,
    known_number,
    positive_integer,
    require,
    require_instance,
    words,
)
from ..trees import Tree
from ._canvas import ACCENT, NEUTRAL, START, as_points, check_axes, draw, polygons, pyplot, seen

WIDTH = 6.5  # of a new figure, in inches


def tree(
    tree: Tree,
    ax: Any = None,
    *,
    shapes: Mapping | ArrayLike | None = None,
    draws: Mapping | ArrayLike | None = None,
    closed: bool = True,
    size: float = 0.6,
    max_outlines: int = 40,
) -> Any:
    """A tree as a ladder, time from left to right, with names and shapes at its nodes.

    Tips are named, and inner nodes that are seen. All shapes are drawn on one scale, whatever the
    scales of the axes: those of tips beside them, before their names, those of inner nodes on them,
    centred.

    **Arguments:**

    - `tree`: a `Tree`, its lengths known.
    - `ax`: axes to draw on.
    - `shapes`: one `(n, 2)` for each of some nodes, by name or by number, or an array `(num_nodes,
      n, 2)`. Nodes whose shape is all NaN have none.
    - `draws`: in the same way `(S, n, 2)`, or `(S, num_nodes, n, 2)`, such as posterior draws of
      ancestors: translucent outlines below the shape, which is their mean unless `shapes` has one.
    - `closed`: whether the last point is joined to the first.
    - `size`: the larger extent of the largest shape, its draws included, in inches.
    - `max_outlines`: draws so many of the draws at most, evenly spaced.

    **Returns:** the `LineCollection` of the branches, one for each node but the root.
    """
    require_instance(tree, Tree, "tree", "a `Tree`, such as `Tree.from_newick(text)`")
    closed = flag(closed, "closed")
    max_outlines = positive_integer(max_outlines, "max_outlines")
    size = known_number(size, "size", "a positive number of inches", lambda value: value > 0)
    x = known_float(tree.depths, "tree.lengths")
    y = _rows(tree)
    # of each node the draws, and a shape: their mean, unless one is given
    clouds = _by_node(tree, draws, "draws", "(S, num_nodes, n, 2)", "(S, n, 2)")
    clouds = {node: cloud[_spaced(len(cloud), max_outlines)] for node, cloud in clouds.items()}
    outlines = {node: np.mean(cloud, axis=0) for node, cloud in clouds.items()}
    outlines |= _by_node(tree, shapes, "shapes", "(num_nodes, n, 2)", "(n, 2)")

    # around the middle of the shape, and not of each draw, so that draws show how they differ
    centred = {node: outline - _middle(outline) for node, outline in outlines.items()}
    clouds = {node: cloud - _middle(outlines[node]) for node, cloud in clouds.items()}
    inches, width, height = _scale([*centred.values(), *clouds.values()], size)

    # a tip takes the room of a shape, and of a name below it where inner nodes have one
    named = sorted(set(tree.observed) - set(tree.tips))
    pitch = max(0.22, 1.1 * height) + (0.4 if named else 0.0)
    ax = _axes(ax, x, y, pitch, 0.5 * width if 0 in outlines else 0.0)
    branches = draw(ax, _ladder(tree, x, y), False, colors=NEUTRAL, linewidths=1.2, zorder=1)
    beside = width if set(outlines) & set(tree.tips) else 0.0
    for node, outline in centred.items():
        shift = 0.5 * beside + 0.06 if node in tree.tips else 0.0
        place = {"transform": _around(ax, x[node], y[node], inches, shift), "clip_on": False}
        _draw_shape(ax, outline, clouds.get(node), closed, place)
    # offsets are in points, 72 to an inch
    style: dict[str, Any] = {"textcoords": "offset points", "fontsize": 9}
    right = 72.0 * beside + 8.0 if beside else 4.0
    names = [name or "" for name in tree.names]
    for tip in tree.tips:
        ax.annotate(names[tip], (x[tip], y[tip]), (right, 0.0), va="center", **style)
    below = -36.0 * height - 3.0
    centre: dict[str, Any] = {"ha": "center", "va": "top"} | style
    for node in named:
        ax.annotate(names[node], (x[node], y[node]), (0.0, below), **centre)
    return branches


def _scale(parts: list[NDArray], size: float) -> tuple[float, float, float]:
    """Inches for one unit of the shapes, and the largest width and height of them in inches."""
    extents = [np.ptp(seen(part), axis=0) for part in parts]
    width, height = np.max(extents, axis=0) if extents else (0.0, 0.0)
    inches = size / max(width, height) if max(width, height) > 0 else 1.0
    return inches, inches * width, inches * height


def _ladder(tree: Tree, x: NDArray, y: NDArray) -> NDArray:
    """For each branch three points (branches, 3, 2): from the parent up or down, then along."""
    parents = np.array(tree.parents[1:])
    corners = [(x[parents], y[parents]), (x[parents], y[1:]), (x[1:], y[1:])]
    return np.stack([np.stack(corner, axis=1) for corner in corners], axis=1)


def _draw_shape(
    ax: Any, outline: NDArray, cloud: NDArray | None, closed: bool, place: dict[str, Any]
) -> None:
    """A shape on white paper, which hides the branches below it, with its draws between."""
    fill = "white" if closed else "none"
    paper = {"colors": "white", "facecolors": fill, "linewidths": 3.0, "zorder": 2}
    # in inches, and not in the axes' units: none of these count for their limits
    ax.add_collection(polygons(outline[None], closed, **paper, **place), autolim=False)
    if cloud is not None:
        opacity = float(np.clip(10.0 / len(cloud), 0.15, 0.5))
        band = {"colors": ACCENT, "linewidths": 0.8, "alpha": opacity, "zorder": 3}
        ax.add_collection(polygons(cloud, closed, **band, **place), autolim=False)
    line = {"colors": START, "linewidths": 1.0, "zorder": 4}
    ax.add_collection(polygons(outline[None], closed, **line, **place), autolim=False)


def _rows(tree: Tree) -> NDArray:
    """The height of each node: tips at 0, −1, ..., an inner node in the middle of its children."""
    y = np.zeros(tree.num_nodes)
    y[list(tree.tips)] = -np.arange(len(tree.tips))
    inner = sorted(set(tree.parents) - {-1}, reverse=True)  # children come after their parent
    parents = np.array(tree.parents)
    for node in inner:
        children = y[parents == node]
        y[node] = (children.min() + children.max()) / 2.0
    return y


def _by_node(tree: Tree, given: Any, name: str, whole: str, single: str) -> dict[int, NDArray]:
    """Arrays by the number of their node, from a mapping or from one array."""
    if given is None:
        return {}
    if isinstance(given, Mapping):
        require(
            len(given) > 0,
            f"`{name}` must have an entry for at least one node; got none. Leave it out then.",
        )
        numbered = {}
        for key, value in given.items():
            numbered[_number(tree, key, name)] = as_points(value, f"{name}[{key!r}]", single)
    else:
        array = as_points(given, name, whole)
        count = array.shape[-3]
        require(
            count == tree.num_nodes,
            f"`{name}` must have the shape {whole} with {tree.num_nodes} nodes, got "
            f"{array.shape}. Shapes of some nodes are given by name: {{name: shape}}.",
        )
        numbered = {node: array[..., node, :, :] for node in range(count)}
    return {node: array for node, array in numbered.items() if len(seen(array))}


def _number(tree: Tree, key: Any, name: str) -> int:
    known = isinstance(key, str) and key in tree.names
    number: Any = tree.names.index(key) if known else key
    whole = isinstance(number, (int, np.integer)) and not isinstance(number, bool)
    require(
        whole and 0 <= number < tree.num_nodes,
        f"`{name}` must be given by names of nodes, or by numbers from 0 to {tree.num_nodes - 1}; "
        f"got {words(key)}.",
    )
    return int(number)


def _spaced(number: int, most: int) -> NDArray:
    return np.unique(np.linspace(0, number - 1, min(number, most)).round().astype(int))


def _middle(outline: NDArray) -> NDArray:
    """The centre of the box around a shape."""
    points = seen(outline)
    return (points.min(axis=0) + points.max(axis=0)) / 2.0


def _axes(ax: Any, x: NDArray, y: NDArray, pitch: float, before: float) -> Any:
    """The given axes, or new ones, with `pitch` inches for each tip and some for the shape at the
    root.

    Time is the only axis that is drawn.
    """
    check_axes(ax)
    plt = pyplot()
    if ax is None:
        _, ax = plt.subplots(figsize=(WIDTH, pitch * (np.ptp(y) + 1.0) + 0.6), layout="constrained")
    span = np.ptp(x) if np.ptp(x) > 0 else 1.0
    ax.spines[["left", "right", "top"]].set_visible(False)
    ax.set_yticks([])
    ax.set_ylim(y.min() - 0.5, y.max() + 0.5)
    # room in front for the shape at the root; names of tips stand outside of the axes
    ax.set_xlim(-1.5 * before / WIDTH * span, span)
    ax.set_xlabel("time since the root")
    return ax


def _around(ax: Any, x: float, y: float, inches: float, shift: float) -> Any:
    """From units of a shape to the canvas: around a point, `shift` inches to its right."""
    from matplotlib.transforms import Affine2D, ScaledTranslation

    on_paper = Affine2D().scale(inches).translate(shift, 0.0) + ax.figure.dpi_scale_trans
    return on_paper + ScaledTranslation(x, y, ax.transData)
