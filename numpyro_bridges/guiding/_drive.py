"""The hot line of a guided step, u = z + Aᵀ N⁻ᵀ (y − (N + P)⁻¹ A z) and log|P| − log|N|, with a
derivative by hand.

With N Nᵀ = S, P Pᵀ = M, y = N⁻¹ r, g = (N + P)⁻¹ A z, h = y − g, w = N⁻ᵀ h, so u = z + Aᵀ w. A
factor changes by

    dN = N F,      F = Φ(N⁻¹ dS N⁻ᵀ),      Φ the lower half of its argument, half of the diagonal,

and F enters only through products with a few columns. So in reverse mode, which JAX gets from this
rule by transposition, the cotangent of F has low rank before the two triangular solves that lead
from F to S: no product of n × n matrices, about half the cost of differentiating the
factorisations one by one.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from .._linalg import cholesky, full_precision, solve_lower


@jax.custom_jvp
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
    N = cholesky(S)
    P = cholesky(M)
    # N + P is triangular too, so (N + P)⁻¹ costs one solve and no factorisation of its own.
    g = solve_lower(N + P, A @ z)
    y = solve_lower(N, r)
    w = solve_lower(N, y - g, transposed=True)
    log_det = jnp.sum(jnp.log(jnp.diagonal(P))) - jnp.sum(jnp.log(jnp.diagonal(N)))
    return (z + A.T @ w, log_det), (N, P, y, g, w)


@drive.defjvp
@full_precision
def _(primals, tangents):
    A, S, M, r, z = primals
    dA, dS, dM, dr, dz = tangents
    out, (N, P, y, g, w) = _forward(A, S, M, r, z)
    F_N = _factor_change(N, dS)
    F_P = _factor_change(P, dM)
    # F as it is applied, to a few columns
    Fy = _times(F_N, y)
    Fg = _times(F_N, g)
    FTh = _times(F_N.T, y - g)
    # (N + P) g = A z, so (N + P) dg = dA z + A dz − (dN + dP) g
    dg = solve_lower(N + P, dA @ z + A @ dz - N @ Fg - P @ _times(F_P, g))
    # N y = r, so dy = N⁻¹ dr − F y, and h = y − g
    dh = solve_lower(N, dr) - Fy - dg
    # Nᵀ w = h, so dw = N⁻ᵀ (dh − dNᵀ w) with dNᵀ w = Fᵀ Nᵀ w = Fᵀ h
    dw = solve_lower(N, dh - FTh, transposed=True)
    # u = z + Aᵀ w, and d log|N| = tr(N⁻¹ dN) = tr F
    du = dz + dA.T @ w + A.T @ dw
    return out, (du, jnp.trace(F_P) - jnp.trace(F_N))


def _factor_change(L, dS):
    """L⁻¹ dL of the factor of S = L Lᵀ."""
    # X = L⁻¹ dS L⁻ᵀ by two solves from the right: dS is symmetric, so the second takes the
    # transpose of the first and no transpose is needed after it.
    half = lax.linalg.triangular_solve(L, dS, left_side=False, lower=True, transpose_a=True)
    X = lax.linalg.triangular_solve(L, half.T, left_side=False, lower=True, transpose_a=True)
    i = jnp.arange(L.shape[0])
    below = jnp.where(i[:, None] > i[None, :], 1.0, 0.0)
    half_of_diagonal = jnp.where(i[:, None] == i[None, :], 0.5, 0.0)
    return X * (below + half_of_diagonal)


def _times(F, x):
    """F x for a few columns, without a `dot`: its transpose, outer products, is one loop over F."""
    return jnp.sum(F[:, :, None] * x[None, :, :], axis=1)
