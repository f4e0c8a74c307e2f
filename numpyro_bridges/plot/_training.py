"""What training has brought to learned guides, and when it stopped."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from .._checks import require, require_instance, words
from ..guiding import ScoreGuide
from ._canvas import ACCENT, NEUTRAL, START, TARGET, as_file, pyplot

_COLORS = (START, TARGET, ACCENT, NEUTRAL)
_COLUMNS = ("bound", "ess", "seconds", "kept")


def training(guides: ScoreGuide | Mapping[str, ScoreGuide], file: Any) -> Any:
    """The evidence bound and the ESS on held-out paths against the seconds of training, written to
    a file.

    A dot marks the network that was kept; what came after it, drawn pale, did not help. The first
    look is at the guide without training. `nb.scores.fit` trains what is drawn.

    **Arguments:** `guides`: a trained `ScoreGuide`; or several by name, such as one for each
    method. `file`: where to write; matplotlib knows the format by its ending.

    **Returns:** the `Figure`, closed. **Errors:** `ValueError` for a guide without a history;
    `ImportError` without matplotlib.
    """
    guides = guides if isinstance(guides, Mapping) else {"": guides}
    require(len(guides) > 0, "`guides` must hold at least one `ScoreGuide`; got none.")
    for name, guide in guides.items():
        label = f"guides[{name!r}]" if name else "guides"
        require_instance(guide, ScoreGuide, label, "a trained `ScoreGuide`")
        require(
            all(column in guide.history for column in _COLUMNS),
            f"`{label}` must have a history of its training, as `nb.scores.fit` gives; got "
            f"{words(guide.history)}.",
        )
    plt = pyplot()
    file = as_file(file, "file")
    figure, axes = plt.subplots(1, 2, figsize=(8.0, 3.0), sharex=True, layout="constrained")
    for i, (name, guide) in enumerate(guides.items()):
        bound, ess, seconds, was_kept = (
            np.asarray(guide.history[column], float) for column in _COLUMNS
        )
        # each was better than those before
        kept = int(np.flatnonzero(was_kept)[-1]) if was_kept.any() else 0
        color = _COLORS[i % len(_COLORS)]
        for ax, values in zip(
            axes, (np.where(np.isfinite(bound), bound, np.nan), 100 * ess), strict=True
        ):
            ax.plot(seconds[kept:], values[kept:], color=color, alpha=0.35)
            ax.plot(seconds[: kept + 1], values[: kept + 1], color=color, label=name)
            ax.plot(seconds[kept], values[kept], color=color, marker="o", markersize=5)
    for ax, label in zip(axes, ("evidence bound, nats", "ESS, %"), strict=True):
        ax.set_ylabel(label, fontsize=9)
        ax.spines[["top", "right"]].set_visible(False)
    axes[1].set_ylim(0.0, 100.0)
    figure.supxlabel("seconds of training; a dot: the network that was kept", fontsize=9)
    if len(guides) > 1:
        axes[0].legend(fontsize=8, frameon=False)
    figure.savefig(file, dpi=150)
    plt.close(figure)
    return figure
