"""Rules over the whole package: imports go downwards, classes are abstract or final, names are
documented.
"""

import ast
import graphlib
import importlib
import inspect
import pkgutil
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import pytest

PACKAGE = "numpyro_bridges"
ROOT = Path(__file__).parents[1] / PACKAGE

# A module imports from the rows above its own, never from its neighbours. Nobody imports the last
# row.
LAYERS = [
    {"_types", "_checks", "_files"},
    {"_devices", "_linalg", "weights", "io"},
    {"_closed", "spaces", "kernels", "shapes"},
    {"sdes"},
    {"conditioning"},
    {"guiding"},
    {"bridges", "trees"},
    {"evidence"},
    {"distributions"},
    {"scores"},
    {"infer"},
    {"datasets", "plot"},
    {"_compare"},
]
LEVEL = {unit: level for level, units in enumerate(LAYERS) for unit in units}

MODULES = {
    ".".join([PACKAGE, *path.relative_to(ROOT).with_suffix("").parts]).removesuffix(
        ".__init__"
    ): path
    for path in sorted(ROOT.rglob("*.py"))
}


def unit_of(module):
    """The file or folder of the package that a module is in; empty for the package's own
    `__init__`.
    """
    return (module.split(".") + [""])[1]


def imports_of(module):
    """Modules of the package that a module imports, anywhere in its text."""
    path = MODULES[module]
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            parents = module.split(".")
            parents = parents if path.name == "__init__.py" else parents[:-1]
            start = parents[: len(parents) - node.level + 1] if node.level else []
            source = ".".join([*start, *([node.module] if node.module else [])])
            names = [f"{source}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            if name.split(".")[0] == PACKAGE:
                found.add(name if name in MODULES else name.rpartition(".")[0])
    return found


@pytest.mark.parametrize("module", sorted(set(MODULES) - {PACKAGE}))
def test_imports_go_downwards(module):
    unit = unit_of(module)
    assert unit in LEVEL, f"{unit} has no layer: give it one in this file"
    for imported in imports_of(module):
        other = unit_of(imported)
        assert other, f"{module} imports the whole package"
        assert other == unit or LEVEL[other] < LEVEL[unit], (
            f"{module} imports {imported}, not below it"
        )


def test_no_import_cycles():
    graph = {module: imports_of(module) - {module} for module in MODULES}
    graphlib.TopologicalSorter(graph).prepare()  # raises CycleError, with the cycle


def test_resolution_of_imports(tmp_path, monkeypatch):
    """The two tests above see every way to write an import."""
    lines = ["from . import a", "from .b import f", "from ..c import g", "from .. import d"]
    text = "\n".join([*lines, f"import {PACKAGE}.e", "import jax", "from jax import numpy"])
    names = ["spaces._new", "spaces.a", "spaces.b", "c", "d", "e"]
    for name in names:
        monkeypatch.setitem(MODULES, f"{PACKAGE}.{name}", tmp_path / "new.py")
    (tmp_path / "new.py").write_text(text)
    assert imports_of(f"{PACKAGE}.spaces._new") == {f"{PACKAGE}.{name}" for name in names[1:]}


def classes():
    for info in pkgutil.walk_packages([str(ROOT)], PACKAGE + "."):
        module = importlib.import_module(info.name)
        for value in vars(module).values():
            if inspect.isclass(value) and value.__module__ == module.__name__:
                yield value


def is_abstract(cls):
    return inspect.isabstract(cls) or bool(getattr(cls, "__abstractvars__", ()))


def named_abstract(cls):
    return cls.__name__.lstrip("_").startswith("Abstract")


def follows_numpyro(cls):
    """Subclasses of NumPyro's classes follow NumPyro's habits."""
    in_numpyro_layers = unit_of(cls.__module__) in ("distributions", "infer")
    return in_numpyro_layers and any(
        base.__module__.split(".")[0] == "numpyro" for base in cls.__mro__
    )


def test_classes_are_abstract_or_final():
    for cls in filter(lambda cls: not follows_numpyro(cls), classes()):
        assert named_abstract(cls) or not is_abstract(cls), (
            f"{cls} is abstract, its name does not say so"
        )
        for base in cls.__mro__[1:]:
            ours = base.__module__.split(".")[0] == PACKAGE
            module = issubclass(base, eqx.Module) and base is not eqx.Module
            assert named_abstract(base) or not (ours or module), (
                f"{cls} subclasses {base}, which is concrete"
            )


def test_public_names_are_documented():
    public = [name for name in MODULES if "._" not in name]
    for module in map(importlib.import_module, public):
        for name, value in vars(module).items():
            ours = str(getattr(value, "__module__", "")).split(".")[0] == PACKAGE
            if ours and callable(value) and not name.startswith("_"):
                text = vars(value).get("__doc__") if inspect.isclass(value) else value.__doc__
                generated = f"{name}("  # by dataclasses, from the fields
                assert text and not text.startswith(generated), (
                    f"{module.__name__}.{name} has no docstring"
                )


def test_import_is_light():
    """Plots, data sets and diagnostics are loaded by those who use them."""
    program = (
        f"import sys, {PACKAGE}; print([name for name in sys.argv[1:] if name in sys.modules])"
    )
    heavy = [
        "arviz",
        "arviz_stats",
        "xarray",
        "matplotlib",
        "ktch",
        "sklearn",
        "pandas",
        "h5netcdf",
    ]
    loaded = subprocess.run(
        [sys.executable, "-c", program, *heavy],
        cwd=ROOT.parent,
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert loaded.strip() == "[]"
