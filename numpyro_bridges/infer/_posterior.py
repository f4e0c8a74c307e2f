"""The posterior of a model, split as the kernels need it.

With θ the unconstrained parameters, z the driving noise and v_s the data that it drives,

    -log p(θ, z | v) = Φ(θ, z) + ½ |z|² + const,    Φ = rest(θ) - Σ_s log p(v_s | θ, z_s),

`rest` holding priors of parameters, Jacobians, factors and data that no noise drives.
"""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpyro
import numpyro.distributions as dist
from jax import Array
from numpyro.distributions import constraints
from numpyro.infer import init_to_median, init_to_sample
from numpyro.infer.util import potential_energy
from numpyro.primitives import Messenger

from .._checks import require_instance
from ..distributions import AbstractNoiseDriven

Sites = dict[str, Array]


def init_to_guided_mean(site=None, num_samples: int = 15):
    """Initial values: noise at zero, which gives the noise-free guided path; parameters at their prior medians."""
    if site is not None and is_noise(site):
        return jnp.zeros(site["fn"].shape())
    return init_to_median(site, num_samples)


def sites_of(model, model_args, model_kwargs, key=0, strategy=init_to_sample) -> dict:
    """Sample and deterministic sites of a model at its data, with values by an initialisation strategy."""
    model = numpyro.handlers.substitute(numpyro.handlers.seed(model, key), substitute_fn=strategy)
    trace = numpyro.handlers.trace(model).get_trace(*model_args, **model_kwargs)
    return {name: site for name, site in trace.items() if site["type"] in ("sample", "deterministic")}


def is_latent(site) -> bool:
    return site["type"] == "sample" and not site["is_observed"]


def is_noise(site) -> bool:
    return site["type"] == "sample" and bool(site["infer"].get("driving_noise"))


def noise_sites(trace) -> tuple[str, ...]:
    """Names of the driving noise in a trace: the block of `PCN` in `Gibbs([(PCN(model), noise_sites), ...])`."""
    require_instance(trace, Mapping, "trace", "sites by name, of `numpyro.handlers.trace(model).get_trace(...)`")
    return tuple(name for name, site in trace.items() if is_noise(site) and not site["is_observed"])


class _Nothing(dist.ImproperUniform):
    """Has log density 0, and does not look at the value."""

    def log_prob(self, value):
        return jnp.zeros(self.batch_shape)


class _Split(Messenger):
    """Takes the prior of the noise, and the likelihoods that it drives, out of a model; keeps the latter.

    What `handlers.scale` makes of the noise's prior, beyond the prior itself, stays in.
    """

    def __init__(self, fn):
        super().__init__(fn)
        self.log_likelihood = {}

    def process_message(self, msg):
        if msg["type"] != "sample":
            return
        fn, log_prob = msg["fn"], None
        if msg["is_observed"] and isinstance(fn, AbstractNoiseDriven):
            log_prob = fn.log_prob(msg["value"])
            if msg.get("_control_flow_done"):  # in a scan a noise may reach later data: one energy for all
                log_prob = jnp.sum(log_prob)
            self.log_likelihood[msg["name"]] = log_prob if msg["scale"] is None else msg["scale"] * log_prob
        if is_noise(msg) and msg["scale"] is not None:
            msg["scale"] = msg["scale"] - 1
        elif is_noise(msg) or log_prob is not None:
            msg["fn"] = _Nothing(constraints.real, fn.batch_shape, fn.event_shape)


def split(model, model_args, model_kwargs, z: Sites) -> tuple[Array, Sites]:
    """rest(θ), and log p(v_s | θ, z_s) of every site that noise drives, shaped as its batch."""
    parts = _Split(numpyro.handlers.seed(model, 0))
    rest = jnp.asarray(potential_energy(parts, model_args, model_kwargs, z))
    return rest, parts.log_likelihood


def misfit(model, model_args, model_kwargs, z: Sites) -> Array:
    """Φ(θ, z)."""
    rest, log_likelihood = split(model, model_args, model_kwargs, z)
    return rest - sum(map(jnp.sum, log_likelihood.values()))


def energies_of(model, model_args, model_kwargs, z: Sites, owners) -> tuple[Array, tuple[Array, ...]]:
    """`rest`, and energies -log p(v_s | θ, z_s), an array for each noise; 0 and Φ where `owners` is `None`."""
    if owners is None:
        phi = misfit(model, model_args, model_kwargs, z)
        return jnp.zeros_like(phi), (phi,)
    rest, log_likelihood = split(model, model_args, model_kwargs, z)
    return rest, tuple(-log_likelihood[owners[noise]] for noise in sorted(owners))


def driven_by(model, model_args, model_kwargs, z: Sites, noise=None) -> dict[str, str] | None:
    """The site that each noise drives, if it drives one of the same batch and nothing else; `None` otherwise.

    Where this holds, the data are independent given θ, each with its own noise. `noise`: names, of all of z by default.
    """
    noise = set(z if noise is None else noise)
    closed, shapes = jax.make_jaxpr(lambda z: split(model, model_args, model_kwargs, z), return_shape=True)(z)
    names = sorted(z)  # the order of the inputs
    rest, *terms = [{names[i] for i in _inputs_of(closed.jaxpr, out)} & noise for out in closed.jaxpr.outvars]
    driven = {}
    for (site, shape), sources in zip(sorted(shapes[1].items()), terms, strict=True):
        if len(sources) != 1 or not sources.isdisjoint(driven) or shape.shape != z[min(sources)].shape[: shape.ndim]:
            return None
        driven[min(sources)] = site
    return driven if set(driven) == noise and not rest else None


def groups_of(noise, owners) -> list[tuple[str, ...]]:
    """Names of the noise of each energy."""
    return [tuple(sorted(noise))] if owners is None else [(name,) for name in sorted(noise)]


def _inputs_of(jaxpr, out) -> set[int]:
    """Indices of the inputs on which an output depends, each equation taken as a whole."""
    needed = {out}
    for equation in reversed(jaxpr.eqns):
        if any(variable in needed for variable in equation.outvars):
            needed.update(variable for variable in equation.invars if not hasattr(variable, "val"))
    return {i for i, variable in enumerate(jaxpr.invars) if variable in needed}
