"""Results for ArviZ: 0.x, an `InferenceData`, and 1.x, a `DataTree`.

The driving noise is left out: thousands of numbers, none of them of interest. The log likelihood log p(v_i | z_i, θ) is
conditional on it, and good for leave-one-out all the same: p(v | θ) is its mean over z ~ N(0, I), so that
E[1/p(v_i | z_i, θ)] over the posterior of (z, θ) is E[1/p(v_i | θ)] over that of θ, the same estimand. The spread of
the bridge's weights adds to that of the importance ratios: read Pareto k̂.
"""

import jax
import numpy as np
import numpyro
from numpyro.infer import MCMC, init_to_sample, log_likelihood

from .._checks import require

HMC_FIELDS = ("potential_energy", "energy", "accept_prob", "num_steps", "adapt_state.step_size", "diverging")
"""What HMC and NUTS can report: `mcmc.run(key, data, extra_fields=HMC_FIELDS)`."""

_ARVIZ_NAMES = {
    "potential_energy": "lp",
    "accept_prob": "acceptance_rate",
    "num_steps": "n_steps",
    "adapt_state.step_size": "step_size",
}


def to_arviz(
    mcmc: MCMC,
    *,
    prior: dict | None = None,
    posterior_predictive: dict | None = None,
    coords: dict | None = None,
    dims: dict | None = None,
    noise: bool = False,
):
    """The result of an MCMC run, for ArviZ.

    **Arguments:**

    - `mcmc`: after `run`. Sample statistics are what the run has collected: `extra_fields=HMC_FIELDS` asks for all.
    - `prior`, `posterior_predictive`: dictionaries from `numpyro.infer.Predictive`.
    - `coords`, `dims`: as in ArviZ; plates name their axes.
    - `noise`: keep the driving noise in the posterior.

    **Returns:** an `InferenceData` (ArviZ 0.x) or a `DataTree` (1.x) with `posterior`, `sample_stats`, `log_likelihood`
    with one value for each datum of each observed site (`numpyro.factor` sites are no data), `observed_data`, and the
    groups of the dictionaries.
    """
    model = getattr(mcmc.sampler, "model", None)
    require(callable(model), "`mcmc` must run a NumPyro model: one with a `potential_fn` of its own has no sites.")
    sites = _sites(model, mcmc._args, mcmc._kwargs)
    observed = {name: site["value"] for name, site in sites.items() if _is_datum(site)}
    hidden = set() if noise else {name for name, site in sites.items() if _is_noise(site)}

    def visible(draws, shape=None):
        return {k: v if shape is None else _regrouped(v, shape) for k, v in draws.items() if k not in hidden}

    samples = mcmc.get_samples(group_by_chain=True)
    shape = next(iter(samples.values())).shape[:2]
    log_lik = log_likelihood(model, mcmc.get_samples(), *mcmc._args, **mcmc._kwargs) if observed else {}
    groups = {
        "posterior": visible(samples),
        "sample_stats": _statistics(mcmc.get_extra_fields(group_by_chain=True)),
        "log_likelihood": {name: _regrouped(log_lik[name], shape) for name in observed},
        "observed_data": observed,
    }
    if posterior_predictive is not None:
        groups["posterior_predictive"] = visible(posterior_predictive, shape)
    if prior is not None:
        draws = {name: np.asarray(value)[None] for name, value in visible(prior).items()}
        groups["prior"] = {name: value for name, value in draws.items() if name not in observed}
        groups["prior_predictive"] = {name: value for name, value in draws.items() if name in observed}
    groups = {group: jax.device_get(values) for group, values in groups.items() if values}
    return _from_groups(groups, coords, _plates(sites) | (dims or {}))


def _sites(model, args, kwargs) -> dict:
    """Sample and deterministic sites of the model at its data."""
    model = numpyro.handlers.substitute(numpyro.handlers.seed(model, 0), substitute_fn=init_to_sample)
    trace = numpyro.handlers.trace(model).get_trace(*args, **kwargs)
    return {name: site for name, site in trace.items() if site["type"] in ("sample", "deterministic")}


def _is_datum(site) -> bool:
    return bool(site.get("is_observed")) and not site["infer"].get("is_auxiliary")


def _is_noise(site) -> bool:
    return bool(site.get("infer", {}).get("driving_noise"))


def _plates(sites) -> dict:
    """Names of the leading axes of each site, from its plates."""
    frames = {name: sorted(site["cond_indep_stack"], key=lambda frame: frame.dim) for name, site in sites.items()}
    return {name: [frame.name for frame in stack] for name, stack in frames.items() if stack}


def _regrouped(draws, shape):
    """Draws with chains and iterations in front."""
    draws = np.asarray(draws)
    return draws.reshape(shape + draws.shape[1:])


def _statistics(fields) -> dict:
    """Sample statistics under ArviZ's names."""
    named = {_ARVIZ_NAMES.get(name, name): value for name, value in fields.items() if hasattr(value, "shape")}
    if "lp" in named:
        named["lp"] = -named["lp"]
    if "n_steps" in named:
        named["tree_depth"] = np.log2(np.asarray(named["n_steps"])).astype(int) + 1
    return named


def _from_groups(groups, coords, dims):
    import arviz

    if int(arviz.__version__.split(".")[0]) < 1:
        return arviz.from_dict(**groups, coords=coords, dims=dims)
    return arviz.from_dict(groups, coords=coords, dims=dims)
