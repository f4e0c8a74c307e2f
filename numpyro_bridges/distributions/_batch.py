"""All that concerns leading axes of a law.

A law is made of parts, such as an SDE, a start and a match. Each part is shared by the whole batch,
or *batched*: all its arrays carry the law's own batch axes in front, as `jax.vmap` of a constructor
returns them. Plates widen the batch; what is written for one datum is mapped over it.
"""

import itertools
from collections.abc import Iterable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from .._checks import floating, require, words
from ..conditioning import IntervalCensored
from ..guiding import AbstractGuide
from ..sdes import AbstractSDE
from ..spaces import AbstractSpace


@eqx.filter_jit
def map_batch(one, shared, own, own_shape, batch_shape, arrays):
    """`one(parts, *items)` of every item of a batch.

    `own`: the parts with axes `own_shape`, `shared`: the others; `arrays`: with axes `batch_shape`.
    """
    if not batch_shape:
        return one(shared | own, *arrays)
    # what is no array is the same for all laws, and cannot be mapped over
    own, static = eqx.partition(own, eqx.is_array)

    def widened(a):
        rest = a.shape[len(own_shape) :]
        # NumPy's broadcasting: plates stand in front of the law's own axes
        a = a.reshape((1,) * (len(batch_shape) - len(own_shape)) + a.shape)
        return flat(jnp.broadcast_to(a, batch_shape + rest))

    def flat(a):
        return a.reshape((-1,) + a.shape[len(batch_shape) :])

    def item(own, *items):
        return one(shared | eqx.combine(own, static), *items)

    # one `vmap`, over all axes as one, whatever their number
    out = jax.vmap(item)(jax.tree.map(widened, own), *map(flat, arrays))
    return jax.tree.map(lambda a: a.reshape(batch_shape + a.shape[1:]), out)


def one_of(parts, batched, own_shape, index):
    """The parts of one law of the batch."""
    # `index` is of the whole batch: plates in front do not count, and axes of 1 are broadcast
    last = index[len(index) - len(own_shape) :]
    index = tuple(i if n > 1 else 0 for i, n in zip(last, own_shape, strict=True))

    def pick(part):
        return jax.tree.map(lambda a: a[index] if eqx.is_array(a) else a, part)

    return {name: pick(part) if name in batched else part for name, part in parts.items()}


def find_batched(parts, batch_shape, declared, check) -> tuple[str, ...]:
    """Names of the parts with batch axes: as declared, or the one reading that `check` accepts."""
    carriers = [name for name, part in parts.items() if batch_shape and _carries(part, batch_shape)]
    if declared is not None:
        for name in declared:
            require(
                name in parts, f"`batched` must name parts among {sorted(parts)}; got {name!r}."
            )
            require(
                name in carriers,
                f"every array of `{name}` must have {batch_shape} in front: it is in `batched`.",
            )
        readings = [tuple(declared)]
    else:
        # every subset: a start (3, 2) in a batch (3,) is three vectors, or one state of 3 points
        readings = [
            r for k in range(len(carriers), -1, -1) for r in itertools.combinations(carriers, k)
        ]
    # the first law of the batch stands for all: they have the same shapes
    start = (0,) * len(batch_shape)
    laws = {reading: one_of(parts, reading, batch_shape, start) for reading in readings}
    fitting = [reading for reading, law in laws.items() if len(laws) == 1 or _accepts(check, law)]
    # where no reading fits, or the only one, the check's own error says what is wrong
    for law in [laws[r] for r in fitting] or list(laws.values()):
        _explained(check, law, batch_shape)
    require(
        len(fitting) == 1,
        f"with `batch_shape={batch_shape}`, {' and '.join(carriers)} can be read with and without "
        f"the batch axes. Say which parts carry them: `batched={fitting[0]}`, or "
        f"`batched={fitting[-1]}`.",
    )
    return fitting[0]


def _accepts(check, law) -> bool:
    try:
        check(law)
    except Exception:  # a user's drift may raise anything at the wrong shape
        return False
    return True


def _explained(check, law, batch_shape):
    try:
        check(law)
    except TypeError as e:
        raise ValueError(
            f"the parts make neither one law nor a batch {batch_shape} of laws: {e} A parameter "
            "with an axis of its own does it. Laws of a batch are built by `jax.vmap` of the "
            "constructors, and declared by `batch_shape`."
        ) from e


def _carries(part, batch_shape) -> bool:
    arrays = [a for a in jax.tree.leaves(part) if eqx.is_array(a)]
    return bool(arrays) and all(a.shape[: len(batch_shape)] == batch_shape for a in arrays)


def stacked(part, axes, inner, own):
    """A part whose arrays have the axes of a stack, then its own batch axes: widened to `inner`."""

    def widened(a):
        if not eqx.is_array(a):
            return a
        rest = a.shape[len(axes) + len(own) :]
        a = jnp.reshape(a, axes + (1,) * (len(inner) - len(own)) + own + rest)
        return jnp.broadcast_to(a, axes + inner + rest)

    return jax.tree.map(widened, part)


def parameters(part, every=False):
    """Arrays that may be parameters; `every`: those of a space and of cut points, which are vectors
    always, too.

    A guide only leads the path, and its arrays may be of any shape but for those of an SDE.
    """
    if isinstance(part, AbstractGuide):
        nodes = jax.tree.leaves(part, is_leaf=lambda node: isinstance(node, AbstractSDE))
        return [
            leaf
            for node in nodes
            if isinstance(node, AbstractSDE)
            for leaf in parameters(node, every)
        ]
    # a space's weights and cut points are vectors always, and may be as long as a batch
    vectors = () if every else (AbstractSpace, IntervalCensored)
    leaves = jax.tree.leaves(part, is_leaf=lambda node: isinstance(node, vectors))
    return [leaf for leaf in leaves if eqx.is_inexact_array(leaf)]


def as_shape(value, name, smallest=1) -> tuple[int, ...]:
    """A tuple of sizes; `ValueError` for anything else, a number included."""
    good = isinstance(value, Iterable) and not isinstance(value, (str, bytes, dict))
    sizes = tuple(value) if good else ()
    good = good and all(
        isinstance(n, (int, np.integer)) and not isinstance(n, bool) and n >= smallest
        for n in sizes
    )
    require(good, f"`{name}` must be a tuple of sizes, such as `(3,)`; got {words(value)}.")
    return tuple(int(n) for n in sizes)


def as_datum(value, name):
    """An array of floats, which stays known where a program is traced."""
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(value)):
        return floating(value, name)
    # else `jnp.asarray` would make a constant of a traced function a tracer, which has no value
    # for the checks to look at
    with jax.ensure_compile_time_eval():
        return floating(value, name)


def broadcasts(small, large) -> bool:
    """Whether shape `small` broadcasts to shape `large`."""
    padded = (1,) * (len(large) - len(small)) + tuple(small)
    return len(padded) == len(large) and all(
        m in (1, n) for m, n in zip(padded, large, strict=True)
    )
