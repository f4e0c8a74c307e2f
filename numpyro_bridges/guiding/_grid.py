"""Time grids."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._checks import as_float, concrete, positive_integer, require, require_finite
from .._types import RealScalar


def time_grid(
    t0: RealScalar, t1: RealScalar | None, num_steps: int | None, ts, *, graded: bool
) -> Float[Array, " K+1"]:
    """The user's grid, checked, or the default one: uniform, or graded towards t1 as t = s(2 − s/T)."""
    if ts is not None:
        require(num_steps is None, f"Give `num_steps` or `ts`, not both; got num_steps = {num_steps}.")
        ts = as_float(ts, "ts")
        require(
            ts.ndim == 1 and ts.shape[0] >= 2, f"`ts` must be a vector of at least two times; got shape {ts.shape}."
        )
        require_finite(ts, "ts")
        require(
            jnp.all(jnp.diff(ts) > 0),
            f"`ts` must increase strictly; a step has length {concrete(jnp.min(jnp.diff(ts)))}. Sort it and remove "
            "repeated times.",
        )
        require(
            t1 is None or jnp.abs(ts[-1] - t1) <= 1e-5 * jnp.abs(ts[-1] - ts[0]),
            f"`ts` must end at `t1`; got ts[-1] = {ts[-1]} and t1 = {t1}. Give only `ts`.",
        )
        begin = concrete(t0)  # 0, the default, says nothing
        require(
            begin is None or np.all(begin == 0) or jnp.abs(ts[0] - t0) <= 1e-5 * jnp.abs(ts[-1] - ts[0]),
            f"`ts` must begin at `t0`; got ts[0] = {ts[0]} and t0 = {t0}. Give only `ts`.",
        )
        return ts
    if t1 is None or num_steps is None:
        raise ValueError(f"Give `t1` and `num_steps`, or a grid `ts`; got t1 = {t1}, num_steps = {num_steps}.")
    num_steps = positive_integer(num_steps, "num_steps")
    t0, t1 = as_float(t0, "t0"), as_float(t1, "t1")
    require(
        t0.ndim == 0 and t1.ndim == 0,
        f"`t0` and `t1` must be one time each; got shapes {t0.shape} and {t1.shape}. Use vmap for a batch.",
    )
    require(
        jnp.isfinite(t0) & jnp.isfinite(t1) & (t1 > t0),
        f"`t1` must be finite and later than `t0`; got t0 = {t0}, t1 = {t1}.",
    )
    s = jnp.linspace(0.0, 1.0, num_steps + 1)
    return t0 + (t1 - t0) * (s * (2 - s) if graded else s)
