"""Landmarks and outlines in CSV tables.

A wide table has one row for a specimen, with columns id, x1, y1, x2, y2, ...; a long one has one row for a
point, with columns id, point, x, y.
"""

import csv
import io
import re
from collections.abc import Iterable, Sequence
from os import PathLike

import numpy as np

from .._checks import choice, require, words
from ._specimen import Specimen, as_specimens, fail, number, open_text, read_text, text

_MISSING = ("", "na", "nan")


def read_csv(
    path: str | PathLike,
    *,
    id: str = "id",
    point: str = "point",
    delimiter: str = ",",
    encoding: str = "utf-8",
) -> list[Specimen]:
    """Specimens of a CSV table with a header, in wide or long layout.

    *Wide*: columns x1, y1, ..., xn, yn (or x1, y1, z1, ...; numbering may begin at 0), in any order. *Long*:
    columns x, y (and z). Further columns go to `Specimen.notes`, in the long layout those that are constant
    within each specimen. Empty cells, `NA` and `NaN` are missing values and become NaN.

    **Arguments:**

    - `path`: the file; a name that ends in `.gz` is decompressed.
    - `id`: the column that names specimens. Without it, wide rows have no name, and long rows are one
      specimen.
    - `point`: long layout: the column that numbers the points of a specimen, from 0 or 1 without gaps; rows
      may come in any order. Without it they are in order.
    - `delimiter`, `encoding`: of the text.

    **Returns:** a list of `Specimen`, in order of appearance.

    **Raises:** `ValueError` with file, line number, what was expected and what was found, for anything else.
    """
    for name, value in (("id", id), ("point", point)):
        require(isinstance(value, str), f"`{name}` must be the name of a column; got {words(value)}.")
    _check_delimiter(delimiter)
    content = read_text(path, encoding, newline="")
    reader = csv.reader(io.StringIO(content, newline=""), delimiter=delimiter)
    header = [name.strip() for name in next(reader, [])]
    if not any(header):
        fail(path, 1, "a header such as id,x1,y1,x2,y2", "nothing", "Write the names of the columns.")
    if len(set(header)) < len(header):
        twice = next(name for name in header if header.count(name) > 1)
        fail(path, 1, "different names of columns", f"{twice!r} twice", "Rename one of them.")
    rows = []
    for cells in reader:
        if not any(cell.strip() for cell in cells):
            continue
        if len(cells) != len(header):
            cure = "Quote cells that contain the delimiter; leave missing cells empty."
            fail(path, reader.line_num, f"{len(header)} cells as in the header", f"{len(cells)}", cure)
        rows.append((reader.line_num, dict(zip(header, (cell.strip() for cell in cells), strict=True))))
    if not rows:
        fail(path, reader.line_num + 1, "at least one row", "the end of the file", "Export the table again.")
    if any(re.fullmatch(r"x\d+", name) for name in header):
        return _read_wide(path, header, rows, id)
    if {"x", "y"} <= set(header):
        return _read_long(path, header, rows, id, point)
    cure = "Rename the columns, or pass the `delimiter` of the file."
    fail(path, 1, "columns x1, y1, ... or x, y", ", ".join(map(repr, header)), cure)


def write_csv(
    path: str | PathLike,
    specimens: Iterable[Specimen],
    *,
    layout: str = "wide",
    delimiter: str = ",",
    encoding: str = "utf-8",
) -> None:
    """Write the landmarks of specimens so that `read_csv` returns the same ones, to the last digit.

    Columns are `id`, the notes, then the coordinates; the long layout numbers points from 1. Missing values
    are NA.

    **Arguments:**

    - `path`: the file; a name that ends in `.gz` is compressed.
    - `specimens`: with the same keys of notes and the same dimension; for the wide layout with equally many
      landmarks.
    - `layout`: `"wide"` or `"long"`.

    **Raises:** `ValueError` for specimens that do not fit one table, and for curves, images and scales, which
    have no column.
    """
    specimens = as_specimens(specimens)
    choice(layout, "layout", ("wide", "long"))
    _check_delimiter(delimiter)
    _check_table(specimens, layout)
    shape, notes = specimens[0].landmarks.shape, list(specimens[0].notes)
    axes = "xyz"[: shape[1]]
    if layout == "wide":
        header = ["id", *notes, *(f"{axis}{i}" for i in range(1, shape[0] + 1) for axis in axes)]
        rows = [[s.id, *s.notes.values(), *map(text, s.landmarks.ravel())] for s in specimens]
    else:
        header = ["id", *notes, "point", *axes]
        rows = [
            [s.id, *s.notes.values(), i, *map(text, row)]
            for s in specimens
            for i, row in enumerate(s.landmarks, start=1)
        ]
    with open_text(path, "w", encoding, newline="") as file:
        writer = csv.writer(file, delimiter=delimiter, lineterminator="\n")
        writer.writerows([header, *rows])


_Rows = Sequence[tuple[int, dict[str, str]]]


def _read_wide(path: str | PathLike, header: list[str], rows: _Rows, id: str) -> list[Specimen]:
    axes = "xyz" if any(re.fullmatch(r"z\d+", name) for name in header) else "xy"
    numbered = [name for name in header if re.fullmatch(rf"[{axes}]\d+", name)]
    indices = sorted({int(name[1:]) for name in numbered})
    first = min(indices[0], 1)
    wanted = [f"{axis}{i}" for i in range(first, indices[-1] + 1) for axis in axes]
    absent = [name for name in wanted if name not in header]
    if absent:
        cure = f"Every point from {first} to {indices[-1]} needs the columns {', '.join(axes)}."
        fail(path, 1, f"the column {absent[0]!r}", f"columns up to {numbered[-1]!r} without it", cure)
    others = [name for name in header if name not in wanted and name != id]
    return [
        Specimen(
            np.reshape([number(row[name], path, line, _MISSING) for name in wanted], (-1, len(axes))),
            id=row.get(id) or None,
            notes={name: row[name] for name in others},
        )
        for line, row in rows
    ]


def _read_long(path: str | PathLike, header: list[str], rows: _Rows, id: str, point: str) -> list[Specimen]:
    axes = [axis for axis in "xyz" if axis in header]
    others = [name for name in header if name not in (*axes, id, point)]
    groups: dict[str | None, list[tuple[int, dict[str, str]]]] = {}
    for line, row in rows:
        groups.setdefault(row.get(id) or None, []).append((line, row))
    constant = [name for name in others if all(len({row[name] for _, row in group}) == 1 for group in groups.values())]
    specimens = []
    for name, group in groups.items():
        ordered = _in_order(path, group, point) if point in header else group
        landmarks = [[number(row[axis], path, line, _MISSING) for axis in axes] for line, row in ordered]
        notes = {key: group[0][1][key] for key in constant}
        specimens.append(Specimen(np.array(landmarks), id=name, notes=notes))
    return specimens


def _in_order(path: str | PathLike, group: _Rows, point: str) -> _Rows:
    """Rows of one specimen by the number of their point."""
    cure = "Number the points of a specimen from 0 or 1, each once; give a missing one a row with NA."
    numbered = []
    for line, row in group:
        if not row[point].isdecimal():
            fail(path, line, f"a whole number in {point!r}", repr(row[point]), cure)
        numbered.append((int(row[point]), line, row))
    numbered.sort(key=lambda entry: entry[:2])
    for expected, (found, line, _) in enumerate(numbered, start=min(numbered[0][0], 1)):
        if found != expected:
            fail(path, line, f"point {expected} next", f"point {found}", cure)
    return [(line, row) for _, line, row in numbered]


def _check_delimiter(delimiter: str) -> None:
    good = isinstance(delimiter, str) and len(delimiter) == 1 and delimiter not in '\r\n"'
    require(good, f"`delimiter` must be one character; got {words(delimiter)}.")


def _check_table(specimens: list[Specimen], layout: str) -> None:
    first = specimens[0]
    columns = slice(None) if layout == "wide" else slice(1, None)
    for i, specimen in enumerate(specimens):
        if specimen.curves or specimen.image is not None or specimen.scale is not None:
            raise ValueError(
                f"`specimens[{i}]` has curves, an image or a scale, which no column holds: use `write_tps`."
            )
        if specimen.landmarks.shape[columns] != first.landmarks.shape[columns] or not len(specimen.landmarks):
            raise ValueError(
                f"`specimens[{i}]` has landmarks of shape {specimen.landmarks.shape}, the first of "
                f"{first.landmarks.shape}: a table holds shapes of one dimension with at least one point, "
                "a wide one also of one number of points."
            )
        if list(specimen.notes) != list(first.notes):
            raise ValueError(
                f"`specimens[{i}]` has the notes {list(specimen.notes)}, the first {list(first.notes)}: "
                "give all the same keys in the same order."
            )
    ids = [specimen.id for specimen in specimens]
    if layout == "long" and len(set(ids)) < len(ids):
        raise ValueError("`specimens` need different ids in a long table, where they keep the rows together.")
