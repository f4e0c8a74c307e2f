"""Checks of what a user passes: the argument in backticks, the rule, the value got, the cure.

A number is decided by its kind and never by what a conversion makes of it: NumPy parses text,
counts days since 1970, takes True for 1 and None for NaN, and JAX drops imaginary parts and masks,
all without a word.
"""

import datetime
import math
import operator
import reprlib
from collections.abc import Callable, Iterable, Mapping
from os import PathLike, fspath
from pathlib import Path
from typing import Any, NoReturn

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

_CURES = {
    "boolean": "True and False are no numbers: 1 and 0 are `float(value)` or `.astype(float)`.",
    "text": "Convert text first: `float(text)`, or `numpy.asarray(texts, float)`.",
    "time": (
        "Give times and dates as numbers, such as days since the first: "
        "`(times - times[0]) / numpy.timedelta64(1, 'D')`."
    ),
    "complex": "Give its real part, or real and imaginary parts as coordinates of their own.",
    "none": "None is not a number: was something left out?",
    "masked": "Some of its entries are masked: fill them in, or leave them out.",
    "ragged": "Rows must have one length: different shapes are a list, and a call for each.",
    "key": "A random key is no number: draw some with it, `jax.random.normal(key, shape)`.",
    "other": "Give a number, or an array of numbers such as `numpy.asarray(value, float)`.",
}
"""What to do about a value, by its kind."""

_DTYPES: dict[Any, str | None] = {  # a time difference is an integer to NumPy: its row comes first
    jnp.bool_: "boolean",
    np.character: "text",
    np.datetime64: "time",
    np.timedelta64: "time",
    jnp.complexfloating: "complex",
    jax.dtypes.prng_key: "key",
    jnp.floating: None,
    jnp.integer: None,
}

# looked at before numbers are, since a boolean is an integer to Python
_TYPES: dict[tuple[type, ...], str] = {
    (bool,): "boolean",
    (str, bytes): "text",
    (datetime.date, datetime.time, datetime.timedelta): "time",
    (complex,): "complex",
    (type(None),): "none",
}

_short = reprlib.Repr()
_short.maxstring = _short.maxother = _short.maxlong = 80


def concrete(x: Any) -> np.ndarray | None:
    """The value as a NumPy array; None where it is traced, or other processes hold a part of it."""
    return np.asarray(x) if _is_here(x) else None


def _is_here(x: Any) -> bool:
    """Whether this process can look at a value, whatever other processes do."""
    return not isinstance(x, Tracer) and getattr(x, "is_fully_addressable", True)


def words(value: Any) -> str:
    """A value as an error shows it: on one line, an array by its type and shape."""
    dtype = getattr(value, "dtype", None)
    shape = getattr(value, "shape", None)
    # a known scalar by its value; a traced one has none
    if dtype is not None and isinstance(shape, tuple) and (shape or isinstance(value, Tracer)):
        return f"an array of {dtype} of shape {shape}"
    try:
        return " ".join(_short.repr(value).split())
    except Exception:  # a class may raise anything, an integer of thousands of digits does
        return object.__repr__(value)


def as_float(x: Any, name: str) -> jax.Array:
    """An array of the default float type; `ValueError` for what holds no real numbers."""
    return _converted(_real(x, name), jnp.result_type(float), name)


def floating(x: Any, name: str) -> jax.Array:
    """An array that keeps single and double precision; others become the default float type."""
    x = _real(x, name)
    # whose type depends on JAX's settings
    known_double = not isinstance(x, jax.Array) and x.itemsize > 4
    keeps = jnp.issubdtype(x.dtype, jnp.floating) and x.dtype.itemsize >= 4 and not known_double
    return jnp.asarray(x) if keeps else _converted(x, jnp.result_type(float), name)


def known(x: Any, name: str) -> np.ndarray | None:
    """The value in double precision as the user gave it, or None where it is traced.

    A constant is known inside a traced function too, but no more once it is a JAX array there: what
    a value decides is decided by this, so that it does not depend on where an object is built.
    """
    x = _real(x, name)
    return np.asarray(x, float) if _is_here(x) else None


def known_float(x: Any, name: str) -> np.ndarray:
    """A NumPy array of double precision, for what is prepared outside traced programs."""
    x = _real(x, name)
    require(
        _is_here(x),
        f"`{name}` must be known before tracing; got {words(x)}. Call this outside `jax.jit` and "
        "`jax.vmap`, with a value of which each process holds all.",
    )
    return np.asarray(x, float)


def exact_float(x: Any, name: str) -> jax.Array | np.ndarray:
    """A NumPy array of double precision where the value is known, whatever the default; a traced
    one as it is.

    For what must be subtracted before it is rounded, such as times.
    """
    x = _real(x, name)
    return np.asarray(x, float) if _is_here(x) else jnp.asarray(x, float)


def _real(x: Any, name: str) -> jax.Array | np.ndarray:
    """x as an array of a real type, its own where it has one."""
    kind = _kind(x)
    if kind is not None:
        _refuse(x, name, kind)
    try:
        # NumPy cannot hold a traced number, so that a list with one becomes a traced array
        if any(isinstance(leaf, Tracer) for leaf in _leaves(x)):
            return x if isinstance(x, Tracer) else jnp.asarray(x, float)
        if isinstance(x, jax.Array):
            return x
        array = np.asarray(x)
        # of numbers that NumPy has no type for, such as fractions and integers of 100 digits
        return array.astype(float) if array.dtype == object else array
    except OverflowError as e:
        raise ValueError(
            f"`{name}` must be a number; got {words(x)}, which is too large for one."
        ) from e
    except (TypeError, ValueError) as e:
        _refuse(x, name, "ragged", e)


def _refuse(x: Any, name: str, kind: str, cause: Exception | None = None) -> NoReturn:
    raise ValueError(
        f"`{name}` must be a number or an array of numbers; got {words(x)}. {_CURES[kind]}"
    ) from cause


def _leaves(x: Any):
    if isinstance(x, (list, tuple)):
        for item in x:
            yield from _leaves(item)
    else:
        yield x


def _kind(x: Any) -> str | None:
    """What x is, if no real number and no array of them: a key of `_CURES`."""
    # entries one by one: an array of them would have one type, and [1, True] be two numbers
    if isinstance(x, (list, tuple)):
        return next((kind for kind in map(_kind, x) if kind is not None), None)
    for types, kind in _TYPES.items():
        if isinstance(x, types):
            return kind
    if isinstance(x, (int, float)):
        return None
    if isinstance(x, np.ma.MaskedArray) and np.ma.is_masked(x):
        return "masked"
    if not isinstance(x, (jax.Array, np.ndarray, np.generic)):
        try:
            x = np.asarray(x)
        except Exception:  # what a foreign `__array__` raises
            return "other"
    if x.dtype == object:
        return _kind(x.tolist()) if x.ndim else "other"
    return next(
        (kind for dtype, kind in _DTYPES.items() if jnp.issubdtype(x.dtype, dtype)), "other"
    )


def _converted(x: jax.Array | np.ndarray, dtype: Any, name: str) -> jax.Array:
    """x in another precision; `ValueError` for a finite number that would become infinite."""
    # a JAX array may be traced, and has a float type; what NumPy holds is looked at
    if isinstance(x, jax.Array):
        return jnp.asarray(x, dtype)
    with np.errstate(over="ignore"):
        converted = x.astype(dtype)
    lost = np.isinf(converted) & np.isfinite(x)
    if np.any(lost):
        raise ValueError(
            f"`{name}` must fit into {dtype}; got {x[lost][0]!s}, which would be infinite. "
            'Choose other units, or double precision: `jax.config.update("jax_enable_x64", True)`.'
        )
    with jax.ensure_compile_time_eval():  # what is known stays known while a program is traced
        return jnp.asarray(converted)


def require(ok: Any, message: str) -> None:
    """`ValueError(message)` unless `ok`; a traced condition passes."""
    if not isinstance(ok, Tracer) and not bool(ok):
        raise ValueError(message)


def positive_integer(value: Any, name: str, least: int = 1) -> int:
    """A static size of at least `least`; any integer type will do, and no boolean."""
    kind = "a positive integer" if least == 1 else f"an integer, at least {least}"
    message = f"`{name}` must be {kind}; got {words(value)}. It is known before tracing."
    require(not isinstance(value, bool), message)
    # not `int`, which takes 2.7 for 2, and text for a number
    try:
        size = operator.index(value)
    except TypeError as e:
        raise ValueError(message) from e
    require(size >= least, message)
    require(size < 2**31, f"`{name}` must be below 2³¹; got {words(value)}.")
    return size


def positive_integers(values: Any, name: str, count: int, whose: str) -> tuple[int, ...]:
    """Static sizes, one for each of `count` things."""
    numbers = known_float(values, name)
    good = numbers.shape == (count,)
    good = good and bool(
        np.all((numbers == np.round(numbers)) & (numbers >= 1) & (numbers < 2**31))
    )
    require(
        good,
        f"`{name}` must be positive integers, one for each of {count} {whose}; got "
        f"{words(values)}.",
    )
    return tuple(int(number) for number in numbers)


def flag(value: Any, name: str) -> bool:
    """True or False, and nothing that merely counts as such to Python: the text "False"."""
    require(
        isinstance(value, (bool, np.bool_)),
        f"`{name}` must be True or False; got {words(value)}. It is known before tracing.",
    )
    return bool(value)


def known_number(
    value: Any,
    name: str,
    rule: str = "a finite number",
    ok: Callable[[float], bool] = math.isfinite,
) -> float:
    """A finite setting, known before tracing, that meets a rule in the precision in use."""
    number = known_float(value, name)
    # 1e-50 is positive, and 0 in single precision
    with np.errstate(over="ignore", under="ignore"):
        rounded = number.astype(jnp.result_type(float))
    require(
        number.ndim == 0 and np.isfinite(rounded) and ok(float(rounded)),
        f"`{name}` must be {rule}; got {words(value)}.",
    )
    return float(number)


def choice(value: Any, name: str, options: Iterable[str], cure: str = "") -> str:
    """One of a few names."""
    options = list(options)
    known = ", ".join(map(repr, options))
    require(
        isinstance(value, str) and value in options,
        f"`{name}` must be one of {known}; got {words(value)}. {cure}".rstrip(),
    )
    return value


def as_path(value: Any, name: str) -> Path:
    """A path; a number would be an open file, and an empty text the working directory."""
    require(
        isinstance(value, (str, PathLike)) and isinstance(fspath(value), str) and value != "",
        f"`{name}` must be a path, text or a `pathlib.Path`; got {words(value)}.",
    )
    return Path(value)


def require_key(key: Any, name: str = "key", several: bool = False) -> None:
    """One random key, typed or raw (`jax.random.PRNGKey(0)`), or `several` in one array."""
    message = f"`{name}` must be a random key, such as `jax.random.key(0)`; got {words(key)}."
    require(isinstance(key, (jax.Array, np.ndarray)), message)
    typed = jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    if not typed:
        # how many words a raw key has depends on the generator that JAX is set to
        raw = jax.eval_shape(jax.random.PRNGKey, 0)
        require(key.dtype == raw.dtype and key.shape[-1:] == raw.shape, message)
    # a raw key has an axis of words, which does not count
    require(
        key.ndim - (not typed) in ((0, 1) if several else (0,)),
        f"`{name}` must be one random key; got {words(key)}, several. Use vmap over them, or one "
        "of them, `keys[0]`.",
    )


def require_mapping(value: Any, name: str) -> None:
    """Something by name; `None` is nothing."""
    good = value is None or (
        isinstance(value, Mapping) and all(isinstance(key, str) for key in value)
    )
    require(good, f"`{name}` must be a dictionary by name, or None; got {words(value)}.")


def require_instance(value: Any, kind: type | tuple[type, ...], name: str, cure: str) -> None:
    """The value is of a class, whose name says what is meant."""
    if not isinstance(value, kind):  # words of a large object take longer than the check
        raise ValueError(f"`{name}` must be {cure}; got {words(value)}.")


def require_finite(x: jax.Array | np.ndarray, name: str, cure: str = "") -> None:
    """Every entry is finite, where that can be known."""
    value = concrete(x)
    if value is not None and not np.all(np.isfinite(value)):
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(value))[0])
        raise ValueError(
            f"`{name}` must be finite; entry {where} is {value[where]}. {cure}".rstrip()
        )


def require_positive(x: jax.Array, name: str, cure: str = "") -> None:
    """Every entry is positive and finite, where that can be known."""
    value = concrete(x)
    if value is not None and not (np.all(value > 0) and np.all(np.isfinite(value))):
        got = np.array2string(value, threshold=8)
        raise ValueError(f"`{name}` must be positive and finite; got {got}. {cure}".rstrip())
