"""Time grids.

A grid holds its start t0 and the times that have *elapsed* since: at a large t0, days or seconds
since 1970, single precision has no digits left for the steps. What is known is prepared in double
precision, whatever the default.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._checks import concrete, exact_float, positive_integer, require, require_finite
from .._types import RealScalar, State
from ._base import AbstractSDE

_PRECISION = 'or use double precision: `jax.config.update("jax_enable_x64", True)`.'


class TimeGrid(eqx.Module):
    """The times t0 + `elapsed` `(K + 1,)`, elapsed[0] being 0. As an array it is its times."""

    t0: Any
    """A NumPy number of double precision where it is known."""
    elapsed: Float[Array, " K+1"]

    @property
    def num_steps(self) -> int:
        """K."""
        return self.elapsed.shape[-1] - 1

    @property
    def ts(self) -> Array | np.ndarray:
        """The times, a NumPy array in double precision where the default would lose digits."""
        begin = concrete(self.t0)
        elapsed = concrete(self.elapsed)
        # An axis more behind a batch of starts, as of a grid that was made under `vmap`.
        if begin is None or elapsed is None:
            begin = jnp.asarray(self.t0, self.elapsed.dtype)
            return begin[..., None] + self.elapsed
        ts = begin[..., None] + elapsed.astype(float)
        fits = np.array_equal(ts.astype(self.elapsed.dtype), ts) or elapsed.dtype == ts.dtype
        return jnp.asarray(ts) if fits else ts

    def since(self, t: RealScalar) -> Float[Array, ""]:
        """The time elapsed at t, without losing digits where both are known."""
        dtype = self.elapsed.dtype
        begin = concrete(self.t0)
        time = exact_float(t, "t")
        if begin is not None and isinstance(time, np.ndarray):
            return jnp.asarray(time - begin, dtype)  # subtracted in double precision, then rounded
        return jnp.asarray(time, dtype) - jnp.asarray(self.t0, dtype)

    def clock(self, sde: AbstractSDE, x: State) -> Float[Array, ""]:
        """What is added to the elapsed time that an SDE is shown: t0, or 0 if it does not ask.

        `ValueError` if its steps then vanish in the precision used.
        """
        dtype = self.elapsed.dtype
        begin = concrete(self.t0)
        elapsed = concrete(self.elapsed)
        # Most SDEs do not depend on the time: they keep the digits of their steps at any t0.
        if begin is not None and np.all(begin == 0) or sde.is_autonomous(x):
            return jnp.zeros((), dtype)
        if begin is not None and elapsed is not None:
            shown = begin.astype(dtype) + elapsed
            require(
                np.all(np.diff(shown) > 0),
                "`t0` must leave the steps their digits, since this SDE depends on the time: from "
                f"t0 = {begin} on, times in {dtype} are {np.spacing(np.abs(shown).max())} apart, "
                f"and the shortest step has length {np.diff(elapsed).min()}. Give its times from "
                f"the start on, {_PRECISION}",
            )
        return jnp.asarray(self.t0, dtype)

    def __array__(self, dtype=None, copy=None):
        return np.asarray(self.ts, dtype)


def time_grid(
    t0: RealScalar | None,
    t1: RealScalar | None,
    num_steps: int | None,
    ts,
    *,
    graded: bool = False,
) -> TimeGrid:
    """The user's grid, checked, or the default: uniform, or graded towards t1, t = s(2 − s/T)."""
    if ts is not None:
        require(
            num_steps is None, f"Give `num_steps` or `ts`, not both; got num_steps = {num_steps}."
        )
        return given_grid(ts, t0, t1)
    if t1 is None or num_steps is None:
        raise ValueError(
            f"Give `t1` and `num_steps`, or a grid `ts`; got t1 = {t1}, num_steps = {num_steps}."
        )
    num_steps = positive_integer(num_steps, "num_steps")
    begin = exact_float(0.0 if t0 is None else t0, "t0")
    end = exact_float(t1, "t1")
    require(
        begin.ndim == 0 and end.ndim == 0,
        f"`t0` and `t1` must be one time each; got shapes {begin.shape} and {end.shape}. Use vmap "
        "for a batch.",
    )
    require(
        jnp.isfinite(begin) & jnp.isfinite(end) & (end > begin),
        f"`t1` must be finite and later than `t0`; got t0 = {begin}, t1 = {end}.",
    )
    # Of unit duration. Graded, steps shrink like the root of the time left: they are short where
    # the pull to an exact end, which grows like one over it, is strong.
    s = np.linspace(0.0, 1.0, num_steps + 1)
    s = s * (2 - s) if graded else s
    if isinstance(begin, np.ndarray) and isinstance(end, np.ndarray):
        return _grid(begin, (end - begin) * s, "`num_steps`")
    # Of a duration that is traced the shape of the grid is known still.
    _require_steps(s, "`num_steps`")
    duration = jnp.asarray(end, float) - jnp.asarray(begin, float)
    return TimeGrid(begin, duration * jnp.asarray(s, float))


def given_grid(ts, t0: RealScalar | None = None, t1: RealScalar | None = None) -> TimeGrid:
    """The user's grid; t0 and t1, where they are given beside it, are its ends."""
    if isinstance(ts, TimeGrid):
        return ts
    ts = exact_float(ts, "ts")
    require(
        ts.ndim == 1 and ts.shape[0] >= 2,
        f"`ts` must be a vector of at least two times; got shape {ts.shape}.",
    )
    known = isinstance(ts, np.ndarray)
    if known:
        require_finite(ts, "ts")
        require(
            np.all(np.diff(ts) > 0),
            f"`ts` must increase strictly; a step has length {np.diff(ts).min()}. Sort it and "
            "remove repeated times.",
        )
    for name, given, place, verb in (("t1", t1, -1, "end"), ("t0", t0, 0, "begin")):
        if given is None:
            continue
        given = exact_float(given, name)
        comparable = known and isinstance(given, np.ndarray)
        # To single precision, in which a grid may have been made.
        require(
            not comparable
            or given.ndim == 0
            and np.abs(ts[place] - given) <= 1e-5 * (ts[-1] - ts[0]),
            f"`ts` must {verb} at `{name}`; got ts[{place}] = {ts[place]} and {name} = {given}. "
            "Give only `ts`.",
        )
    return _grid(np.asarray(ts[0]) if known else ts[0], ts - ts[0], "`ts`")


def _grid(begin, elapsed, name: str) -> TimeGrid:
    """In the default precision, if its steps fit into it."""
    if isinstance(elapsed, np.ndarray):
        _require_steps(elapsed, name)
    return TimeGrid(begin, jnp.asarray(elapsed, float))


def _require_steps(elapsed: np.ndarray, name: str) -> None:
    rounded = elapsed.astype(jnp.result_type(float))
    require(
        np.all(np.diff(rounded) > 0),
        f"{name} must leave steps that can be told apart: at the end, times in {rounded.dtype} "
        f"are {np.spacing(rounded[-1])} apart, and the shortest step has length "
        f"{np.diff(elapsed).min()}. Take fewer steps, or longer ones, {_PRECISION}",
    )
