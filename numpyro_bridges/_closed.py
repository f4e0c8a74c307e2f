"""A user's function as a closed program.

JAX keeps compiled code by the function that it was made from. A function that reads an attribute, a
global or a closure is the same function after what it reads has changed, and goes on with the old
values, silently. So each function is traced once where it meets the shapes at which it is to be
called: the arrays that it captures become leaves, traced ones too, and all else that it reads is
frozen at that moment and is a part of what compiled code is kept by.
"""

import pickle
import weakref
from collections import deque
from collections.abc import Callable, Hashable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, jaxpr_as_fun
from jaxtyping import Array

from ._checks import require
from ._linalg import full_precision, varying_axes, varying_like


class _Program:
    """A traced function without the arrays that it captures; compared by identity."""

    def __init__(self, jaxpr: Jaxpr, structure: Any):
        self.jaxpr = jaxpr
        self.structure = structure
        """Of the arguments, whose arrays are the inputs."""
        self.sources: deque[tuple] = deque(maxlen=8)
        """The last functions that it was traced from, with the types of their arguments."""

    def __reduce__(self):
        # A jaxpr cannot be pickled. A function can, if it has a name and still is what was traced.
        for source in reversed(tuple(self.sources)):
            if _is_pickled(source) and close(*source).program is self:
                return _program, source
        raise pickle.PicklingError(
            "a function cannot be pickled where it has no name in a module, after what it reads "
            "has changed, and where it captures values of a traced program. Give it what it reads "
            "as arguments, such as `args`."
        )


def _is_pickled(source: tuple) -> bool:
    try:
        pickle.dumps(source)
    except Exception:  # whatever a user's objects raise
        return False
    return True


def _program(*source) -> _Program:
    return close(*source).program


_programs: weakref.WeakValueDictionary[Hashable, _Program] = weakref.WeakValueDictionary()
"""One object for all functions that compute the same, so that they share their compiled code."""


class Closed(eqx.Module):
    """A function of arrays, and of pytrees of them, that reads nothing but its arguments and its
    own leaves.
    """

    captured: tuple[Array, ...]
    program: _Program = eqx.field(static=True)

    @property
    def shape(self) -> tuple[int, ...]:
        """Of the value."""
        return _type(self.program.jaxpr.outvars[0]).shape

    def __call__(self, *args):
        leaves, structure, _ = _inputs(args)
        types = list(map(_type, self.program.jaxpr.invars))
        require(
            structure == self.program.structure
            and [x.shape for x in leaves] == [a.shape for a in types],
            f"a function was traced for arrays {[a.shape for a in types]}, and is called with "
            f"{[x.shape for x in leaves]}, or with objects of another structure. For other shapes "
            "make a new object from the function itself.",
        )
        # A program has one type for each input, as the function that was traced had.
        leaves = [x.astype(a.dtype) for x, a in zip(leaves, types, strict=True)]
        if any(varying_axes(x) for x in (*leaves, *self.captured)):
            (out,) = _marked(self.program.jaxpr, self.captured, leaves)
        else:
            (out,) = jaxpr_as_fun(ClosedJaxpr(self.program.jaxpr, self.captured))(*leaves)
        return out


def _marked(jaxpr: Jaxpr, captured, leaves) -> list:
    """The outputs of a program, operation by operation, inside `jax.shard_map`.

    Each operation there takes values that vary over the same devices, which the constants of a
    program that was traced outside do not.
    """
    variables = [*jaxpr.constvars, *jaxpr.invars]
    values = dict(zip(variables, [*captured, *leaves], strict=True))

    def read(variables):
        return [jnp.asarray(v.val) if isinstance(v, Literal) else values[v] for v in variables]

    for eqn in jaxpr.eqns:
        inputs = read(eqn.invars)
        inputs = varying_like(inputs, *inputs)
        if eqn.primitive.name in ("jit", "pjit"):
            # a program within: its constants have to be marked too
            inner = eqn.params["jaxpr"]
            outputs = _marked(inner.jaxpr, inner.consts, inputs)
        else:
            params = eqn.primitive.get_bind_params(eqn.params)
            outputs = eqn.primitive.bind(*inputs, **params)
            outputs = outputs if eqn.primitive.multiple_results else [outputs]
        values.update(zip(eqn.outvars, outputs, strict=True))
    return read(jaxpr.outvars)


@full_precision
def close(function: Callable, *args) -> Closed:
    """`function`, which returns an array, traced for arguments like `args`."""
    leaves, structure, static = _inputs(args)

    def call(*leaves):  # a new function at each call: JAX keeps what it has traced by the function
        return function(*eqx.combine(jax.tree.unflatten(structure, leaves), static))

    traced = jax.make_jaxpr(call)(*leaves)
    # a copy: a value of a traced program that has ended is refused here, not where the result is
    # computed
    captured = [
        jnp.array(c, copy=True) if isinstance(c, Tracer) else jnp.asarray(c) for c in traced.consts
    ]
    key: Hashable = (structure, _key(traced.jaxpr))
    # The same values, but two users may have written two derivatives.
    if rules := _rules(traced):
        key = key, _derivative(traced.jaxpr, [*captured, *leaves], "custom_vjp_call" in rules)
    program = _programs.get(key)
    if program is None:
        program = _Program(traced.jaxpr, structure)
        _programs[key] = program
    if not any(isinstance(c, Tracer) for c in captured):
        # Kept for pickling: types in the place of arrays, which may be large.
        types = list(map(_type, traced.jaxpr.invars))
        source = function, *eqx.combine(jax.tree.unflatten(structure, types), static)
        if source not in program.sources:
            program.sources.append(source)
    return Closed(tuple(captured), program)


def _type(variable: Any) -> jax.ShapeDtypeStruct:
    aval = variable.aval
    return jax.ShapeDtypeStruct(aval.shape, aval.dtype, weak_type=aval.weak_type)


def _inputs(args) -> tuple[list, Any, Any]:
    """The arrays of the arguments, their structure, and what else the arguments hold."""
    numbers = (bool, int, float, np.ndarray, np.generic)
    args = tuple(jnp.asarray(a) if isinstance(a, numbers) else a for a in args)
    arrays, static = eqx.partition(
        args, lambda a: eqx.is_array(a) or isinstance(a, jax.ShapeDtypeStruct)
    )
    leaves, structure = jax.tree.flatten(arrays)
    return leaves, structure, static


# What tells programs apart: primitives, their parameters and the exact constants, without names and
# sources.

_RULES = {"custom_jvp_call", "custom_vjp_call"}
"""Primitives with a user's rule of differentiation, a function that is new at each trace."""


def _key(jaxpr: Jaxpr) -> Hashable:
    """Equal for programs that are equal but for the names of their variables."""
    number: dict[Any, int] = {}

    def name(v):
        return _value(v.val) if isinstance(v, Literal) else number.setdefault(v, len(number))

    def declared(variables):
        return tuple((name(v), v.aval) for v in variables)

    inputs = declared(jaxpr.constvars), declared(jaxpr.invars)
    lines = tuple(
        (eqn.primitive, tuple(map(name, eqn.invars)), _parameters(eqn), declared(eqn.outvars))
        for eqn in jaxpr.eqns
    )
    return inputs, lines, tuple(map(name, jaxpr.outvars))


def _parameters(eqn) -> Hashable:
    if eqn.primitive.name in _RULES:
        # The rule itself is a new function each time; what it says is asked of `_derivative`.
        return tuple(
            _value(value)
            for value in eqn.params.values()
            if isinstance(value, (ClosedJaxpr, Jaxpr))
        )
    return tuple((name, _value(value)) for name, value in sorted(eqn.params.items()))


def _value(value: Any) -> Hashable:
    """A constant or a parameter, equal where it is the same to the last bit."""
    if isinstance(value, ClosedJaxpr):
        return _key(value.jaxpr), tuple(map(_value, value.consts))
    if isinstance(value, Jaxpr):
        return _key(value)
    if isinstance(value, (jax.Array, np.ndarray, np.generic)) and not isinstance(value, Tracer):
        data: Any = value
        if jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
            data = jax.random.key_data(data)
        data = np.asarray(data)
        return value.dtype, data.shape, getattr(value, "weak_type", None), data.tobytes()
    # 1, 1.0 and True are equal, 0.0 and -0.0 too
    if isinstance(value, (bool, int, float, complex)):
        return type(value), repr(value)
    if type(value) in (tuple, list):
        return tuple(map(_value, value))
    if type(value) is dict:
        return tuple((k, _value(v)) for k, v in value.items())
    return _hashable(value)


class _Identity:
    """What cannot be hashed is equal to itself only."""

    def __init__(self, value: Any):
        self.value = value

    def __eq__(self, other):
        return isinstance(other, _Identity) and self.value is other.value

    def __hash__(self):
        return id(self.value)


def _hashable(value: Any) -> Hashable:
    try:
        hash(value)
    except TypeError:
        return _Identity(value)
    return value


def _rules(value: Any) -> set[str]:
    """The rules that are met in a jaxpr, and in those among the parameters of its equations."""
    if isinstance(value, (ClosedJaxpr, Jaxpr)):  # one class in later versions of JAX
        found = [
            _rules(list(eqn.params.values())) | ({eqn.primitive.name} & _RULES)
            for eqn in value.eqns
        ]
    else:
        found = map(_rules, value) if type(value) in (tuple, list) else []
    return set().union(*found)


def _derivative(jaxpr: Jaxpr, inputs: list, reverse: bool) -> Hashable:
    """What rules say of the derivative; where it cannot be traced nothing is equal to it."""
    inexact = [i for i, x in enumerate(inputs) if jnp.issubdtype(x.dtype, jnp.inexact)]
    num_captured = len(jaxpr.constvars)

    def derivative(*inputs):
        def call(*moved):
            # only numbers move; integers and keys stay
            by_place = dict(enumerate(inputs)) | dict(zip(inexact, moved, strict=True))
            values = list(by_place.values())
            program = jaxpr_as_fun(ClosedJaxpr(jaxpr, values[:num_captured]))
            return program(*values[num_captured:])[0]

        moved = tuple(inputs[i] for i in inexact)
        if not reverse:
            return jax.jvp(call, moved, moved)[1]
        out, pull = jax.vjp(call, *moved)
        return pull(jnp.ones_like(out))

    try:
        return _value(jax.make_jaxpr(derivative)(*inputs))
    except Exception:  # a user's rule may raise anything
        return _Identity(jaxpr)
