"""What a guide adds to the drift, drawn on the shapes of a path."""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import numpy as np
from numpy.typing import ArrayLike, NDArray

from .._checks import as_float, flag, known_float, known_number, require, require_instance
from .._linalg import apply
from ..bridges import GuidedBridge
from ._canvas import as_file, as_points, draw, pyplot, seen
from ._shapes import score_field

_PALE = "#c8c8c8"


def score_frames(
    bridges: GuidedBridge | Mapping[str, GuidedBridge],
    paths: ArrayLike | Mapping[str, ArrayLike],
    times: ArrayLike,
    file: Any,
    *,
    scale: float | None = None,
    closed: bool = True,
) -> list[list[Any]]:
    """The drift a(t, x) ∇ log h̃(t, x) that conditioning adds, on the shapes of a path: a row of
    frames for each bridge.

    Below each shape, in pale grey, lies the target: the state nearest to the path's end that meets
    the condition.

    **Arguments:**

    - `bridges`: of shapes in the plane; or several by name, as for numbers of basis functions.
    - `paths`: (K + 1, n, 2), the states of a path at the bridge's `ts`, or coefficients on a
      `FourierBasis`; for several bridges the paths by the same names, or one for all.
    - `times`: from t0 to before t1, one column each; drawn at the nearest grid time before t1.
    - `file`: where to write; matplotlib knows the format by its ending.
    - `scale`: length of an arrow for one unit of drift, a time. The same in all frames; by default
      the longest arrow is a third of the largest shape's extent.
    - `closed`: whether the last point is joined to the first.

    **Returns:** the `Quiver`s, a list for each row. The figure is closed. **Errors:** `ValueError`
    for shapes, names and times that do not fit; `ImportError` without matplotlib.
    """
    bridges = bridges if isinstance(bridges, Mapping) else {"": bridges}
    require(len(bridges) > 0, "`bridges` must hold at least one `GuidedBridge`; got none.")
    for name, bridge in bridges.items():
        require_instance(
            bridge, GuidedBridge, f"bridges[{name!r}]" if name else "bridges", "a `GuidedBridge`"
        )
    file = as_file(file, "file")
    closed = flag(closed, "closed")
    if scale is not None:
        scale = known_number(scale, "scale", "a number from 0 on, a time", lambda value: value >= 0)
    paths = paths if isinstance(paths, Mapping) else dict.fromkeys(bridges, paths)
    if set(paths) != set(bridges):
        raise ValueError(
            f"`paths` must have the names of `bridges`, {list(bridges)}; got {list(paths)}."
        )
    rows = {name: _Row(bridge, paths[name], times) for name, bridge in bridges.items()}
    length = _default_scale(list(rows.values())) if scale is None else scale
    corners = np.concatenate([row.corners(length) for row in rows.values()])
    figure, axes = _canvas(len(rows), len(np.atleast_1d(times)), corners)
    first = next(iter(rows.values())).times
    drawn = []
    for line, (name, row) in zip(axes, rows.items(), strict=True):
        drawn.append([row.draw(ax, i, length, closed) for i, ax in enumerate(line)])
        line[0].text(
            -0.04, 0.5, name, transform=line[0].transAxes, rotation=90, ha="right", va="center"
        )
        if row.times is first or not np.allclose(row.times, first):
            for ax, time in zip(line, row.times, strict=True):
                ax.set_title(f"$t = {time:.3g}$", fontsize=10)
    words = (
        f"arrows: $a\\,s$, the drift that conditioning adds, × {length:.2g} time units; "
        "grey: the target"
    )
    figure.supxlabel(words, fontsize=9)
    figure.savefig(file, dpi=150)
    pyplot().close(figure)
    return drawn


class _Row:
    """Points (T, q, 2) of a path, the drifts there, and the points (q, 2) of the target."""

    def __init__(self, bridge: GuidedBridge, path: ArrayLike, times: ArrayLike):
        states = _states(bridge, path)
        chosen = _chosen(bridge, times)
        space = bridge.sde.space
        to_points = (lambda x: x) if space is None else space.to_points
        self.times = np.asarray(bridge.ts)[chosen]
        drifts = _guiding_drift(bridge, states)[chosen]
        self.drifts = np.asarray(jax.vmap(to_points)(drifts), dtype=float)
        if not np.isfinite(self.drifts).all():
            raise ValueError(
                "`paths` must lead to finite drifts a(t, x) ∇ log h̃(t, x); got NaN or infinite "
                "ones."
            )
        self.points = as_points(jax.vmap(to_points)(states[chosen]), "paths", "(T, q, 2)")
        self.target = np.asarray(
            to_points(bridge.condition.reference(bridge.sde, states[-1])), dtype=float
        )

    def corners(self, scale: float) -> NDArray:
        """All that is drawn, (N, 2)."""
        return np.concatenate(
            [seen(part) for part in (self.points, self.points + scale * self.drifts, self.target)]
        )

    def draw(self, ax: Any, i: int, scale: float, closed: bool) -> Any:
        limits = ax.axis()
        draw(ax, self.target[None], closed, colors=_PALE, linewidths=2.0, zorder=0)
        longest = float(np.linalg.norm(self.drifts[i], axis=1).max())
        arrows = score_field(
            self.points[i], self.drifts[i], ax, length=scale * longest, closed=closed, width=0.007
        )
        ax.axis(limits)
        return arrows


def _default_scale(rows: list[_Row]) -> float:
    """The longest arrow is a third of the largest extent; 0 where there is no drift."""
    longest = max(np.linalg.norm(row.drifts, axis=-1).max() for row in rows)
    return (
        float(max(np.ptp(row.points, axis=1).max() for row in rows) / (3 * longest))
        if longest > 0
        else 0.0
    )


def _states(bridge: GuidedBridge, path: ArrayLike) -> jax.Array:
    states = as_float(path, "paths").astype(bridge.x0.dtype)
    shape = (bridge.num_steps + 1, *bridge.x0.shape)
    if states.shape != shape:
        raise ValueError(
            f"`paths` must have a state for each of a bridge's `ts`, shape {shape}; got "
            f"{states.shape}."
        )
    return states


def _chosen(bridge: GuidedBridge, times: ArrayLike) -> NDArray:
    """The grid times nearest to the given ones, the end left out, as numbers."""
    ts = np.asarray(bridge.ts)
    times = np.atleast_1d(known_float(times, "times"))
    inside = np.all((times >= ts[0]) & (times < ts[-1]))
    if times.ndim > 1 or not times.size or not inside:
        raise ValueError(f"`times` must lie in [{ts[0]}, {ts[-1]}), before the end; got {times}.")
    return np.abs(ts[:-1] - times[:, None]).argmin(axis=1)


@eqx.filter_jit
def _guiding_drift(bridge: GuidedBridge, path):
    def one(t, x, score):
        return apply(bridge.sde.covariance(t, x), score)

    return jax.vmap(one)(bridge.shown_ts[:-1], path[:-1], bridge.scores(path))


def _canvas(num_rows: int, num_columns: int, corners: NDArray) -> tuple[Any, Any]:
    """A grid of axes without frames, all with the limits of the corners (N, 2)."""
    low = corners.min(axis=0)
    high = corners.max(axis=0)
    margin = 0.04 * (high - low).max()
    width, height = 2.1 * np.maximum((high - low) / (high - low).max(), 0.2)
    size = (width * num_columns + 0.4, height * num_rows + 0.7)
    figure, axes = pyplot().subplots(
        num_rows, num_columns, figsize=size, squeeze=False, layout="constrained"
    )
    for ax in axes.flat:
        ax.set_axis_off()
        ax.set_aspect("equal")
        ax.set_xlim(low[0] - margin, high[0] + margin)
        ax.set_ylim(low[1] - margin, high[1] + margin)
    return figure, axes
