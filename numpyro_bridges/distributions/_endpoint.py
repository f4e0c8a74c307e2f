"""The law of what is seen of a diffusion at a later time.

`sample` simulates the SDE and observes its end. `log_prob(v)`, with standard normal noise z bound, is the log weight of
the guided bridge to v, so that

    E[exp log_prob(v | z)] = p(v | x0),    z ~ N(0, I),

p being the density that `sample` draws from: N(z; 0, I) exp(log_prob(v | z)) is an exact data augmentation.
"""

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

from .._checks import as_float, require, require_finite
from .._types import RealScalar, State
from ..bridges import GuidedBridge
from ..conditioning import AbstractMatch
from ..guiding import AbstractGuide, time_grid
from ..sdes import AbstractSDE, simulate
from ._batch import find_batched, one_of
from ._noise_driven import AbstractNoiseDriven


class DiffusionEndpoint(AbstractNoiseDriven):
    """The law of an observation, at t1, of a diffusion that starts at x0.

    **Arguments:**

    - `sde`: an `AbstractSDE`.
    - `x0`: `(n, dim)` or `(n,)`.
    - `match`: how the end state is seen, an `ExactMatch`, `InexactMatch` or `IntervalCensored`; the datum is `obs=`.
    - `t1`, `t0`, `num_steps`, `ts`, `guide`: as for `GuidedBridge`.
    - `batch_shape`: leading axes of a batch of laws with starts or SDEs of their own. Exchangeable data need none: a
      plate is enough. With `batch_shape=(B,)`, `x0` may be `(B, n, dim)`, and `sde`, `match` and `guide` may be what
      `jax.vmap` of a constructor returns, every array with the batch axis in front. All else is shared.
    - `batched`: names of the parts that carry it, such as `("sde", "x0")`; by default found from the shapes, where they
      leave no doubt.

    **Shapes:** `event_shape` is that of an observation, `(m, dim)` or `(m,)`. `IntervalCensored` observes numbers of
    bins, held as floats. The noise of a datum has shape `(num_steps, k, dim)`.

    **Errors:** `ValueError` for every other leading axis, for kernels that are no densities (`normalised=False`), for
    data that are not finite, for more data than noises, and for `log_prob` without noise.
    """

    def __init__(
        self,
        sde: AbstractSDE,
        x0: State,
        match: AbstractMatch,
        *,
        t1: RealScalar | None = None,
        num_steps: int | None = None,
        t0: RealScalar = 0.0,
        ts=None,
        guide: AbstractGuide | None = None,
        batch_shape: tuple[int, ...] = (),
        batched: tuple[str, ...] | None = None,
        validate_args: bool | None = None,
    ):
        require(
            isinstance(match, AbstractMatch),
            f"`match` must be a model of observation, such as `InexactMatch(variance)`; got {type(match).__name__}. "
            "The datum is given to the site, `obs=`.",
        )
        match.check_density()
        x0 = as_float(x0, "x0")
        require_finite(x0, "x0")
        batch_shape = tuple(batch_shape)
        parts = {"sde": sde, "x0": x0, "match": match, "guide": guide}
        names = find_batched(parts, batch_shape, batched, _check)
        one = one_of(parts, names, batch_shape, (0,) * len(batch_shape))
        datum = jnp.zeros(_seen(one).shape)
        exact = one["match"].at(datum).exact
        parts["ts"] = one["ts"] = time_grid(t0, t1, num_steps, ts, graded=exact)
        noise_shape = _bridge(one, datum).noise_shape
        declared = batched is not None
        super().__init__(parts, names, declared, batch_shape, datum.shape, noise_shape, validate_args)

    def path(self, observed):
        """The bridges to `observed` that the bound noise drives, batch axes and then `(num_steps + 1, n, dim)`.

        NaN where the law is masked: the datum says nothing of that path, and no bridge leads to it.
        """
        require(self.noise is not None, "`path` needs the noise: use `law.given(noise)`.")
        self._check_value(observed)
        observed = jnp.broadcast_to(observed, self.shape())
        path = self._over_batch(_path, self._full_shape, observed, self.noise)
        if self._mask is None:
            return path
        return jnp.where(self._mask.reshape(self._full_shape + (1,) * (path.ndim - self._mask.ndim)), path, jnp.nan)

    @staticmethod
    def _observe(parts, key):
        key_path, key_seen = jr.split(key)
        return parts["match"].sample(key_seen, parts["sde"], _free_path(parts, key_path)[-1])

    @staticmethod
    def _simulate(parts, key):
        key_path, key_seen = jr.split(key)
        path = _free_path(parts, key_path)
        seen = parts["match"].sample(key_seen, parts["sde"], path[-1])
        return seen, _bridge(parts, seen).noise_from_path(path, jr.fold_in(key, 2))

    @staticmethod
    def _log_weight(parts, value, noise):
        return _bridge(parts, value).log_weight(noise)

    @staticmethod
    def _placeholder(parts, value):
        return parts["match"].sample(jr.key(0), parts["sde"], parts["x0"]).astype(value.dtype)

    @staticmethod
    def _check_data(parts, values):
        """Entries are checked one by one, so that many data are one datum with many columns."""
        rows = np.moveaxis(values, 0, -1)
        parts["match"].at(rows.reshape(len(rows), -1) if len(values) > 1 else values[0])


def _bridge(parts, value) -> GuidedBridge:
    condition = parts["match"].at(value)
    return GuidedBridge(parts["sde"], condition, x0=parts["x0"], ts=parts["ts"], guide=parts["guide"])


def _path(parts, value, noise):
    return _bridge(parts, value).path(noise)


def _free_path(parts, key):
    sde, x0, ts = parts["sde"], parts["x0"], parts["ts"]
    shape = (len(ts) - 1, sde.noise_size(x0), x0.shape[1] if x0.ndim == 2 else 1)
    return simulate(sde, x0, ts, jr.normal(key, shape, x0.dtype))


def _seen(parts):
    """Shape of what is seen, by tracing one step and its observation."""

    def seen(key):
        sde, x0 = parts["sde"], parts["x0"]
        return parts["match"].sample(key, sde, sde.transition(jnp.zeros(()), jnp.ones(()), x0).mean)

    return jax.eval_shape(seen, jr.key(0))


def _check(parts):
    """Raises unless the parts make one law."""
    x0 = parts["x0"]
    require(
        x0.ndim in (1, 2),
        f"`x0` must be one state, (n, dim) or (n,); got shape {x0.shape}. Declare a batch of starts by `batch_shape`.",
    )
    parts["sde"].check_state(x0)
    _seen(parts)
