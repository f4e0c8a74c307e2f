"""Several observations of one state as one.

A product of Gaussian densities is a constant and one Gaussian density of the same state,

    Π_i N(v_i; L_i x, Σ_i) = exp(c) N(v; L x, Σ).

Where all rows have one match, v is the mean of r values and Σ = Σ_1 / r. Where errors are
independent, v is the mean weighted by precision. In general v = R⁻¹ Σ_i L_iᵀ Σ_i⁻¹ v_i, L = Rᵀ and
Σ = 1, with R Rᵀ = Σ_i L_iᵀ Σ_i⁻¹ L_i. The constant is that of any one state, such as one near the
data, where no density is small.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._linalg import apply, cholesky, rows, solve_lower
from .._types import State
from ..sdes import AbstractSDE
from ._base import AbstractCondition, Observation
from ._match import InexactMatch, _Fused, _Seen
from ._message import GaussianMessage, gaussian_log_density


def fused(
    match: InexactMatch,
    values: Float[Array, "rows m *dim"],
    sizes: tuple[int, ...],
    own: bool,
    sde: AbstractSDE,
    x: State,
) -> AbstractCondition:
    """For each of several states one condition, along a leading axis.

    **Arguments:** `values`: first `sizes[0]` observations of the first state, then `sizes[1]` of
    the second, and so on; `match`: an inexact one, the same for all, or `own`, one for each value
    along a leading axis; `x`: a state.
    """
    owner = np.repeat(np.arange(len(sizes)), sizes)
    # `at` fills in what a mask hides; data were checked before.
    values = jax.vmap(lambda match, v: match.at(v).observed, in_axes=(0 if own else None, 0))(
        match, values
    )

    def total(a: Array) -> Array:
        return jnp.zeros((len(sizes), *a.shape[1:]), a.dtype).at[owner].add(a)

    if not own:
        seen = match.observation(sde, x)
        return _of_one_match(seen, values, owner, np.array(sizes), total)
    seen = jax.vmap(lambda match: match.observation(sde, x))(match)
    assert seen.factor is not None
    is_diagonal = max(seen.operator.ndim, seen.factor.ndim) - 1 < 2
    return (_independent if is_diagonal else _dense)(seen, values, owner, total, x)


def _of_one_match(
    seen: Observation, values, owner, sizes, total: Callable[[Array], Array]
) -> AbstractCondition:
    """v is the mean of r values, Σ = Σ_1 / r, and the constant is had where L x is that mean."""
    count = jnp.asarray(sizes, values.dtype)
    one_factor = seen.factor
    assert one_factor is not None
    mean = total(values) / rows(count, values)

    def log_density(r):
        return gaussian_log_density(r, one_factor) + seen.log_scale

    density = jax.vmap(log_density)(values - mean[owner])
    factor = jax.vmap(lambda r: one_factor / jnp.sqrt(r))(count)
    constant = total(density) - jax.vmap(gaussian_log_density)(jnp.zeros_like(mean), factor)
    operator = jnp.broadcast_to(seen.operator, (len(sizes), *seen.operator.shape))
    return _Seen(_Fused(Observation(operator, factor, constant)), mean)


def _independent(
    seen: Observation, values, owner, total: Callable[[Array], Array], x: State
) -> AbstractCondition:
    """A precision for each row of a state; it is 0 where nothing is seen."""
    assert seen.factor is not None
    ndim = max(seen.operator.ndim, seen.factor.ndim)
    operator, factor = (
        a.reshape(a.shape + (1,) * (ndim - a.ndim)) for a in (seen.operator, seen.factor)
    )
    # Diagonal operators are masks, of zeros and ones: L v = v where something is seen.
    precision = (operator / factor) ** 2
    together = total(precision)
    there = together > 0
    # Where nothing is seen the operator is 0, and any variance will do.
    together = jnp.where(there, together, 1.0)
    weighted = total(jax.vmap(apply)(precision, values))
    mean = jax.vmap(lambda h, f: apply(1 / h, f))(together, weighted)
    zeros = jnp.zeros(len(together), x.dtype)
    fused_seen = Observation(there.astype(x.dtype), 1 / jnp.sqrt(together), zeros)
    return _with_constant(seen, values, owner, total, fused_seen, mean, mean)


def _dense(
    seen: Observation, values, owner, total: Callable[[Array], Array], x: State
) -> AbstractCondition:
    """v = R⁻¹ F and L = Rᵀ with R Rᵀ = H = Σ_i L_iᵀ Σ_i⁻¹ L_i, F = Σ_i L_iᵀ Σ_i⁻¹ v_i."""
    n = x.shape[0]
    one = jnp.ones((), x.dtype)
    # Operators may leave directions open, where H has no factor without it.
    nugget = 10 * n * jnp.finfo(x.dtype).eps if seen.operator.ndim == 3 else 0.0

    def information(operator, factor, v):
        H, F, _ = GaussianMessage(operator, jnp.zeros_like(v), factor, v, 0 * one).information(n)
        return H, F.reshape(x.shape)

    def root(H):
        jitter = nugget * jnp.max(jnp.diagonal(H)) * jnp.eye(n, dtype=x.dtype)
        return cholesky(H + jitter)

    def pull(around):
        """H, and F of the residuals at a state, which is small near the data."""
        residual = values - jax.vmap(apply)(seen.operator, around[owner])
        return jax.tree.map(total, jax.vmap(information)(seen.operator, seen.factor, residual))

    start = jnp.broadcast_to(x, (owner[-1] + 1, *x.shape))
    H, F = pull(start)
    R = jax.vmap(root)(H)
    # H⁻¹ F leads to the best state. From there F is nearly 0, and v = R⁻¹ F + Rᵀ y keeps digits
    # that a sum of large values would lose.
    near = start + jax.vmap(lambda R, F: solve_lower(R, solve_lower(R, F), transposed=True))(R, F)
    _, F = pull(near)
    operator = R.transpose(0, 2, 1)
    value = jax.vmap(lambda R, F, y: solve_lower(R, F) + R.T @ y)(R, F, near)
    ones = jnp.ones(len(R), x.dtype)
    return _with_constant(
        seen, values, owner, total, Observation(operator, ones, 0 * ones), value, near
    )


def _with_constant(
    seen: Observation, values, owner, total, one: Observation, value, near: State
) -> AbstractCondition:
    """`one` with the constant that makes it the product at the states `near`, hence anywhere."""

    def log_density(seen, v, x):
        return gaussian_log_density(v - apply(seen.operator, x), seen.factor) + seen.log_scale

    product = total(jax.vmap(log_density)(seen, values, near[owner]))
    constant = product - jax.vmap(log_density)(one, value, near)
    return _Seen(_Fused(Observation(one.operator, one.factor, constant)), value)
