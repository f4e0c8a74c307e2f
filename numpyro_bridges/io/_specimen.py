"""One specimen as files hold it, and what the readers of all formats share."""

import codecs
import gzip
import re
import warnings
import zlib
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from os import PathLike, fspath
from pathlib import Path
from typing import NoReturn, TextIO, cast

import numpy as np
from numpy.typing import NDArray

from .._checks import as_path, known_float, known_number, require, require_instance, words

NOT_AVAILABLE = ("", "na", "n/a", "#n/a", "<na>", "nan", "null", "none")
"""Texts, in lower case, that are no number in any table, and say that one is missing."""

_BYTE_ORDER_MARKS = {  # the one of UTF-32 begins like that of UTF-16, and comes first
    codecs.BOM_UTF8: "utf-8",
    codecs.BOM_UTF32_LE: "utf-32",
    codecs.BOM_UTF32_BE: "utf-32",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
}

_WORKBOOKS = (b"PK\x03\x04", b"\xd0\xcf\x11\xe0")
"""How the files of spreadsheet programs begin, the new ones and the old ones."""

_CODES = (999.0, 9999.0, 99999.0)
"""Numbers that stand for a missing one, where all the coordinates of a point are the same one."""


@dataclass(frozen=True, eq=False)
class Specimen:
    """Landmarks and curves of one specimen, with what its file says about it.

    - `landmarks`: (n, d), d = 2 or 3, in the file's unit; NaN where missing; n = 0 where there are
      only curves.
    - `curves`: arrays (n_j, d), one for each curve or outline.
    - `id`, `image`: as written in the file, or `None`.
    - `scale`: length units per file unit, or `None`. Coordinates are *not* multiplied by it.
    - `notes`: everything else, text by key (a comment, further columns of a table).
    """

    landmarks: NDArray
    curves: tuple[NDArray, ...] = ()
    id: str | None = None
    image: str | None = None
    scale: float | None = None
    notes: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self):
        require(
            isinstance(self.curves, (list, tuple)),
            f"`curves` must be a tuple of arrays (n, d); got {words(self.curves)}.",
        )
        curves = tuple(known_float(curve, f"curves[{j}]") for j, curve in enumerate(self.curves))
        # a frozen dataclass sets its own fields so
        object.__setattr__(self, "curves", curves)
        object.__setattr__(self, "landmarks", known_float(self.landmarks, "landmarks"))
        if self.scale is not None:
            scale = known_number(
                self.scale, "scale", "a positive number, or None", lambda value: value > 0
            )
            object.__setattr__(self, "scale", scale)
        for name in ("id", "image"):
            value = getattr(self, name)
            require(
                value is None or isinstance(value, str),
                f"`{name}` must be text, or None; got {words(value)}.",
            )
        require(
            isinstance(self.notes, Mapping)
            and all(isinstance(x, str) for item in self.notes.items() for x in item),
            f"`notes` must be text by key, texts both; got {words(self.notes)}.",
        )
        shape = self.landmarks.shape
        if len(shape) != 2 or shape[1] not in (2, 3):
            raise ValueError(f"`landmarks` must have the shape (n, 2) or (n, 3), got {shape}.")
        for j, curve in enumerate(self.curves):
            if curve.ndim != 2 or curve.shape[1] != shape[1]:
                raise ValueError(
                    f"`curves[{j}]` must have the shape (n, {shape[1]}), got {curve.shape}."
                )


def open_text(path: str | PathLike, encoding: str) -> TextIO:
    """A text file to write, compressed where its name ends in `.gz`; line ends stay as they are."""
    path = as_path(path, "path")
    check_encoding(encoding)
    if fspath(path).endswith(".gz"):
        return cast(TextIO, gzip.open(path, "wt", encoding=encoding, newline=""))
    return open(path, "w", encoding=encoding, newline="")


def check_encoding(encoding: str) -> None:
    try:
        codecs.lookup(encoding)
    except (LookupError, TypeError, ValueError) as error:
        raise ValueError(
            f"`encoding` must be the name of one, such as 'utf-8'; got {words(encoding)}."
        ) from error


def read_text(path: str | PathLike, encoding: str) -> str:
    """The file's text, decompressed, its line ends as they are.

    A byte order mark says in what encoding a file was written, and is believed.
    """
    path = as_path(path, "path")
    check_encoding(encoding)
    # told by its first bytes, whatever the name says
    content = path.read_bytes()
    if content.startswith(b"\x1f\x8b"):
        content = _decompressed(path, content)
    require(
        not content.startswith(_WORKBOOKS),
        f"{path}: expected text, found a workbook of a spreadsheet program. Save it as CSV.",
    )
    marks = [name for mark, name in _BYTE_ORDER_MARKS.items() if content.startswith(mark)]
    encoding = marks[0] if marks else encoding
    try:
        found = content.decode(encoding)
    except UnicodeDecodeError as error:
        cure = (
            "Its byte order mark says this encoding: the file is damaged, save it again."
            if marks
            else "Pass its `encoding`, such as 'cp1252' on Windows."
        )
        raise ValueError(
            f"{path}: expected text in the encoding {encoding!r}, found byte "
            f"{error.object[error.start]:#04x}. {cure}"
        ) from error
    # UTF-16 without a mark decodes as UTF-8: every other byte of Latin text is 0
    order = "le" if content[1:2] == b"\0" else "be"
    require(
        "\0" not in found,
        f"{path}: expected text in the encoding {encoding!r}, found bytes of zero. "
        f"Pass its `encoding`, probably 'utf-16-{order}'.",
    )
    return found.removeprefix("\ufeff")


def _decompressed(path: Path, content: bytes) -> bytes:
    try:
        return gzip.decompress(content)
    except (EOFError, OSError, zlib.error) as error:
        raise ValueError(
            f"{path}: expected a whole gzip file, found a damaged one ({error}). Copy it again."
        ) from error


def read_lines(path: str | PathLike, encoding: str) -> list[str]:
    """The lines of a file, of whatever system, stripped."""
    return [line.strip() for line in re.split("\r\n?|\n", read_text(path, encoding))]


def stem(path: str | PathLike) -> str:
    """The name of a file without its endings, which a specimen has that is alone in it."""
    return re.sub(r"(?i)(\.mrk)?\.\w+(\.gz)?$", "", Path(path).name)


def as_specimens(specimens: Iterable[Specimen]) -> list[Specimen]:
    """At least one, as a list."""
    require(
        isinstance(specimens, Iterable) and not isinstance(specimens, str),
        f"`specimens` must be a list of `Specimen`; got {words(specimens)}.",
    )
    specimens = list(specimens)
    for i, specimen in enumerate(specimens):
        require_instance(specimen, Specimen, f"specimens[{i}]", "a `Specimen`")
    require(len(specimens) > 0, "`specimens` must hold at least one specimen, got none.")
    return specimens


def fail(path: str | PathLike, line: int, expected: str, found: str, cure: str) -> NoReturn:
    """Every complaint about a file has this form."""
    raise ValueError(f"{fspath(path)}, line {line}: expected {expected}, found {found}. {cure}")


def number(
    token: str,
    path: str | PathLike,
    line: int,
    missing: Collection[str | float] = ("na", "nan"),
    decimal: str = ".",
    cure: str = "Write decimals with a point, and NA for a missing value.",
) -> float:
    """A finite number, or NaN for one of the codes of a missing value, texts in lower case."""
    if token.lower() in missing:
        return np.nan
    # not by the locale, which is the reader's and not the file's
    try:
        value = float(token.replace(decimal, "."))
    except ValueError:
        value = np.inf
    # 1_000 is a number to Python; a point is none where numbers have commas
    if not np.isfinite(value) or "_" in token or decimal != "." and "." in token:
        fail(path, line, "a finite number", repr(token), cure)
    # codes again, as numbers: -999 and -999.0 are one
    return np.nan if value in missing else value


def missing_codes(missing: str | float | Iterable[str | float]) -> frozenset[str | float]:
    """Codes that a user names, as texts and where possible as numbers, and the usual texts."""
    listed = isinstance(missing, Iterable) and not isinstance(missing, (str, bytes))
    codes: set[str | float] = set(NOT_AVAILABLE)
    for code in list(missing) if listed else [missing]:  # type: ignore[arg-type]
        if isinstance(code, str):
            codes.add(code.strip().lower())
            try:
                codes.add(float(code))
            except ValueError:
                pass  # a code that is no number, such as "x"
        else:
            codes.add(
                known_number(code, "missing", "a code, a text or a number, or a list of them")
            )
    return frozenset(codes)


def warn_of_codes(path: str | PathLike, specimens: list[Specimen], cure: str) -> None:
    """Tells of points that look as if they stood for missing ones, and are read as they are.

    That is: all coordinates the same negative number where all others are positive, or all 999 or
    the like.
    """
    suspects = []
    for i, specimen in enumerate(specimens):
        points = specimen.landmarks
        # (-1, -1) among positive ones, or (999, 999) among any
        same = np.all(points == points[:, :1], axis=1)
        negative = same & np.all(points < 0, axis=1)
        others = points[~negative & np.isfinite(points).all(axis=1)]
        if not others.size or np.any(others < 0):
            negative[:] = False
        found = np.flatnonzero(negative | same & np.isin(points[:, 0], _CODES))
        suspects += [(called(specimens, i), int(j) + 1, points[j, 0]) for j in found]
    if suspects:
        name, point, value = suspects[0]
        more = f", and {len(suspects) - 1} more" if len(suspects) > 1 else ""
        warnings.warn(
            f"{fspath(path)}: point {point} of {name} is {value:g} in all its coordinates{more}: a "
            f"code for a missing point? They are read as they are. {cure}",
            stacklevel=3,
        )


def called(specimens: Collection[Specimen], i: int) -> str:
    """How messages speak of one of several specimens."""
    id = list(specimens)[i].id
    return f"`specimens[{i}]`" if id is None else f"`specimens[{i}]` ({id!r})"


def text(value: float) -> str:
    """The shortest text that reads back as the same number; NA for NaN."""
    return "NA" if np.isnan(value) else repr(float(value))
