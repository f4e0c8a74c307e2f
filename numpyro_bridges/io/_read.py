"""One reader for all formats."""

import re
from os import PathLike

from .._checks import as_path
from ._csv import read_csv
from ._morphologika import read_morphologika
from ._nts import read_nts
from ._slicer import read_slicer
from ._specimen import Specimen, read_text
from ._tps import read_tps

_READERS = {
    r"\A\s*\{": read_slicer,
    r"\A# Markups fiducial file": read_slicer,
    r"(?im)^[ \t]*LM3?[ \t]*=": read_tps,
    r"(?im)^\[\s*(individuals|rawpoints)\s*\]": read_morphologika,
    r"(?im)^[ \t]*1\s+\d+[LBE]?\s+\d+L?\s.*\bDIM\s*=": read_nts,
}
"""By what stands in their files."""


def read(path: str | PathLike, *, encoding: str = "utf-8", **settings) -> list[Specimen]:
    """Specimens of a file in any of the formats of this module, which is told by what stands in it.

    **Arguments:** `settings`: those of the format's own reader, `read_tps`, `read_csv`,
    `read_slicer`, `read_nts` or `read_morphologika`. What is none of the others is read as a table.

    **Returns:** a list of `Specimen`.
    """
    content = read_text(path, encoding)
    # without DIM= an NTS file looks like a table of numbers: its name decides
    by_name = as_path(path, "path").name.lower().removesuffix(".gz").endswith((".nts", ".dta"))
    found = [reader for pattern, reader in _READERS.items() if re.search(pattern, content)]
    reader = read_nts if by_name else (found or [read_csv])[0]
    return reader(path, encoding=encoding, **settings)
