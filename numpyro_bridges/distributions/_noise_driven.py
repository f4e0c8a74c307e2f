"""A NumPyro distribution of an observation: its density, given the noise, is a bridge's."""

import copy
import math
from typing import cast

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import numpyro.distributions as dist
from jaxtyping import Array
from numpyro.distributions import constraints

from .._checks import concrete, floating, require, require_key, words
from ._batch import as_datum, as_shape, broadcasts, map_batch, one_of, parameters, stacked
from ._driving_noise import DrivingNoise, NoiseBlocks


class AbstractNoiseDriven(dist.Distribution):
    """The law of an observation. Its density given standard normal noise averages over the noise to
    that of `sample`.

    A subclass says, for the parts of one law, how to simulate, how to weigh and what a datum must
    be.

    What `jax.vmap` and `lax.scan` stack into one law is a batch of laws, their axes in front of its
    own.
    """

    arg_constraints = {}
    pytree_data_fields = ("parts", "noise", "_mask", "_stack")
    pytree_aux_fields = ("_batched", "_declared", "_plain", "_own_shape", "_noise_shape", "_moved")
    # The law of which `_as_batch` made a batch. It is flattened in the place of the batch: what a
    # `vmap` over the batch unflattens is then single laws again.
    _single = None

    def __init__(
        self,
        parts,
        batched,
        declared,
        batch_shape,
        event_shape,
        noise_shape,
        validate_args=None,
        plain=(),
    ):
        self.parts = parts
        self.noise = None
        self._mask = None
        # A probe of shape (): `jax.vmap` and `lax.scan` put their axes in front of all arrays of
        # what they return, and by the probe they are known from those of the parts.
        self._stack = np.zeros(())
        self._batched = batched
        self._declared = declared
        # parts made of scalars, which no parameter of a datum can have broadcast
        self._plain = plain
        self._own_shape = batch_shape
        self._noise_shape = noise_shape
        self._moved = 0
        super().__init__(batch_shape, event_shape, validate_args=validate_args)
        self.refuse_hidden_axes(batch_shape, names=("sde", "match"))

    def tree_flatten(self):
        return super().tree_flatten() if self._single is None else self._single.tree_flatten()

    @classmethod
    def tree_unflatten(cls, aux_data, params):
        law = cast(AbstractNoiseDriven, super().tree_unflatten(aux_data, params))
        stack = law._stack
        known = isinstance(stack, (jax.Array, np.ndarray))  # no placeholder of jax's
        return law._as_batch(stack.shape) if known and stack.ndim else law

    def _as_batch(self, axes):
        """The batch of laws whose arrays all have the axes of a stack in front."""
        inner = (1,) * (len(self._full_shape) - len(self._own_shape)) + self._own_shape
        parts = {}
        for name, part in self.parts.items():
            own = self._own_shape if name in self._batched else ()
            parts[name] = stacked(part, axes, inner, own)
        # every part has the stack's axes, so that every part is batched now
        law = self._replace(
            parts=parts,
            _batched=tuple(self.parts),
            _own_shape=axes + inner,
            _batch_shape=axes + self.batch_shape,
            _declared=True,
            _stack=np.zeros(()),
        )
        law._single = self
        return law

    @staticmethod
    def _simulate(parts, key):
        """An observation and the noise with which a bridge to it follows the simulated path."""
        raise NotImplementedError

    @staticmethod
    def _observe(parts, key):
        """An observation."""
        raise NotImplementedError

    @staticmethod
    def _log_weight(parts, value, noise):
        """log p(value | noise), which integrates over the noise."""
        raise NotImplementedError

    @staticmethod
    def _log_weights(parts, value, noise):
        """The same as a sum over `noise_blocks`."""
        raise NotImplementedError

    @staticmethod
    def _placeholder(parts, value):
        """A datum like `value` that is harmless, where the real one is masked."""
        raise NotImplementedError

    @staticmethod
    def _check_data(parts, values):
        """`ValueError` if one of the values (a leading axis) cannot be observed by the match."""
        raise NotImplementedError

    @property
    def has_rsample(self):
        """`False`: variational guides ask, and a law whose density needs noise cannot be one."""
        return False

    @property
    def support(self):
        return constraints.independent(constraints.real, self.event_dim)

    def noise_prior(self) -> DrivingNoise:
        """The prior of the noise, N(0, I), one noise for each datum of the batch."""
        return DrivingNoise(self.batch_shape, self.event_shape[: self._moved] + self._noise_shape)

    @property
    def noise_blocks(self) -> NoiseBlocks | None:
        """The blocks of the noise of a datum, or `None` where it is one."""
        return None

    def given(self, noise):
        """The same law with its noise bound, so that it has a `log_prob`. Leading axes of the noise
        widen the batch.
        """
        event = self.event_shape[: self._moved] + self._noise_shape
        noise = floating(noise, "noise")
        k = noise.ndim - len(event)
        require(
            k >= 0 and noise.shape[k:] == event,
            f"`noise` must have shape (..., {', '.join(map(str, event))}), one for each datum; got "
            f"{noise.shape}.",
        )
        require(
            broadcasts(self.batch_shape, noise.shape[:k]),
            f"`noise` must have one noise for each datum, batch shape {self.batch_shape}; got "
            f"{noise.shape[:k]}. Draw it from `law.noise_prior()`, inside the same plates as the "
            "data.",
        )
        # without the old noise, which need not be as many as the new one
        free = self._replace(noise=None)
        wide = free._widened(noise.shape[: noise.ndim - len(self._noise_shape)])
        return wide._replace(noise=noise)

    def sample(self, key, sample_shape=()):
        """Observations of the unconditioned process. Bound noise, of a datum, plays no part."""
        return self._over_batch(self._observe, *self._keys(key, sample_shape))

    def sample_with_noise(self, key, sample_shape=()):
        """Joint draws (v, z): with v from `sample`, z the noise by which the bridge to v retraces
        the simulated path.

        They have density `exp(noise_prior().log_prob(z) + given(z).log_prob(v))`. To draw z from
        its prior and then v gives the same margins and the wrong joint law.
        """
        return self._over_batch(self._simulate, *self._keys(key, sample_shape))

    def log_prob(self, value, intermediates=None):
        """log p(value | noise). Its exponential averages over the noise to the density of `sample`.

        It is no density of `value` at fixed noise. Where the law is masked it is 0, whatever the
        value, NaN included.
        """
        return self._log_prob_by(self._log_weight, (), value)

    def _log_prob_by_block(self, value):
        """Terms that add up to `log_prob`, an axis of `noise_blocks` behind those of the batch."""
        blocks = self.noise_blocks
        assert blocks is not None
        return self._log_prob_by(self._log_weights, (len(blocks.above),), value)

    def _log_prob_by(self, log_weight, inner, value):
        """`inner`: the axes of a log weight, behind those of the batch."""
        value = as_datum(value, "value")
        self._check_value(value, "value")
        require(
            self.noise is not None,
            f"the noise site is missing: {type(self).__name__} has a density only with its noise "
            "bound. Use `numpyro_bridges.sample(name, law, obs=...)`, the handler `NoiseReparam`, "
            "or `law.given(noise)`.",
        )
        full = self._full_shape
        mask = self._mask
        known_mask = None if mask is None else concrete(mask)
        # nothing counts: no bridge need be computed
        if known_mask is not None and not np.any(known_mask):
            return jnp.zeros(self.batch_shape + inner)
        value = jnp.broadcast_to(value, self.shape())
        # The value is replaced before, and the result after. A `where` after alone would leave the
        # derivative NaN where a hidden value is NaN: 0 · NaN.
        if mask is not None:
            hidden = ~mask.reshape(mask.shape + (1,) * (value.ndim - mask.ndim))
            value = jnp.where(hidden, self._over_batch(self._placeholder, full, value), value)
        log_prob: Array = self._over_batch(log_weight, full, value, self.noise)
        if mask is not None:
            log_prob = jnp.where(mask.reshape(mask.shape + (1,) * len(inner)), log_prob, 0.0)
        # axes that `to_event` has moved are one datum, of independent ones
        last = len(self.batch_shape)
        return jnp.sum(log_prob, axis=tuple(range(last, last + self._moved)))

    def _paths_to(self, observed, one):
        """Paths of each datum by `one`, NaN where the law is masked."""
        require(self.noise is not None, "`path` needs the noise: use `law.given(noise)`.")
        observed = as_datum(observed, "observed")
        self._check_value(observed, "observed")
        observed = jnp.broadcast_to(observed, self.shape())
        path = self._over_batch(one, self._full_shape, observed, self.noise)
        if self._mask is None:
            return path
        mask = self._mask.reshape(self._full_shape + (1,) * (path.ndim - self._mask.ndim))
        return jnp.where(mask, path, jnp.nan)

    def expand(self, batch_shape):
        return self._widened(as_shape(batch_shape, "batch_shape") + self.event_shape[: self._moved])

    # `expand`, `mask` and `to_event` return a law like this one: NumPyro's wrappers would hide
    # `given`, and a site could not bind its noise
    def mask(self, mask):
        if mask is True:
            return self
        known = mask if isinstance(mask, jax.Array) else np.asarray(mask)
        booleans = known.dtype == np.bool_
        require(
            booleans, f"`mask` must hold booleans, True where a datum counts; got {words(mask)}."
        )
        mask = jnp.asarray(known)
        law = self.expand(jnp.broadcast_shapes(mask.shape, self.batch_shape))
        mask = jnp.broadcast_to(mask, law.batch_shape)
        # a mask is of data as they are now: of all that `to_event` has moved into one
        mask = jnp.broadcast_to(mask.reshape(mask.shape + (1,) * law._moved), law._full_shape)
        return law._replace(_mask=mask if law._mask is None else mask & law._mask)

    def to_event(self, reinterpreted_batch_ndims=None):
        n = len(self.batch_shape)
        k = n if reinterpreted_batch_ndims is None else reinterpreted_batch_ndims
        good = isinstance(k, (int, np.integer)) and 0 <= k <= n
        require(
            good,
            f"`reinterpreted_batch_ndims` must be a number from 0 to {n}, the number of batch "
            f"axes; got {words(k)}.",
        )
        batch = self.batch_shape[: n - k]
        moved = self.batch_shape[n - k :]
        return self._replace(
            _batch_shape=batch, _event_shape=moved + self.event_shape, _moved=self._moved + k
        )

    def _replace(self, **fields):
        law = copy.copy(self)
        law._single = None
        for name, value in fields.items():
            setattr(law, name, value)
        return law

    @property
    def _full_shape(self):
        """The batch, axes that `to_event` has moved included."""
        return self.batch_shape + self.event_shape[: self._moved]

    def _widened(self, full):
        old = self._full_shape
        if full == old:
            return self
        require(broadcasts(old, full), f"a law of batch shape {old} cannot be expanded to {full}.")
        self.refuse_hidden_axes(full, names=("sde", "match"))
        noise = self.noise
        mask = self._mask
        if noise is not None:
            require(
                math.prod(old) == math.prod(full),
                f"the law has {math.prod(old)} noise(s), batch shape {old}, and is expanded to "
                f"{full}. One noise shared by several data is a wrong likelihood: draw it inside "
                "the same plates, or use `numpyro_bridges.sample`.",
            )
            noise = noise.reshape(full + self._noise_shape)
        mask = mask if mask is None else jnp.broadcast_to(mask, full)
        return self._replace(_batch_shape=full[: len(full) - self._moved], noise=noise, _mask=mask)

    def refuse_hidden_axes(self, batch, drawn="", names=None) -> None:
        """`ValueError` where a shared part has an axis as long as one of the batch.

        It may be a parameter of each datum, which would be broadcast into the state. The SDE and
        the match are refused on sight. A start, a grid or a space has axes of its own always, and
        is refused where a site, `drawn`, shows that there are parameters of each datum.
        """
        if self._declared:
            return
        sizes = set(batch) - {1}
        for name in self.parts if names is None else names:
            part = None if name in self._batched + self._plain else self.parts.get(name)
            for leaf in parameters(part, every=names is None):
                require(
                    sizes.isdisjoint(leaf.shape),
                    f"`{name}` holds an array of shape {leaf.shape} and is used in a batch "
                    f"{tuple(batch)}{drawn and f', in which `{drawn}` is drawn'}. A parameter "
                    "drawn inside the plate would be broadcast into the state: build one "
                    f"`{name}` for each datum by `jax.vmap`, and give `batch_shape`. If the array "
                    f"belongs to every datum, say `batched={self._batched}`.",
                )

    def _keys(self, key, sample_shape):
        require_key(key)
        shape = as_shape(sample_shape, "sample_shape", smallest=0) + self._full_shape
        return shape, jr.split(key, shape)

    def _over_batch(self, one, batch_shape, *arrays):
        """`one(parts, *items)` of every item of the batch, results with the batch axes in front"""
        own = {name: self.parts[name] for name in self._batched}
        shared = {name: part for name, part in self.parts.items() if name not in own}
        return map_batch(one, shared, own, self._own_shape, batch_shape, arrays)

    def _check_value(self, value, name):
        shape = jnp.shape(value)
        k = len(shape) - self.event_dim
        require(
            k >= 0 and shape[k:] == self.event_shape,
            f"`{name}`, an observation, must have shape {self.event_shape}, behind a batch "
            f"{self.batch_shape}; got {shape}.",
        )
        require(
            broadcasts(shape[:k], self.batch_shape),
            f"`{name}` holds {math.prod(shape[:k])} observations, batch shape {shape[:k]}, for a "
            f"law of batch {self.batch_shape}. One noise shared by several data is a wrong "
            "likelihood: put the site into a `numpyro.plate`.",
        )
        # traced values cannot be looked at
        data = concrete(value)
        mask = True if self._mask is None else concrete(self._mask)
        if data is not None and mask is not None:
            full = shape[: k + self._moved] if mask is True else self._full_shape
            data = np.broadcast_to(data, full + self.event_shape[self._moved :])
            with jax.ensure_compile_time_eval():
                self._check_seen(data, np.broadcast_to(mask, full))

    def _check_seen(self, data, seen):
        """All data at once; one by one to name a wrong one, or where each has its own match."""
        batched = tuple({"match"} & set(self._batched))
        match = {name: self.parts[name] for name in ("match", "settings") if name in self.parts}
        # thousands of data in one check; only where it fails they are taken one by one
        if not seen.any() or not batched and _passes(self._check_data, match, data[seen]):
            return
        for index in map(tuple, np.argwhere(seen)):
            # the place in the law's own batch, behind plates
            own = index[max(len(index) - len(self._own_shape), 0) :]
            own = (0,) * (len(self._own_shape) - len(own)) + own
            try:
                self._check_data(one_of(match, batched, self._own_shape, own), data[index][None])
            except ValueError as e:
                raise ValueError(f"datum {tuple(map(int, index))}: {e}" if index else str(e)) from e

    def _validate_sample(self, value):
        # NumPyro warns of values outside of the support; ours are refused
        self._check_value(value, "value")
        return jnp.ones((), bool)


def _passes(check, *args) -> bool:
    try:
        check(*args)
    except ValueError:
        return False
    return True
