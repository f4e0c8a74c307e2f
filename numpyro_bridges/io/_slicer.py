"""Markups of 3D Slicer: one specimen a file, JSON (`.mrk.json`) or the older text (`.fcsv`)."""

import csv
import json
import re
from os import PathLike

import numpy as np

from ._specimen import Specimen, fail, number, read_text, stem

_CURVES = ("Curve", "ClosedCurve", "Line")
# in words in JSON, as numbers in `.fcsv`
_DEFINED = ("defined", "2")
_STATES = ("undefined", "preview", "missing", "0", "1", "3", *_DEFINED)
_COLUMNS: tuple[str, ...] = (
    *("id", "x", "y", "z", "ow", "ox", "oy", "oz", "vis", "sel", "lock", "label", "desc"),
    *("associatednodeid", "positionstatus", "autocreated"),
)
"""Of `.fcsv`; the last two are there without being named."""
_SYSTEMS = {"0": "RAS", "1": "LPS"}
"""What older files call the coordinate systems."""


def read_slicer(path: str | PathLike, *, encoding: str = "utf-8") -> list[Specimen]:
    """The specimen of a file of markups of 3D Slicer, `.mrk.json` or `.fcsv`.

    It has the name of the file. Control points of a list of points are landmarks, those of curves
    and lines are curves. A point that is not defined is missing (NaN). Coordinates are those of the
    file. Its coordinate system is in `Specimen.notes["coordinate system"]`: LPS and RAS differ by
    half a turn, which alignment takes out. The labels of the landmarks are in `notes["labels"]`,
    one a line.

    **Arguments:**

    - `path`: the file; one that gzip compressed is decompressed.
    - `encoding`: of the text, unless the file has a byte order mark, which says it.

    **Returns:** a list of one `Specimen` in three dimensions, as other readers return.

    **Raises:** `ValueError` for anything else, such as planes, or several lists of points.
    """
    content = read_text(path, encoding)
    if content.lstrip().startswith("{"):
        return [_from_json(path, content)]
    return [_from_fcsv(path, content)]


def _from_json(path: str | PathLike, content: str) -> Specimen:
    try:
        markups = json.loads(content)["markups"]
        # LPS is the default of the format
        lists = [(m["type"], m.get("coordinateSystem", "LPS"), m["controlPoints"]) for m in markups]
    except json.JSONDecodeError as error:
        fail(path, error.lineno, "JSON", f"something else ({error.msg})", "Save the markups again.")
    except (AttributeError, KeyError, TypeError) as error:
        cure = "Save the markups from Slicer as .mrk.json."
        fail(path, 1, "markups with their type and controlPoints", f"others ({error!r})", cure)
    other = [kind for kind, _, _ in lists if kind not in ("Fiducial", *_CURVES)]
    if other or not lists:
        cure = "Save them in a file of their own."
        fail(path, 1, "points and curves", f"markups of the type {other or None}", cure)
    landmarks = [(system, points) for kind, system, points in lists if kind == "Fiducial"]
    if len(landmarks) > 1:
        fail(path, 1, "one list of points", f"{len(landmarks)}", "Merge them, or save one a file.")
    systems = sorted({str(system) for _, system, _ in lists})
    if len(systems) > 1:
        fail(path, 1, "one coordinate system", " and ".join(systems), "Save the markups again.")
    points = landmarks[0][1] if landmarks else []
    return Specimen(
        _positions(path, points),
        tuple(_positions(path, points) for kind, _, points in lists if kind in _CURVES),
        id=stem(path),
        notes=_notes(systems[0], [str(point.get("label", "")) for point in points]),
    )


def _positions(path: str | PathLike, points: list[dict]) -> np.ndarray:
    """(n, 3), NaN where a point is not defined."""
    positions = np.full((len(points), 3), np.nan)
    for i, point in enumerate(points):
        if _is_defined(path, 1, str(point.get("positionStatus", "defined"))):
            position = point.get("position")
            if not isinstance(position, list) or len(position) != 3:
                cure = "Save the markups again."
                fail(path, 1, f"three coordinates of control point {i + 1}", repr(position), cure)
            positions[i] = [number(str(x), path, 1, missing=()) for x in position]
    return positions


def _is_defined(path: str | PathLike, line: int, state: str) -> bool:
    if state not in _STATES:
        cure = "Save the markups from Slicer."
        fail(path, line, f"a positionStatus, one of {', '.join(_STATES)}", repr(state), cure)
    return state in _DEFINED


def _from_fcsv(path: str | PathLike, content: str) -> Specimen:
    lines = re.split("\r\n?|\n", content)
    # lines of comment hold settings, the names of the columns among them
    said = {}
    for line in lines:
        if line.startswith("#"):
            key, _, value = line[1:].partition("=")
            said[key.strip().lower()] = value.strip()
    columns = [name.strip().lower() for name in said.get("columns", ",".join(_COLUMNS)).split(",")]
    if not {"x", "y", "z"} <= set(columns):
        fail(path, 1, "columns x, y, z", ",".join(columns), "Save the markups again.")
    if columns == list(_COLUMNS[:14]):
        columns = list(_COLUMNS)  # see there
    landmarks = []
    labels = []
    for i, line in enumerate(lines, start=1):
        if not line.strip() or line.startswith("#"):
            continue
        # by `csv`, since a label may have commas within quotes; versions differ in how many cells
        cells = dict(zip(columns, next(csv.reader([line])), strict=False))
        if "z" not in cells:
            fail(path, i, "a point with x, y, z", repr(line), "Save the markups again.")
        defined = _is_defined(path, i, cells.get("positionstatus", "").strip() or "defined")
        position = [np.nan] * 3  # what stands there has no meaning
        if defined:
            position = [number(cells[axis].strip(), path, i) for axis in "xyz"]
        landmarks.append(position)
        labels.append(cells.get("label", ""))
    if not landmarks:
        cure = "Save the markups again."
        fail(path, len(lines), "at least one point", "the end of the file", cure)
    system = str(said.get("coordinatesystem", "0"))
    notes = _notes(str(_SYSTEMS.get(system, system)), labels)
    return Specimen(np.array(landmarks), id=stem(path), notes=notes)


def _notes(system: str, labels: list[str]) -> dict[str, str]:
    return {"coordinate system": system, "labels": "\n".join(labels)}
