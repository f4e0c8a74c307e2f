"""Sets of specimens: as one array, and together with what another table says of them."""

import dataclasses
import difflib
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .._checks import as_path, choice, require, words
from ._csv import Table, check_delimiter, read_table
from ._specimen import Specimen, as_specimens, called, check_encoding, fail


class Stack(NamedTuple):
    """What `stack` returns.

    - `names`: the `id` of each specimen, `None` where it has none.
    - `shapes`: (N, n, d), NaN where a point is missing.
    """

    names: list[str | None]
    shapes: NDArray


def stack(specimens: Iterable[Specimen], *, points: str = "all") -> Stack:
    """The names of specimens and one array of their points, which must be equally many.

    **Arguments:**

    - `specimens`: of one dimension, with the same numbers of landmarks and of points on each curve.
    - `points`: `"all"`, landmarks and then those of the curves; `"landmarks"`; or `"curves"`.
      Curves often begin and end at landmarks: to have such points twice is to have two that can
      never part.

    **Returns:** `(names, shapes)`, a `Stack`.

    **Raises:** `ValueError` that names the specimens that differ from most.
    """
    specimens = as_specimens(specimens)
    choice(points, "points", ("all", "landmarks", "curves"))
    # compared by what would be said of them: specimens that differ can then be told so
    kinds = [_kind(specimen, points) for specimen in specimens]
    (usual, how_many), *_ = Counter(kinds).most_common(1)
    odd = [i for i, kind in enumerate(kinds) if kind != usual]
    if odd:
        listed = "; ".join(f"{called(specimens, i)} has {kinds[i]}" for i in odd[:5])
        more = f"; and {len(odd) - 5} more" if len(odd) > 5 else ""
        raise ValueError(
            f"`specimens` must have the same points; {how_many} of {len(specimens)} have {usual}, "
            f"but {listed}{more}. Leave them out, or give a missing landmark a row of NA."
        )
    shapes = np.stack([np.concatenate(_parts(specimen, points)) for specimen in specimens])
    if shapes.shape[1] == 0:
        has = _kind(specimens[0], "all")
        raise ValueError(
            f"`specimens` must have points to stack; got {has}, and points={points!r}."
        )
    return Stack([specimen.id for specimen in specimens], shapes)


def _parts(specimen: Specimen, points: str) -> list[NDArray]:
    landmarks = specimen.landmarks[: 0 if points == "curves" else None]
    return [landmarks, *(() if points == "landmarks" else specimen.curves)]


def _kind(specimen: Specimen, points: str) -> str:
    """What must agree, in words."""
    said = []
    if points != "curves":
        said.append(f"{len(specimen.landmarks)} landmarks")
    if points != "landmarks" and (specimen.curves or not said):
        said.append(
            f"curves of {', '.join(str(len(curve)) for curve in specimen.curves) or 'no'} points"
        )
    return " and ".join(said) + f" in {specimen.landmarks.shape[1]} dimensions"


def join(
    specimens: Iterable[Specimen],
    table: Any,
    *,
    by: str | None = "id",
    of: str = "id",
    delimiter: str | None = None,
    encoding: str = "utf-8",
) -> list[Specimen]:
    """Specimens with what a second table says of each, such as species and sex, in their `notes`.

    **Arguments:**

    - `table`: a CSV file with a row for each specimen, or a `pandas.DataFrame`. Rows of others are
      left out.
    - `by`: the column of the table that names the specimen, in any case; `None` takes row after
      row, as many as there are specimens.
    - `of`: what the specimen is called there: its `"id"`, its `"image"`, or a key of its `notes`.
    - `delimiter`, `encoding`: of the file, as in `read_csv`.

    **Returns:** new specimens in the same order, the columns of the table after their own notes.

    **Raises:** `ValueError` that lists specimens without a row and near spellings; for several rows
    of one, and for a column whose key the notes have with another text.
    """
    specimens = as_specimens(specimens)
    require(
        by is None or isinstance(by, str),
        f"`by` must be the name of a column, or None; got {words(by)}.",
    )
    require(
        isinstance(of, str), f"`of` must be 'id', 'image' or a key of the notes; got {words(of)}."
    )
    if delimiter is not None:
        check_delimiter(delimiter)
    check_encoding(encoding)
    if hasattr(table, "columns"):  # a data frame; pandas need not be installed
        header = [str(name) for name in table.columns]
        rows = [
            dict(zip(header, map(_as_text, row), strict=True))
            for row in table.itertuples(index=False)
        ]
        column = _column(header, by)
    else:
        read = read_table(as_path(table, "table"), delimiter, encoding)
        if read.bare:
            cure = "Write the names of the columns above them."
            fail(table, 1, "a header such as id,species", "numbers only", cure)
        rows = [row.cells for row in read.rows]
        column = None if by is None else read.column(by)
        header = read.header
    require(
        by is None or column is not None,
        f"`by` must be a column of the `table`, one of {', '.join(map(repr, header))}; got {by!r}. "
        "`by=None` takes row after row.",
    )
    chosen = _in_order(specimens, rows) if column is None else _by_name(specimens, rows, column, of)
    kept = [name for name in header if name and name != column]
    joined = []
    for i, row in enumerate(chosen):
        notes = _together(specimens, i, {name: row[name] for name in kept})
        joined.append(dataclasses.replace(specimens[i], notes=notes))
    return joined


def _column(header: Sequence[str], by: str | None) -> str | None:
    # by the rule of a file's table, whatever the case
    return None if by is None else Table("", list(header), [], ",", False).column(by)


def _as_text(value: Any) -> str:
    """A cell of pandas: numbers that it made floats are whole again, the missing are empty."""
    if value is None or value != value:  # NaN, of whatever type
        return ""
    # a column of integers with one missing is of floats in pandas: 7.0 was 7
    return str(int(value)) if isinstance(value, float) and value.is_integer() else str(value)


def _in_order(specimens: list[Specimen], rows: list[dict[str, str]]) -> list[dict[str, str]]:
    require(
        len(rows) == len(specimens),
        f"`table` must have a row for each of {len(specimens)} specimens with by=None; got "
        f"{len(rows)}. Pass `by`, the column that names them.",
    )
    return rows


def _by_name(
    specimens: list[Specimen], rows: list[dict[str, str]], column: str, of: str
) -> list[dict[str, str]]:
    named: dict[str, dict[str, str]] = {}
    twice = []
    for row in rows:
        name = row[column]
        if name in named:
            twice.append(name)
        named[name] = row
    names = [_name(specimens, i, of) for i in range(len(specimens))]
    # rows of others are left out, however often they come
    twice = [name for name in twice if name in names]
    require(
        not twice,
        f"`table` must have one row for a specimen; several have {(twice or [''])[0]!r} in "
        f"{column!r}.",
    )
    lacking = [name for name in names if name not in named]
    if lacking:
        near = {name: difflib.get_close_matches(name, named, 1) for name in lacking[:5]}
        listed = ", ".join(
            repr(name) + (f" (there is {found[0]!r})" if found else "")
            for name, found in near.items()
        )
        more = f" and {len(lacking) - 5} more" if len(lacking) > 5 else ""
        raise ValueError(
            f"`table` must have a row for each specimen; {column!r} lacks {listed}{more}. Correct "
            "the names, or say by `by` and `of` what names specimens."
        )
    return [named[name] for name in names]


def _name(specimens: list[Specimen], i: int, of: str) -> str:
    """What a specimen is called in the table."""
    specimen = specimens[i]
    found = getattr(specimen, of) if of in ("id", "image") else specimen.notes.get(of)
    require(
        found is not None,
        f"{called(specimens, i)} has no {of!r} to be found by in the `table`: say by `of` what "
        "names it, or take row after row by `by=None`.",
    )
    return str(found)


def _together(specimens: list[Specimen], i: int, more: dict[str, str]) -> dict[str, str]:
    notes = dict(specimens[i].notes)
    # neither of two texts is taken for the other; the same text twice is no matter
    differ = [key for key, value in more.items() if notes.get(key, value) != value]
    require(
        not differ,
        f"{called(specimens, i)} has notes that the `table` has with other texts: "
        f"{', '.join(differ)}. Rename the columns.",
    )
    return notes | more
