"""Signatures of classes whose constructor equinox writes: mkdocstrings reads the source alone."""

import importlib
import inspect
from typing import Any

import equinox as eqx
import griffe


class Constructors(griffe.Extension):
    def on_class(self, *, cls: griffe.Class, **kwargs: Any) -> None:
        value = getattr(importlib.import_module(cls.module.path), cls.name, None)
        written_by_equinox = inspect.isclass(value) and issubclass(value, eqx.Module)
        if not written_by_equinox or inspect.isabstract(value) or _writes_its_own(value):
            return
        parameters = inspect.signature(value).parameters.values()
        described = [
            griffe.Parameter("self"),
            *(_described(parameter, cls) for parameter in parameters),
        ]
        constructor = griffe.Function("__init__", parameters=griffe.Parameters(*described))
        cls.set_member("__init__", constructor)


def _writes_its_own(value: type) -> bool:
    """Whether a class or its parents define a constructor; a generated one has no file."""
    code = getattr(value.__init__, "__code__", None)
    return code is not None and not code.co_filename.startswith("<")


def _described(parameter: inspect.Parameter, cls: griffe.Class) -> griffe.Parameter:
    has_default = parameter.default is not parameter.empty
    field = cls.all_members.get(parameter.name)
    return griffe.Parameter(
        parameter.name,
        kind=griffe.ParameterKind(parameter.kind.description),
        annotation=getattr(field, "annotation", None),
        default=repr(parameter.default) if has_default else None,
    )
