"""Files that are written whole or not at all."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any


def write_whole(file: Path, write: Callable[[Any], None]) -> None:
    """`write(f)` fills a binary file, which then takes the place of `file`, also on a disk that
    loses its power.
    """
    part = file.with_suffix(".tmp")
    with open(part, "wb") as f:
        write(f)
        f.flush()
        os.fsync(f.fileno())
    os.replace(part, file)
    if os.name == "posix":
        directory = os.open(file.parent, os.O_RDONLY)
        os.fsync(directory)
        os.close(directory)
