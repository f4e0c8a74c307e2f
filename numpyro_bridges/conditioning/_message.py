"""A Gaussian message: a linear observation with Gaussian noise, as a function of the state.

    h(x) = exp(log_scale) N(v; L x + shift, P Pᵀ ⊗ I_dim)

This covariance form holds what a backward filter passes on: it stays finite for exact observations
(P = 0) and costs no more than the information form h(x) = exp(c + Fᵀx − ½ xᵀHx), since L has at
most as many rows as the state. Any Gaussian message, of any rank, has it: with H = RᵀR take L = R,
P = 1.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._linalg import (
    apply,
    columns,
    filled,
    log_diagonal,
    promote,
    rows,
    solve_lower,
    transpose,
    without_variance,
)
from .._types import State, Structured

_LOG_2PI = 1.8378770664093453


class GaussianMessage(eqx.Module):
    """h(x) = exp(log_scale) N(observed; operator x + shift, factor factorᵀ)."""

    operator: Structured
    shift: State
    factor: Structured
    observed: State
    log_scale: Float[Array, ""]

    def residual(self, x: State) -> State:
        """P⁻¹ (v − L x − shift)."""
        return solve_lower(self.factor, self.observed - self.shift - apply(self.operator, x))

    def log_value(self, x: State) -> Float[Array, ""]:
        """log h(x)."""
        # Not by `residual`: where P has no variance the density asks for the difference itself.
        difference = self.observed - self.shift - apply(self.operator, x)
        return self.log_scale + gaussian_log_density(difference, self.factor)

    def score(self, x: State) -> State:
        """∇ log h(x) = Lᵀ (P Pᵀ)⁻¹ (v − L x − shift)."""
        pull = solve_lower(self.factor, self.residual(x), transposed=True)
        return apply(transpose(self.operator), pull)

    def information(self, n: int) -> tuple[Float[Array, "n n"], State, Float[Array, ""]]:
        """H, F and c with log h(x) = c + Fᵀx − ½ xᵀHx, for states of n rows."""
        m = self.observed.shape[0]
        # H = (P⁻¹ L)ᵀ (P⁻¹ L) and F = (P⁻¹ L)ᵀ P⁻¹ (v − shift); c is log h(0).
        root = solve_lower(promote(self.factor, 2, m), promote(self.operator, 2, n))
        v = solve_lower(self.factor, self.observed - self.shift)
        return root.T @ root, root.T @ v, self.log_scale + whitened_log_density(v, self.factor)


def gaussian_log_density(r: State, factor: Structured) -> Float[Array, ""]:
    """log N(r; 0, P Pᵀ); −inf where a coordinate of r has no variance and is not 0."""
    # A factor without variance has a row of zeros there; with 1 on its diagonal the solve goes
    # through, and the other coordinates do not feel it.
    empty = without_variance(factor)
    factor = filled(factor, empty)
    return where_possible(r, empty, whitened_log_density(solve_lower(factor, r), factor))


def where_possible(r: State, empty: Array, log_value: Float[Array, ""]) -> Float[Array, ""]:
    """A log density of r, whose coordinates have no variance where `empty`, by `without_variance`.

    If one of those is not 0 there is no such r, and the density is 0. If it is 0 there is no
    density: NaN.
    """
    there = empty if empty.ndim == 0 else rows(empty, r)
    impossible = jnp.any(there & (r != 0))
    return jnp.where(impossible, -jnp.inf, jnp.where(jnp.any(empty), jnp.nan, log_value))


def whitened_log_density(y: State, factor: Structured) -> Float[Array, ""]:
    """log N(r; 0, P Pᵀ) from y = P⁻¹ r."""
    m = y.shape[0]
    dim = columns(y)
    # All columns share P, so its determinant counts `dim` times.
    return -0.5 * jnp.sum(y * y) - dim * (log_diagonal(factor, m) + 0.5 * m * _LOG_2PI)
