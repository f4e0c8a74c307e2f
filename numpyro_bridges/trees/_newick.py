"""Trees from Newick and NEXUS text, read by DendroPy.

Of the readers compared, the package `newick` reads a branch with two lengths, `c:2:1`, as 21, and
its errors have no position; hyperiax's reader knows neither quotes nor comments; DendroPy has
positions, quotes, comments, and NEXUS with its table of translations. It takes the last of two
lengths, so that is looked for beforehand, and comments are taken out, since one before a quoted
name hides the quote.
"""

import re
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .._checks import as_path, positive_integer, require, words

# quotes come first: a bracket within them is part of a name; '' within them is a quote
_QUOTED_OR_COMMENT = re.compile(r"'(?:[^']|'')*'|\[[^\]]*\]")
_UNROOTED = re.compile(r"(?im)^(\s*)utree\b")
_TWO_LENGTHS = re.compile(r":[^,();:]*(:)")


class Parsed(NamedTuple):
    """Nodes in preorder; the root's parent is −1, a length `None` where none is written."""

    parents: list[int]
    lengths: list[float | None]
    names: list[str | None]


def text_of(source: str | PathLike) -> str:
    """Text as it is (it has a parenthesis or a semicolon), the content of a file by its path."""
    if isinstance(source, str) and re.search(r"[(;]", source):
        return source
    return as_path(source, "source").read_text(encoding="utf-8-sig")


def parse(source: str | PathLike, index: int | None, preserve_underscores: bool) -> Parsed:
    """One tree of a text or of a file."""
    text = text_of(source)
    place = "" if text is source else f"{Path(source)}: "
    text = _without_comments(text)
    if not _is_nexus(text) and not text.rstrip().endswith(";"):
        text = text.rstrip() + ";"  # a file may end without
    # a colon within quotes belongs to a name
    found = _TWO_LENGTHS.search(_hidden_quotes(text))
    require(
        found is None,
        f"{place}a branch has two lengths, {_position(text, found)}. Keep one of them.",
    )
    trees = _read(text, place, preserve_underscores)
    require(len(trees) > 0, f"{place}`source` must hold a tree; got {words(text.strip())}.")
    require(
        index is not None or len(trees) == 1,
        f"{place}`source` holds {len(trees)} trees where one is asked for: choose one by `index`, "
        "from 0 on.",
    )
    chosen = 0 if index is None else positive_integer(index, "index", least=0)
    require(
        chosen < len(trees),
        f"{place}`index` must be below the number of trees, {len(trees)}; got {index}.",
    )
    return _nodes(trees[chosen])


def _without_comments(text: str) -> str:
    """Comments and annotations become blanks of the same length, so that positions stay."""

    def blank(found: re.Match) -> str:
        return found[0] if found[0].startswith("'") else re.sub(r"[^\n]", " ", found[0])

    return _QUOTED_OR_COMMENT.sub(blank, text)


def _hidden_quotes(text: str) -> str:
    return _QUOTED_OR_COMMENT.sub(lambda found: "_" * len(found[0]), text)


def _position(text: str, found: re.Match | None) -> str:
    # group 1 is the second colon; line and column count from 1
    before = text[: found.start(1)] if found else ""
    return f"line {before.count(chr(10)) + 1}, column {len(before) - before.rfind(chr(10))}"


def _read(text: str, place: str, preserve_underscores: bool) -> Any:
    # here, since most programs read no tree
    import dendropy

    nexus = _is_nexus(text)
    if nexus:  # PAML writes rooted trees so; DendroPy does not know the word
        text = _UNROOTED.sub(r"\1 tree", text)
    # names of inner nodes stay labels, where several nodes may have the support 95
    settings = dict(preserve_underscores=preserve_underscores, suppress_internal_node_taxa=True)
    # a tree without the mark [&R] would be unrooted to DendroPy
    settings |= dict(rooting="force-rooted")
    if not nexus:  # names that are given twice are ours to refuse
        settings |= dict(suppress_leaf_node_taxa=True)
    try:
        return dendropy.TreeList.get(data=text, schema="nexus" if nexus else "newick", **settings)
    except Exception as error:  # DendroPy's errors have no class in common, and say where
        cure = (
            "Parentheses must match, and a name with a blank, a comma or a parenthesis needs "
            "quotes, 'H. sapiens'."
        )
        raise ValueError(f"{place}`source` must be Newick or NEXUS: {error}. {cure}") from error


def _is_nexus(text: str) -> bool:
    return text.lstrip().upper().startswith("#NEXUS")


def _nodes(tree: Any) -> Parsed:
    parsed = Parsed([], [], [])
    number = {}
    for node in tree.preorder_node_iter():
        number[node] = len(number)
        parsed.parents.append(-1 if node.parent_node is None else number[node.parent_node])
        length = node.edge_length
        parsed.lengths.append(None if length is None else float(length))
        parsed.names.append(_name(node))
    return parsed


def _name(node: Any) -> str | None:
    label = node.label if node.taxon is None else node.taxon.label
    if label is None or node.is_leaf():
        return label
    return None if _is_support(label) else label


def _is_support(label: str) -> bool:
    """Inner nodes may have supports, `95` or `0.98/100`, where a name would be."""
    try:
        # `inf` and `nan` are numbers to Python, and may be the names of clades
        return bool(np.all([np.isfinite(float(part)) for part in label.split("/")]))
    except ValueError:
        return False
