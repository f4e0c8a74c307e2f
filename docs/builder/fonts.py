"""The font of the formulas: without one, browsers of some systems draw brackets and sums too small."""

import html
import io
import re
from pathlib import Path

import ziamath
from fontTools import subset

SOURCE = Path(ziamath.__file__).parent / "fonts" / "STIXTwoMath-Regular.ttf"  # SIL Open Font License

# Browsers draw a letter that stands for a variable from these slanted alphabets.
SLANTED = [*range(0x1D434, 0x1D468), 0x210E, *range(0x1D6E2, 0x1D71C)]


def mathematical_font(pages: str) -> bytes:
    """STIX Two Math, of as many characters as the formulas of the pages use, as WOFF2."""
    formulas = html.unescape("".join(re.findall(r"<math\b.*?</math>", pages, re.S)))
    options = subset.Options(flavor="woff2", layout_features=["*"])
    font = subset.load_font(str(SOURCE), options)
    chosen = subset.Subsetter(options)
    chosen.populate(text=formulas, unicodes=SLANTED)
    chosen.subset(font)
    file = io.BytesIO()
    subset.save_font(font, file, options)
    return file.getvalue()
