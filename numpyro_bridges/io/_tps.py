"""The tps format of tpsDig (F. J. Rohlf).

```text
LM=2            a specimen begins: two landmarks follow (LM3= where they have three coordinates)
1431.0 3206.2
960.0 3039.2
CURVES=1        one curve follows,
POINTS=3        of three points
1431.0 3206.2
1423.0 3208.9
1419.9 3217.4
IMAGE=a.jpg     then keys with text, in any order
ID=a
SCALE=0.0125
```
"""

import re
from collections.abc import Iterable, Iterator
from os import PathLike
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from .._checks import flag
from ._specimen import (
    NOT_AVAILABLE,
    Specimen,
    as_specimens,
    fail,
    number,
    open_text,
    read_lines,
    text,
    warn_of_codes,
)

_BLOCKS = {"LM": 2, "LM3": 3}
_FIELDS = {"IMAGE": "image", "ID": "id", "SCALE": "scale"}
_LINES = ("CURVES", "OUTLINES")
_RESERVED = {*_BLOCKS, *_FIELDS, *_LINES, "POINTS"}


def read_tps(
    path: str | PathLike, *, negative_is_missing: bool = False, encoding: str = "utf-8"
) -> list[Specimen]:
    """Specimens of a tps file, in its order.

    Keys may be in any case; blank lines and blanks at the end of a line do not matter, nor do lines
    of comment: those before the first LM=, and those that begin with #. OUTLINES are curves, after
    those of CURVES. Keys other than LM, LM3, CURVES, OUTLINES, POINTS, IMAGE, ID and SCALE
    (COMMENT, VARIABLES, ...) are kept in `Specimen.notes`, one that comes twice with its texts on
    two lines; those that carry rows of numbers (RADII) are refused. SCALE is reported, not applied;
    one that is empty or NA is none.

    **Arguments:**

    - `path`: the file; a name that ends in `.gz` is decompressed.
    - `negative_is_missing`: tokens `NA` and `NaN` always are missing values and become NaN. tpsDig
      instead marks a missing landmark with negative coordinates. As aligned data are negative too,
      that is only read so if asked for: then a landmark with a negative coordinate becomes NaN in
      all its coordinates. Curves are left alone. A `UserWarning` tells of landmarks that look like
      such marks and are not read so.
    - `encoding`: of the text.

    **Returns:** a list of `Specimen`.

    **Raises:** `ValueError` with file, line number, what was expected and what was found, for
    anything else.
    """
    negative_is_missing = flag(negative_is_missing, "negative_is_missing")
    lines = _Lines(path, read_lines(path, encoding))
    if lines.current is None:
        fail(path, 1, "LM= or LM3=", "an empty file", "Export the file again.")
    specimens = []
    while lines.current is not None:
        specimens.append(_specimen(lines, negative_is_missing))
    warn_of_codes(path, specimens, "Pass `negative_is_missing=True` if so.")
    return specimens


def write_tps(
    path: str | PathLike, specimens: Iterable[Specimen], *, encoding: str = "utf-8"
) -> None:
    """Write specimens so that `read_tps` returns the same ones, to the last digit.

    Missing values are written as NA. A name that ends in `.gz` is compressed.

    **Raises:** `ValueError` where a text would not read back: line breaks (except in notes), blanks
    at its ends, a note whose key has a meaning in the format.
    """
    lines = [line for specimen in as_specimens(specimens) for line in _format(specimen)]
    with open_text(path, encoding) as file:
        file.write("\n".join(lines) + "\n")


class _Lines:
    """The lines with content: `current`, the next one (`None` at the end), and its `number`."""

    def __init__(self, path: str | PathLike, every: list[str]):
        self.path = path
        keys = [_key(line) for line in every]
        # a comment above the first specimen may be any text
        first = next((i for i, key in enumerate(keys) if key in _BLOCKS), 0)
        if any(key in _RESERVED or _is_row(every[i]) for i, key in enumerate(keys[:first])):
            first = 0  # more than a comment: the first specimen says what is wrong
        numbered = enumerate(every[first:], start=first + 1)
        self._rest = ((i, line) for i, line in numbered if line and not _is_comment(line))
        self._num_lines = len(every)
        self.advance()

    def advance(self) -> None:
        self.number, self.current = next(self._rest, (self._num_lines, None))

    def key(self) -> tuple[str, str] | None:
        """(KEY, value) of a line KEY=value; `None` for any other."""
        if self.current is None or "=" not in self.current:
            return None
        return _key(self.current), self.current.partition("=")[2].strip()

    def fail(self, expected: str, cure: str) -> NoReturn:
        found = "the end of the file" if self.current is None else repr(self.current)
        fail(self.path, self.number, expected, found, cure)


def _key(line: str) -> str:
    """What stands before the first =, in upper case."""
    key, equals, _ = line.partition("=")
    return key.strip().upper() if equals else ""


def _is_comment(line: str) -> bool:
    # "#ID=a" would be a key; so a comment has no =
    return line.startswith("#") and "=" not in line


def _is_row(line: str) -> bool:
    """Whether a line holds numbers only, as those of points do."""
    return re.fullmatch(r"[\s\d.,+-]*\d[\s\d.,+-]*", line) is not None


def _specimen(lines: _Lines, negative_is_missing: bool) -> Specimen:
    key, _ = lines.key() or ("", "")
    if key not in _BLOCKS:
        cure = (
            "A specimen begins with LM=: delete what stands before the first one; numbers follow "
            "LM=, LM3= or POINTS= only, as many as these say."
        )
        lines.fail("LM= or LM3=", cure)
    dim = _BLOCKS[key]
    began = lines.number
    landmarks = _rows(lines, key, _count(lines), dim)
    if negative_is_missing:
        landmarks[(landmarks < 0.0).any(axis=1)] = np.nan
    curves, fields, notes = _entries(lines, dim, began)
    named = {_FIELDS[key]: value for key, value in fields.items()}
    # outlines after curves, in whatever order the file has them
    every = [curve for key in _LINES for curve in curves.get(key, ())]
    return Specimen(landmarks, tuple(every), notes=notes, **named)


def _entries(
    lines: _Lines, dim: int, began: int
) -> tuple[dict[str, list[NDArray]], dict, dict[str, str]]:
    """What stands between the landmarks and the next specimen: curves, fields and notes by key."""
    curves: dict[str, list[NDArray]] = {}
    fields: dict = {}
    notes: dict[str, str] = {}
    while (entry := lines.key()) is not None and entry[0] not in _BLOCKS:
        key, value = entry
        if key in fields or key in curves:
            lines.fail(
                f"{key}= once for the specimen from line {began}", "Delete one of the two lines."
            )
        if key in _LINES:
            curves[key] = list(_curves(lines, key, dim))
            continue  # it has gone on to the line after its last point
        # a block more than CURVES= says
        if key == "POINTS":
            lines.fail(
                "CURVES= before POINTS=", "CURVES= gives the number of POINTS= blocks: correct it."
            )
        if key == "SCALE":
            fields[key] = _scale(lines, value)
        elif key in _FIELDS:
            fields[key] = value
        else:
            notes[key] = f"{notes[key]}\n{value}" if key in notes else value
        lines.advance()
    return curves, fields, notes


def _scale(lines: _Lines, value: str) -> float | None:
    """A positive number, or none where the line says nothing."""
    if value.lower() in NOT_AVAILABLE:
        return None
    scale = number(value, lines.path, lines.number, missing=())
    if not scale > 0:
        lines.fail("a positive number after SCALE=", "Correct it, or delete the line.")
    return scale


def _count(lines: _Lines) -> int:
    key, value = lines.key() or ("", "")
    if not value.isdecimal():
        lines.fail(
            f"a whole number after {key}=", "Write the number of rows or blocks that follow."
        )
    lines.advance()
    return int(value)


def _rows(lines: _Lines, key: str, count: int, dim: int) -> NDArray:
    began = lines.number
    rows = np.empty((count, dim))
    for i in range(count):
        cure = f"The block {key}={count} before line {began} is cut short or its number is wrong."
        if lines.current is None or "=" in lines.current:
            lines.fail(f"point {i + 1} of {count}", cure)
        tokens = lines.current.split()
        if len(tokens) != dim:
            cure = "LM= is for two coordinates and LM3= for three, separated by blanks."
            lines.fail(f"{dim} numbers for point {i + 1} of {count}", cure)
        rows[i] = [number(token, lines.path, lines.number) for token in tokens]
        lines.advance()
    return rows


def _curves(lines: _Lines, key: str, dim: int) -> Iterator[NDArray]:
    count = _count(lines)
    for j in range(count):
        if (lines.key() or ("", ""))[0] != "POINTS":
            lines.fail(f"POINTS= of curve {j + 1} of {count}", f"Add the curve, or correct {key}=.")
        yield _rows(lines, "POINTS", _count(lines), dim)


def _format(specimen: Specimen) -> Iterator[str]:
    dim = specimen.landmarks.shape[1]
    yield f"{'LM' if dim == 2 else 'LM3'}={len(specimen.landmarks)}"
    yield from _number_lines(specimen.landmarks)
    if specimen.curves:
        yield f"CURVES={len(specimen.curves)}"
        for curve in specimen.curves:
            yield f"POINTS={len(curve)}"
            yield from _number_lines(curve)
    if specimen.image is not None:
        yield f"IMAGE={_one_line(specimen.image, 'image')}"
    if specimen.id is not None:
        yield f"ID={_one_line(specimen.id, 'id')}"
    if specimen.scale is not None:
        yield f"SCALE={float(specimen.scale)!r}"
    for key, value in specimen.notes.items():
        one_line = re.fullmatch(r"[^\s=]([^\n\r=]*[^\s=])?", key)
        if not one_line or key != key.upper() or key in _RESERVED:
            raise ValueError(
                f"`notes` has the key {key!r}: use upper case, and no key that has a meaning in "
                "the format."
            )
        # a key that comes twice is read as a text of two lines
        for line in value.split("\n"):
            yield f"{key}={_one_line(line, 'notes')}"


def _number_lines(points: NDArray) -> Iterator[str]:
    return (" ".join(map(text, row)) for row in points)


def _one_line(value: str, name: str) -> str:
    if value != value.strip() or "\n" in value or "\r" in value:
        raise ValueError(f"`{name}` must be one line without blanks at its ends, got {value!r}.")
    return value
