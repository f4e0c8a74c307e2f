"""Linear maps that act on the first axis of a state, stored by their shape.

`()` is a multiple of the identity, `(n,)` a diagonal, `(m, n)` a matrix. A state is `(n,)` or `(n,
dim)`; the same map acts on every column, so no Kronecker product is ever formed. The rank is known
when a program is traced: a scalar or diagonal problem compiles to elementwise work.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike

from ._types import State, Structured


def full_precision(f):
    """Products in `f` keep float32, where a GPU's default is a 10-bit mantissa (TF32)."""

    # Weights need every digit. The setting is read while a program is traced, not when it runs.
    @functools.wraps(f)
    def wrapped(*args, **kwargs):
        with jax.default_matmul_precision("highest"):
            return f(*args, **kwargs)

    return wrapped


def varying_like(carry, *inputs):
    """The first carry of a loop that computes with `inputs`, typed as what it becomes.

    Inside `jax.shard_map` a constant is the same on every device and the loop's result is not: JAX
    wants that said of the carry beforehand. Elsewhere nothing is done.
    """
    axes = frozenset().union(*(varying_axes(leaf) for leaf in jax.tree.leaves(inputs)))

    def mark(leaf):
        missing = tuple(sorted(axes - varying_axes(leaf)))
        return _mark_varying(leaf, missing) if missing else leaf

    return jax.tree.map(mark, carry)


def varying_axes(leaf) -> frozenset:
    """Mesh axes along which a value differs from device to device."""
    if not eqx.is_array(leaf):
        return frozenset()
    kind = jax.typeof(leaf)
    # `vma` up to JAX 0.9, a part of `manual_axis_type` in 0.12
    manual = getattr(kind, "manual_axis_type", None)
    return getattr(kind, "vma", frozenset()) if manual is None else manual.varying


def _mark_varying(leaf, axes):
    # `pvary` is the older name
    return lax.pcast(leaf, axes, to="varying") if hasattr(lax, "pcast") else lax.pvary(leaf, axes)


def rows(d, x):
    """A diagonal `d` shaped to scale the rows of `x`."""
    return d.reshape(d.shape + (1,) * (x.ndim - 1))


def apply(A: Structured, x: State) -> State:
    """A x."""
    if A.ndim == 0:
        return A * x
    return rows(A, x) * x if A.ndim == 1 else A @ x


def product(A: Array, B: Array) -> Array:
    """A B of matrices; without a `dot` where A is small: a batch is one loop over all entries."""
    return jnp.sum(A[:, :, None] * B[None], axis=1) if A.shape[0] <= 4 else A @ B


def transpose(A: Structured) -> Structured:
    """Aᵀ."""
    return A.T


def compose(A: Structured, B: Structured) -> Structured:
    """A B."""
    if A.ndim == 0 or B.ndim == 0:
        return A * B
    if A.ndim == 1:
        return A * B if B.ndim == 1 else A[:, None] * B
    return A * B[None, :] if B.ndim == 1 else A @ B


def congruence(A: Structured, S: Structured) -> Structured:
    """A S Aᵀ, of the same or a larger rank than S."""
    if A.ndim == 2 and S.ndim == 0:
        return S * (A @ A.T)
    return compose(compose(A, S), transpose(A))


def add(A: Structured, B: Structured) -> Structured:
    """A + B."""
    if A.ndim < B.ndim:
        A, B = B, A
    # Shapes would broadcast without this, and a diagonal be added to every row.
    return A + diagonal_matrix(B, A.shape[0]) if A.ndim == 2 and B.ndim < 2 else A + B


def diagonal_matrix(d: Structured, n: int) -> Structured:
    """A scalar or diagonal as an n × n matrix; elementwise, where a scatter would be a loop."""
    return jnp.where(jnp.eye(n, dtype=bool), d if d.ndim == 0 else d[:, None], 0.0)


def diagonal(A: Structured, n: int) -> Structured:
    """The diagonal `(n,)` of a map."""
    return jnp.broadcast_to(A, (n,)) if A.ndim < 2 else jnp.diagonal(A)


def promote(A: Structured, ndim: int, n: int) -> Structured:
    """The same map with at least the given rank, `n` being the size of the state."""
    if A.ndim == 0 and ndim >= 1:
        A = jnp.full((n,), A)
    return diagonal_matrix(A, n) if A.ndim == 1 and ndim == 2 else A


def safe_sqrt(x: ArrayLike) -> Array:
    """√x with slope 0 at exactly 0, where that of √x is infinite: of √y² the mean of both sides."""
    zero = x == 0
    # the inner `where` keeps the infinite slope, the outer one the value 1, out of the result
    return jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, x)))


def cholesky(S: Structured) -> Structured:
    """Lower factor C with C Cᵀ = S; NaN where it has none, but for zeros of a diagonal S."""
    # Callers give symmetric matrices: to symmetrise them again costs a pass, forward and backward.
    return safe_sqrt(S) if S.ndim < 2 else lax.linalg.cholesky(S, symmetrize_input=False)


def semidefinite_cholesky(S: Structured) -> Structured:
    """The same, with rows of zeros for coordinates without variance."""
    if S.ndim < 2:
        return safe_sqrt(S)
    empty = without_variance(S)
    # Filled first: a NaN of the factorisation would survive in slopes, whatever is put over it.
    return jnp.where(empty[:, None], 0.0, cholesky(filled(S, empty)))


def without_variance(S: Structured) -> Array:
    """Where the diagonal of a covariance or a factor is 0: `()` for a scalar, else `(m,)`."""
    return (jnp.diagonal(S) if S.ndim == 2 else S) == 0


def filled(S: Structured, empty: Array) -> Structured:
    """S with variance 1 for coordinates that have none, which no other coordinate then feels."""
    if S.ndim < 2:
        return jnp.where(empty, 1.0, S)
    return jnp.where(jnp.eye(S.shape[0], dtype=bool) & empty[:, None], 1.0, S)


def symmetric(S: Structured) -> Structured:
    """½ (S + Sᵀ): a factorisation has derivatives for symmetric matrices; a parameter is any."""
    return 0.5 * (S + S.T) if S.ndim == 2 else S


def solve_lower(C: Structured, x: State, transposed: bool = False) -> State:
    """C⁻¹ x, or C⁻ᵀ x, for a lower triangular C."""
    if C.ndim < 2:
        return x / (C if C.ndim == 0 else rows(C, x))
    out = lax.linalg.triangular_solve(
        C, as_columns(x), left_side=True, lower=True, transpose_a=transposed
    )
    return out.reshape(x.shape)


def solve_positive(S: Structured, x: State, factor: Structured | None = None) -> State:
    """S⁻¹ x for a positive definite S, with the derivative of a solution.

    That of the factorisation takes two solves with all columns of S, and this one with those of x.
    `factor`: that of S, if there is one already; no derivative goes through it.
    """
    if S.ndim < 2:
        return solve_lower(S, x)
    C = lax.stop_gradient(cholesky(lax.stop_gradient(S)) if factor is None else factor)

    def by_factor(_, x):
        return solve_lower(C, solve_lower(C, x), transposed=True)

    return lax.custom_linear_solve(lambda x: apply(S, x), x, by_factor, symmetric=True)


@jax.custom_jvp
def half_square(S: Array, x: Array) -> Array:
    """½ Σ xᵀ S⁻¹ x over the columns of x, for a matrix S, with derivatives that take one solve."""
    return 0.5 * jnp.sum(x * solve_positive(S, x))


@half_square.defjvp
@full_precision
def _(primals, tangents):
    S, x = primals
    dS, dx = tangents
    y = solve_positive(S, x)
    return 0.5 * jnp.sum(x * y), jnp.sum(y * dx) - 0.5 * jnp.sum(y * (dS @ y))


def log_diagonal(C: Structured, m: int):
    """log|C| of a triangular C that acts on `m` rows."""
    if C.ndim == 0:
        return m * jnp.log(C)
    return jnp.sum(jnp.log(C if C.ndim == 1 else jnp.diagonal(C)))


def as_columns(x: State) -> State:
    """A vector state as a matrix of one column."""
    return x if x.ndim == 2 else x[:, None]


def columns(x: State) -> int:
    """Number of columns that share a covariance: `dim`, 1 for a vector."""
    return x.shape[1] if x.ndim == 2 else 1
