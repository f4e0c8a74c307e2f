"""The standard normal noise that drives a bridge."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import jax.random as jr
import numpyro.distributions as dist
from numpyro.distributions import constraints

from .._checks import require, require_key
from ._batch import broadcasts

_LOG_2PI = 1.8378770664093453


class NoiseBlocks(NamedTuple):
    """How the first axis of the noise of a datum, its rows, is cut into blocks, one after the
    other.

    The log probability is a sum over the blocks, and each term depends on the noise of its own
    block and of those on the way to it: on no other.
    """

    sizes: tuple[int, ...]
    """Rows of each block."""
    above: tuple[int, ...]
    """For each block the number of the one before it, smaller than its own, or −1."""


class MissingNoise(ValueError):
    """The noise has no value, and there is no random key to draw one."""


class DrivingNoise(dist.Distribution):
    """The prior of the driving noise, z ~ N(0, I): `event_shape` is that of the noise of one datum.

    `mask` returns the prior itself. A masked datum says nothing about its noise, which then has its
    prior as posterior; masked too, the noise would have a constant density, which is improper, and
    a sampler would follow it to infinity.
    """

    arg_constraints = {}

    @property
    def support(self):
        return constraints.independent(constraints.real, self.event_dim)

    def sample(self, key: jax.Array, sample_shape: tuple[int, ...] = ()):
        if key is None:
            # NumPyro passes None where no handler seeds the site, as where draws lack the noise
            raise MissingNoise("the noise has no value, and there is no random key to draw one.")
        require_key(key)
        return jr.normal(key, self.shape(sample_shape))

    def log_prob(self, value, intermediates=None):
        axes = tuple(range(-self.event_dim, 0))
        return -0.5 * jnp.sum(jnp.square(value) + _LOG_2PI, axis=axes)

    @property
    def mean(self):
        return jnp.zeros(self.shape())

    @property
    def variance(self):
        return jnp.ones(self.shape())

    def expand(self, batch_shape):
        batch_shape = tuple(batch_shape)
        require(
            broadcasts(self.batch_shape, batch_shape),
            f"a noise of batch shape {self.batch_shape} cannot be expanded to {batch_shape}.",
        )
        return DrivingNoise(batch_shape, self.event_shape)

    def mask(self, mask):
        # `handlers.mask` masks every site within it, see above
        return self

    def to_event(self, reinterpreted_batch_ndims=None):
        # one of its own again: NumPyro's `Independent` could be masked
        shape = self.batch_shape
        moved = len(shape) if reinterpreted_batch_ndims is None else reinterpreted_batch_ndims
        kept = len(shape) - moved
        return DrivingNoise(shape[:kept], shape[kept:] + self.event_shape)
