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
    """Marginal densities of scalar parameters: posterior filled, prior as a dashed line.

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
    draws = _scalars(samples)
    axes = _axes(axes, list(draws))
    areas = []
    for ax, (name, values) in zip(axes, draws.items(), strict=True):
        grids = [_grid(values, 0.001)]
        curves = [_density(values, grids[0])]
        if prior is not None and name in prior:
            before = _prior_draws(prior[name], name)
            # priors have long tails, which would leave the posterior no room
            grids.append(_grid(before, 0.1))
            curves.append(_density(before, grids[1]))
            dashes: dict[str, Any] = {"linestyle": (0, (4, 2)), "linewidth": 1.2}
            ax.plot(grids[1], curves[1], color="#555555", zorder=3, **dashes)
        areas.append(ax.fill_between(grids[0], curves[0], color=ACCENT, alpha=0.35, linewidth=0.0))
        ax.plot(grids[0], curves[0], color=ACCENT, linewidth=1.4)
        _draw_interval(ax, values, level)
        if truth is not None and name in truth:
            true = known_number(truth[name], f"truth[{name!r}]")
            ax.axvline(true, color=TARGET, linewidth=1.4, zorder=2)
        ax.set(xlabel=name, yticks=[], ylim=(0.0, 1.08 * max(curve.max() for curve in curves)))
        ax.set_xlim(min(grid[0] for grid in grids), max(grid[-1] for grid in grids))
        ax.spines[["left", "top", "right"]].set_visible(False)
    return areas


def _scalars(samples: Mapping[str, ArrayLike]) -> dict[str, NDArray]:
    """Draws `(S,)` by name; `ValueError` where there are none, or not all are finite."""
    draws = {}
    for name, value in samples.items():
        # noise may be large: its shape is looked at before it is copied from a device
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
    return draws


def _axes(axes: Any, names: list[str]) -> NDArray:
    if axes is None:
        size = (2.8 * len(names), 2.0)
        figure, axes = pyplot().subplots(1, len(names), figsize=size, layout="constrained")
        figure.get_layout_engine().set(w_pad=0.12)
    axes = np.ravel(axes)
    if len(axes) != len(names):
        raise ValueError(f"`axes` must be as many as the parameters {names}, got {len(axes)}.")
    return axes


def _prior_draws(draws: ArrayLike, name: str) -> NDArray:
    values = np.ravel(known_float(draws, f"prior[{name!r}]"))
    require(
        values.size > 0 and np.all(np.isfinite(values)),
        f"`prior[{name!r}]` must be draws, finite numbers; got {words(draws)}.",
    )
    return values


def _draw_interval(ax: Any, values: NDArray, level: float) -> None:
    """The central interval as a bar on the axis, the median as a dot."""
    tail = (1.0 - level) / 2.0
    low, middle, high = np.quantile(values, [tail, 0.5, 1.0 - tail])
    # half of them is below the axis, where they would be cut off
    whole: dict[str, Any] = {"clip_on": False}
    bar: dict[str, Any] = {"linewidth": 4.0, "solid_capstyle": "butt"} | whole
    ax.plot([low, high], [0.0, 0.0], color=START, zorder=4, **bar)
    dot: dict[str, Any] = {"markeredgecolor": START, "markersize": 6} | whole
    ax.plot(middle, 0.0, "o", color="white", zorder=5, **dot)


def _grid(values: NDArray, tail: float) -> NDArray:
    """Where a density is drawn: a little beyond two quantiles, above zero if every draw is."""
    low, high = np.quantile(values, [tail, 1.0 - tail])
    margin = 3.0 * _bandwidth(values)
    low = low - margin
    return np.linspace(max(low, 0.0) if values.min() > 0.0 else low, high + margin, 256)


def _bandwidth(values: NDArray) -> float:
    """Silverman's rule, with the smaller of the two usual spreads; positive for equal draws too."""
    # the interquartile range of a normal distribution is 1.34 standard deviations; it is 0 where
    # half of the draws are equal
    upper, lower = np.quantile(values, [0.75, 0.25])
    spread = min(values.std(), (upper - lower) / 1.34) or values.std()
    return float(0.9 * max(spread, 1e-6 * abs(values).max(), 1e-12) * len(values) ** -0.2)


def _density(values: NDArray, grid: NDArray) -> NDArray:
    """Kernel estimate, narrow where draws are dense (Abramson 1982), which keeps sharp modes."""
    # a matrix of draws and places: at most some thousands of draws, evenly
    values = values[:: max(1, len(values) // 4000)]

    def estimate(at: NDArray, bandwidth: NDArray) -> NDArray:
        kernels = np.exp(-0.5 * ((at[:, None] - values) / bandwidth) ** 2) / bandwidth
        return kernels.mean(axis=1) / np.sqrt(2.0 * np.pi)

    def reflected(bandwidth: NDArray) -> NDArray:
        # what a kernel has below 0 is added above, so that a density at 0 is not halved
        density = estimate(grid, bandwidth)
        return density + estimate(-grid, bandwidth) if values.min() > 0.0 else density

    fixed = np.full(len(values), _bandwidth(values))
    pilot = np.interp(values, grid, reflected(fixed))
    pilot = np.maximum(pilot, 1e-3 * pilot.max())
    # h √(g / f), g the geometric mean of the pilot density f at the draws
    typical = np.exp(np.mean(np.log(pilot)))
    return reflected(fixed * np.clip(np.sqrt(typical / pilot), 0.3, 3.0))
