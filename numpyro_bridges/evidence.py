"""The evidence p(condition | x0) by importance sampling, with what is needed to judge it."""

import math
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
from jax.sharding import Mesh
from jaxtyping import Array, Float, PRNGKeyArray

from . import weights
from ._checks import positive_integer, require_instance, require_key
from ._devices import gather, mesh_for, spread
from .bridges import GuidedBridge


class EvidenceEstimate(eqx.Module):
    """An estimate of log p(condition | x0). `str` of it says whether to trust it, and if not, why.

    - `log_evidence`: log of the mean weight, unsmoothed: the mean is unbiased, its log too low by
      about SE²/2.
    - `standard_error`: of it, in nats, what the drawn weights have missed of the tail included;
      `inf` where nothing can be said of it (`weights.standard_error`).
    - `ess`: the effective number of particles.
    - `pareto_k`: k̂, the shape of the weights' tail; −inf where all are equal to rounding.
    - `rounding`: what rounding may account for in a log weight, in nats.
    - `log_weights`: `(num_particles,)`.
    """

    log_evidence: Float[Array, ""]
    standard_error: Float[Array, ""]
    ess: Float[Array, ""]
    pareto_k: float
    rounding: float
    log_weights: Float[Array, " particles"]

    @property
    def trusted(self) -> bool:
        """Whether `log_evidence` ± 2 `standard_error` can be taken at its word: both are finite.

        The error is, where k̂ is below `weights.pareto_k_threshold(num_particles)`. A tail of which
        no path has given a sign cannot be seen.
        """
        return bool(jnp.isfinite(self.log_evidence) & jnp.isfinite(self.standard_error))

    @property
    def doubt(self) -> str:
        """Why it is not to be trusted, in a few words; empty where it is."""
        num_particles = self.log_weights.shape[0]
        if self.trusted:
            return ""
        if num_particles < 2:
            return "a single particle has no standard error"
        if not math.isfinite(self.log_evidence):
            return f"the log evidence is {self.log_evidence:.2f}"
        if math.isinf(self.pareto_k):
            return (
                f"the tail of {num_particles} particles has no shape: too few, or nearly all of "
                "weight 0"
            )
        threshold = weights.pareto_k_threshold(num_particles)
        if self.pareto_k < threshold:
            return f"k̂ = {self.pareto_k:.2f}, of a tail of few weights"
        return f"k̂ = {self.pareto_k:.2f}, and must be below {threshold:.2f}"

    def __str__(self) -> str:
        found = f"log evidence {self.log_evidence:.4g} ± {self.standard_error:.2g}"
        quality = (
            f"ESS {self.ess:.4g} of {self.log_weights.shape[0]} particles, k̂ {self.pareto_k:.2f}"
        )
        verdict = "" if self.trusted else f". Not to be trusted: {self.doubt}"
        return f"{found} ({quality}){verdict}"


def estimate_evidence(
    bridge: GuidedBridge,
    key: PRNGKeyArray,
    num_particles: int,
    *,
    batch_size: int = 256,
    mesh: Mesh | None = None,
) -> EvidenceEstimate:
    """Estimate p(condition | x0) from independent guided paths.

    **Arguments:** `num_particles`: number of paths, at least 2. `batch_size`: how many a device
    runs at once; memory is bounded by it. `mesh`: the devices that share the paths, as for
    `spread`.

    **Returns:** an `EvidenceEstimate`. A path that failed numerically makes it NaN.
    """
    num_particles = positive_integer(num_particles, "num_particles", 2)
    batch_size = positive_integer(batch_size, "batch_size")
    require_instance(bridge, GuidedBridge, "bridge", "a `GuidedBridge`")
    require_key(key)
    batches, mesh = _batches(key, num_particles, batch_size, mesh)
    found = [_log_weights(bridge, keys, mesh) for keys in batches]
    return estimate_from(bridge, jnp.concatenate(gather(found)))


def timed_estimate(
    bridge: GuidedBridge,
    key: PRNGKeyArray,
    num_particles: int,
    batch_size: int,
    mesh: Mesh | None,
) -> tuple[EvidenceEstimate, float]:
    """The same, of any number of particles, and the seconds that paths took once compiled."""
    batches, mesh = _batches(key, num_particles, batch_size, mesh)
    # Compiled for each size of batch, of which the last may have its own.
    for keys in {len(keys): keys for keys in batches}.values():
        jax.block_until_ready(_log_weights(bridge, keys, mesh))
    start = time.perf_counter()
    found = [jax.block_until_ready(_log_weights(bridge, keys, mesh)) for keys in batches]
    seconds = time.perf_counter() - start
    return estimate_from(bridge, jnp.concatenate(gather(found))), seconds


def estimate_from(bridge: GuidedBridge, log_weights: Array) -> EvidenceEstimate:
    """What log weights of a bridge say of its evidence."""
    log_evidence = weights.log_mean_exp(log_weights)
    rounding = _rounding(bridge, float(log_evidence))
    # Each of two log weights may be off by the rounding, and rounding errors have no tail.
    equal = jnp.ptp(log_weights) <= 2 * rounding
    judged = jnp.where(equal, log_evidence, log_weights)
    standard_error, ess, pareto_k = weights.quality(judged)
    return EvidenceEstimate(
        log_evidence, standard_error, ess, float(pareto_k), rounding, log_weights
    )


def driving_noise(bridge: GuidedBridge, key: PRNGKeyArray) -> Array:
    """Standard normal noise of one path."""
    return jr.normal(key, bridge.noise_shape, bridge.x0.dtype)


def _batches(
    key: PRNGKeyArray, num_particles: int, batch_size: int, mesh: Mesh | None
) -> tuple[list[PRNGKeyArray], Mesh | None]:
    """Keys of what runs at once, and the devices that share each batch of them."""
    mesh = mesh_for(num_particles, "`num_particles`", mesh)
    at_once = batch_size * (1 if mesh is None else mesh.size)
    # A key for each particle, so that the estimate does not depend on batches or devices.
    keys = jr.split(key, num_particles)
    return [keys[i : i + at_once] for i in range(0, num_particles, at_once)], mesh


# A function of the module, and the bridge its argument: bridges that differ in arrays only share
# one compiled program.
@eqx.filter_jit
def _log_weights(bridge: GuidedBridge, keys, mesh: Mesh | None = None):
    def log_weight(key):
        return bridge.log_weight(driving_noise(bridge, key))

    return spread(log_weight, mesh)(keys)


def _rounding(bridge: GuidedBridge, log_evidence: float) -> float:
    """K sums of numbers as large as a log weight, and as all squared noises."""
    size = math.prod(bridge.noise_shape) + bridge.num_steps * abs(log_evidence)
    return float(jnp.finfo(bridge.x0.dtype).eps) * size
