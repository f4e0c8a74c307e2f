"""Small sets of shapes for examples and tests, aligned and of unit size, and a tree."""

import csv
import importlib.util
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ._checks import known_float, positive_integer, words
from .shapes import procrustes_align, resample
from .trees import Tree

# lengths by Grafen's rule: see `mosquito_tree`
_MOSQUITO_TREE = (
    "(AN:1,(UR:0.9,((((TO:0.1,WY:0.1):0.3,(MA:0.2,(OR:0.1,CA:0.1):0.1):0.2):0.2,(CX:0.1,DE:0.1)Culicini:0.5):0.2,"
    "(PS:0.1,AE:0.1)Aedini:0.7):0.1)Culicinae:0.1);"
)


@dataclass(frozen=True, eq=False)
class Shapes:
    """Shapes in register: aligned on their mean, each of unit RMS radius, centred.

    - `points`: (N, num_points, 2).
    - `mean`: (num_points, 2), their Procrustes mean, of unit RMS radius too.
    - `labels`: the group of each shape, such as its genus.
    - `names`: a name for each shape.
    """

    points: NDArray
    mean: NDArray
    labels: tuple[str, ...]
    names: tuple[str, ...]


GENERA = {
    "AE": "Aedes",
    "AN": "Anopheles",
    "CA": "Culiseta",
    "CX": "Culex",
    "DE": "Deinocerites",
    "MA": "Mansonia",
    "OR": "Orthopodomyia",
    "PS": "Psorophora",
    "TO": "Toxorhynchites",
    "UR": "Uranotaenia",
    "WY": "Wyeomyia",
}
"""Names of the genera by the codes of the source, which gives these alone."""


def mosquito_wings(num_points: int = 32, genus: str | None = None) -> Shapes:
    """Outlines of mosquito wings (Rohlf & Archie 1984), from the package `ktch`.

    126 specimens. By the source's codes of the genera: 57 of `AE`, *Aedes*; 25 of `CX`, *Culex*; 12
    of `PS`, *Psorophora*; 11 of `AN`, *Anopheles*; 7 of `CA`, *Culiseta*; 4 each of `UR`,
    *Uranotaenia*, and `WY`, *Wyeomyia*; 3 of `MA`, *Mansonia*; 1 each of `DE`, *Deinocerites*,
    `OR`, *Orthopodomyia*, and `TO`, *Toxorhynchites*.

    The source gives 100 points of each outline at equal polar angles, which crowds them in the
    middle of a long wing; here they are at equal arc length. The first point of every outline is
    the corner at the wing's hinge; they run counter-clockwise. Shapes are aligned within the
    selection by rotations, so the same wing is turned a little differently in another selection.
    The long axis of the mean lies on the x-axis, the hinge at positive x.

    **Arguments:**

    - `num_points`: of each outline, at least 3. More than about 100 only interpolate the source.
    - `genus`: a code or a name from above; all genera without it.

    **Returns:** `Shapes`; labels are genera, names such as `"CX 103"` hold the source's number.

    **Raises:** `ImportError` without `ktch`, `ValueError` for a genus that is not there.
    """
    num_points = positive_integer(num_points, "num_points", least=3)
    folder = _ktch_data() / "outline_mosquito_wings"
    with open(folder / "meta_outline_mosquito_wings.csv", encoding="utf-8", newline="") as file:
        genera = {row["specimen_id"]: row["genus"] for row in csv.DictReader(file)}
    chosen = [
        specimen
        for specimen, code in genera.items()
        if genus is None or str(genus) in (code, GENERA[code])
    ]
    if not chosen:
        available = ", ".join(
            f"{code!r}, {GENERA[code]} ({count})"
            for code, count in Counter(genera.values()).most_common()
        )
        raise ValueError(
            f"`genus` must be one of {available}, or None for all; got {words(genus)}."
        )
    # columns: specimen, number of the point, x, y
    specimen, _, *xy = np.loadtxt(
        folder / "data_outline_mosquito_wings.csv", delimiter=",", skiprows=1, unpack=True
    )
    outlines = [np.stack(xy, axis=1)[specimen == int(name)] for name in chosen]
    labels = tuple(genera[name] for name in chosen)
    names = tuple(f"{label} {name}" for label, name in zip(labels, chosen, strict=True))
    wings = _in_register([resample(outline, num_points) for outline in outlines], labels, names)
    return _along_x(wings)


def mosquito_tree() -> Tree:
    """The tree of the 11 genera of `mosquito_wings`, one unit high, its tips named by their codes.

    *Anopheles* `AN`, *Uranotaenia* `UR`, *Toxorhynchites* `TO`, *Wyeomyia* `WY`, *Mansonia* `MA`,
    *Orthopodomyia* `OR`, *Culiseta* `CA`, *Culex* `CX`, *Deinocerites* `DE`, *Psorophora* `PS`,
    *Aedes* `AE`. The source of the wings gives codes alone; they come in the usual order of the
    genera, in which *Culiseta* stands where `CA` does. Inner nodes with a name are `Culicinae`,
    `Culicini` and `Aedini`.

    The topology is that of the amino acids of 709 genes in 256 species (Soghigian and others 2023),
    pruned to these genera [@soghigian2023]. There *Deinocerites* lies within *Culex*, and *Aedes*
    holds genera that are not here.

    **Lengths are no dates.** They are those of Grafen (1989): a node with n tips below it lies (n −
    1)/10 before the present [@grafen1989]. Rates per unit of time are rates per height of this
    tree.
    """
    return Tree.from_newick(_MOSQUITO_TREE)


def ellipses(num_points: int = 32, aspects: Sequence[float] = (1.0, 1.25, 1.5, 2.0)) -> Shapes:
    """Ellipses with the given ratios of their axes: the smallest set to try a model on, without a
    download.

    Points are at equal arc length, counter-clockwise from the end of the long axis at positive x
    (for a ratio below 1, the short one). Labels are the ratios.

    **Arguments:**

    - `num_points`: of each outline, at least 3.
    - `aspects`: ratios of the x-axis to the y-axis, from 1e-6 to 1e6.

    **Returns:** `Shapes`.
    """
    num_points = positive_integer(num_points, "num_points", least=3)
    ratios = known_float(aspects, "aspects")
    if ratios.ndim != 1 or ratios.size == 0 or not np.all((ratios >= 1e-6) & (ratios <= 1e6)):
        raise ValueError(
            f"`aspects` must be one or more ratios from 1e-6 to 1e6; got {words(aspects)}."
        )
    # equal angles are not equal arc lengths: many of them, of which `resample` takes some
    angles = np.linspace(0.0, 2.0 * np.pi, 100 * num_points, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    labels = tuple(f"{aspect:g}" for aspect in ratios)
    points = [resample(circle * [aspect, 1.0], num_points) for aspect in ratios]
    return _in_register(points, labels, tuple(f"ellipse {label}" for label in labels))


def _in_register(
    points: Sequence[NDArray], labels: tuple[str, ...], names: tuple[str, ...]
) -> Shapes:
    alignment = procrustes_align(np.stack(points))
    return Shapes(alignment.shapes, alignment.mean, labels, names)


def _along_x(shapes: Shapes) -> Shapes:
    """Turned so that the mean's long axis is the x-axis and its first point lies at positive x."""
    # principal axes of the mean, which is centred; their signs are arbitrary
    _, _, axes = np.linalg.svd(shapes.mean)
    axes[0] *= np.sign(shapes.mean[0] @ axes[0])
    # the first axis and what is a quarter turn from it: a rotation, never a reflection
    turn = np.stack([axes[0], [-axes[0, 1], axes[0, 0]]], axis=1)
    return replace(shapes, points=shapes.points @ turn, mean=shapes.mean @ turn)


def _ktch_data() -> Path:
    """The folder of data inside `ktch`, found without importing it, which takes seconds."""
    spec = importlib.util.find_spec("ktch")
    folders = spec.submodule_search_locations if spec is not None else None
    if not folders:
        raise ImportError(
            "The outlines are in the package `ktch`, which is not installed: pip install "
            "'numpyro_bridges[examples]'"
        )
    return Path(folders[0]) / "datasets" / "data"
