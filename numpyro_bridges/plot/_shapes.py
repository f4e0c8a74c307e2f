"""Drawings of shapes and of their paths."""

from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from .._checks import choice, flag, known_number, positive_integer
from ._canvas import NEUTRAL, START, TARGET, as_points, as_times, draw, seen, shape_axes, time_map


def outlines(
    shapes: ArrayLike,
    ax: Any = None,
    *,
    mean: ArrayLike | None = None,
    closed: bool = True,
    color: Any = NEUTRAL,
    linewidth: float = 0.8,
    **kwargs: Any,
) -> Any:
    """Shapes (n, 2) or (N, n, 2) as thin outlines, with their mean (n, 2) on top if it is given.

    A missing (NaN) point leaves a gap. Further keywords go to the `LineCollection`, which is
    returned.
    """
    shapes = as_points(shapes, "shapes", "(n, 2)", "(N, n, 2)")
    shapes = shapes.reshape(-1, *shapes.shape[-2:])
    closed = flag(closed, "closed")
    linewidth = known_number(linewidth, "linewidth", "a positive number", lambda value: value > 0)
    ax = shape_axes(ax, shapes)
    style: dict[str, Any] = {"alpha": _opacity(len(shapes))} | kwargs
    lines = draw(ax, shapes, closed, colors=color, linewidths=linewidth, **style)
    if mean is not None:
        mean = as_points(mean, "mean", "(n, 2)")
        draw(ax, mean[None], closed, colors=START, linewidths=2.0, zorder=3)
    return lines


def path(
    path: ArrayLike,
    ax: Any = None,
    *,
    ts: ArrayLike | None = None,
    num_outlines: int = 12,
    closed: bool = True,
    trajectories: bool = True,
    cmap: Any = None,
    **kwargs: Any,
) -> Any:
    """One path of a shape through time as outlines whose colour is the time.

    **Arguments:**

    - `path`: (K + 1, n, 2).
    - `ax`: axes to draw on.
    - `ts`: (K + 1,) times, default 0 to 1 in equal steps.
    - `num_outlines`: how many to draw, the first and the last included, at nearly equal steps of
      the grid.
    - `closed`: whether the last point is joined to the first.
    - `trajectories`: whether to draw the way of every point as a faint line.
    - `cmap`: colour map over time.

    **Returns:** the `LineCollection` of outlines; `fig.colorbar(lines, label="time")` explains its
    colours.
    """
    path = as_points(path, "path", "(K + 1, n, 2)")
    times = as_times(ts, len(path))
    closed = flag(closed, "closed")
    trajectories = flag(trajectories, "trajectories")
    num_outlines = positive_integer(num_outlines, "num_outlines")
    ax = shape_axes(ax, path)
    if trajectories:
        ways = path.transpose(1, 0, 2)  # a polygon for each point
        draw(ax, ways, False, colors=NEUTRAL, linewidths=0.5, alpha=0.5, zorder=1)
    # each once, where there are fewer states than outlines
    chosen = np.unique(np.linspace(0, len(path) - 1, num_outlines).round().astype(int))
    widths = np.where(np.isin(chosen, (0, len(path) - 1)), 2.2, 1.0)
    cmap = cmap or time_map()
    lines = draw(ax, path[chosen], closed, linewidths=widths, cmap=cmap, zorder=2, **kwargs)
    # colours by times, whatever the steps of the grid
    lines.set_array(times[chosen])
    lines.set_clim(times[0], times[-1])
    return lines


def bridge_fan(
    paths: ArrayLike,
    start: ArrayLike,
    target: ArrayLike,
    ax: Any = None,
    *,
    ts: ArrayLike | None = None,
    num_frames: int = 5,
    direction: Literal["row", "column"] = "row",
    closed: bool = True,
    max_outlines: int = 100,
) -> list:
    """Bridges from a start to a target as a strip of frames: at each of a few times, all their
    outlines.

    Every frame repeats the start (dark, bold in the first frame) and the target (orange, bold in
    the last), so that the eye sees the fan leave one, widen and close on the other. They are
    labelled "start" and "target" and the first fan "bridges", for `ax.legend()`; axes that are made
    here have a legend.

    **Arguments:**

    - `paths`: (S, K + 1, n, 2).
    - `start`, `target`: (n, 2).
    - `ax`: axes to draw on.
    - `ts`: (K + 1,) times, default 0 to 1 in equal steps.
    - `num_frames`: how many times, at nearly equal steps of time, the ends included.
    - `direction`: frames from left to right or from top to bottom.
    - `closed`: whether the last point is joined to the first.
    - `max_outlines`: draws at most the first so many paths.

    **Returns:** one `LineCollection` of outlines for each frame.
    """
    max_outlines = positive_integer(max_outlines, "max_outlines")
    num_frames = positive_integer(num_frames, "num_frames")
    closed = flag(closed, "closed")
    choice(direction, "direction", ("row", "column"))
    paths = as_points(paths, "paths", "(S, K + 1, n, 2)")[:max_outlines]
    start = as_points(start, "start", "(n, 2)")
    target = as_points(target, "target", "(n, 2)")
    times = as_times(ts, paths.shape[1])
    wanted = np.linspace(times[0], times[-1], num_frames)
    chosen = [int(np.abs(times - time).argmin()) for time in wanted]
    # all frames are on the same axes, each shifted by the box around all that is drawn in any
    corners = np.concatenate([seen(paths[:, chosen]), seen(start), seen(target)])
    low = corners.min(axis=0)
    high = corners.max(axis=0)
    step = (high - low) * ([1.12, 0.0] if direction == "row" else [0.0, -1.25])
    strip = np.stack([low, high]) + step * np.arange(num_frames)[:, None, None]
    own_axes = ax is None
    ax = shape_axes(ax, strip, size=(2.2 if direction == "row" else 1.6) * num_frames)

    colors = time_map()(np.linspace(0.0, 1.0, num_frames))
    drawn = []
    for frame, index in enumerate(chosen):
        shift = frame * step
        first = frame == 0
        last = frame == num_frames - 1
        fan = {"colors": [colors[frame]], "linewidths": 0.8, "alpha": _opacity(len(paths))}
        fan["label"] = "bridges" if first else None
        drawn.append(draw(ax, paths[:, index] + shift, closed, **fan))
        width = 2.2 if first else 0.9
        label = "start" if first else None
        style = {"colors": START, "linewidths": width, "zorder": 3, "label": label}
        draw(ax, (start + shift)[None], closed, **style)
        width = 2.2 if last else 0.9
        label = "target" if last else None
        style = {"colors": TARGET, "linewidths": width, "zorder": 4, "label": label}
        draw(ax, (target + shift)[None], closed, linestyles="-" if last else (0, (4, 2)), **style)
        below = ((low[0] + high[0]) / 2.0 + shift[0], low[1] + shift[1])
        label = f"$t = {times[index]:.2g}$"
        style = {"ha": "center", "va": "top", "fontsize": 9}
        ax.annotate(label, below, (0, -5), textcoords="offset points", **style)
    if own_axes:
        columns = 3 if direction == "row" else 1
        ax.figure.legend(loc="outside lower center", ncols=columns, frameon=False, fontsize=9)
    return drawn


def score_field(
    points: ArrayLike,
    arrows: ArrayLike,
    ax: Any = None,
    *,
    length: float | None = None,
    closed: bool = True,
    color: Any = TARGET,
    **kwargs: Any,
) -> Any:
    """A vector at each point of a shape, such as a score or a drift, as arrows on the outline.

    **Arguments:**

    - `points`, `arrows`: (n, 2).
    - `ax`: axes to draw on.
    - `length`: the longest arrow in the unit of the points; default a quarter of the shape's larger
      extent. Arrows are in proportion to one another.
    - `closed`: whether the last point is joined to the first.

    **Returns:** the `Quiver`.
    """
    points = as_points(points, "points", "(n, 2)")
    arrows = as_points(arrows, "arrows", "(n, 2)")
    if arrows.shape != points.shape:
        raise ValueError(
            f"`arrows` must have the shape of `points` {points.shape}, got {arrows.shape}."
        )
    closed = flag(closed, "closed")
    if length is None:
        length = 0.25 * float(np.ptp(seen(points), axis=0).max())
    length = known_number(length, "length", "a number from 0 on", lambda value: value >= 0)
    longest = np.nanmax(np.linalg.norm(arrows, axis=1), initial=0.0)
    drawn = arrows * (length / longest if longest > 0.0 else 0.0)
    ax = shape_axes(ax, np.concatenate([points, points + drawn]))
    draw(ax, points[None], closed, colors=NEUTRAL, linewidths=1.2, zorder=1)
    ax.plot(*points.T, linestyle="none", marker="o", markersize=2.5, color=START, zorder=2)
    # matplotlib counts the feet of arrows for the limits, and not the tips
    ax.update_datalim(points + drawn)
    ax.autoscale_view()
    # in the units of the points: matplotlib scales arrows by the axes otherwise
    settings = dict(
        angles="xy", scale_units="xy", scale=1.0, width=0.0045, headwidth=3.5, headlength=4.5
    )
    return ax.quiver(*points.T, *drawn.T, color=color, zorder=3, **settings | kwargs)


def _opacity(num_lines: int) -> float:
    """Many lines on top of one another are drawn lighter."""
    return float(np.clip(12.0 / num_lines, 0.15, 1.0))
