"""Marginal densities of posterior draws."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .._checks import known_float, known_number, require, require_mapping, words
from ._canvas import ACCENT, START, TARGET, pyplot


def posterior(
    samples: Mapping[str, ArrayLike],
    prior: Mapping[str, ArrayLike] | None = None,
    axes: Any = None,
    *,
    truth: Mapping[str, float] | None = None,
    level: float = 0.9,
) -> list:
    """Marginal densities of scalar parameters: posterior filled, prior as a broken line.

    Densities are Gaussian kernel estimates, reflected at zero where every draw is positive. A bar
    marks the central interval, a dot the median; the prior is shown over its central 80 %.

    **Arguments:**

    - `samples`: draws (S,) by name. Entries of any other shape are left out (noise, vectors).
    - `prior`: prior draws by name; names that `samples` lacks are left out.
    - `axes`: as many axes as there are parameters.
    - `truth`: values to mark, in simulation studies.
    - `level`: probability of the interval.

    **Returns:** the list of filled areas, one for each parameter in order.
    """
    require(samples is not None, "`samples` must be a dictionary of draws by name; got None.")
    for name, given in (("samples", samples), ("prior", prior), ("truth", truth)):
        require_mapping(given, name)
    level = known_number(level, "level", "a probability in (0, 1)", lambda value: 0 < value < 1)
    draws = {}
    for name, value in samples.items():
        if getattr(value, "ndim", 1) == 1:
            values = known_float(value, f"samples[{name!r}]")
            draws |= {name: values} if values.ndim == 1 and values.size else {}
    if not draws:
        raise ValueError(
            "`samples` must hold at least one scalar parameter, an entry of shape (S,)."
        )
    for name, values in draws.items():
        if not np.isfinite(values).all():
            raise ValueError(
                f"`samples[{name!r}]` must be finite, got NaN or infinite draws: find out why "
                "first."
            )
    if axes is None:
        figure, axes = pyplot().subplots(
            1, len(draws), figsize=(2.8 * len(draws), 2.0), layout="constrained"
        )
        figure.get_layout_engine().set(w_pad=0.12)
    axes = np.ravel(axes)
    if len(axes) != len(draws):
        raise ValueError(
            f"`axes` must be as many as the parameters {list(draws)}, got {len(axes)}."
        )
    areas = []
    for ax, (name, values) in zip(axes, draws.items(), strict=True):
        grids = [_grid(values, 0.001)]
        curves = [_density(values, grids[0])]
        if prior is not None and name in prior:
            before = np.ravel(known_float(prior[name], f"prior[{name!r}]"))
            require(
                before.size > 0 and np.all(np.isfinite(before)),
                f"`prior[{name!r}]` must be draws, finite numbers; got {words(prior[name])}.",
            )
            grids.append(_grid(before, 0.1))
            curves.append(_density(before, grids[1]))
            ax.plot(
                grids[1], curves[1], color="#555555", linewidth=1.2, linestyle=(0, (4, 2)), zorder=3
            )
        areas.append(ax.fill_between(grids[0], curves[0], color=ACCENT, alpha=0.35, linewidth=0.0))
        ax.plot(grids[0], curves[0], color=ACCENT, linewidth=1.4)
        tail = (1.0 - level) / 2.0
        low, middle, high = np.quantile(values, [tail, 0.5, 1.0 - tail])
        ax.plot(
            [low, high],
            [0.0, 0.0],
            color=START,
            linewidth=4.0,
            solid_capstyle="butt",
            clip_on=False,
            zorder=4,
        )
        ax.plot(
            middle,
            0.0,
            "o",
            color="white",
            markeredgecolor=START,
            markersize=6,
            clip_on=False,
            zorder=5,
        )
        if truth is not None and name in truth:
            ax.axvline(
                known_number(truth[name], f"truth[{name!r}]"), color=TARGET, linewidth=1.4, zorder=2
            )
        ax.set(xlabel=name, yticks=[], ylim=(0.0, 1.08 * max(curve.max() for curve in curves)))
        ax.set_xlim(min(grid[0] for grid in grids), max(grid[-1] for grid in grids))
        ax.spines[["left", "top", "right"]].set_visible(False)
    return areas


def _grid(values: NDArray, tail: float) -> NDArray:
    """Where a density is drawn: a little beyond two quantiles, above zero if every draw is."""
    low, high = np.quantile(values, [tail, 1.0 - tail])
    margin = 3.0 * _bandwidth(values)
    low = low - margin
    return np.linspace(max(low, 0.0) if values.min() > 0.0 else low, high + margin, 256)


def _bandwidth(values: NDArray) -> float:
    """Silverman's rule, with the smaller of the two usual spreads; positive for equal draws too."""
    spread = (
        min(values.std(), np.subtract(*np.quantile(values, [0.75, 0.25])) / 1.34) or values.std()
    )
    return float(0.9 * max(spread, 1e-6 * abs(values).max(), 1e-12) * len(values) ** -0.2)


def _density(values: NDArray, grid: NDArray) -> NDArray:
    """Kernel estimate, narrow where draws are dense (Abramson 1982), which keeps sharp modes."""
    values = values[:: max(1, len(values) // 4000)]

    def estimate(at: NDArray, bandwidth: NDArray) -> NDArray:
        kernels = np.exp(-0.5 * ((at[:, None] - values) / bandwidth) ** 2) / bandwidth
        return kernels.mean(axis=1) / np.sqrt(2.0 * np.pi)

    def reflected(bandwidth: NDArray) -> NDArray:
        density = estimate(grid, bandwidth)
        return density + estimate(-grid, bandwidth) if values.min() > 0.0 else density

    fixed = np.full(len(values), _bandwidth(values))
    pilot = np.interp(values, grid, reflected(fixed))
    pilot = np.maximum(pilot, 1e-3 * pilot.max())
    return reflected(fixed * np.clip(np.sqrt(np.exp(np.mean(np.log(pilot))) / pilot), 0.3, 3.0))
