"""Log evidences of one estimand by several bridges, with effective sample sizes and cost."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ._canvas import ACCENT, NEUTRAL, START, as_file, pyplot


def draw_comparison(rows: Mapping[str, Mapping[str, float | bool]], path: Any) -> Any:
    """The rows of a `Comparison` as three panels, written to a file; the `Figure`, closed."""
    plt = pyplot()
    path = as_file(path, "path")
    size = (8.0, 1.0 + 0.42 * len(rows))
    figure, axes = plt.subplots(
        1, 3, figsize=size, sharey=True, layout="constrained", width_ratios=[1.4, 1, 1.2]
    )
    colors = [START if row["trusted"] else NEUTRAL for row in rows.values()]

    def column(name: str) -> NDArray:
        return np.array([row[name] for row in rows.values()], dtype=float)

    for ax in axes:
        ax.spines[["top", "right", "left"]].set_visible(False)
        ax.tick_params(axis="y", length=0)
    _evidences(
        axes[0], column("log_evidence"), column("standard_error"), column("trusted") > 0, colors
    )
    _bars(axes[1], 100 * column("ess_fraction"), colors, "ESS, %")
    run = column("seconds_per_effective_sample")
    total = column("seconds_per_effective_sample_with_training")
    trained = bool(np.any(total > run))
    # the longer bars first, in a pale colour: those of the run cover their beginnings
    if trained:
        axes[2].barh(range(len(rows)), _finite(total), height=0.5, color=ACCENT, alpha=0.35)
    label = "seconds per effective sample" + trained * "\n(pale: with training)"
    _bars(axes[2], run, colors, label, total)
    axes[0].set_yticks(range(len(rows)), list(rows))
    axes[0].set_ylim(len(rows) - 0.4, -0.6)  # the first row at the top
    figure.savefig(path, dpi=150)
    plt.close(figure)
    return figure


def _evidences(ax, values: NDArray, errors: NDArray, trusted: NDArray, colors: list[str]) -> None:
    for i, color in enumerate(colors):
        if np.isfinite(values[i]):
            error = 2 * errors[i] if np.isfinite(errors[i]) else None
            ax.errorbar(values[i], i, xerr=error, color=color, marker="o", markersize=4, capsize=3)
        if not trusted[i]:
            # where there is no point to be grey, the value is said
            value = "" if np.isfinite(values[i]) else f"{values[i]}, "
            words = f"{value}not to be trusted"
            place = {"xycoords": ("axes fraction", "data"), "ha": "left", "va": "bottom"}
            ax.annotate(words, (0.02, i - 0.12), fontsize=7, color=NEUTRAL, **place)
    ax.set_xlabel("log evidence ± 2 SE", fontsize=9)
    ax.margins(x=0.1)


def _bars(
    ax, values: NDArray, colors: list[str], label: str, totals: NDArray | None = None
) -> None:
    """Horizontal bars with numbers in place of an axis; what is not finite has no bar."""
    totals = values if totals is None else totals
    ax.barh(range(len(values)), _finite(values), height=0.5, color=colors)
    for i, (value, total) in enumerate(zip(values, totals, strict=True)):
        words = f"{value:.3g}" + (f", {total:.3g}" if total > value else "")
        ax.annotate(
            words, (_finite(total), i), (3, 0), textcoords="offset points", va="center", fontsize=8
        )
    ax.set_xlabel(label, fontsize=9)
    ax.set_xlim(0.0, 1.5 * max(_finite(totals).max(), np.finfo(float).tiny))
    ax.spines["bottom"].set_visible(False)
    ax.set_xticks([])


def _finite(values: Any) -> NDArray:
    return np.where(np.isfinite(values), values, 0.0)
