"""The font of the formulas: browsers without one draw brackets and sums too small."""

import html
import io
import re
from importlib.metadata import distribution
from pathlib import Path

from fontTools import subset

# The font that ziamath draws with (SIL Open Font License); nothing else of the package is used.
SOURCE = Path(str(distribution("ziamath").locate_file("ziamath/fonts/STIXTwoMath-Regular.ttf")))

# Browsers draw a letter that stands for a variable from these slanted alphabets.
SLANTED = [*range(0x1D434, 0x1D468), 0x210E, *range(0x1D6E2, 0x1D71C)]


def mathematical_font(pages: str) -> bytes:
    """STIX Two Math, of as many characters as the formulas of the pages use, as WOFF2."""
    formulas = html.unescape("".join(re.findall(r"<math\b.*?</math>", pages, re.S)))
    options = subset.Options(flavor="woff2", layout_features=["*"])
    chosen = subset.Subsetter(options)
    chosen.populate(text=formulas, unicodes=SLANTED)
    file = io.BytesIO()
    with subset.load_font(str(SOURCE), options) as font:
        chosen.subset(font)
        subset.save_font(font, file, options)
    return file.getvalue()
