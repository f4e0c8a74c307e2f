"""What tells a chain that goes on from one that starts again: 32 bits, kept in its state.

It is mixed from the arguments of the model and the random key with which the chain continues. Where
`MCMC.run` gives a warm state a new key, or the model new arguments, the number in the state no
longer holds, and its energies are stale.
"""

import re
import zlib

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jax.core import Tracer


def of_arguments(arguments):
    """Of any pytree: its arrays by their bits, the rest by its words, where these are known."""
    leaves, structure = jax.tree.flatten(arguments)
    arrays = [leaf for leaf in leaves if _has_bits(leaf)]
    others = [leaf for leaf in leaves if not _has_bits(leaf)]
    shapes = [(jnp.shape(x), x.dtype.name) for x in arrays]
    # without addresses, which a process that goes on with a chain would not repeat
    words = re.sub(" at 0x[0-9a-f]+", "", repr((structure, others, shapes)))
    # not Python's `hash`, which differs from process to process
    seal = np.array([zlib.crc32(words.encode())], np.uint32)
    for x in arrays:
        # mixed at each, so that their order counts
        seal = _mixed(seal ^ _of_bits(_bits(x)))
    return seal


def with_key(seal, key):
    """A scalar, of arguments and a key."""
    return _mixed(jnp.asarray(seal) ^ _of_bits(_bits(key)))[0]


def _has_bits(x) -> bool:
    dtype = getattr(x, "dtype", None)
    kinds = (jnp.number, jnp.bool_, jax.dtypes.prng_key)
    return dtype is not None and any(jnp.issubdtype(dtype, kind) for kind in kinds)


def _bits(x):
    """The words of 32 bits of an array, `(n,)`, by NumPy unless it is traced."""
    if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
        x = jr.key_data(x)
    # Both ways must give the same words, since one data set is traced in one place and known in
    # another: types as JAX has them, complex numbers as pairs, small types as float32.
    if not isinstance(x, Tracer):
        x = np.asarray(x)
        x = x.astype(jax.dtypes.canonicalize_dtype(x.dtype))
        x = x.astype(np.float32) if x.dtype.itemsize < 4 else x
        return np.ascontiguousarray(x).reshape(-1).view(np.uint32)
    if jnp.iscomplexobj(x):
        x = jnp.stack([x.real, x.imag], axis=-1)
    x = x.astype(jnp.float32) if x.dtype.itemsize < 4 else x
    return jax.lax.bitcast_convert_type(x, jnp.uint32).reshape(-1)


def _of_bits(bits):
    """Each word is mixed with its place, so that neither swaps nor changes of sign cancel."""
    places = np.arange(bits.size, dtype=np.uint32)
    return _mixed(bits ^ _mixed(places + np.uint32(1))).sum(keepdims=True, dtype=np.uint32)


def _mixed(x):
    """The last mixing of MurmurHash3, a bijection of 32 bits."""
    x = (x ^ (x >> np.uint32(16))) * np.uint32(0x85EBCA6B)
    x = (x ^ (x >> np.uint32(13))) * np.uint32(0xC2B2AE35)
    return x ^ (x >> np.uint32(16))
