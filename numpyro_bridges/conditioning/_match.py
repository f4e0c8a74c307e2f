"""Observed values: exact, v = L X_T, and inexact, v = L X_T + N(0, Σ) with Σ from the H-norm."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import lineax as lx
import numpy as np
from jaxtyping import Array, Bool, PRNGKeyArray

from .._checks import as_float, concrete, require, require_finite, require_instance, require_positive
from .._linalg import apply, cholesky, columns, congruence, diagonal, solve_lower, symmetric
from .._types import State, Structured
from ..sdes import AbstractSDE
from ..spaces import AbstractSpace
from ._base import AbstractCondition, AbstractMatch, Observation, Target, lift
from ._message import whitened_log_density

_LOG_2PI = 1.8378770664093453


class _Seen(AbstractCondition):
    """A match at its datum."""

    match: "ExactMatch | InexactMatch"
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
            f"`operator` must have {n} columns, as many as the state has rows; got shape {operator.shape}.",
        )
        m = operator.shape[0] if operator.ndim == 2 else n
        shape = (m, *x.shape[1:])
        require(
            self.observed.shape == shape,
            f"`observed` must have shape {shape} for a state {x.shape}; got {self.observed.shape}. "
            "Several observations need a batch: `vmap`, or a plate with one noise each.",
        )
        jax.eval_shape(lambda: self.match.observation(sde, x))

    def observation(self, sde, x):
        return self.match.observation(sde, x)

    def reference(self, sde, x):
        return lift(self.observation(sde, x).operator, x, self.observed)

    def log_value(self, law_mean, law_factor):
        return whitened_log_density(solve_lower(law_factor, self.observed - law_mean), law_factor)

    def target(self, law_mean, law_factor, noise):
        return Target(self.observed, jnp.zeros((), self.observed.dtype))

    def noise_from_target(self, law_mean, law_factor, seen):
        return jnp.zeros((0, *seen.shape), seen.dtype)


class ExactMatch(AbstractMatch):
    """The end state is seen without noise, v = L X_T: the first coordinates, some points, or all.

    There is no limit as the number of coordinates grows; it is part of the model.

    **Arguments:**

    - `operator`: L, `(m, n)` or a lineax operator; the identity if not given.
    - `mask`: `(n,)` booleans instead of `operator`: which rows are seen (known when the program is traced).
    """

    operator: Structured
    exact: ClassVar[bool] = True

    def __init__(self, operator=None, *, mask=None):
        if mask is not None:
            require(operator is None, "Give `operator` or `mask`, not both.")
            keep = concrete(mask)
            if keep is None:
                raise ValueError("`mask` of an exact match must be known when the program is traced; use InexactMatch.")
            keep = _mask(keep)
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
    """The end state is seen with Gaussian noise of a given variance in the H-norm, exp(−‖L X_T − v‖²_H / 2 variance).

    With quadrature weights w the noise of point i has variance `variance / w_i`: on a curve of n points the same
    `variance` gives the same likelihood as n grows.

    **Arguments:**

    - `variance`: σ, positive: a number, or `(m,)` or `(m, m)` to be divided by the weights in the same way.
    - `operator`: L, `(m, n)` or a lineax operator; the identity if not given. Rows of the identity (a selection of
      points) keep their points' weights; any other operator is seen in the Euclidean norm of R^m.
    - `mask`: `(n,)` booleans instead of `operator`: which rows are seen. The datum's other rows are ignored.
    - `space`: whose weights to use; the SDE's if not given, Euclidean where it has none.
    - `normalised`: `True` is the Lebesgue density of the observation. `False` is the kernel itself, whose expectation
      has a limit as n → ∞; it is no density, so distributions refuse it.

    `InexactMatch.from_point_sd(sd, space)` takes the standard deviation of one point's coordinate instead.
    """

    variance: Structured
    operator: Structured
    mask: Bool[Array, " n"] | None
    space: AbstractSpace | None
    normalised: bool = eqx.field(static=True)
    selected: tuple[int, ...] | None = eqx.field(static=True)
    exact: ClassVar[bool] = False

    def __init__(
        self, variance, operator=None, space: AbstractSpace | None = None, normalised: bool = True, *, mask=None
    ):
        require(operator is None or mask is None, "Give `operator` or `mask`, not both.")
        self.variance = as_float(variance, "variance")
        shape = self.variance.shape
        require(
            len(shape) < 2 or shape == shape[:1] * 2,
            f"`variance` must be a number, (m,) or a matrix (m, m); got shape {shape}.",
        )
        if space is not None:
            require_instance(space, AbstractSpace, "space", "a space, whose weights to use, or left out")
        if self.variance.ndim < 2:
            require_positive(self.variance, "variance", "For an observation without noise use ExactMatch.")
        elif concrete(self.variance) is not None:
            factor = cholesky(self.variance)
            require(
                jnp.all(jnp.isfinite(factor)) & jnp.allclose(self.variance, self.variance.T),
                "`variance` must be a symmetric, positive definite matrix; its Cholesky factorisation fails. "
                "Observe fewer combinations, or add a small multiple of the identity.",
            )
        self.mask = None if mask is None else _mask(mask)
        self.operator = _operator(operator)
        self.selected = _selection(self.operator)
        self.space = space
        self.normalised = bool(normalised)

    @classmethod
    def from_point_sd(cls, sd, space: AbstractSpace, **kwargs) -> "InexactMatch":
        """From the standard deviation of one coordinate of one point (of average weight): variance = sd² · mean(w)."""
        sd = as_float(sd, "sd")
        require_positive(sd, "sd", "For an observation without noise use ExactMatch.")
        require_instance(space, AbstractSpace, "space", "a space, whose weights say how far a point counts")
        return cls(sd**2 * jnp.mean(space.weights), space=space, **kwargs)

    def at(self, observed) -> AbstractCondition:
        """The condition that `observed` was seen."""
        return _Seen(match=self, observed=_datum(observed, self.mask))

    def _factor(self, sde: AbstractSDE, x: State) -> Structured:
        space = sde.space if self.space is None else self.space
        m = self.operator.shape[0] if self.operator.ndim == 2 else x.shape[0]
        weights = None if space is None else space.weights.astype(x.dtype)
        if weights is not None and self.operator.ndim == 2 and (self.space is None or weights.shape != (m,)):
            weights = None if self.selected is None else weights[jnp.array(self.selected)]
        variance = symmetric(self.variance.astype(x.dtype))
        require(
            variance.ndim == 0 or variance.shape[0] == m,
            f"`variance` must be a scalar or have {m} rows, one per observed row; got shape {variance.shape}.",
        )
        require(
            weights is None or weights.shape == (m,),
            f"`space` must have one weight per observed row, {m}; got {None if weights is None else weights.shape}.",
        )
        if weights is not None:
            variance = congruence(1 / jnp.sqrt(weights), variance) if variance.ndim else variance / weights
        return cholesky(variance)

    def observation(self, sde: AbstractSDE, x: State) -> Observation:
        factor = self._factor(sde, x)
        operator = self.operator.astype(x.dtype)
        m = operator.shape[0] if operator.ndim == 2 else x.shape[0]
        rows = jnp.full((m,), 0.5 * _LOG_2PI, x.dtype) + jnp.log(diagonal(factor, m))
        if self.mask is not None:
            require(
                self.mask.shape == (m,) and factor.ndim < 2,
                f"`mask` must have shape {(m,)} and go with independent noise; got {self.mask.shape}.",
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
            "`normalised=False` is a kernel and no density of what is sampled, so it cannot be a likelihood: "
            "use `normalised=True` here, and `normalised=False` with `GuidedBridge` and `estimate_evidence`.",
        )


def _operator(operator) -> Structured:
    """L as an array; the identity is the scalar 1."""
    if operator is None:
        return jnp.ones(())
    if isinstance(operator, lx.AbstractLinearOperator):
        operator = operator.as_matrix()
    operator = as_float(operator, "operator")
    require(
        operator.ndim == 2,
        f"`operator` must be a matrix (m, n) with one row per observed value; got shape {operator.shape}.",
    )
    require_finite(operator, "operator")
    value = concrete(operator)
    require(
        value is None or np.linalg.matrix_rank(value) == len(value),
        f"`operator` must have independent rows; its rank is below its {operator.shape[0]} rows. "
        "Remove repeated observations.",
    )
    return operator


def _mask(mask) -> Array:
    """Which rows are seen, as booleans."""
    value = concrete(mask)
    shape = np.shape(mask) if value is None else value.shape
    require(len(shape) == 1, f"`mask` must be a vector (n,), one entry for each row; got shape {shape}.")
    require(
        value is None or np.all((value == 0) | (value == 1)),
        f"`mask` must hold booleans, True where a row is seen; got {value}.",
    )
    return jnp.asarray(mask, bool) if value is None else jnp.asarray(value.astype(bool))


def _selection(operator: Structured) -> tuple[int, ...] | None:
    """The rows of the identity that the operator consists of, if it does."""
    value = concrete(operator)
    if value is None or value.ndim < 2 or not np.all((value == 0) | (value == 1)) or not np.all(value.sum(1) == 1):
        return None
    return tuple(int(i) for i in value.argmax(1))


def _datum(observed, mask=None) -> State:
    """The observed value; missing entries are allowed where a mask hides them."""
    v = as_float(observed, "observed")
    if mask is not None:
        require(
            v.shape[:1] == mask.shape, f"`observed` must have {mask.shape[0]} rows, like `mask`; got shape {v.shape}."
        )
        v = jnp.where(mask.reshape(mask.shape + (1,) * (v.ndim - 1)), v, 0.0)
    require_finite(v, "observed", "Missing points are declared by `mask=` or left out by `operator=`.")
    return v
