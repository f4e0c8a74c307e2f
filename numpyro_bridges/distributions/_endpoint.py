"""The law of what is seen of a diffusion at a later time.

`sample` simulates the SDE and observes its end. `log_prob(v)`, with standard normal noise z bound,
is the log weight of the guided bridge to v, so that

    E[exp log_prob(v | z)] = p(v | x0),    z ~ N(0, I),

p being the density that `sample` draws from: N(z; 0, I) exp(log_prob(v | z)) is an exact data
augmentation.
"""

from collections.abc import Iterable

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array
from numpy.typing import ArrayLike

from .._checks import (
    as_float,
    concrete,
    exact_float,
    require,
    require_finite,
    require_instance,
    words,
)
from .._types import RealScalar
from ..bridges import GuidedBridge
from ..conditioning import AbstractDensityMatch, AbstractMatch
from ..guiding import AbstractGuide
from ..sdes import AbstractSDE, simulate, time_grid
from ._batch import as_shape, find_batched, one_of
from ._noise_driven import AbstractNoiseDriven


class DiffusionEndpoint(AbstractNoiseDriven):
    """The law of an observation, at t1, of a diffusion that starts at x0.

    **Arguments:**

    - `sde`: an `AbstractSDE`.
    - `x0`: `(n, dim)` or `(n,)`.
    - `match`: how the end state is seen, an `ExactMatch`, `InexactMatch` or `IntervalCensored`; the
      datum is `obs=`.
    - `t1`, `t0`, `num_steps`, `ts`, `guide`: as for `GuidedBridge`. Data with times of their own
      are a batch: with `batch_shape=(B,)`, `t1` and `t0` may be `(B,)`, and `ts` `(B, K + 1)`.
    - `batch_shape`: leading axes of a batch of laws with starts or SDEs of their own. Exchangeable
      data need none: a plate is enough. With `batch_shape=(B,)`, `x0` may be `(B, n, dim)`, and
      `sde`, `match` and `guide` may be what `jax.vmap` of a constructor returns, every array with
      the batch axis in front. All else is shared. The law itself may be made by `jax.vmap` too: its
      batch is then what it was mapped over.
    - `batched`: names of the parts that carry it, such as `("sde", "x0")`; by default found from
      the shapes, where they leave no doubt.

    **Shapes:** `event_shape` is that of an observation, `(m, dim)` or `(m,)`. `IntervalCensored`
    observes numbers of bins, held as floats. The noise of a datum has shape `(num_steps, k, dim)`.

    **Errors:** `ValueError` for every other leading axis, for kernels that are no densities
    (`normalised=False`), for data that are not finite, for more data than noises, and for
    `log_prob` without noise.
    """

    def __init__(
        self,
        sde: AbstractSDE,
        x0: ArrayLike,
        match: AbstractMatch,
        *,
        t1: RealScalar | None = None,
        num_steps: int | None = None,
        t0: RealScalar | None = None,
        ts=None,
        guide: AbstractGuide | None = None,
        batch_shape: tuple[int, ...] = (),
        batched: tuple[str, ...] | None = None,
        validate_args: bool | None = None,
    ):
        require(
            isinstance(match, AbstractMatch),
            "`match` must be a model of observation, such as `InexactMatch(variance)`; got "
            f"{type(match).__name__}. The datum is given to the site, `obs=`.",
        )
        match.check_density()
        x0 = as_float(x0, "x0")
        require_finite(x0, "x0")
        require_instance(sde, AbstractSDE, "sde", "an SDE, such as `LinearSDE(drift, diffusion)`")
        if guide is not None:
            require_instance(guide, AbstractGuide, "guide", "a guide, such as `FrozenGuide()`")
        batch_shape = as_shape(batch_shape, "batch_shape")
        batched = names_of(batched)
        parts = {"sde": sde, "x0": x0, "match": match, "guide": guide}
        # which parts are batched comes first: all shapes below are those of one law
        names = find_batched(parts, batch_shape, batched, check_law)
        one = one_of(parts, names, batch_shape, (0,) * len(batch_shape))
        datum = example(one)
        exact = one["match"].at(datum).exact
        # in double precision until differences are taken: dates are large and steps are small
        given = {"t0": t0, "t1": t1, "ts": ts}
        times = {k: value if value is None else exact_float(value, k) for k, value in given.items()}
        parts["ts"], own = _grids(times, batch_shape, num_steps=num_steps, graded=exact)
        names += ("ts",) if own else ()
        # again, with its grid
        one = one_of(parts, names, batch_shape, (0,) * len(batch_shape))
        close_parts(parts, one, names, len(batch_shape), one["ts"].elapsed)
        noise_shape = _noise_shape(one, datum)
        declared = batched is not None
        # a grid that is made here comes from scalars: its axis is none of data
        plain = ("ts",) if ts is None else ()
        super().__init__(
            parts, names, declared, batch_shape, datum.shape, noise_shape, validate_args, plain
        )

    @property
    def times(self):
        """The times of a path, `(num_steps + 1,)`, behind a batch where data have their own."""
        ts = self.parts["ts"].ts
        if "ts" not in self._batched:
            return ts
        inner = (1,) * (len(self._full_shape) - len(self._own_shape))
        return jnp.broadcast_to(ts.reshape(inner + ts.shape), self._full_shape + ts.shape[-1:])

    def path(self, observed):
        """The bridges to `observed` that the bound noise drives, batch axes and then `(num_steps +
        1, n, dim)`.

        NaN where the law is masked: the datum says nothing of that path, and no bridge leads to it.
        """
        return self._paths_to(observed, _path)

    @staticmethod
    def _observe(parts, key):
        key_path, key_seen = jr.split(key)
        return parts["match"].sample(key_seen, parts["sde"], _free_path(parts, key_path)[-1])

    @staticmethod
    def _simulate(parts, key):
        key_path, key_seen = jr.split(key)
        path = _free_path(parts, key_path)
        seen = parts["match"].sample(key_seen, parts["sde"], path[-1])
        # the path leaves some noise free (a pinned last step, more noises than states): a key
        # of its own draws it
        return seen, _bridge(parts, seen).noise_from_path(path, jr.fold_in(key, 2))

    @staticmethod
    def _log_weight(parts, value, noise):
        return _bridge(parts, value).log_weight(noise)

    @staticmethod
    def _placeholder(parts, value):
        return parts["match"].example(parts["sde"], parts["x0"]).astype(value.dtype)

    @staticmethod
    def _check_data(parts, values):
        """Entries are checked one by one, so that many data are one datum with many columns."""
        # checking a datum builds a condition: one of many columns instead of many of them
        rows = np.moveaxis(values, 0, -1)
        parts["match"].at(rows.reshape(len(rows), -1) if len(values) > 1 else values[0])


def names_of(batched) -> tuple[str, ...] | None:
    """The declared parts. Times show by their shapes whether they are batched."""
    if batched is None:
        return None
    several = isinstance(batched, Iterable) and not isinstance(batched, (str, bytes))
    names: list = list(batched) if several else [batched]
    good = several and all(isinstance(name, str) for name in names)
    require(good, f"`batched` must be a tuple of names, such as `('x0',)`; got {words(batched)}.")
    return tuple(name for name in names if name not in ("t0", "t1", "ts"))


def _grids(times, batch_shape, **settings):
    """The time grid, or one for each law of a batch, and whether it is one each."""
    own = {}
    shared = {}
    for name, value in times.items():
        shape = () if value is None else np.shape(value)
        # a grid has its own axis of times, the last
        inner = shape[len(shape) - 1 :] if name == "ts" else ()
        batch = shape[: len(shape) - len(inner)]
        require(
            batch in ((), batch_shape),
            f"`{name}` must be {'one grid' if inner else 'one time'}, or one for each law of a "
            f"batch, {batch_shape + inner} with `batch_shape={batch_shape}`; got shape {shape}. "
            f"Data with times of their own need `batch_shape={batch}`.",
        )
        (own if batch else shared)[name] = value
    if not own:
        return time_grid(**shared, **settings), False

    def grid(own):
        return time_grid(**shared, **own, **settings)

    # traced times go through `vmap`; known ones one by one, so that an error names its law
    if any(concrete(value) is None for value in own.values()):
        one = grid
        for _ in batch_shape:
            one = jax.vmap(one)
        return one({name: jnp.asarray(value) for name, value in own.items()}), True
    grids = []
    for index in np.ndindex(batch_shape):
        try:
            grids.append(grid({name: np.asarray(value)[index] for name, value in own.items()}))
        except ValueError as e:
            raise ValueError(f"law {index} of the batch: {e}") from e
    return jax.tree.map(lambda *a: jnp.stack(a).reshape(batch_shape + a[0].shape), *grids), True


def _bridge(parts, value) -> GuidedBridge:
    condition = parts["match"].at(value)
    return GuidedBridge(
        parts["sde"], condition, x0=parts["x0"], ts=parts["ts"], guide=parts["guide"]
    )


def close_parts(parts, one, names, num_axes, ts, several=()) -> None:
    """Freezes what users' functions read; `several`: parts of which one law has many."""

    def set_closed(name, close):
        # traced at the shapes of one law; arrays of the batch are mapped over
        one[name] = close(one[name])
        for _ in range((num_axes if name in names else 0) + (name in several)):
            close = eqx.filter_vmap(close)
        parts[name] = close(parts[name])

    x0 = one["x0"]
    set_closed("sde", lambda sde: sde.closed(ts[0], x0))
    if isinstance(one["match"], AbstractDensityMatch):
        datum = example(one)
        set_closed("match", lambda match: match.closed(x0, datum))
    if parts["guide"] is not None:
        set_closed("guide", lambda guide: guide.closed(one["sde"], x0, ts))


def _noise_shape(parts, datum) -> tuple[int, ...]:
    if not isinstance(parts["match"], AbstractDensityMatch):
        return _bridge(parts, datum).noise_shape
    # its approximation, which takes a while, is that of another datum
    return eqx.filter_eval_shape(lambda *a: jnp.zeros(_bridge(*a).noise_shape), parts, datum).shape


def _path(parts, value, noise):
    return _bridge(parts, value).path(noise)


def _free_path(parts, key):
    sde = parts["sde"]
    x0 = parts["x0"]
    grid = parts["ts"]
    shape = (grid.num_steps, sde.noise_size(x0), x0.shape[1] if x0.ndim == 2 else 1)
    return simulate(sde, x0, grid, jr.normal(key, shape, x0.dtype))


def example(parts) -> Array:
    """A datum for what is known before there is one: zeros, where a match may be made at them."""
    match = parts["match"]
    # a density of the user's may not be defined at 0
    if isinstance(match, AbstractDensityMatch):
        return match.example(parts["sde"], parts["x0"])
    return jnp.zeros(seen_shape(parts))


def seen_shape(parts) -> tuple[int, ...]:
    """Shape of what is seen, by tracing one step and its observation."""

    def seen(t0, t1, x0):
        sde = parts["sde"]
        return parts["match"].example(sde, sde.transition(t0, t1, x0).mean)

    # no number: a coefficient may be defined on [t0, t1] only
    time = jax.ShapeDtypeStruct((), parts["x0"].dtype)
    return jax.eval_shape(seen, time, time, parts["x0"]).shape


def check_law(parts):
    """Raises unless the parts make one law."""
    x0 = parts["x0"]
    require(
        x0.ndim in (1, 2),
        f"`x0` must be one state, (n, dim) or (n,); got shape {x0.shape}. Declare a batch of "
        "starts by `batch_shape`.",
    )
    parts["sde"].check_state(x0)
    seen_shape(parts)
