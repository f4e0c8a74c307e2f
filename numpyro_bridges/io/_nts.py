"""The NTS format of NTSYSpc (F. J. Rohlf), also `.dta` of Landmark Editor: a matrix of numbers.

```text
"a comment
1 2L 4 1 -999 DIM=2        a rectangle of 2 rows, which have labels, and 4 columns; -999 is missing
first second               the labels
1 2 3 4                    the rows: points one after another
5 6 -999 -999
```
"""

import re
from collections.abc import Iterator
from os import PathLike
from typing import NamedTuple

import numpy as np

from ._specimen import Specimen, fail, missing_codes, number, read_lines, stem

# labels of rows are listed first (L), or begin (B) or end (E) their row
_HEADER = re.compile(
    r"1\s+(?P<rows>\d+)(?P<row_labels>[LBE]?)\s+(?P<columns>\d+)(?P<column_labels>L?)"
    r"(\s+(?P<has_missing>\d+)(\s+(?P<code>[^\s=]+))?)?(\s+DIM=(?P<dim>[23]))?",
    re.IGNORECASE,
)


def read_nts(path: str | PathLike, *, encoding: str = "utf-8") -> list[Specimen]:
    """Specimens of an NTS file, one a row; or the one specimen of a file whose rows are points.

    Rows are points where there are as many columns as dimensions; the specimen then has the name of
    the file. The labels of rows are the names of specimens, or those of points, in
    `Specimen.notes["labels"]`, one a line. Missing are the code that the file names, and NA.

    **Arguments:**

    - `path`: the file; one that gzip compressed is decompressed.
    - `encoding`: of the text, unless the file has a byte order mark, which says it.

    **Returns:** a list of `Specimen`.

    **Raises:** `ValueError` with file, line number, what was expected and what was found, for
    anything else.
    """
    lines = read_lines(path, encoding)
    content = [(i, line) for i, line in enumerate(lines, start=1) if line and line[0] not in "\"'"]
    if not content:
        fail(path, 1, "a line such as 1 10L 20 0 DIM=2", "an empty file", "Export the file again.")
    header = _header(path, *content[0])
    # what follows is words: line breaks have no meaning
    tokens = _Tokens(path, content[1:], len(lines))
    labels, rows = _labels_and_rows(path, tokens, header)
    tokens.end()
    shapes = np.reshape(rows, (-1, header.num_columns // header.dim, header.dim))
    if header.num_columns == header.dim:  # a row is a point, and the matrix a specimen
        notes = {"labels": "\n".join(labels)} if labels else {}
        return [Specimen(shapes[:, 0], id=stem(path), notes=notes)]
    return [
        Specimen(shape, id=name)
        for shape, name in zip(shapes, labels or [None] * header.num_rows, strict=True)
    ]


class _Header(NamedTuple):
    """What the first line says."""

    num_rows: int
    num_columns: int
    dim: int
    row_labels: str
    """L, B, E, or none."""
    has_column_labels: bool
    codes: frozenset[str | float]


def _header(path: str | PathLike, began: int, line: str) -> _Header:
    found = _HEADER.fullmatch(re.sub(r"\s*=\s*", "=", line))
    if found is None:
        cure = "It says: 1, the rows, the columns, whether some are missing and their code, DIM=."
        fail(path, began, "a line such as 1 10L 20 0 DIM=2", repr(line), cure)
    num_columns = int(found["columns"])
    # DIM= is an addition to the format, which matrices of points do without
    dim = int(found["dim"] or num_columns)
    if dim not in (2, 3) or num_columns == 0 or num_columns % dim:
        cure = "Write DIM=2 or DIM=3 at the end of the line."
        fail(path, began, "DIM=, which divides the columns", repr(line), cure)
    # the code counts only where the number before it, 0 or 1, says that some are missing
    has_missing = int(found["has_missing"] or 0) > 0
    codes = missing_codes(found["code"] if has_missing and found["code"] else ())
    return _Header(
        int(found["rows"]),
        num_columns,
        dim,
        found["row_labels"].upper(),
        bool(found["column_labels"]),
        codes,
    )


def _labels_and_rows(
    path: str | PathLike, tokens: "_Tokens", header: _Header
) -> tuple[list[str], list[list[float]]]:
    where = header.row_labels
    labels = tokens.take(header.num_rows) if where == "L" else []
    # labels of columns say nothing that is kept
    tokens.take(header.num_columns if header.has_column_labels else 0)
    rows = []
    for _ in range(header.num_rows):
        labels += tokens.take(1 if where == "B" else 0)
        values = tokens.take(header.num_columns)
        rows.append([number(value, path, tokens.line, header.codes) for value in values])
        labels += tokens.take(1 if where == "E" else 0)
    return labels, rows


class _Tokens:
    """The words of a file, and the line that the last of them was on."""

    def __init__(self, path: str | PathLike, content: list[tuple[int, str]], num_lines: int):
        self.path = path
        self.num_lines = num_lines
        self.line = num_lines
        self._rest: Iterator = ((i, word) for i, line in content for word in line.split())

    def take(self, count: int) -> list[str]:
        taken = []
        for _ in range(count):
            self.line, word = next(self._rest, (self.num_lines, None))
            if word is None:
                cure = "The file is cut short, or its first line says too much."
                fail(self.path, self.line, "more numbers or labels", "the end of the file", cure)
            taken.append(word)
        return taken

    def end(self) -> None:
        cure = "The first line says too little."
        for line, word in self._rest:
            fail(self.path, line, "the end of the file", repr(word), cure)
