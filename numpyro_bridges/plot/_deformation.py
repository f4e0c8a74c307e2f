"""What a path of landmarks does to the plane around them."""

from typing import Any

import jax
import numpy as np
from numpy.typing import ArrayLike

from .._checks import flag, known_number, positive_integer, require, require_instance
from ..sdes import KunitaFlow
from ._canvas import NEUTRAL, START, TARGET, as_points, draw, shape_axes

_PER_CELL = 4
"""Points of a grid line between two others."""


def deformation(
    flow: KunitaFlow,
    path: ArrayLike,
    ax: Any = None,
    *,
    num_lines: int = 20,
    margin: float = 0.25,
    closed: bool = True,
    cmap: Any = "PuOr",
    **kwargs: Any,
) -> Any:
    """A grid as the flow carries it along a path, coloured by how much area grows, log₂ of the
    Jacobian determinant.

    **Arguments:**

    - `flow`: a `KunitaFlow` in the plane.
    - `path`: (K + 1, n, 2), the states of a path of it; in coefficients where its space is a basis.
    - `ax`: axes to draw on.
    - `num_lines`: lines of the grid along its longer side.
    - `margin`: how far it reaches beyond the first shape, a fraction of the size of that.
    - `closed`: whether the last point of an outline is joined to the first.
    - `cmap`: a colour map whose middle stands for no change.

    Broken is the outline at the start, drawn out the one at the end. Further keywords go to
    `pcolormesh`.

    **Returns:** its `QuadMesh`; `fig.colorbar(mesh, label="log₂ area")` explains its colours. A
    determinant that is not positive, where steps are too long for the flow, is left white.
    """
    require_instance(flow, KunitaFlow, "flow", "a flow, such as `KunitaFlow(space, kernel)`")
    require(
        flow.space.dim == 2,
        f"`flow` must move points of the plane; those of its space are in R^{flow.space.dim}.",
    )
    path = as_points(path, "path", "(K + 1, n, 2)")
    n = flow.space.size
    require(
        path.shape[1] == n,
        f"`path` must have {n} rows, as many as a state of `flow`; got shape {path.shape}.",
    )
    num_lines = positive_integer(num_lines, "num_lines", least=2)
    margin = known_number(margin, "margin", "a number from 0 on", lambda value: value >= 0)
    closed = flag(closed, "closed")
    first = np.asarray(flow.space.to_points(path[0]))
    last = np.asarray(flow.space.to_points(path[-1]))
    low = first.min(axis=0)
    high = first.max(axis=0)
    size = (high - low).max()
    low = low - margin * size
    high = high + margin * size
    # square cells, of which the shorter side has fewer; lines are curves between their crossings
    counts = np.maximum(np.ceil(num_lines * (high - low) / (high - low).max()).astype(int), 2)
    sides = [np.linspace(low[i], high[i], _PER_CELL * (counts[i] - 1) + 1) for i in range(2)]
    points = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1)
    carried, stretched = _carried(flow, path, points.reshape(-1, 2))
    carried = np.asarray(carried).reshape(points.shape)
    stretched = np.asarray(stretched).reshape(points.shape[:2])
    area = np.log2(stretched, out=np.full(stretched.shape, np.nan), where=stretched > 0)
    # symmetric limits, so that the middle of the colours stands for no change
    most = np.nanmax(np.abs(area)) if np.isfinite(area).any() else 0.0
    ax = shape_axes(ax, np.concatenate([carried.reshape(-1, 2), first, last]))
    limits = {"vmin": -max(most, 1e-3), "vmax": max(most, 1e-3)}
    style: dict[str, Any] = {"shading": "gouraud", "cmap": cmap, "zorder": 0} | limits | kwargs
    mesh = ax.pcolormesh(carried[..., 0], carried[..., 1], area, **style)
    for lines in (carried[::_PER_CELL], carried[:, ::_PER_CELL].swapaxes(0, 1)):
        draw(ax, lines, False, colors=NEUTRAL, linewidths=0.5, alpha=0.8, zorder=1)
    draw(ax, first[None], closed, colors=START, linewidths=1.5, linestyles="dashed", zorder=2)
    draw(ax, last[None], closed, colors=TARGET, linewidths=1.8, zorder=3)
    return mesh


@jax.jit
def _carried(flow: KunitaFlow, path, points):
    return flow.carry(path, points)[-1], flow.jacobian(path, points)[-1]
