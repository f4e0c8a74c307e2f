"""Landmarks and outlines in CSV tables.

A wide table has one row for a specimen, with columns id, x1, y1, x2, y2, ...; a long one has one
row for a point, with columns id, point, x, y.
"""

import csv
import io
import re
import warnings
from collections import Counter
from collections.abc import Collection, Iterable
from os import PathLike, fspath
from typing import NamedTuple

import numpy as np

from .._checks import choice, positive_integer, require, words
from ._specimen import (
    Specimen,
    as_specimens,
    fail,
    missing_codes,
    number,
    open_text,
    read_text,
    stem,
    text,
    warn_of_codes,
)

_DELIMITERS = ("\t", ";", "|", ",", " ")
"""In the order in which they are looked for: names and numbers may have commas and blanks in
them."""

_SEPARATED = r"[\s._-]*"
_NUMBERED = (  # in lower case; what comes before tells several sets of columns apart
    re.compile(rf"(?P<set>(?:.*[^a-z])?)(?P<axis>[xyz]){_SEPARATED}(?P<number>\d+)"),
    re.compile(rf"(?P<set>.*?)(?P<number>\d+){_SEPARATED}(?P<axis>[xyz])"),
)
"""x1, X01, raw.x_1; and 1_x, 1.X, LM1x."""

_COUNTED = re.compile(
    rf"(?P<set>((raw|proc|procrustes){_SEPARATED})?coord)(inate)?s?{_SEPARATED}(?P<number>\d+)"
)
"""RawCoord1: coordinates numbered through."""

_NAMED = re.compile(r"(?P<name>.+)[\s._-]+(?P<axis>[xyz])")
"""nasion_x."""

_ONE_SET = "Delete or rename the columns of the others."

_CURE = "Pass the `decimal` sign, or name the codes of `missing` values."


def read_csv(
    path: str | PathLike,
    *,
    id: str | None = "id",
    point: str = "point",
    delimiter: str | None = None,
    decimal: str | None = None,
    missing: str | float | Iterable[str | float] = (),
    dim: int | None = None,
    encoding: str = "utf-8",
) -> list[Specimen]:
    """Specimens of a CSV table with a header, in wide or long layout.

    *Wide*: columns x1, y1, ..., xn, yn (or x1, y1, z1, ...; numbering may begin at 0), in any
    order. Upper case, leading zeros, the number in front (`1_x`, `1.X`, `LM1_x`), names for numbers
    (`nasion_x`, in the order in which they come) and coordinates numbered through (`RawCoord1`) are
    read as well. *Long*: columns x, y (and z). Further columns go to `Specimen.notes`, in the long
    layout those that are constant within each specimen.

    Empty cells and columns at the end do not matter, nor do lines of comment (#) above the header,
    which may be one. A first column without a name holds the names of the rows, which in a wide
    table without a column `id` are those of the specimens. Two columns of numbers without a header
    are the points of one specimen, which has the name of the file.

    **Arguments:**

    - `path`: the file; one that gzip compressed is decompressed.
    - `id`: the column that names specimens, in any case. Without it, wide rows have no name. A long
      table may lack it only if no other column could be it; `None` says that it is one specimen.
    - `point`: long layout: the column that numbers the points of a specimen, from 0 or 1 without
      gaps; rows may come in any order. Without it they are in order.
    - `delimiter`: by default the first of tab, semicolon, bar, comma and blanks that divides the
      header.
    - `decimal`: the decimal sign; by default a comma where numbers have commas and none has a
      point.
    - `missing`: codes for a missing value, such as -999, beside empty cells, `NA`, `NaN`, `null`
      and the like. Missing values become NaN. A `UserWarning` tells of points that look like codes
      and are not read so.
    - `dim`: 2 or 3, where coordinates are numbered through.
    - `encoding`: of the text, unless the file has a byte order mark, which says it.

    **Returns:** a list of `Specimen`, in order of appearance.

    **Raises:** `ValueError` with file, line number, what was expected and what was found, for
    anything else.
    """
    _check_settings(id, point, decimal, dim)
    codes = missing_codes(missing)
    table = read_table(path, delimiter, encoding)
    # what the columns are called decides the layout; with both there would be a choice to make
    wide = _wide_columns(table)
    long = _long_columns(table)
    if wide and long:
        found = f"those of {list(long.values())[0]!r} and {wide[0]!r}"
        fail(path, 1, "one set of coordinates", found, _ONE_SET)
    columns = wide or list(long.values()) or _bare_columns(table)
    sign = decimal or _decimal_sign(table, columns, codes)
    # called from here, since it may warn, of the line that calls this function
    axes = len(long) if long else _num_axes(table, columns, dim)
    points = _points(table, columns, axes, codes, sign)
    if wide:
        specimens = _wide(table, points, columns, id)
    elif long:
        specimens = _long(table, points, columns, id, point)
    else:
        specimens = [Specimen(np.concatenate(list(points.values())), id=stem(path))]
    warn_of_codes(path, specimens, "Name the code in `missing` if so.")
    return specimens


def _check_settings(id, point, decimal, dim) -> None:
    for name, value in (("id", id), ("point", point)):
        allowed = isinstance(value, str) or name == "id" and value is None
        require(allowed, f"`{name}` must be the name of a column; got {words(value)}.")
    require(
        decimal in (None, ".", ","), f"`decimal` must be '.' or ',', or None; got {words(decimal)}."
    )
    if dim is not None:
        message = f"`dim` must be 2 or 3, or None; got {words(dim)}."
        require(positive_integer(dim, "dim") in (2, 3), message)


def write_csv(
    path: str | PathLike,
    specimens: Iterable[Specimen],
    *,
    layout: str = "wide",
    delimiter: str = ",",
    encoding: str = "utf-8",
) -> None:
    """Write the landmarks of specimens so that `read_csv` returns the same ones, to the last digit.

    Columns are `id`, the notes, then the coordinates; the long layout numbers points from 1.
    Missing values are NA.

    **Arguments:**

    - `path`: the file; a name that ends in `.gz` is compressed.
    - `specimens`: with the same keys of notes and the same dimension; for the wide layout with
      equally many landmarks.
    - `layout`: `"wide"` or `"long"`.

    **Raises:** `ValueError` for specimens that do not fit one table, and for curves, images and
    scales, which have no column.
    """
    specimens = as_specimens(specimens)
    choice(layout, "layout", ("wide", "long"))
    check_delimiter(delimiter)
    _check_table(specimens, layout)
    shape = specimens[0].landmarks.shape
    notes = list(specimens[0].notes)
    axes = "xyz"[: shape[1]]
    # numbers as the shortest texts that read back as the same ones
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
    with open_text(path, encoding) as file:
        writer = csv.writer(file, delimiter=delimiter, lineterminator="\n")
        writer.writerows([header, *rows])


class Row(NamedTuple):
    """Cells by column, and the line of the file that they end on."""

    line: int
    cells: dict[str, str]


class Table(NamedTuple):
    """A table as text."""

    path: str | PathLike
    header: list[str]
    rows: list[Row]
    delimiter: str
    bare: bool
    """Whether the file has no header: columns are called 1, 2, ..."""

    def column(self, name: str) -> str | None:
        """The column of this name, or the only one of this name in other cases."""
        alike = [column for column in self.header if column.lower() == name.lower()]
        if name in alike:
            return name
        return alike[0] if len(alike) == 1 else None

    def listed(self) -> str:
        """The columns, for messages."""
        return ", ".join(map(repr, self.header))


def read_table(path: str | PathLike, delimiter: str | None, encoding: str) -> Table:
    """Any table, with or without a header, by column."""
    if delimiter is not None:
        check_delimiter(delimiter)
    content = read_text(path, encoding)
    # lines above the table, which count for the numbers of lines in messages
    above = re.findall(r"\A(?:(?:sep=.|#.*)\n)*", content.replace("\r\n", "\n"))[0].splitlines()
    content = content.split("\n", len(above))[-1]
    said = [line[4] for line in above if line.startswith("sep=")]  # for a spreadsheet program
    if delimiter is None:
        delimiter = str(said[0]) if said else _delimiter_of(content)
    records = _records(path, content, delimiter, len(above))
    if not records:
        cure = "Write the names of the columns."
        fail(path, 1, "a header such as id,x1,y1,x2,y2", "nothing", cure)
    header, records, bare = _header(path, records, above, delimiter)
    records = [(line, _without_empty_end(cells, len(header))) for line, cells in records]
    if not bare and all(len(cells) == len(header) + 1 for _, cells in records):
        header = ["", *header]  # as R writes the names of rows
    # the first column may lack a name, where it names the rows; others are empty columns
    kept = [j for j, name in enumerate(header) if name or j == 0]
    _check_cells(path, records, len(header), kept)
    header = [header[j] for j in kept]
    _check_different(path, header)
    rows = []
    for line, cells in records:
        named = {name: cells[j] for name, j in zip(header, kept, strict=True)}
        rows.append(Row(line, named))
    return Table(path, header, rows, delimiter, bare)


_Records = list[tuple[int, list[str]]]
"""The (last) line of each, and its cells."""


def _records(path: str | PathLike, content: str, delimiter: str, num_above: int) -> _Records:
    """Stripped cells of the lines that have any."""
    reader = _reader(content, delimiter)
    records = []
    try:
        for cells in reader:
            # a quoted cell may have line breaks: only the reader knows the line of the file
            records.append((reader.line_num + num_above, [cell.strip() for cell in cells]))
    except csv.Error as error:
        line = reader.line_num + num_above
        fail(path, line, "cells of a table", f"something else ({error})", "Close all quotes.")
    return [(line, cells) for line, cells in records if any(cells)]


def _header(
    path: str | PathLike, records: _Records, above: list[str], delimiter: str
) -> tuple[list[str], _Records, bool]:
    """The names of columns, the records below them, and whether there are no names in the file."""
    began, first = records[0]
    if not all(_is_number(cell) for cell in first):
        if len(records) == 1:
            cure = "Export the table again."
            fail(path, began + 1, "at least one row", "the end of the file", cure)
        return _without_empty_end(first, 1), records[1:], False
    names = above[-1].lstrip("# ").split(delimiter) if above else []
    if _has_axes(names, len(first)):  # the header is a comment, as NumPy writes it
        return [name.strip() for name in names], records, False
    return [str(j + 1) for j in range(len(first))], records, True


def _check_different(path: str | PathLike, header: list[str]) -> None:
    twice = [name for name, count in Counter(header).items() if count > 1]
    if twice:
        fail(path, 1, "different names of columns", f"{twice[0]!r} twice", "Rename one of them.")


def _check_cells(path: str | PathLike, records: _Records, count: int, kept: list[int]) -> None:
    """Refuses lines of other lengths, and cells in columns without a name."""
    for line, cells in records:
        if len(cells) != count:
            cure = "Quote cells that contain the delimiter; leave missing cells empty."
            fail(path, line, f"{count} cells as in the header", f"{len(cells)}", cure)
        for j, cell in enumerate(cells):
            if cell and j not in kept:
                expected = f"nothing in column {j + 1}, which has no name"
                fail(path, line, expected, repr(cell), "Write its name.")


def _has_axes(names: list[str], count: int) -> bool:
    """Whether these can be the names of so many columns, x and y or numbered ones among them."""
    plain = [_plain(name.strip()) for name in names]
    numbered = any(pattern.fullmatch(name) for name in plain for pattern in _NUMBERED)
    return len(names) == count and (numbered or {"x", "y"} <= set(plain))


def _reader(content: str, delimiter: str):
    # tables with blanks between cells are aligned by several of them
    blanks = delimiter == " "
    return csv.reader(
        io.StringIO(content, newline=""), delimiter=delimiter, skipinitialspace=blanks
    )


def _delimiter_of(content: str) -> str:
    """The first that divides the first line with content."""
    start = content[: 1 << 16]  # a file may be large, and its first line is not
    for delimiter in _DELIMITERS:
        for cells in _reader(start, delimiter):
            filled = sum(bool(cell.strip()) for cell in cells)
            if filled > 1:
                return delimiter
            if filled == 1:
                break
    return ","


def _without_empty_end(cells: list[str], length: int) -> list[str]:
    while len(cells) > length and not cells[-1]:
        cells = cells[:-1]
    return cells


def _is_number(cell: str) -> bool:
    return re.fullmatch(r"[+-]?[\d.,]*\d[\d.,]*(e[+-]?\d+)?", cell.lower()) is not None


def _plain(name: str) -> str:
    """A name of a column in lower case, without its unit."""
    # "x (mm)", but not "x(1)", which is a number
    return re.sub(r"\s*[(\[][^\d)\]]*[)\]]$", "", name.lower())


_Place = tuple[int, str, str]
"""Number of the point, axis and name of a column of coordinates; axis "" where it is counted."""


def _wide_columns(table: Table) -> list[str]:
    """Those of coordinates, point by point; none if the table is not wide."""
    # a column such as `y2020` beside x and y is no point, and makes no table wide
    whole = [places for places in _numbered_sets(table) if _has_a_point(places)]
    if not whole:
        whole = _named_points(table)
    if not whole:
        return []
    if len(whole) > 1:
        found = " and ".join(repr(places[0][2]) for places in whole)
        fail(table.path, 1, "one set of coordinates", f"those of {found}", _ONE_SET)
    columns = _by_place(table, whole[0])
    indices = sorted({i for i, _ in columns})
    axes = sorted({axis for _, axis in columns})
    # from 0 or from 1: a first point that is missing would shift all others
    first = min(indices[0], 1)
    wanted = [(i, axis) for i in range(first, indices[-1] + 1) for axis in axes]
    absent = [place for place in wanted if place not in columns]
    if absent:
        i, axis = absent[0]
        last = list(columns.values())[-1]
        what = f"Every point from {first} to {indices[-1]} needs the columns {', '.join(axes)}."
        cure = what if axis else "Number them through."
        fail(table.path, 1, f"the column '{axis}{i}'", f"columns up to {last!r} without it", cure)
    return [columns[place] for place in wanted]


def _numbered_sets(table: Table) -> list[list[_Place]]:
    """Columns with a number in their name, apart by how it is written and what comes before."""
    sets: dict[tuple[int, str], list[_Place]] = {}
    for name in table.header:
        for form, pattern in enumerate((*_NUMBERED, _COUNTED)):
            if found := pattern.fullmatch(_plain(name)):
                parts = found.groupdict()
                place = (int(parts["number"]), parts.get("axis", ""), name)
                sets.setdefault((form, parts["set"]), []).append(place)
                break
    return list(sets.values())


def _by_place(table: Table, places: list[_Place]) -> dict[tuple[int, str], str]:
    """Columns by point and axis, each once."""
    columns = {}
    for i, axis, name in places:
        if (i, axis) in columns:
            found = f"{columns[i, axis]!r} and {name!r}"
            cure = "Rename or delete one of them."
            fail(table.path, 1, "one column for a coordinate", found, cure)
        columns[i, axis] = name
    return columns


def _has_a_point(places: list[_Place]) -> bool:
    """Whether the columns have x and y of some point."""
    found = {(i, axis) for i, axis, _ in places}
    return any(axis == "" or {(i, "x"), (i, "y")} <= found for i, axis in found)


def _named_points(table: Table) -> list[list[_Place]]:
    """Columns of at least two points that have names, which are numbered as they come."""
    matches = [(name, _NAMED.fullmatch(_plain(name))) for name in table.header]
    named = [(found["name"], found["axis"], name) for name, found in matches if found]
    axes: dict[str, set[str]] = {}
    for point, axis, _ in named:
        axes.setdefault(point, set()).add(axis)
    points = [point for point, has in axes.items() if {"x", "y"} <= has]
    # one alone may be anything, such as `location_x` and `location_y` of a long table
    if len(points) < 2:
        return []
    return [[(points.index(point), axis, name) for point, axis, name in named if point in points]]


def _num_axes(table: Table, columns: list[str], dim: int | None) -> int:
    """2 or 3, of a wide table or a bare one."""
    counted = all(_COUNTED.fullmatch(_plain(name)) for name in columns)
    if not counted:
        return 3 if any(re.search(r"z[\s._-]*\d+$|z$", _plain(name)) for name in columns) else 2
    count = len(columns)
    # by what divides the number of coordinates; both do for multiples of 6, which are told of
    found = dim or (3 if count % 2 and count % 3 == 0 else 2)
    if count % found:
        cure = "Pass `dim`, 2 or 3."
        fail(table.path, 1, f"a multiple of {found} coordinates", f"{count}", cure)
    if dim is None and count % 6 == 0:
        warnings.warn(
            f"{fspath(table.path)}: {columns[0]!r} to {columns[-1]!r} are read as {count // 2} "
            f"points in the plane. Pass `dim=2` if they are, or `dim=3` if they are {count // 3} "
            "points in space.",
            stacklevel=3,
        )
    return found


def _long_columns(table: Table) -> dict[str, str]:
    """Columns by axis; none if the table is not long."""
    columns: dict[str, str] = {}
    for name in table.header:
        axis = _plain(name)
        if axis in ("x", "y", "z"):
            if axis in columns:
                found = f"{columns[axis]!r} and {name!r}"
                fail(table.path, 1, f"one column {axis}", found, "Rename one of them.")
            columns[axis] = name
    return dict(sorted(columns.items())) if {"x", "y"} <= set(columns) else {}


def _bare_columns(table: Table) -> list[str]:
    """The two of a file without a header."""
    expected = "columns x1, y1, ... or x, y"
    if table.bare and len(table.header) == 2:
        return table.header
    if table.bare:
        cure = "Write the names of the columns above them."
        fail(table.path, 1, f"a header with {expected}", "no header, numbers only", cure)
    cure = "Rename the columns, or pass the `delimiter` of the file."
    if any(_is_number(name) for name in table.header):
        cure = "Is there no header? Write the names of the columns above the numbers."
    fail(table.path, 1, expected, table.listed(), cure)


def _decimal_sign(table: Table, columns: list[str], codes: Collection[str | float]) -> str:
    """A comma where numbers have commas and no points, and these do not separate thousands."""
    every = [row.cells[name] for row in table.rows for name in columns]
    cells = [cell for cell in every if cell.lower() not in codes]
    with_comma = [cell for cell in cells if "," in cell]
    if not with_comma or any("." in cell for cell in cells):
        return "."
    grouped = all(re.fullmatch(r"[+-]?[1-9]\d{0,2}(,\d{3})+", cell) for cell in with_comma)
    # where semicolons divide cells, commas are decimal: so do spreadsheets write both
    return "." if grouped and table.delimiter != ";" else ","


def _id_column(table: Table, id: str | None) -> str | None:
    """The column that names specimens, if there is one; one that was asked for must be there."""
    column = None if id is None else table.column(id)
    if column is None and id not in (None, "id"):
        cure = "Pass the `id` column of the file."
        fail(table.path, 1, f"a column {id!r}", table.listed(), cure)
    return column


_Points = dict[int, np.ndarray]
"""Those of a row, by its line."""


def _points(
    table: Table, columns: list[str], axes: int, codes: Collection[str | float], sign: str
) -> _Points:
    points = {}
    for row in table.rows:
        cells = [row.cells[name] for name in columns]
        values = [number(cell, table.path, row.line, codes, sign, _CURE) for cell in cells]
        points[row.line] = np.reshape(values, (-1, axes))
    return points


def _wide(table: Table, points: _Points, columns: list[str], id: str | None) -> list[Specimen]:
    column = _id_column(table, id)
    # names of rows, as R writes them, in a column without a name
    if column is None and id is not None and "" in table.header:
        column = ""
    others = [name for name in table.header if name and name not in columns and name != column]
    specimens = []
    for row in table.rows:
        name = None if column is None else row.cells[column] or None
        notes = {name: row.cells[name] for name in others}
        specimens.append(Specimen(points[row.line], id=name, notes=notes))
    return specimens


def _long(
    table: Table, points: _Points, columns: list[str], id: str | None, point: str
) -> list[Specimen]:
    column = _id_column(table, id)
    order = table.column(point)
    if order is None and point != "point":
        cure = "Pass the `point` column of the file."
        fail(table.path, 1, f"a column {point!r}", table.listed(), cure)
    others = [name for name in table.header if name and name not in (*columns, column, order)]
    if column is None and id is not None:
        _check_one_specimen(table, others)
    groups = _grouped(table, column)
    if order is not None:
        groups = {name: _in_order(table, group, order) for name, group in groups.items()}
    else:
        _check_order(table, groups, others)
    # others are of points, and a note is of a specimen
    constant = [name for name in others if _is_constant(name, groups)]
    specimens = []
    for name, group in groups.items():
        landmarks = np.concatenate([points[row.line] for row in group])
        notes = {key: group[0].cells[key] for key in constant}
        specimens.append(Specimen(landmarks, id=name, notes=notes))
    return specimens


def _grouped(table: Table, column: str | None) -> dict[str | None, list[Row]]:
    """Rows by the name of their specimen, which need not be neighbours."""
    groups: dict[str | None, list[Row]] = {}
    for row in table.rows:
        name = None if column is None else row.cells[column]
        if name == "":
            cure = "Write the name of the specimen in each row of it."
            fail(table.path, row.line, f"a name in {column!r}", "none", cure)
        groups.setdefault(name, []).append(row)
    return groups


def _is_constant(name: str, groups: dict[str | None, list[Row]]) -> bool:
    """Whether a column has one text within each specimen."""
    return all(row.cells[name] == rows[0].cells[name] for rows in groups.values() for row in rows)


def _check_one_specimen(table: Table, others: list[str]) -> None:
    """Refuses a long table without names of specimens that has columns which could hold them.

    They hold every value twice or more.
    """
    counts = {name: Counter(row.cells[name] for row in table.rows) for name in others}
    repeated = [name for name, count in counts.items() if min(count.values()) > 1]
    if repeated:
        found = f"no column id, but {', '.join(map(repr, repeated))}"
        cure = (
            f"Pass `id={repeated[0]!r}` if that names the specimens, or `id=None` if all rows are "
            "points of one."
        )
        fail(table.path, 1, "a column 'id' that names the specimens", found, cure)


def _check_order(table: Table, groups: dict[str | None, list[Row]], others: list[str]) -> None:
    """Refuses rows without numbers in which a further column says that points come in different
    orders.

    Its values are different ones within a specimen, and more or less the same in all.
    """
    longest = max(map(len, groups.values()))
    for name in others:
        seen = {}
        for id, group in groups.items():
            seen[id] = [row.cells[name] for row in group]
        every = {value for values in seen.values() for value in values}
        labels = all(len(set(values)) == len(values) for values in seen.values())
        # a column of measurements has other values in every specimen, and says nothing of points
        if not labels or longest < 2 or len(every) > 1.5 * longest:
            continue
        first, *rest = seen.items()
        for id, values in rest:
            if values != first[1]:
                cure = (
                    f"Pass `point={name!r}` if that numbers the points, or sort the rows and add "
                    "NA for missing points."
                )
                one = ", ".join(first[1][:6])
                other = ", ".join(values[:6])
                found = f"{one} for {first[0]!r} and {other} for {id!r}"
                expected = f"one order of points in {name!r}"
                fail(table.path, groups[id][0].line, expected, found, cure)


def _in_order(table: Table, group: list[Row], point: str) -> list[Row]:
    """Rows of one specimen by the number of their point."""
    cure = (
        "Number the points of a specimen from 0 or 1, each once; give a missing one a row with NA."
    )
    numbered = []
    for row in group:
        cell = row.cells[point]
        if not cell.isdecimal():
            fail(table.path, row.line, f"a whole number in {point!r}", repr(cell), cure)
        numbered.append((int(cell), row.line, row))
    numbered.sort(key=lambda entry: entry[:2])
    # from 0 or 1 on, each number once: a gap would pair other points than those that correspond
    for expected, (found, line, _) in enumerate(numbered, start=min(numbered[0][0], 1)):
        if found != expected:
            fail(table.path, line, f"point {expected} next", f"point {found}", cure)
    return [row for _, _, row in numbered]


def check_delimiter(delimiter: str) -> None:
    good = isinstance(delimiter, str) and len(delimiter) == 1 and delimiter not in '\r\n"'
    require(good, f"`delimiter` must be one character; got {words(delimiter)}.")


def _check_table(specimens: list[Specimen], layout: str) -> None:
    first = specimens[0]
    columns = slice(None) if layout == "wide" else slice(1, None)
    for i, specimen in enumerate(specimens):
        if specimen.curves or specimen.image is not None or specimen.scale is not None:
            raise ValueError(
                f"`specimens[{i}]` has curves, an image or a scale, which no column holds: use "
                "`write_tps`."
            )
        if specimen.landmarks.shape[columns] != first.landmarks.shape[columns] or not len(
            specimen.landmarks
        ):
            raise ValueError(
                f"`specimens[{i}]` has landmarks of shape {specimen.landmarks.shape}, the first of "
                f"{first.landmarks.shape}: a table holds shapes of one dimension with at least one "
                "point, a wide one also of one number of points."
            )
        if list(specimen.notes) != list(first.notes):
            raise ValueError(
                f"`specimens[{i}]` has the notes {list(specimen.notes)}, the first "
                f"{list(first.notes)}: give all the same keys in the same order."
            )
    ids = [specimen.id for specimen in specimens]
    if layout == "long" and len(set(ids)) < len(ids):
        raise ValueError(
            "`specimens` need different ids in a long table, where they keep the rows together."
        )
