"""The format of Morphologika (P. O'Higgins and N. Jones): sections that begin with a name in
brackets.

```text
[individuals]
2
[landmarks]
3
[dimensions]
2
[names]
first
second
[labels]
sex
[labelvalues]
f
m
[rawpoints]
'first
1 2
3 4
5 6
'second
...
```
"""

import re
from collections.abc import Iterable
from os import PathLike

import numpy as np

from ._specimen import Specimen, fail, missing_codes, number, read_lines, warn_of_codes

_Lines = list[tuple[int, str]]
"""Lines with their numbers."""


def read_morphologika(
    path: str | PathLike,
    *,
    missing: str | float | Iterable[str | float] = (),
    encoding: str = "utf-8",
) -> list[Specimen]:
    """Specimens of a Morphologika file, with their names, and their labels and groups as
    `Specimen.notes`.

    Sections that say how to draw shapes (wireframe, polygons) are skipped.

    **Arguments:**

    - `path`: the file; one that gzip compressed is decompressed.
    - `missing`: codes for a missing value, such as 9999, beside NA and the like.
    - `encoding`: of the text, unless the file has a byte order mark, which says it.

    **Returns:** a list of `Specimen`.

    **Raises:** `ValueError` with file, line number, what was expected and what was found, for
    anything else.
    """
    codes = missing_codes(missing)
    sections = _sections(path, read_lines(path, encoding))
    count = _whole_number(path, sections, "individuals")
    num_points = _whole_number(path, sections, "landmarks")
    dim = _whole_number(path, sections, "dimensions")
    names: list[str | None] = [None] * count
    if sections.get("names"):
        names = [line for _, line in _exactly(path, sections, "names", count)]
    # a line before each specimen has its name again, behind a quote: it may be left out
    points = [line for line in sections["rawpoints"] if line[1][0] not in "'\"#"]
    rows = _exactly(path, sections | {"rawpoints": points}, "rawpoints", count * num_points)
    values = []
    for line, row in rows:
        tokens = re.split(r"[\s,]+", row)
        if len(tokens) != dim:
            fail(path, line, f"{dim} coordinates", repr(row), "Correct [dimensions], or the line.")
        values.append([number(token, path, line, codes) for token in tokens])
    notes = _notes(path, sections, count)
    shapes = np.reshape(values, (count, num_points, dim))
    specimens = [
        Specimen(shape, id=name, notes=note)
        for shape, name, note in zip(shapes, names, notes, strict=True)
    ]
    warn_of_codes(path, specimens, "Name the code in `missing` if so.")
    return specimens


def _sections(path: str | PathLike, lines: list[str]) -> dict[str, _Lines]:
    """Lines with content by the name of their section, in lower case."""
    sections: dict[str, _Lines] = {}
    name = None
    for i, line in enumerate(lines, start=1):
        if found := re.fullmatch(r"\[\s*(.+?)\s*\]", line):
            name = found[1].lower()
            if name in sections:
                fail(path, i, f"[{name}] once", "it twice", "Write one file for each.")
            sections[name] = []
        elif line and name is None:
            fail(path, i, "a section such as [individuals]", repr(line), "Delete the line.")
        elif line:
            sections[str(name)].append((i, line))
    for name in ("individuals", "landmarks", "dimensions", "rawpoints"):
        if name not in sections:
            cure = "A file of Morphologika has them all."
            fail(path, len(lines), f"a section [{name}]", "none", cure)
    return sections


def _exactly(path: str | PathLike, sections: dict[str, _Lines], name: str, count: int) -> _Lines:
    lines = sections[name]
    if len(lines) != count:
        line = lines[-1][0] if lines else 1
        cure = "Correct the numbers of [individuals] and [landmarks], or the section."
        fail(path, line, f"{count} lines in [{name}]", f"{len(lines)}", cure)
    return lines


def _whole_number(path: str | PathLike, sections: dict[str, _Lines], name: str) -> int:
    ((line, value),) = _exactly(path, sections, name, 1)
    if not value.isdecimal() or int(value) < 1 or name == "dimensions" and value not in ("2", "3"):
        expected = "2 or 3" if name == "dimensions" else "a positive whole number"
        fail(path, line, f"{expected} in [{name}]", repr(value), "Correct it.")
    return int(value)


def _notes(path: str | PathLike, sections: dict[str, _Lines], count: int) -> list[dict[str, str]]:
    """Labels, and the group, of each specimen."""
    notes = _labels(path, sections, count)
    for note, group in zip(notes, _groups(path, sections, count), strict=False):
        note["group"] = group
    return notes


def _labels(path: str | PathLike, sections: dict[str, _Lines], count: int) -> list[dict[str, str]]:
    """The values of each specimen, by label."""
    notes: list[dict[str, str]] = [{} for _ in range(count)]
    labels = _words(sections, "labels")
    if not labels or "labelvalues" not in sections:
        return notes
    values = _exactly(path, sections, "labelvalues", count)
    for note, (line, value) in zip(notes, values, strict=True):
        # of a single label the value may have blanks
        parts = value.split() if len(labels) > 1 else [value]
        if len(parts) != len(labels):
            cure = "Write each without blanks."
            fail(path, line, f"{len(labels)} values of labels", repr(value), cure)
        note |= dict(zip(labels, parts, strict=True))
    return notes


def _groups(path: str | PathLike, sections: dict[str, _Lines], count: int) -> list[str]:
    """The group of each specimen, of which the file has names and sizes in turn; none without."""
    words = _words(sections, "groups")
    sizes = [int(word) if word.isdecimal() else 0 for word in words[1::2]]
    if words and (len(words) % 2 or sum(sizes) != count):
        cure = "It says the name and the size of each group."
        line = sections["groups"][0][0]
        fail(path, line, f"[groups] of {count} specimens in all", repr(" ".join(words)), cure)
    groups = []
    for name, size in zip(words[::2], sizes, strict=True):
        groups += [name] * size
    return groups


def _words(sections: dict[str, _Lines], name: str) -> list[str]:
    return [word for _, line in sections.get(name, []) for word in line.split()]
