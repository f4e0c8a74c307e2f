"""One specimen as files hold it, and what the readers of all formats share."""

import codecs
import gzip
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from os import PathLike, fspath
from typing import NoReturn, TextIO, cast

import numpy as np
from numpy.typing import NDArray

from .._checks import as_path, known_float, known_number, require, require_instance, words


@dataclass(frozen=True, eq=False)
class Specimen:
    """Landmarks and curves of one specimen, with what its file says about it.

    - `landmarks`: (n, d), d = 2 or 3, in the file's unit; NaN where missing; n = 0 where there are only
      curves.
    - `curves`: arrays (n_j, d), one for each curve.
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
        object.__setattr__(self, "curves", curves)
        object.__setattr__(self, "landmarks", known_float(self.landmarks, "landmarks"))
        if self.scale is not None:
            scale = known_number(self.scale, "scale", "a positive number, or None", lambda value: value > 0)
            object.__setattr__(self, "scale", scale)
        for name in ("id", "image"):
            value = getattr(self, name)
            require(value is None or isinstance(value, str), f"`{name}` must be text, or None; got {words(value)}.")
        require(
            isinstance(self.notes, Mapping) and all(isinstance(x, str) for item in self.notes.items() for x in item),
            f"`notes` must be text by key, texts both; got {words(self.notes)}.",
        )
        shape = self.landmarks.shape
        if len(shape) != 2 or shape[1] not in (2, 3):
            raise ValueError(f"`landmarks` must have the shape (n, 2) or (n, 3), got {shape}.")
        for j, curve in enumerate(self.curves):
            if curve.ndim != 2 or curve.shape[1] != shape[1]:
                raise ValueError(f"`curves[{j}]` must have the shape (n, {shape[1]}), got {curve.shape}.")


def open_text(path: str | PathLike, mode: str, encoding: str, newline: str | None = None) -> TextIO:
    """A text file, compressed where its name ends in `.gz`."""
    path = as_path(path, "path")
    try:
        codecs.lookup(encoding)
    except (LookupError, TypeError, ValueError) as error:
        raise ValueError(f"`encoding` must be the name of one, such as 'utf-8'; got {words(encoding)}.") from error
    if fspath(path).endswith(".gz"):
        return cast(TextIO, gzip.open(path, f"{mode}t", encoding=encoding, newline=newline))
    return cast(TextIO, open(path, mode, encoding=encoding, newline=newline))


def read_text(path: str | PathLike, encoding: str, newline: str | None = None) -> str:
    """The file's text without a byte order mark, or an error that names the file and the encoding."""
    try:
        with open_text(path, "r", encoding, newline) as file:
            return file.read().removeprefix("\ufeff")
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{fspath(path)}: expected text in the encoding {encoding!r}, found byte "
            f"{error.object[error.start]:#04x}. Pass its `encoding`, such as 'cp1252' on Windows."
        ) from error


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


def number(token: str, path: str | PathLike, line: int, missing: tuple[str, ...] = ("na", "nan")) -> float:
    """A finite number, or NaN for one of the (lower case) marks of a missing value."""
    if token.lower() in missing:
        return np.nan
    try:
        value = float(token)
    except ValueError:
        value = np.inf
    if "_" in token or not np.isfinite(value):
        cure = "Write decimals with a point, and NA for a missing value."
        fail(path, line, "a finite number", repr(token), cure)
    return value


def text(value: float) -> str:
    """The shortest text that reads back as the same number; NA for NaN."""
    return "NA" if np.isnan(value) else repr(float(value))
