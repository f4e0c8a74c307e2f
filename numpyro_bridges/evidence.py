"""The evidence p(condition | x0) by importance sampling, with what is needed to judge it."""

import equinox as eqx
import jax
import jax.random as jr
from jaxtyping import Array, Float, PRNGKeyArray

from . import weights
from ._checks import require, require_instance
from .bridges import GuidedBridge


class EvidenceEstimate(eqx.Module):
    """An estimate of log p(condition | x0).

    `log_evidence` is the log of the mean weight, `standard_error` its Monte Carlo standard error, `ess` the effective
    number of particles. `pareto_k` above min(1 − 1/log10(num_particles), 0.7) says that the weights' tail is too heavy
    for either to be trusted (Vehtari et al. 2024). `log_weights` `(num_particles,)`.
    """

    log_evidence: Float[Array, ""]
    standard_error: Float[Array, ""]
    ess: Float[Array, ""]
    pareto_k: float
    log_weights: Float[Array, " particles"]


@eqx.filter_jit
def _log_weights(bridge: GuidedBridge, keys, batch_size: int):
    def one(key):
        return bridge.log_weight(jr.normal(key, bridge.noise_shape, bridge.x0.dtype))

    return jax.lax.map(one, keys, batch_size=batch_size)


def estimate_evidence(
    bridge: GuidedBridge, key: PRNGKeyArray, num_particles: int, *, batch_size: int = 256
) -> EvidenceEstimate:
    """Estimate p(condition | x0) from independent guided paths.

    **Arguments:** `num_particles`: number of paths. `batch_size`: how many run at once; memory is bounded by it.

    **Returns:** an `EvidenceEstimate`. A path that failed numerically makes it NaN.
    """
    require(
        isinstance(num_particles, int) and num_particles >= 2,
        f"`num_particles` must be an integer of at least 2; got {num_particles!r}.",
    )
    require_instance(bridge, GuidedBridge, "bridge", "a `GuidedBridge`")
    require(
        isinstance(batch_size, int) and batch_size >= 1, f"`batch_size` must be a positive integer; got {batch_size!r}."
    )
    log_weights = _log_weights(bridge, jr.split(key, num_particles), min(batch_size, num_particles))
    return EvidenceEstimate(
        weights.log_mean_exp(log_weights),
        weights.standard_error(log_weights),
        weights.effective_sample_size(log_weights),
        float(weights.pareto_k(log_weights)),
        log_weights,
    )
