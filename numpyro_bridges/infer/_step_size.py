"""Step sizes that adapt to a target acceptance by NumPyro's dual averaging, within bounds."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array
from numpyro.infer.hmc_util import dual_averaging

from ._rotation import choose

_start, _update = dual_averaging()


class StepSize(NamedTuple):
    """The step in use, and the state of its averaging."""

    value: Array
    averaging: tuple


def start_step_size(value: Array) -> StepSize:
    log_value: Any = jnp.log(value)
    return StepSize(value, _start(log_value))


def update_step_size(step: StepSize, shortfall, bounds, *, renew, last) -> StepSize:
    """After a draw `shortfall` below target. `renew`: anew from the mean; `last`: stays there."""
    # `averaging` has the log of the last step first, and then that of their weighted mean
    averaging = _update(shortfall, step.averaging)
    log_value, log_mean = averaging[:2]
    mean = jnp.clip(jnp.exp(log_mean), *bounds)
    value = jnp.where(renew | last, mean, jnp.clip(jnp.exp(log_value), *bounds))
    # where the reference was renewed, steps are in other units: the past is forgotten
    again = start_step_size(mean)
    return choose(renew, again, StepSize(value, averaging))
