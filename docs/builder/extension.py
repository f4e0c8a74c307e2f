"""What our pages have and Markdown does not know: mathematics as MathML, citations as links.

Browsers draw MathML by themselves, so a page needs neither a script nor a network.
"""

import html
import re
from pathlib import Path
from xml.etree.ElementTree import Element, tostring

from latex2mathml.converter import convert_to_element
from markdown import Extension
from markdown.inlinepatterns import InlineProcessor
from markdown.postprocessors import Postprocessor
from pybtex.database import Entry, parse_file
from pybtex.style.formatting.plain import Style

ACCENTS = {"~": "\N{SMALL TILDE}", "^": "\N{MODIFIER LETTER CIRCUMFLEX ACCENT}"}
FUNCTIONS = {"log", "exp", "sin", "cos", "det", "dim"}
OPERATORS = {"~": "\N{TILDE OPERATOR}", ":": ":", "\N{PRIME}": "\N{PRIME}"}
CAPITALS = set("ΓΔΘΛΞΠΣΥΦΨΩ")
SIGNS = {"-", "+", "\N{MINUS SIGN}"}
CLOSING = {")", "]", "}"}
FENCES = {"|", "\N{DOUBLE VERTICAL LINE}"}

THIN = {"width": "0.167em"}

LAST = 0  # priority of a processor that runs after all others


class Mathematics(Postprocessor):
    r"""What arithmatex has marked, `\(...\)` in a line and `\[...\]` as a block, converted."""

    MARKED = re.compile(
        r'<(?:span|div) class="arithmatex">\s*'
        r"\\(?P<kind>[(\[])(?P<tex>.*?)\\[)\]]\s*</(?:span|div)>",
        re.S,
    )

    def run(self, text: str) -> str:
        return self.MARKED.sub(self._converted, text)

    def _converted(self, found: re.Match) -> str:
        tex = html.unescape(found["tex"]).strip()
        if found["kind"] == "(":
            return mathml(tex, "inline")
        return f'<div class="equation">{mathml(tex, "block")}</div>'


def mathml(tex: str, display: str) -> str:
    """TeX as MathML, set as TeX would set it where latex2mathml leaves that to chance."""
    formula = convert_to_element(tex, display=display)
    for part in formula.iter():
        part.text = part.text and html.unescape(part.text)  # characters come as entities
    for part in list(formula.iter()):
        if part.tag == "mover" and part[1].text in ACCENTS:
            part.set("accent", "true")
            part[1].text = ACCENTS[part[1].text]
        if part.tag == "mrow":
            space(part)
        if part.tag == "mi" and part.text in OPERATORS:
            part.tag, part.text = "mo", OPERATORS[part.text]
        elif part.tag == "mi" and part.text in CAPITALS:
            part.set("mathvariant", "normal")
        elif part.tag == "mo" and part.text in FENCES:
            part.attrib.update({"lspace": "0", "rspace": "0", "stretchy": "false"} | part.attrib)
    return tostring(formula, encoding="unicode")


def space(row: Element) -> None:
    """Thin spaces beside the name of a function, as in 2 log x but not in log(x).

    None follows the sign of a number, -1, as one follows that of a difference.
    """
    children = [None, *row, None]
    row[:] = []
    for before, child, after in zip(children, children[1:-1], children[2:], strict=False):
        nothing = before is None or before.tag == "mo" and before.text not in CLOSING
        if child.text in SIGNS and nothing:
            child.set("form", "prefix")
        is_function = child.text in FUNCTIONS
        if is_function and before is not None and before.tag not in ("mo", "mspace"):
            row.append(Element("mspace", THIN))
        row.append(child)
        if is_function and after is not None and after.tag != "mspace" and after.text != "(":
            row.append(Element("mspace", THIN))


class Citation(InlineProcessor):
    """`[@key]` as a link with the authors and the year; mkdocs-autorefs knows where the list is."""

    def __init__(self, entries: dict[str, Entry]):
        super().__init__(r"\[@(\w+)\]")
        self.entries = entries

    def handleMatch(self, m: re.Match, data: str):  # noqa: N802, the name that Markdown calls
        key = m.group(1)
        if key not in self.entries:
            raise ValueError(f"`[@{key}]` must be a key of docs/references.bib; add the entry.")
        link = Element("autoref", {"identifier": key})
        link.text = authors_and_year(self.entries[key])
        return link, m.start(0), m.end(0)


class Pages(Extension):
    """The extension that `mkdocs.yml` would name, if it could be imported."""

    def __init__(self, bibliography: Path):
        super().__init__()
        self.entries = entries_of(bibliography)

    def extendMarkdown(self, md):  # noqa: N802
        md.postprocessors.register(Mathematics(md), "mathematics", LAST)
        # before links, which begin with a bracket too
        md.inlinePatterns.register(Citation(self.entries), "citation", 175)


def entries_of(bibliography: Path) -> dict[str, Entry]:
    """The entries of a BibTeX file by their keys, in the order of the file."""
    return dict(parse_file(str(bibliography)).entries)


def authors_and_year(entry: Entry) -> str:
    """Such as Bell 1994, Durham and Gallant 2002, or Baker et al. 2024."""
    surnames = []
    for person in entry.persons["author"]:
        parts = [*person.rich_prelast_names, *person.rich_last_names]
        surnames.append(" ".join(str(part) for part in parts))
    if len(surnames) > 2:
        surnames = [f"{surnames[0]} et al."]
    return f"{' and '.join(surnames)} {entry.fields['year']}"


def bibliography_page(bibliography: Path) -> str:
    """All entries in full, each with its key as an anchor."""
    entries = entries_of(bibliography)
    blocks = ["# References"]
    for entry in Style().format_entries(list(entries.values())):
        label = authors_and_year(entries[entry.key])
        text = re.sub("</?span.*?>", "", entry.text.render_as("html"))  # about letters in capitals
        blocks.append(f"[](){{#{entry.key}}}\n**{label}.** {text}")
    return "\n\n".join(blocks)
