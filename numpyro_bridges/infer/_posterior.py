"""The posterior of a model, split as the kernels need it.

With θ the unconstrained parameters, z the driving noise and v_s the data that it drives,

    -log p(θ, z | v) = Φ(θ, z) + ½ |z|² + const,    Φ = rest(θ) - Σ_s log p(v_s | θ, z_s),

`rest` holding priors of parameters, Jacobians, factors and data that no noise drives.
"""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jax import Array
from numpyro.distributions import constraints
from numpyro.infer import init_to_median, init_to_sample
from numpyro.infer.util import compute_log_probs, constrain_fn, potential_energy
from numpyro.primitives import Messenger

from .._checks import require, require_instance
from ..distributions import AbstractNoiseDriven

Sites = dict[str, Array]


def init_to_guided_mean(site=None, num_samples: int = 15):
    """Initial values: noise at zero, which gives the noise-free guided path; parameters at their
    prior medians.
    """
    if site is not None and is_noise(site):
        return jnp.zeros(site["fn"].shape())
    return init_to_median(site, num_samples)


def sites_of(model, model_args, model_kwargs, key=0, strategy=init_to_sample) -> dict:
    """Sample and deterministic sites of a model at its data, with values by an initialisation
    strategy.
    """
    model = numpyro.handlers.substitute(numpyro.handlers.seed(model, key), substitute_fn=strategy)
    trace = numpyro.handlers.trace(model).get_trace(*model_args, **model_kwargs)
    return {
        name: site for name, site in trace.items() if site["type"] in ("sample", "deterministic")
    }


def is_latent(site) -> bool:
    return site["type"] == "sample" and not site["is_observed"]


def is_noise(site) -> bool:
    return site["type"] == "sample" and bool(site["infer"].get("driving_noise"))


def noise_sites(trace) -> tuple[str, ...]:
    """Names of the driving noise in a trace: the block of `PCN` in `Gibbs([(PCN(model),
    noise_sites), ...])`.
    """
    require_instance(
        trace, Mapping, "trace", "sites by name, of `numpyro.handlers.trace(model).get_trace(...)`"
    )
    return tuple(name for name, site in trace.items() if is_noise(site) and not site["is_observed"])


def _refuse_to_draw(site):
    """For `substitute`: the site of a sample, or of a plate's subset, that nothing has given a
    value.
    """
    if site["value"] is not None or site["type"] not in ("sample", "plate"):
        return
    name = site["name"]
    if site["type"] == "plate":
        size, subsample_size = site["args"]
        raise ValueError(
            f"plate `{name}` draws {subsample_size} of its {size} data at random, and a chain "
            "would see one draw of them for ever: leave out `subsample_size`. Minibatches are for "
            "`SVI`; kernels that correct for them, such as `HMCECS`, cannot hold this one."
        )
    raise ValueError(
        f"site `{name}` would be drawn at random wherever the model is evaluated: it is not among "
        "the sites whose values the kernel has. A model must have the same latent sites at every "
        "call."
    )


class _AsGiven(numpyro.handlers.substitute):
    """A context in which a model that draws at random, beyond the values of its sites, raises
    `ValueError`.

    There is no random key, not even one of a `seed` handler inside or outside. What has no value is
    refused by its name, within control flow too. `numpyro.prng_key()` gives `None`, which does no
    harm to those that ask and do not draw, such as Equinox modules.
    """

    def __init__(self):
        super().__init__(substitute_fn=_refuse_to_draw)
        self._asked = False

    def process_message(self, msg):
        super().process_message(msg)
        if msg["type"] in ("prng_key", "control_flow"):
            fn = msg["fn"]
            msg["fn"] = lambda *args, rng_key=None, **kwargs: fn(*args, rng_key=None, **kwargs)
            self._asked |= msg["type"] == "prng_key"

    def __exit__(self, kind, error, traceback):
        super().__exit__(kind, error, traceback)
        if self._asked and isinstance(error, Exception):
            raise ValueError(
                "the model needs a random key: for `numpyro.prng_key()`, the initial values of a "
                "network, or a site under `handlers.block`. A chain would use one draw for ever. "
                "Draw by `numpyro.sample`, or pass what was drawn as an argument, a network's "
                f"parameters by `handlers.substitute`. Without a key came {kind.__name__}: {error}"
            ) from error


class _Nothing(dist.ImproperUniform):
    """Has log density 0, and does not look at the value."""

    def log_prob(self, value):
        return jnp.zeros(self.batch_shape)


class _Split(Messenger):
    """Takes the prior of the noise, and the likelihoods that it drives, out of a model; keeps the
    latter.

    What `handlers.scale` makes of the noise's prior, beyond the prior itself, stays in.
    """

    def __init__(self, fn, by_block):
        super().__init__(fn)
        self.log_likelihood = {}
        self._by_block = by_block

    def process_message(self, msg):
        if msg["type"] != "sample":
            return
        fn = msg["fn"]
        log_prob = None
        if msg["is_observed"] and isinstance(fn, AbstractNoiseDriven):
            cut = self._by_block and fn.noise_blocks is not None
            log_prob = fn._log_prob_by_block(msg["value"]) if cut else fn.log_prob(msg["value"])
            scale = 1.0 if msg["scale"] is None else msg["scale"]
            log_prob = jnp.asarray(scale)[..., None] * log_prob if cut else scale * log_prob
            # in a scan a noise may reach later data: one energy for all
            if msg.get("_control_flow_done"):
                log_prob = jnp.sum(log_prob)
            self.log_likelihood[msg["name"]] = log_prob
        if is_noise(msg) and msg["scale"] is not None:
            msg["scale"] = msg["scale"] - 1
        elif is_noise(msg) or log_prob is not None:
            msg["fn"] = _Nothing(constraints.real, fn.batch_shape, fn.event_shape)


class _Data(Messenger):
    """Takes the data and the prior of the noise out of a model; keeps the log likelihood of all
    data.
    """

    def __init__(self, fn, latent):
        super().__init__(fn)
        self.log_likelihood = jnp.zeros(())
        # factors that NumPyro adds to the priors
        self._jacobians = {f"_{name}_log_det" for name in latent}

    def process_message(self, msg):
        if msg["type"] != "sample" or msg["name"] in self._jacobians:
            return
        require(
            msg["scale"] is None,
            f"site `{msg['name']}` is scaled, by `handlers.scale` or a plate that is subsampled: "
            "the evidence is that of all data, each counted once.",
        )
        if msg["is_observed"]:
            self.log_likelihood += jnp.sum(msg["fn"].log_prob(msg["value"]))
        if msg["is_observed"] or is_noise(msg):
            msg["fn"] = _Nothing(constraints.real, msg["fn"].batch_shape, msg["fn"].event_shape)


def prior_and_likelihood(model, model_args, model_kwargs, z: Sites) -> tuple[Array, Array]:
    """-log p(θ) of unconstrained parameters, and log p(v | θ, z) of all data."""
    parts = _Data(model, z)
    with _AsGiven():
        prior = jnp.asarray(potential_energy(parts, model_args, model_kwargs, z))
    return prior, parts.log_likelihood


def split(model, model_args, model_kwargs, z: Sites, by_block: bool = False) -> tuple[Array, Sites]:
    """rest(θ), and log p(v_s | θ, z_s) of every site that noise drives, shaped as its batch.

    `by_block`: where the noise has blocks, with an axis for their terms behind.
    """
    parts = _Split(model, by_block)
    with _AsGiven():
        rest = jnp.asarray(potential_energy(parts, model_args, model_kwargs, z))
    return rest, parts.log_likelihood


def constrained(model, model_args, model_kwargs, z: Sites) -> Sites:
    """Constrained values of latent sites, and the values of deterministic ones."""
    with _AsGiven():
        return constrain_fn(model, model_args, model_kwargs, z, return_deterministic=True)


def supports_that_move(sites, values: Sites) -> list[str]:
    """Of the sites that a function of `values` gives, those whose support depends on the values."""

    def bounds(values):
        leaves = {name: jax.tree.leaves(site["fn"].support) for name, site in sites(values).items()}
        return {name: [x for x in own if isinstance(x, Array)] for name, own in leaves.items()}

    closed, shapes = jax.make_jaxpr(bounds, return_shape=True)(values)
    names = [name for name in sorted(shapes) for _ in shapes[name]]  # the order of the outputs
    outputs = zip(names, closed.jaxpr.outvars, strict=True)
    return sorted({name for name, out in outputs if _inputs_of(closed.jaxpr, out)})


def not_finite(model, model_args, model_kwargs, z: Sites, with_gradient: bool) -> list[str]:
    """What is not finite of the posterior at z, site by site, in words."""

    def log_densities(z):
        with _AsGiven():
            values = constrain_fn(model, model_args, model_kwargs, z)
            return compute_log_probs(model, model_args, model_kwargs, values, sum_log_prob=False)[0]

    def phi(z):
        return misfit(model, model_args, model_kwargs, z)

    # Traced, so that no check of values stands in the way.
    gradient = jax.jit(jax.grad(phi))(z) if with_gradient else {}
    found = {"value": z, "log density": jax.jit(log_densities)(z), "gradient": gradient}
    words = []
    for what, sites in found.items():
        for name, x in sites.items():
            bad = np.asarray(x)[~np.isfinite(x)]
            if bad.size:
                words.append(
                    f"the {what} of `{name}`, {bad[0]} in {bad.size} of {np.size(x)} entries"
                )
    return words


def misfit(model, model_args, model_kwargs, z: Sites) -> Array:
    """Φ(θ, z)."""
    rest, log_likelihood = split(model, model_args, model_kwargs, z)
    return rest - sum(map(jnp.sum, log_likelihood.values()))


def energies_of(
    model, model_args, model_kwargs, z: Sites, owners, by_block: bool = False
) -> tuple[Array, tuple[Array, ...]]:
    """`rest`, and energies -log p(v_s | θ, z_s), an array for each noise; 0 and Φ where `owners` is
    `None`.
    """
    if owners is None:
        phi = misfit(model, model_args, model_kwargs, z)
        return jnp.zeros_like(phi), (phi,)
    rest, log_likelihood = split(model, model_args, model_kwargs, z, by_block)
    return rest, tuple(-log_likelihood[owners[noise]] for noise in sorted(owners))


def driven_by(model, model_args, model_kwargs, z: Sites, noise=None) -> dict[str, str] | None:
    """The site that each noise drives, if it drives one of the same batch and nothing else; `None`
    otherwise.

    Where this holds, the data are independent given θ, each with its own noise. `noise`: names, of
    all of z by default.
    """
    noise = set(z if noise is None else noise)
    closed, shapes = jax.make_jaxpr(
        lambda z: split(model, model_args, model_kwargs, z), return_shape=True
    )(z)
    names = sorted(z)  # the order of the inputs
    rest, *terms = [
        {names[i] for i in _inputs_of(closed.jaxpr, out)} & noise for out in closed.jaxpr.outvars
    ]
    driven = {}
    for (site, shape), sources in zip(sorted(shapes[1].items()), terms, strict=True):
        if (
            len(sources) != 1
            or not sources.isdisjoint(driven)
            or shape.shape != z[min(sources)].shape[: shape.ndim]
        ):
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
