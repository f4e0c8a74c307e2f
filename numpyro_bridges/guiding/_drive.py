"""The hot line of a guided step, u = z + Aᵀ N⁻ᵀ (y − (N + P)⁻¹ A z) and log|P| − log|N|, with a derivative by hand.

With N Nᵀ = S, P Pᵀ = M, y = N⁻¹ r, g = (N + P)⁻¹ A z, h = y − g, w = N⁻ᵀ h, so u = z + Aᵀ w. Both factors enter only
through solves with a few columns, so their cotangents have low rank before the factorisation's own pullback,

    S̄ = N⁻ᵀ Φ(Nᵀ N̄) N⁻¹,      Φ the symmetric matrix with the lower half of its argument,

and Φ(Nᵀ N̄) needs no product of n × n matrices: the cotangent of a triangular solve may keep its upper half, which a
product with Nᵀ leaves above the diagonal. That is about half the cost of differentiating the factorisations one by one.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from .._linalg import cholesky, diagonal_matrix, full_precision, solve_lower


@jax.custom_vjp
def drive(
    A: Float[Array, "m k"],
    S: Float[Array, "m m"],
    M: Float[Array, "m m"],
    r: Float[Array, "m dim"],
    z: Float[Array, "k dim"],
) -> tuple[Float[Array, "k dim"], Float[Array, ""]]:
    """u, and log|P| − log|N| for one column."""
    return _forward(A, S, M, r, z)[0]


def _forward(A, S, M, r, z):
    N, P = cholesky(S), cholesky(M)
    g = solve_lower(N + P, A @ z)
    y = solve_lower(N, r)
    w = solve_lower(N, y - g, transposed=True)
    log_det = jnp.sum(jnp.log(jnp.diagonal(P))) - jnp.sum(jnp.log(jnp.diagonal(N)))
    u = z + A.T @ w
    # Under `vmap` both outputs are batched, or neither: a shared one would have its cotangent counted for each example.
    return (u, log_det + 0 * u[0, 0]), (A, N, P, z, y, g, w)


@full_precision
def _backward(residuals, cotangents):
    A, N, P, z, y, g, w = residuals
    u_bar, log_det_bar = cotangents
    h_bar = solve_lower(N, A @ u_bar)
    q_bar = -solve_lower(N + P, h_bar, transposed=True)
    r_bar = solve_lower(N, h_bar, transposed=True)
    left = jnp.concatenate([y - g, h_bar, N.T @ q_bar], axis=1)
    right = jnp.concatenate([h_bar, y, g], axis=1)
    S_bar = _pullback(N, -left @ right.T, -log_det_bar)
    M_bar = _pullback(P, -(P.T @ q_bar) @ g.T, log_det_bar)
    A_bar = jnp.concatenate([w, q_bar], axis=1) @ jnp.concatenate([u_bar, z], axis=1).T
    return A_bar, S_bar, M_bar, r_bar, u_bar + A.T @ q_bar


def _pullback(L, X, diagonal):
    """Cotangent of L Lᵀ from X = Lᵀ L̄, whose lower half counts, plus a multiple of the identity."""
    i = jnp.arange(L.shape[0])
    F = 0.5 * (jnp.where(i[:, None] >= i[None, :], X, X.T) + diagonal_matrix(diagonal, L.shape[0]))
    half = lax.linalg.triangular_solve(L, F, left_side=False, lower=True)
    return lax.linalg.triangular_solve(L, half.T, left_side=False, lower=True)


drive.defvjp(_forward, _backward)
