"""The documentation: its code runs, its citations exist, and what is exported is documented."""

import inspect
import json
import os
import re
import socket
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

import numpyro_bridges as nb

pytestmark = pytest.mark.numpyro

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
SOURCES = sorted((ROOT / "numpyro_bridges").rglob("*.py"))
BIBLIOGRAPHY = (ROOT / "docs" / "references.bib").read_text(encoding="utf-8")
ENTRIES = {key: body for key, body in re.findall(r"@\w+\{(\w+),\n(.*?)\n\}", BIBLIOGRAPHY, re.S)}

RUN_BLOCKS = """
import re, sys
first, count, *paths = sys.argv[1:]
pages = {path: open(path, encoding="utf-8").read() for path in paths}
blocks = [(path, found) for path in paths for found in re.finditer(r"^```python\\n(.*?)^```", pages[path], re.S | re.M)]
for path, found in blocks[int(first) :: int(count)]:
    lines_before = pages[path][: found.start(1)].count("\\n")
    exec(compile("\\n" * lines_before + found.group(1), path, "exec"), {"__name__": "__main__"})
    print("ran the block at line", lines_before)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "names",
    [
        ["extending.md"],
        ["data.md", "guides.md", "scores.md", "trees.md", "troubleshooting.md"],
        ["fields.md", "hierarchical.md", "observation_sd.md", "long_runs.md"],
        ["loo.md", "svi.md"],
    ],
    ids=["extending", "others", "models", "integrated"],
)
def test_code_runs_as_it_stands(names, tmp_path):
    """Every block by itself, in single precision as a user's process has it; an error names the
    line of the page.

    Two processes share the blocks. The README's first page is run by test_examples.py.
    """
    pages = [ROOT / "docs" / name for name in names]
    printed = printed_by([({}, first, "2", *pages) for first in "01"], tmp_path)
    blocks = sum(page.read_text(encoding="utf-8").count("\n```python\n") for page in pages)
    assert blocks >= 3 and printed.count("ran the block") == blocks


@pytest.mark.slow
def test_code_runs_on_many_devices(tmp_path):
    """The first block on 8 devices of one process, the second in two processes."""
    page = ROOT / "docs" / "devices.md"
    assert page.read_text(encoding="utf-8").count("\n```python\n") == 2
    with socket.socket() as free:
        free.bind(("localhost", 0))
        told = {"COORDINATOR": f"localhost:{free.getsockname()[1]}", "NUM_PROCESSES": "2"}
    processes = [(told | {"PROCESS_ID": rank}, "1", "2", page) for rank in "01"]
    printed = printed_by([({}, "0", "2", page), *processes], tmp_path)
    assert printed.count("ran the block") == 3 and printed.count("drift") == 1
    assert "log evidence" in printed and "'devices': 4" in printed


def printed_by(calls, folder) -> str:
    """What the processes print that run blocks of pages, each with an environment of its own."""
    quick = {
        "OPENBLAS_NUM_THREADS": "1",
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
        "PYTHONPATH": str(ROOT),
    }
    told = "ignore:residual brought nothing:UserWarning"  # of a page's few updates, which says so
    program = [sys.executable, "-W", "error::UserWarning", "-W", told, "-c", RUN_BLOCKS]
    running = [
        subprocess.Popen(
            [*program, *map(str, arguments)],
            cwd=folder,
            env=os.environ | quick | own,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for own, *arguments in calls
    ]
    printed = [process.communicate(timeout=300)[0] for process in running]
    assert [process.returncode for process in running] == [0] * len(calls), "\n".join(printed)
    return "".join(printed)


@pytest.mark.slow
def test_code_has_the_right_types(tmp_path):
    """What the pages pass is what the annotations take: pyright over every block, with the settings
    of the package.
    """
    pytest.importorskip("pyright")
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for found in re.finditer(r"^```python\n(.*?)^```", text, re.S | re.M):
            line = text[: found.start(1)].count("\n")
            (tmp_path / f"{page.stem}_{line}.py").write_text(found.group(1), encoding="utf-8")
    settings = {"extraPaths": [str(ROOT)], "typeCheckingMode": "basic", "pythonVersion": "3.11"}
    (tmp_path / "pyrightconfig.json").write_text(json.dumps(settings))
    checker = [
        sys.executable,
        "-m",
        "pyright",
        "--pythonpath",
        sys.executable,
        "--project",
        str(tmp_path),
    ]
    quiet = {"PYRIGHT_PYTHON_IGNORE_WARNINGS": "1"}
    done = subprocess.run(
        checker, env=os.environ | quiet, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr


def fields(body):
    return dict(re.findall(r"^\s*(\w+)\s*=\s*\{(.*)\},?$", body, re.M))


def test_bibliography_is_well_formed():
    keys = re.findall(r"@\w+\{(\w+),", BIBLIOGRAPHY)
    assert len(keys) == len(set(keys)) == len(ENTRIES)
    for key, body in ENTRIES.items():
        assert {"author", "title", "year"} <= set(fields(body)), key
        assert fields(body)["year"] == key[-4:], key


@pytest.mark.parametrize(
    "path", [*PAGES, *SOURCES], ids=lambda path: path.relative_to(ROOT).as_posix()
)
def test_citations_exist(path):
    """Keys, [@key], and names with a year, "Gower 1975" or "Mider, Schauer and van der Meulen
    (2021)".
    """
    text = path.read_text(encoding="utf-8")
    for key in re.findall(r"\[@(\w+)\]", text):
        assert key in ENTRIES, f"{key} is not in references.bib"
    if "References" in text:
        text = text[: text.rindex("References")]
    for found in re.finditer(r"(?:\b[A-Z][\w’']+|\bal\.),? \(?((?:19|20)\d\d)\b", text):
        before, year = text[max(found.start() - 60, 0) : found.end()], found.group(1)
        authors = [
            fields(body)["author"] for body in ENTRIES.values() if fields(body)["year"] == year
        ]
        surnames = [author.split(",")[0] for names in authors for author in names.split(" and ")]
        assert any(surname in before for surname in surnames), (
            f"no entry of {year} for “{before[-40:]}”"
        )


def test_every_entry_is_cited():
    text = "".join(path.read_text(encoding="utf-8") for path in [*PAGES, *SOURCES])
    assert [key for key in ENTRIES if f"[@{key}]" not in text] == []


def test_versions_agree():
    """What is said of the version and of dependencies in more than one place is the same."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    recipe = (ROOT / ".ci" / "conda" / "recipe.yaml").read_text(encoding="utf-8")
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.search(r"^version: (\S+)$", citation, re.M).group(1) == project["version"]
    assert re.search(r'^  version: "(\S+)"$', recipe, re.M).group(1) == project["version"]
    assert f"## {project['version']}" in (ROOT / "docs" / "changelog.md").read_text(
        encoding="utf-8"
    )
    needed = {requirement.replace(" ", "") for requirement in project["dependencies"]}
    run = recipe[recipe.index("  run:") : recipe.index("tests:")]
    packaged = {
        line.replace(" ", "")
        for line in re.findall(r"^    - (.*)$", run, re.M)
        if "python" not in line
    }
    assert packaged == needed


def test_lowest_versions_are_the_bounds():
    """The constraints with which CI runs once are those that `pyproject.toml` claims, or what
    others need.
    """
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = (ROOT / ".ci" / "lowest.txt").read_text(encoding="utf-8")
    lowest = dict(re.findall(r"^(\S+)==(\S+)$", lines, re.M))
    extras = project["optional-dependencies"]
    for text in [*project["dependencies"], *extras["examples"], *extras["tests"][1:]]:
        requirement = Requirement(text)
        assert lowest[requirement.name] in requirement.specifier, text


def test_top_level_names_have_docstrings():
    names = [name for name in vars(nb) if not name.startswith("_")]
    assert {"GuidedBridge", "DiffusionEndpoint", "sample", "datasets"} <= set(names)
    for name in names:
        value = getattr(nb, name)
        text = vars(value).get("__doc__") if inspect.isclass(value) else value.__doc__
        assert text or re.fullmatch(r"[a-z]+", name) and inspect.ismodule(value), (
            f"{name} has no docstring"
        )
