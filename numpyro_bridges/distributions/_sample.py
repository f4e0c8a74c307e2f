"""Sites with driving noise: a primitive, and a reparametrisation handler that does the same for `numpyro.sample`."""

import numpy as np
import numpyro
from numpyro.infer.reparam import Reparam

from .._checks import require
from ._noise_driven import AbstractNoiseDriven


def sample(name: str, law: AbstractNoiseDriven, obs=None, *, infer: dict | None = None):
    """`numpyro.sample` for a law that is driven by noise: a site for the noise, then the site of the observation.

        noise = numpyro.sample(f"{name}_noise", law.noise_prior(), infer={"driving_noise": True})
        value = numpyro.sample(name, law.given(noise), obs=obs)

    Inside plates every datum has its own noise. Unobserved, the site simulates. The noise in posterior draws belongs to
    the data that were seen: leave it out of what `Predictive` is given where the number of data changes.
    `handlers.scale` multiplies both log densities, as minibatches of a plate need; it does not temper the likelihood,
    since the integral of a power is no power of the integral.

    **Arguments:** `law`: a `DiffusionEndpoint`. `obs`: what was seen, shaped as the law, plates in front. `infer`: for
    the observed site.

    **Returns:** the observation.
    """
    law = _with_noise(name, law, obs)
    return numpyro.sample(name, law, obs=obs, infer=infer)


class NoiseReparam(Reparam):
    """Lets plain `numpyro.sample(name, law, obs=...)` do what `numpyro_bridges.sample` does.

    model = numpyro.handlers.reparam(model, config={"wing": NoiseReparam()})
    """

    def __call__(self, name, fn, obs):
        return _with_noise(name, fn, obs), obs


def _with_noise(name, law, obs):
    require(
        isinstance(law, AbstractNoiseDriven),
        f"site `{name}`: the law must be driven by noise, such as `DiffusionEndpoint`; got {type(law).__name__}. "
        "Wrap a law by its own methods, `law.expand`, `law.mask` and `law.to_event`, which keep the noise.",
    )
    noise = numpyro.sample(f"{name}_noise", law.noise_prior(), infer={"driving_noise": True})
    law = law.given(noise)
    seen = law.shape() if obs is None else np.shape(obs)
    require(
        seen == law.shape(),
        f"site `{name}`: `obs` must have shape {law.shape()}, plates in front; got {seen}. Several data need a plate.",
    )
    return law
