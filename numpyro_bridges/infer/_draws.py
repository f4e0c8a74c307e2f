"""The draws of a run, and what a model says at them."""

import jax.numpy as jnp
import numpy as np
import numpyro
from numpyro.distributions import ExpandedDistribution, Independent, MaskedDistribution
from numpyro.infer import MCMC

from .. import weights
from .._checks import require, require_instance
from ..distributions import AbstractNoiseDriven


def model_of(mcmc):
    """The model of a run, and a function that replays it.

    `replay(value_of, names)`: the laws and values of these sites where every site has the value
    that `value_of(site)` gives it.
    """
    require_instance(mcmc, MCMC, "mcmc", "an `MCMC` of NumPyro")
    model = getattr(mcmc.sampler, "model", None)
    require(
        callable(model),
        "`mcmc` must run a NumPyro model: one with a `potential_fn` of its own has no sites.",
    )

    def replay(value_of, names):
        at_values = numpyro.handlers.substitute(
            numpyro.handlers.seed(model, 0), substitute_fn=value_of
        )
        trace = numpyro.handlers.trace(at_values).get_trace(*mcmc._args, **mcmc._kwargs)
        return {name: (trace[name]["fn"], trace[name]["value"]) for name in names}

    return model, replay


def with_noise(mcmc):
    """Indices of the draws whose noise is there, and the values of those draws."""
    samples = mcmc.get_samples(group_by_chain=True)
    draws = np.arange(next(iter(samples.values())).shape[1])
    noise = mcmc.get_extra_fields(group_by_chain=True).get("noise")
    every = getattr(mcmc, "_keep_noise", None)
    if not isinstance(noise, dict) or not every or every > len(draws):
        return draws, samples
    draws = draws[every - 1 :: every]
    return draws, {name: value[:, draws] for name, value in samples.items()} | noise


def spaced(number: int, wanted: int):
    """`wanted` of a number of places, evenly spaced; at most all."""
    return np.linspace(0, number - 1, min(wanted, number)).astype(int)


def is_datum(site) -> bool:
    return bool(site.get("is_observed")) and not site["infer"].get("is_auxiliary")


def mask_of(law):
    """Which data count, booleans with the axes of the batch in front, or `None` where no mask is.

    Axes that `to_event` has made part of a datum follow those of the batch.
    """
    if isinstance(law, AbstractNoiseDriven):
        return law._mask
    if not isinstance(law, (ExpandedDistribution, Independent, MaskedDistribution)):
        return None
    inner = mask_of(law.base_dist)
    if isinstance(law, Independent):
        return inner
    own = jnp.asarray(law._mask if isinstance(law, MaskedDistribution) else True)
    if inner is None and isinstance(law, ExpandedDistribution):
        return None
    inner = jnp.ones((), bool) if inner is None else inner
    inside = inner.shape[len(law.base_dist.batch_shape) :]
    own = own.reshape(own.shape + (1,) * len(inside))
    return jnp.broadcast_to(inner & own, law.batch_shape + inside)


def surely_heavy(k, num_particles):
    """Whether k̂ is above the threshold by two standard errors: of many data one is above it by
    chance."""
    k = np.clip(k, 0.0, 2.0)
    # (1 + k)/√M is the standard error of a shape from the M largest weights, here about 3 √S of S
    error = (1 + k) / np.sqrt(3 * np.sqrt(num_particles))
    return k - 2 * error >= weights.pareto_k_threshold(num_particles)
