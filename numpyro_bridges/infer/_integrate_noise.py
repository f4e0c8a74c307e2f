"""Models whose likelihoods are averages over new driving noise, for variational inference.

The objective of `SVI` with a guide q of the parameters is then

    E_q E_z [log p(θ) + Σ_s log 1/K Σ_k p(v_s | θ, z_sk) - log q(θ)],    z_sk ~ N(0, I),

an importance weighted bound [@burda2016] in the noise, and the usual one in the parameters. It is
below that of the model whose noise is integrated out by about 1/(2K) of the relative variance of
the weights of each datum. A guide of noise and parameters, mean-field or not, leaves out most of
what the two say of each other.
"""

import jax
import jax.numpy as jnp
import numpyro
import numpyro.distributions as dist
from numpyro.primitives import Messenger

from .. import weights
from .._checks import positive_integer, require
from ..distributions import AbstractNoiseDriven
from ._posterior import is_noise


def integrate_noise(model, num_particles: int = 16):
    """A model without driving noise: each datum has the mean of the weights of K new bridges.

        parameters = nb.infer.integrate_noise(model)
        guide = AutoMultivariateNormal(parameters)
        result = SVI(parameters, guide, optax.adam(0.01), Trace_ELBO()).run(key, 2000, data)

    **Arguments:**

    - `model`: a NumPyro model that observes laws by `sample`. Its other latent sites stay as they
      are.
    - `num_particles`: K. The bound of each datum is too low by about the relative variance of its
      weights over 2K, and the posterior is off by how much that varies with the parameters: compare
      two numbers.

    **Returns:** a model of the same arguments, random at every call: it is for `SVI`, which gives
    it a key at each step, and for no kernel of MCMC. Plates that are subsampled may be used.

    **Errors:** `ValueError` for noise that drives anything but one observed law, and for sites in a
    `scan`.
    """
    require(
        callable(model), f"`model` must be a NumPyro model, a callable; got {type(model).__name__}."
    )
    num_particles = positive_integer(num_particles, "num_particles")

    def integrated(*args, **kwargs):
        averages = _Averages(model, num_particles)
        value = averages(*args, **kwargs)
        averages.check()
        return value

    return integrated


class _Averages(Messenger):
    """Hides the sites of noise, and makes averages of the laws that they drive."""

    def __init__(self, fn, num_particles):
        super().__init__(fn)
        self._num_particles = num_particles
        self._hidden = []
        self._averaged = []

    def process_message(self, msg):
        if msg["type"] != "sample":
            return
        driven = msg["is_observed"] and isinstance(msg["fn"], AbstractNoiseDriven)
        if not driven and not is_noise(msg):
            return
        require(
            not msg.get("_control_flow_done"),
            f"site `{msg['name']}` is in a `scan`, where a noise may reach later data: write the "
            "loop out.",
        )
        if driven:
            self._averaged.append(msg["name"])
            msg["fn"] = _Averaged(msg["fn"], numpyro.prng_key(), self._num_particles)
        elif msg["value"] is None:
            self._hidden.append(msg["name"])
            msg["value"] = jnp.zeros(msg["fn"].shape())
            msg["stop"] = True

    def check(self):
        require(
            len(self._hidden) == len(self._averaged),
            "each noise must drive one observed law, by `numpyro_bridges.sample`; the model has "
            f"the noise {self._hidden} and observes the laws {self._averaged}.",
        )


class _Averaged(dist.Distribution):
    """A law with its noise averaged over."""

    arg_constraints = {}

    def __init__(self, law, key, num_particles):
        self._law = law
        self._key = key
        self._num_particles = num_particles
        super().__init__(law.batch_shape, law.event_shape, validate_args=False)

    @property
    def support(self):
        return self._law.support

    def sample(self, key, sample_shape=()):
        return self._law.sample(key, sample_shape)

    def log_prob(self, value, intermediates=None):
        noise = self._law.noise_prior().sample(self._key, (self._num_particles,))
        log_weights = jax.vmap(lambda z: self._law.given(z).log_prob(value))(noise)
        return weights.log_mean_exp(log_weights, axis=0)
