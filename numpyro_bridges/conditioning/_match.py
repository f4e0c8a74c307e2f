"""Observed values: exact, v = L X_T, and inexact, v = L X_T + N(0, Σ) with Σ from the H-norm."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import lineax as lx
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, PRNGKeyArray

from .._checks import (
    as_float,
    concrete,
    flag,
    known,
    require,
    require_finite,
    require_instance,
    require_positive,
    words,
)
from .._linalg import apply, cholesky, columns, congruence, diagonal, symmetric
from .._types import State, Structured
from ..sdes import AbstractSDE
from ..spaces import AbstractSpace
from ._base import AbstractCondition, AbstractMatch, Observation, Target, lift
from ._message import gaussian_log_density

_LOG_2PI = 1.8378770664093453


class _Seen(AbstractCondition):
    """A match at its datum."""

    match: "ExactMatch | InexactMatch | _Fused"
    observed: State
    num_extra_noises: ClassVar[int] = 0

    @property
    def exact(self) -> bool:
        return self.match.exact

    def check(self, sde, x):
        operator = self.match.operator
        n = x.shape[0]
        require(
            operator.ndim == 0 or operator.shape[-1] == n,
            f"`operator` must have {n} columns, as many as the state has rows; got shape "
            f"{operator.shape}.",
        )
        m = operator.shape[0] if operator.ndim == 2 else n
        shape = (m, *x.shape[1:])
        # Exactly: a datum with an axis more would broadcast against the state, and weigh a sum.
        require(
            self.observed.shape == shape,
            f"`observed` must have shape {shape} for a state {x.shape}; got {self.observed.shape}. "
            "Several observations need a batch: `vmap`, or a plate with one noise each.",
        )
        # What a match checks when it meets a state, without computing it.
        jax.eval_shape(lambda: self.match.observation(sde, x))

    def observation(self, sde, x):
        return self.match.observation(sde, x)

    def reference(self, sde, x):
        return lift(self.observation(sde, x).operator, x, self.observed)

    def displaced(self, shift):
        return _Seen(match=self.match, observed=self.observed - shift)

    def log_value(self, law_mean, law_factor):
        return gaussian_log_density(self.observed - law_mean, law_factor)

    def target(self, law_mean, law_factor, noise):
        return Target(self.observed, jnp.zeros((), self.observed.dtype))

    def noise_from_target(self, law_mean, law_factor, seen):
        return jnp.zeros((0, *seen.shape), seen.dtype)


class _Fused(eqx.Module):
    """Several inexact matches as one, known by what is seen with it."""

    seen: Observation
    exact: ClassVar[bool] = False

    @property
    def operator(self) -> Structured:
        return self.seen.operator

    def observation(self, sde: AbstractSDE, x: State) -> Observation:
        return self.seen


class ExactMatch(AbstractMatch):
    """The end state is seen without noise, v = L X_T: the first coordinates, some points, or all.

    There is no limit as the number of coordinates grows; it is part of the model.

    It needs noise in every direction that is seen, and an SDE that is known to have none is
    refused. Where a traced parameter takes the noise away (a scale that underflows), the log weight
    is −inf, the datum being out of reach, or NaN where it is met to the last digit: there is no
    density then.

    **Arguments:**

    - `operator`: L, `(m, n)` or a lineax operator; the identity if not given.
    - `mask`: `(n,)` booleans instead of `operator`: which rows are seen. It is a constant, inside a
      traced function too, since it says how many rows a datum has.
    """

    operator: Structured
    exact: ClassVar[bool] = True

    def __init__(self, operator=None, *, mask=None):
        if mask is not None:
            require(operator is None, "Give `operator` or `mask`, not both.")
            require(
                not _is_traced(mask),
                "`mask` of an exact match must be known when the program is traced; got a traced "
                "array. Give a NumPy array, or use InexactMatch.",
            )
            keep = _mask(mask)
            # An exact match has no variance to make infinite: what is hidden has no row.
            require(keep.any(), "`mask` must leave at least one row to be seen; got all False.")
            operator = np.eye(len(keep))[keep]
        self.operator = _operator(operator)

    def at(self, observed) -> AbstractCondition:
        """The condition L X_T = observed."""
        return _Seen(match=self, observed=_datum(observed))

    def observation(self, sde: AbstractSDE, x: State) -> Observation:
        return Observation(self.operator.astype(x.dtype), None, jnp.zeros((), x.dtype))

    def sample(self, key: PRNGKeyArray, sde: AbstractSDE, x: State) -> Array:
        return apply(self.operator, x)

    def check_density(self) -> None:
        pass


class InexactMatch(AbstractMatch):
    """The end state is seen with Gaussian noise of a given variance in the H-norm.

    Its density is proportional to exp(−‖L X_T − v‖²_H / 2 variance).

    With quadrature weights w the noise of point i has variance `variance / w_i`: on a curve of n
    points the same `variance` gives the same likelihood as n grows.

    **Arguments:**

    - `variance`: σ, positive: a number, or `(m,)` or `(m, m)` to be divided by the weights in the
      same way.
    - `operator`: L, `(m, n)` or a lineax operator; the identity if not given. An operator whose
      every row is a row of the identity, a selection of points, keeps their weights; any other is
      seen in the Euclidean norm of R^m. Its values say which it is, wherever the match is built.
    - `mask`: `(n,)` booleans instead of `operator`: which rows are seen. The datum's other rows are
      ignored.
    - `space`: whose weights to use; the SDE's if not given, Euclidean where it has none. A space
      with one weight for each row that an operator sees gives those rows its weights.
    - `normalised`: `True` is the Lebesgue density of the observation. `False` is the kernel itself,
      whose expectation has a limit as n → ∞; it is no density, so distributions refuse it.

    `InexactMatch.from_point_sd(sd, space)` takes the standard deviation of one point's coordinate
    instead.
    """

    variance: Structured
    operator: Structured
    mask: Bool[Array, " n"] | None
    space: AbstractSpace | None
    normalised: bool = eqx.field(static=True)
    exact: ClassVar[bool] = False

    def __init__(
        self,
        variance,
        operator=None,
        space: AbstractSpace | None = None,
        normalised: bool = True,
        *,
        mask=None,
    ):
        require(operator is None or mask is None, "Give `operator` or `mask`, not both.")
        self.variance = as_float(variance, "variance")
        shape = self.variance.shape
        require(
            len(shape) < 2 or shape == shape[:1] * 2,
            f"`variance` must be a number, (m,) or a matrix (m, m); got shape {shape}.",
        )
        if space is not None:
            require_instance(
                space, AbstractSpace, "space", "a space, whose weights to use, or left out"
            )
        if self.variance.ndim < 2:
            require_positive(
                self.variance, "variance", "For an observation without noise use ExactMatch."
            )
        elif concrete(self.variance) is not None:
            # The factorisation reads one triangle only, so symmetry is asked for by itself.
            factor = cholesky(self.variance)
            require(
                jnp.all(jnp.isfinite(factor)) & jnp.allclose(self.variance, self.variance.T),
                "`variance` must be a symmetric, positive definite matrix; its Cholesky "
                "factorisation fails. Observe fewer combinations, or add a small multiple of the "
                "identity.",
            )
        self.mask = None if mask is None else jnp.asarray(_mask(mask))
        self.operator = _operator(operator)
        self.space = space
        self.normalised = flag(normalised, "normalised")

    @classmethod
    def from_point_sd(cls, sd, space: AbstractSpace, **kwargs) -> "InexactMatch":
        """From the standard deviation of one coordinate of one point, of average weight.

        variance = sd² · mean(w).
        """
        sd = as_float(sd, "sd")
        require_positive(sd, "sd", "For an observation without noise use ExactMatch.")
        require_instance(
            space, AbstractSpace, "space", "a space, whose weights say how far a point counts"
        )
        return cls(sd**2 * jnp.mean(space.weights), space=space, **kwargs)

    def at(self, observed) -> AbstractCondition:
        """The condition that `observed` was seen."""
        return _Seen(match=self, observed=_datum(observed, self.mask))

    def _weights(self, sde: AbstractSDE, x: State) -> Array | None:
        """One weight for each row that is seen; `None` in Euclidean space."""
        space = sde.space if self.space is None else self.space
        if space is None:
            return None
        weights = space.weights.astype(x.dtype)
        n = x.shape[0]
        m = self.operator.shape[0] if self.operator.ndim == 2 else n
        own = self.space is not None and weights.shape == (m,)
        require(
            own or weights.shape == (n,),
            f"`space` must have one weight per row of the state, {n}, or per observed row, {m}; "
            f"got {weights.shape}.",
        )
        if self.operator.ndim == 0:
            return weights
        others = weights if own else jnp.ones((m,), x.dtype)
        if weights.shape != (n,):
            return others
        # A selection of points keeps their weights. By `where` and no `if`: an operator may be
        # traced, and means the same then.
        picked = self.operator == 1
        is_binary = jnp.all(picked | (self.operator == 0))
        is_selection = is_binary & jnp.all(jnp.sum(picked, axis=1) == 1)
        kept = jnp.sum(jnp.where(picked, weights[None], 0.0), axis=1)
        return jnp.where(is_selection, kept, others)

    def _factor(self, sde: AbstractSDE, x: State) -> Structured:
        """P with P Pᵀ = W^{-½} variance W^{-½}: in the H-norm a row counts by its weight."""
        m = self.operator.shape[0] if self.operator.ndim == 2 else x.shape[0]
        variance = symmetric(self.variance.astype(x.dtype))
        require(
            variance.ndim == 0 or variance.shape[0] == m,
            f"`variance` must be a scalar or have {m} rows, one per observed row; got shape "
            f"{variance.shape}.",
        )
        weights = self._weights(sde, x)
        if weights is not None:
            if variance.ndim:
                variance = congruence(1 / jnp.sqrt(weights), variance)
            else:
                variance = variance / weights
        return cholesky(variance)

    def observation(self, sde: AbstractSDE, x: State) -> Observation:
        factor = self._factor(sde, x)
        operator = self.operator.astype(x.dtype)
        m = operator.shape[0] if operator.ndim == 2 else x.shape[0]
        # ½ log 2π + log P_ii of each row: what makes exp(−½ |P⁻¹ r|²) a density. `log_scale` gives
        # it back where there is to be none: for the kernel, and for rows that a mask hides, which
        # the operator sees as 0 with the datum 0.
        rows = jnp.full((m,), 0.5 * _LOG_2PI, x.dtype) + jnp.log(diagonal(factor, m))
        if self.mask is not None:
            require(
                self.mask.shape == (m,) and factor.ndim < 2,
                f"`mask` must have shape {(m,)} and go with independent noise; got "
                f"{self.mask.shape}.",
            )
            operator = self.mask.astype(x.dtype)
            rows = jnp.where(self.mask, 0.0, rows) if self.normalised else rows
        elif self.normalised:
            rows = jnp.zeros_like(rows)
        return Observation(operator, factor, columns(x) * jnp.sum(rows))

    def sample(self, key: PRNGKeyArray, sde: AbstractSDE, x: State) -> Array:
        mean = apply(self.operator, x)
        noise = jr.normal(key, mean.shape, mean.dtype)
        return mean + apply(self._factor(sde, x), noise)

    def check_density(self) -> None:
        require(
            self.normalised,
            "`normalised=False` is a kernel and no density of what is sampled, so it cannot be a "
            "likelihood: use `normalised=True` here, and `normalised=False` with `GuidedBridge` "
            "and `estimate_evidence`.",
        )


def _operator(operator) -> Structured:
    """L as an array; the identity is the scalar 1."""
    if operator is None:
        return jnp.ones(())
    if isinstance(operator, lx.AbstractLinearOperator):
        operator = operator.as_matrix()
    value = known(operator, "operator")
    operator = as_float(operator, "operator")
    require(
        operator.ndim == 2,
        "`operator` must be a matrix (m, n) with one row per observed value; got shape "
        f"{operator.shape}.",
    )
    require(
        operator.size >= 1,
        f"`operator` must see at least one value of at least one row; got {operator.shape}.",
    )
    if value is not None:
        require_finite(value, "operator")
        # Of dependent rows a datum is impossible, or one of them tells nothing.
        require(
            np.linalg.matrix_rank(value) == len(value),
            f"`operator` must have independent rows; its rank is below its {operator.shape[0]} "
            "rows. Remove repeated observations.",
        )
    return operator


def _is_traced(mask) -> bool:
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(mask))


def _mask(mask) -> Array | np.ndarray:
    """Which rows are seen, as booleans: a NumPy array unless it is traced."""
    try:
        value = jnp.asarray(mask) if _is_traced(mask) else np.asarray(mask)
    except (TypeError, ValueError):  # lists of several lengths, random keys
        value = np.zeros(1)
    require(
        value.ndim == 1,
        f"`mask` must be a vector (n,), one entry for each row; got shape {value.shape}.",
    )
    require(
        value.dtype == bool,
        f"`mask` must hold booleans, True where a row is seen; got {words(mask)}. From indices: "
        "`numpy.isin(numpy.arange(n), indices)`; from zeros and ones: `numpy.asarray(mask) == 1`.",
    )
    return value


def _datum(observed, mask=None) -> State:
    """The observed value; missing entries are allowed where a mask hides them."""
    v = as_float(observed, "observed")
    if mask is not None:
        require(
            v.shape[:1] == mask.shape,
            f"`observed` must have {mask.shape[0]} rows, like `mask`; got shape {v.shape}.",
        )
        # 0 is what the operator of a mask makes of a hidden row; a NaN would stay one in 0 · NaN.
        v = jnp.where(mask.reshape(mask.shape + (1,) * (v.ndim - 1)), v, 0.0)
    require_finite(
        v, "observed", "Missing points are declared by `mask=` or left out by `operator=`."
    )
    return v
