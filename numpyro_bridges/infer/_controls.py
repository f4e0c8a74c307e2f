"""Whether the controls of flows tell enough of their noise, at the draws of a posterior."""

import warnings

import numpy as np
from jax import Array

from ..distributions import AbstractNoiseDriven
from ..sdes import ControlNoise, KunitaFlow

_SEEN = 0.01
"""Part of a(x, x) that is missing, from which on `KunitaFlow.noise_error` warns too."""


def has_controls(law) -> bool:
    """Of a law of one flow, driven by the noise of controls, that starts at one shape."""
    flow = law.parts.get("sde") if isinstance(law, AbstractNoiseDriven) else None
    if not isinstance(flow, KunitaFlow) or not isinstance(flow.noise_field, ControlNoise):
        return False
    return flow.covariance_kernel.variance.ndim == 0 and law.parts["x0"].ndim == 2


def missing_variance(law) -> Array:
    """The part of a(x, x) that the controls do not tell of the worst landmark of the start."""
    return law.parts["sde"].noise_error(law.parts["x0"])["missing"]


def warn_of_missing(name: str, missing: np.ndarray, law) -> None:
    """`missing`, of each draw."""
    share = np.mean(missing > _SEEN)
    if share > 0:
        num_controls = law.parts["sde"].noise_size(law.parts["x0"])
        warnings.warn(
            f"the flow of `{name}` needs more controls than its {num_controls}: at "
            f"{100 * share:.2g} % of the draws "
            "they miss more than 1 % of a(x, x) at a landmark of the start, "
            f"{100 * np.max(missing):.2g} % at most, "
            "since the length scale is short there. Give `ControlNoise(num_points)` more of them; "
            "`ControlNoise.within(tolerance, x, kernel)`, at the shortest length scale, finds how "
            "many.",
            stacklevel=4,
        )
