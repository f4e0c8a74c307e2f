"""Exponential steps: what is linear is stepped by its exact law, what is not is held over the step.

    dX = (A X + β) dt + σ dW:
    X_{t+τ} | X_t ~ N(e^{Aτ} X_t + ∫₀^τ e^{Au} β du,  ∫₀^τ e^{Au} σσᵀ e^{Aᵀu} du)

The integrals are elementwise for a scalar or diagonal A, and by series and doubling otherwise.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._linalg import (
    add,
    apply,
    as_columns,
    compose,
    congruence,
    product,
    promote,
    semidefinite_cholesky,
    varying_like,
)
from .._types import RealScalar, State, Structured
from ._base import AffineStep, Transition

_TERMS = 22
"""Of the series, at a norm of at most 1."""
_DOUBLINGS = 20
"""Of the step: B dt up to 2^20."""
_ROOTS, _GAUSS = np.polynomial.legendre.leggauss(10)
_NODES = 0.5 + 0.5 * _ROOTS
_WEIGHTS = 0.5 * _GAUSS
"""Gauss–Legendre on [0, 1]: exact up to degree 19, so to the last digit for e^{sx} with |x| < 1."""


def _phi1(x: Array) -> Array:
    """φ₁(x) = (eˣ − 1)/x = ∫₀¹ e^{sx} ds, with its derivatives of every order.

    Those of the quotient lose their digits near 0, at 0 half their value; within 1 the integral by
    quadrature has them.
    """
    # Each branch gets harmless numbers where the other is taken.
    near = jnp.abs(x) < 1
    small = jnp.where(near, x, 0.0)
    large = jnp.where(near, 1.0, x)
    nodes, weights = (
        jnp.asarray(a, x.dtype).reshape((1,) * x.ndim + (-1,)) for a in (_NODES, _WEIGHTS)
    )
    integral = jnp.sum(weights * jnp.exp(nodes * small[..., None]), axis=-1)
    return jnp.where(near, integral, jnp.expm1(large) / large)


def _affine_flow(B: Array, beta: Array, a: Array, dt: RealScalar) -> tuple[Array, Array, Array]:
    """e^{Bτ} − 1, ∫₀^τ e^{Bu} β du and ∫₀^τ e^{Bu} a e^{Bᵀu} du at τ = dt.

    By Taylor series at dt/2^k, and k doublings. The block exponential of Van Loan (1978) holds
    e^{−Bτ} beside e^{Bτ} and loses the covariance of a stiff equation to cancellation, 0.1 at
    Bτ = 40; a doubling is a sum of covariances. To double e^{Bτ} − 1 keeps the digits that e^{Bτ}
    would lose in small steps. NaN where Bτ is beyond 2^20.
    """
    one = jnp.ones((), B.dtype)
    norm = jnp.max(jnp.sum(jnp.abs(B), axis=0)) * dt
    # A number of doublings has no derivative, and needs none: the result is the same for any.
    k = jnp.ceil(jnp.log2(jnp.maximum(jax.lax.stop_gradient(norm), one)))
    part = dt * 2.0**-k
    A = B * part
    beta = beta * part
    a = a * part

    def series(carry, j):
        # With part = 1: A^j / j!, A^j β / (j + 1)!, and of the covariance, whose derivative is
        # S' = a + A S + S Aᵀ, the coefficient C_j = (A C_{j−1} + C_{j−1} Aᵀ) / (j + 1).
        power, term, terms, totals = carry
        power = product(A, power) / j
        term = product(A, term) / (j + 1)
        rate = product(A, terms) / (j + 1)
        terms = rate + rate.T
        E, shift, S = totals
        return (power, term, terms, (E + power, shift + term, S + terms)), None

    start = (jnp.eye(B.shape[0], dtype=B.dtype), beta, a, (jnp.zeros_like(B), beta, a))
    start = varying_like(start, B, beta, a, dt)
    (*_, totals), _ = jax.lax.scan(series, start, jnp.arange(1, _TERMS + 1, dtype=B.dtype))

    def double(totals, i):
        # Twice the time, with E = e^{Bτ} − 1: e^{2Bτ} − 1 = 2E + E², and shift and S are those of
        # the second half plus those of the first carried through it, (1 + E) S (1 + E)ᵀ.
        E, shift, S = totals
        ES = product(E, S)
        doubled = (
            2 * E + product(E, E),
            2 * shift + product(E, shift),
            2 * S + ES + ES.T + product(ES, E.T),
        )
        return jax.tree.map(lambda new, old: jnp.where(i < k, new, old), doubled, totals), None

    # All doublings are computed and k of them kept: a loop of k, which is traced, has no reverse
    # mode.
    (E, shift, S), _ = jax.lax.scan(double, totals, jnp.arange(_DOUBLINGS, dtype=B.dtype))
    return jax.tree.map(lambda x: jnp.where(k <= _DOUBLINGS, x, jnp.nan), (E, shift, S))


def _psd_cholesky(S: Structured) -> Structured:
    """Cholesky factor of a covariance that may be singular, by a nugget of rounding errors."""
    if S.ndim < 2:
        return semidefinite_cholesky(S)
    # Relative to each diagonal entry: components of a stiff equation differ by many magnitudes.
    d = jnp.diagonal(S)
    eps = jnp.finfo(S.dtype).eps
    return semidefinite_cholesky(S + jnp.diag(4 * eps * d + 1e-24 * jnp.max(d)))


def flow(
    A: Structured, beta: State, a: Structured, dt: RealScalar
) -> tuple[Structured, State, Structured]:
    """e^{A dt} − 1, ∫ e^{Au} β du and ∫ e^{Au} a e^{Aᵀu} du over a step."""
    if A.ndim < 2:
        # ∫₀^dt e^{(A_i + A_j) u} a_ij du = dt φ₁((A_i + A_j) dt) a_ij, and ∫₀^dt e^{Au} du alike
        rate = A if a.ndim < 2 or A.ndim == 0 else 0.5 * (A[:, None] + A[None, :])
        mean_map = dt * _phi1(dt * A)
        return mean_map * A, apply(mean_map, beta), dt * _phi1(2 * dt * rate) * a
    a = promote(a, 2, A.shape[0])
    growth, shift, S = _affine_flow(A, beta if beta.ndim == 2 else beta[:, None], a, dt)
    return growth, shift.reshape(beta.shape), 0.5 * (S + S.T)


def exponential_transition(
    A: Structured, beta: State, noise: tuple[Structured, Structured], dt: RealScalar, x: State
) -> Transition:
    """The step from x, `noise` being σ and a = σσᵀ."""
    sigma, a = noise
    growth, shift, S = flow(A, beta, a, dt)
    increment = apply(growth, x) + shift
    if A.ndim == 0 or (A.ndim == 1 and sigma.ndim < 2):
        # σ times a positive number, smooth also where σ is 0, as a root of σ² is not
        factor = compose(jnp.sqrt(dt * _phi1(2 * dt * A)), sigma)
        return Transition(x, increment, factor, S)
    # A transition's covariance is that of its factor to the last digit, the nugget included: a
    # guide that is told another one would weigh steps that the factor does not make.
    factor = _psd_cholesky(S)
    return Transition(x, increment, factor, congruence(factor, jnp.ones((), x.dtype)))


def exponential_noise_size(A: Structured, sigma_shape: tuple[int, ...], x: State) -> int:
    """Number of noises that drive such a step."""
    return sigma_shape[1] if len(sigma_shape) == 2 and A.ndim == 0 else x.shape[0]


def affine_step(
    A: Structured, slope: Structured, beta: State, a: Structured, dt: RealScalar
) -> AffineStep:
    """The step of dX = (A X + slope X + β) dt + σ dW, in which slope X + β is held."""
    # X' = e^{A dt} X + ∫₀^dt e^{Au} du (slope X + β) + noise
    one = jnp.ones((), beta.dtype)
    if A.ndim < 2:
        growth, shift, S = flow(A, beta, a, dt)
        held = compose(dt * _phi1(dt * A), slope)
    else:
        # The integral acts on the columns of the slope as on those of β: one pass for both.
        columns = jnp.concatenate([promote(slope, 2, len(A)), as_columns(beta)], axis=1)
        growth, moved, S = flow(A, columns, a, dt)
        held = moved[:, : len(A)]
        shift = moved[:, len(A) :].reshape(beta.shape)
    return AffineStep(add(add(one, growth), held), shift, S)
