"""Pages that are made while the site is built, and a check of what was built.

MkDocs calls the functions `on_*`. Made are the reference (a page for each sub-package, from the
docstrings), the bibliography, the tutorials (from the percent scripts of `examples/`), the first
steps (from the README), and the figure of the landing page.
"""

import html
import importlib
import inspect
import logging
import pkgutil
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

from extension import Pages, bibliography_page
from figure import wing_bridge
from fonts import mathematical_font
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

import numpyro_bridges as nb

ROOT = Path(__file__).parents[2]
BIBLIOGRAPHY = ROOT / "docs" / "references.bib"
FIGURES = ROOT / "output"  # where examples leave theirs, when they have been run in the root

# Sub-packages in which other layers and classes of a user's own find more than most users need.
LAYERS = ("bridges", "conditioning", "distributions", "evidence", "guiding", "sdes", "trees")

log = logging.getLogger("mkdocs.hooks")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """The version beside the name, in the header and in titles; our Markdown."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    config.site_name = f"{config.site_name} {project['version']}"
    config.markdown_extensions.append(Pages(BIBLIOGRAPHY))
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    made: dict[str, str | bytes] = {"references.md": bibliography_page(BIBLIOGRAPHY)}
    made["start.md"] = first_steps((ROOT / "README.md").read_text(encoding="utf-8"))
    made["assets/wing.svg"] = wing_bridge()
    made |= {f"api/{name}.md": text for name, text in reference_pages()}
    for script in sorted((ROOT / "examples").glob("*.py")):
        made[f"tutorials/{script.stem}.md"] = tutorial(script.read_text(encoding="utf-8"))
    pages = "".join(str(page) for page in made.values())
    for figure in FIGURES.glob("*.png"):
        if f"({figure.name})" in pages:
            made[f"tutorials/{figure.name}"] = figure.read_bytes()
    for path, content in made.items():
        files.append(File.generated(config, path, content=content))
    return files


def on_post_build(config: MkDocsConfig) -> None:
    """A warning, so an error of a strict build, for each page that is not as it should be."""
    site = Path(config.site_dir)
    pages = {path: path.read_text(encoding="utf-8") for path in site.rglob("*.html")}
    for path, text in pages.items():
        for problem in problems(text):
            log.warning("%s: %s", path.relative_to(site), problem)
    font = mathematical_font("".join(pages.values()))
    (site / "assets" / "mathematics.woff2").write_bytes(font)


def problems(page: str) -> Iterator[str]:
    """What is left of the source outside code, and what a browser would fetch from elsewhere."""
    prose = re.sub(r"<(code|pre|script|style)\b.*?</\1>", "", page, flags=re.S)
    prose = html.unescape(prose)
    for found in re.findall(r"\[@\w+\]", prose):
        yield f"unresolved citation {found}"
    for found in re.findall(r"\\[()\[\]A-Za-z].{0,30}|\$\$.{0,30}", prose):
        yield f"raw TeX {found}"
    for tag in re.findall(r"<(?:script|img|link|iframe|source)\b[^>]*>", page):
        if re.search(r'(?:src|href)="(?:https?:)?//', tag) and 'rel="canonical"' not in tag:
            yield f"fetched from another host: {tag}"


def first_steps(readme: str) -> str:
    """The sections of the README on how to begin."""
    sections = dict(re.findall(r"^## (.+?)\n(.*?)(?=^## |\Z)", readme, re.S | re.M))
    chosen = ["Try it", "The first page", "Which data fit", "What is not covered yet"]
    return "\n".join(["# First steps\n", *(f"## {title}\n{sections[title]}" for title in chosen)])


def tutorial(script: str) -> str:
    """A percent script as a page: its Markdown cells as they are, the others as code.

    An image that a Markdown cell shows, `![caption](name.png)`, is left out where the script has
    not been run.
    """
    blocks = []
    for cell in re.split(r"^# %%", script, flags=re.M)[1:]:
        kind, _, body = cell.partition("\n")
        if "[markdown]" in kind:
            text = re.sub(r"^# ?", "", body, flags=re.M).strip()
            blocks.append(re.sub(r"^!\[.*?\]\((.+?)\)$", _image_if_there, text, flags=re.M))
        elif body.strip():
            code = re.sub(r" +# noqa.*", "", body.strip())
            blocks.append(f"```python\n{code}\n```")
    return "\n\n".join(blocks)


def _image_if_there(found: re.Match) -> str:
    return found.group() if (FIGURES / found.group(1)).exists() else ""


def reference_pages() -> Iterator[tuple[str, str]]:
    """A page for each sub-package, one on what only the top level has, a first that lists it."""
    top = {name: value for name, value in vars(nb).items() if ours(name, value)}
    names = [info.name for info in pkgutil.iter_modules(nb.__path__)]
    units = [name for name in names if not name.startswith("_")]
    alone = [name for name, value in top.items() if unit_of(value) not in units]
    yield "index", overview(top)
    yield "compare", "\n\n".join(["# Comparison of guides", *map(directive, alone)])
    for unit in units:
        module = importlib.import_module(f"{nb.__name__}.{unit}")
        yield unit, module_page(unit, module, top)


def ours(name: str, value: object) -> bool:
    module = str(getattr(value, "__module__", ""))
    return callable(value) and not name.startswith("_") and module.startswith(nb.__name__)


def unit_of(value: object) -> str:
    return str(value.__module__).split(".")[1]


def module_page(unit: str, module: ModuleType, top: dict[str, object]) -> str:
    public = {name: value for name, value in vars(module).items() if ours(name, value)}
    found = {name: value for name, value in public.items() if unit_of(value) == unit}
    blocks = [f"# nb.{unit}", inspect.getdoc(module) or ""]
    blocks += [directive(name) for name, value in found.items() if top.get(name) is value]
    others = [f"{unit}.{name}" for name, value in found.items() if top.get(name) is not value]
    if unit in LAYERS and others:
        seen = "[Writing your own](../extending.md) shows it in use."
        blocks += ["## For classes of your own", f"What other layers build on. {seen}"]
        blocks += [directive(name, level=3) for name in others]
    else:
        blocks += [directive(name) for name in others]
    return "\n\n".join(blocks)


def directive(name: str, level: int = 2) -> str:
    """What mkdocstrings replaces by the docstring of a name below `nb`."""
    label = name.rpartition(".")[2]
    options = f"      heading: nb.{name}\n      toc_label: {label}\n      heading_level: {level}"
    return f"::: {nb.__name__}.{name}\n    options:\n{options}"


def overview(top: dict[str, object]) -> str:
    """Every name of the top level, with the first line of its docstring."""
    rows = [
        "# Reference",
        "Names of the top level, `import numpyro_bridges as nb`; the pages beside have the rest.",
    ]
    table = ["| name | what it is |", "|---|---|"]
    for name, value in sorted(top.items(), key=lambda item: item[0].lower()):
        first = (inspect.getdoc(value) or "").partition("\n\n")[0]
        cell = first.replace("\n", " ").replace("|", "\\|")
        table.append(f"| [`nb.{name}`][{nb.__name__}.{name}] | {cell} |")
    return "\n\n".join([*rows, "\n".join(table)])
