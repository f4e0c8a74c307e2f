"""Checks of what a user passes: the argument in backticks, the rule, the value got, the cure."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer


def concrete(x: Any) -> np.ndarray | None:
    """The value as a NumPy array, or None while a program is traced."""
    return None if isinstance(x, Tracer) else np.asarray(x)


def as_float(x: Any, name: str) -> jax.Array:
    """An array of the default float type; `ValueError` for what is no number."""
    try:
        return jnp.asarray(x, float)
    except (TypeError, ValueError) as e:
        raise ValueError(f"`{name}` must be a number or an array of numbers; got {x!r}.") from e


def floating(x: Any, name: str) -> jax.Array:
    """An array that keeps its precision; whole numbers become the default float type."""
    keeps = jnp.issubdtype(getattr(x, "dtype", int), jnp.floating)
    return jnp.asarray(x) if keeps else as_float(x, name)


def require(ok: Any, message: str) -> None:
    """`ValueError(message)` unless `ok`; a traced condition passes."""
    if not isinstance(ok, Tracer) and not bool(ok):
        raise ValueError(message)


def positive_integer(value: Any, name: str) -> int:
    """A static size."""
    good = isinstance(value, (int, np.integer)) and not isinstance(value, bool) and value >= 1
    require(good, f"`{name}` must be a positive integer; got {value!r}. It is known before tracing.")
    return int(value)


def require_instance(value: Any, kind: type, name: str, cure: str) -> None:
    """The value is of a class, whose name says what is meant."""
    require(isinstance(value, kind), f"`{name}` must be {cure}; got {value!r}.")


def require_finite(x: jax.Array, name: str, cure: str = "") -> None:
    """Every entry is finite, where that can be known."""
    value = concrete(x)
    if value is not None and not np.all(np.isfinite(value)):
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(value))[0])
        raise ValueError(f"`{name}` must be finite; entry {where} is {value[where]}. {cure}".rstrip())


def require_positive(x: jax.Array, name: str, cure: str = "") -> None:
    """Every entry is positive and finite, where that can be known."""
    value = concrete(x)
    if value is not None and not (np.all(value > 0) and np.all(np.isfinite(value))):
        raise ValueError(
            f"`{name}` must be positive and finite; got {np.array2string(value, threshold=8)}. {cure}".rstrip()
        )
