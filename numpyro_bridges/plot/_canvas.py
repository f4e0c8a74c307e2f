"""The axes, colours and lines that all drawings share."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .._checks import as_path, known_float, require, words

START = "#003f5c"
TARGET = "#d55e00"
ACCENT = "#0072b2"
NEUTRAL = "#8a8a8a"


def pyplot() -> Any:
    # here, since matplotlib need not be installed
    try:
        import matplotlib.pyplot as plt
    except ImportError as error:
        raise ImportError(
            "Drawing needs matplotlib: pip install 'numpyro_bridges[examples]'"
        ) from error
    return plt


def check_axes(ax: Any) -> None:
    require(
        ax is None or hasattr(ax, "add_collection"),
        f"`ax` must be axes of matplotlib, such as `plt.subplots()[1]`; got {words(ax)}.",
    )


def shape_axes(ax: Any, points: NDArray, size: float = 5.0) -> Any:
    """The given axes, or new ones without frame in the proportions of (..., 2) points, `size`
    inches long.

    One unit is as long in x as in y.
    """
    plt = pyplot()
    check_axes(ax)
    if ax is None:
        extent = np.ptp(seen(points), axis=0)
        longest = extent.max()
        # a single point has no proportions, and a straight line would be a figure of no height
        proportions = extent / longest if 0 < longest < np.inf else np.ones(2)
        figsize = size * np.maximum(proportions, 0.05) + 0.3
        _, ax = plt.subplots(figsize=tuple(figsize), layout="constrained")
        ax.set_axis_off()
    ax.set_aspect("equal")
    return ax


def polygons(shapes: NDArray, closed: bool, **kwargs: Any) -> Any:
    """Polygons (N, n, 2) as one `LineCollection`; a missing (NaN) point leaves a gap."""
    from matplotlib.collections import LineCollection

    if closed:
        shapes = np.concatenate([shapes, shapes[:, :1]], axis=1)
    style: dict[str, Any] = {"capstyle": "round", "joinstyle": "round"}
    return LineCollection(list(shapes), **style | kwargs)


def draw(ax: Any, shapes: NDArray, closed: bool, **kwargs: Any) -> Any:
    """Polygons on axes, which grow to hold them."""
    lines = polygons(shapes, closed, **kwargs)
    # limits by the points that are not missing
    ax.add_collection(lines, autolim=False)
    ax.update_datalim(seen(shapes))
    ax.autoscale_view()
    return lines


def seen(points: NDArray) -> NDArray:
    """(..., 2) points that are not missing, as (N, 2)."""
    points = points.reshape(-1, 2)
    return points[np.isfinite(points).all(axis=1)]


def time_map() -> Any:
    """Viridis without its palest end, which is lost on white paper."""
    from matplotlib.colors import ListedColormap

    return ListedColormap(pyplot().get_cmap("viridis")(np.linspace(0.0, 0.88, 256)), name="time")


def as_times(ts: ArrayLike | None, num_times: int) -> NDArray:
    times = np.linspace(0.0, 1.0, num_times) if ts is None else known_float(ts, "ts")
    if times.shape != (num_times,):
        raise ValueError(
            f"`ts` must have the shape ({num_times},), one time for each state, got {times.shape}."
        )
    require(np.all(np.isfinite(times)), f"`ts` must be finite; got {times}.")
    return times


def as_points(points: ArrayLike, name: str, *shapes: str) -> NDArray:
    """An array of one of the shapes written as text, such as "(n, 2)"."""
    points = known_float(points, name)
    if points.ndim not in [shape.count(",") + 1 for shape in shapes] or points.shape[-1] != 2:
        raise ValueError(
            f"`{name}` must have the shape {' or '.join(shapes)}, got {points.shape}. "
            "Of shapes in space draw two coordinates: points[..., :2]."
        )
    if not len(seen(points)):
        raise ValueError(
            f"`{name}` must have a point that is not missing, got none of {points.shape}."
        )
    return points


def as_file(file: Any, name: str) -> Any:
    """Where a figure is written to: a path, or a binary file that is open."""
    return file if hasattr(file, "write") else as_path(file, name)
