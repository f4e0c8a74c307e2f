"""Steps that are driven by fewer noises than numbers are observed: the algebra of the noises.

Let k noises drive m > k observed values, v ~ N(x + s G u, E + κ G Gᵀ), u ~ N(0, I): the step, and
the time left after it. With r = v − x,

    C = Gᵀ E⁻¹ G,      f = Gᵀ E⁻¹ r,      H = (I + κ C)⁻¹ C,

the law of u given v is N(Π⁻¹ s (I + κ C)⁻¹ f, Π⁻¹), Π = I + s² H, and all matrices are k × k. E is
what no path changes: errors that are independent, and what is bridged by a covariance of the end,
E = D + λ F Fᵀ, D diagonal. With N Nᵀ = I + λ Fᵀ D⁻¹ F

    E⁻¹ = D⁻¹ − λ D⁻¹ F N⁻ᵀ N⁻¹ Fᵀ D⁻¹                                          (Woodbury).
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from .._linalg import (
    add,
    apply,
    cholesky,
    columns,
    congruence,
    full_precision,
    log_diagonal,
    solve_lower,
    solve_positive,
    transpose,
)
from .._types import Noise, State, Structured
from ..conditioning import whitened_log_density
from ._steering import AbstractConditionalSteering, log_ratio


def are_few(sigma: Structured, num_values: int) -> bool:
    """Whether noises are fewer than values by so much that their algebra is the cheaper one."""
    return sigma.ndim == 2 and 2 * sigma.shape[1] <= num_values


class Errors(eqx.Module):
    """E = D + λ F Fᵀ, D a multiple of the identity or diagonal and positive; D alone without F."""

    sd: Structured
    """√D."""
    factor: Float[Array, "m q"] | None = None
    """D^{-½} F."""
    gram: Float[Array, "q q"] | None = None
    """Fᵀ D⁻¹ F."""

    @classmethod
    def of(cls, sd: Structured, factor: Float[Array, "m q"] | None = None) -> "Errors":
        """From √D and F."""
        if factor is None:
            return cls(sd)
        factor = solve_lower(sd, factor)
        return cls(sd, factor, factor.T @ factor)


@jax.custom_jvp
def _schur(A: Array, scale: Array, B: Array, T: "_Positive") -> Array:
    """A − λ Bᵀ T⁻¹ B, symmetric, with a derivative that needs none of a factorisation."""
    across = solve_lower(T.factor, B)
    return A - scale * (across.T @ across)


@_schur.defjvp
@full_precision
def _(primals, tangents):
    _, scale, B, T = primals
    dA, dscale, dB, dT = tangents
    Y = T.solve(B)
    half = scale * (Y.T @ dB) + 0.5 * dscale * (Y.T @ B)
    return _schur(*primals), dA - half - half.T + scale * (Y.T @ dT.matrix @ Y)


class _Positive(eqx.Module):
    """A positive definite matrix I + S beside its factor, by which it is solved."""

    matrix: Float[Array, "k k"]
    factor: Float[Array, "k k"]

    @classmethod
    def plus_identity(cls, S: Float[Array, "k k"]) -> "_Positive":
        matrix = add(S, jnp.ones((), S.dtype))
        # solutions have derivatives of their own, for which the factor is a constant
        return cls(matrix, cholesky(lax.stop_gradient(matrix)))

    def solve(self, x: State) -> State:
        return solve_positive(self.matrix, x, self.factor)


class LowRank(eqx.Module):
    """The covariance E + κ G Gᵀ of what is observed."""

    errors: Errors
    end_scale: Float[Array, ""]
    """λ."""
    factor: Float[Array, "m k"]
    """D^{-½} G."""
    scale: Float[Array, ""]
    """κ."""
    end: _Positive | None
    """I + λ Fᵀ D⁻¹ F = N Nᵀ."""
    gram: Float[Array, "k k"]
    """C."""
    whole: _Positive
    """I + κ C."""

    def __init__(self, errors: Errors, end_scale, factor: Float[Array, "m k"], scale):
        self.errors = errors
        self.end_scale = end_scale
        self.scale = scale
        # All is in units of the errors, D^{-½} on the left of every m-vector, so that E is the
        # identity but for F.
        self.factor = solve_lower(errors.sd, factor)
        self.end = None
        self.gram = self.factor.T @ self.factor
        if errors.factor is not None and errors.gram is not None:
            # C = Gᵀ D⁻¹ G − λ (N⁻¹ Fᵀ D⁻¹ G)ᵀ (N⁻¹ Fᵀ D⁻¹ G)
            self.end = _Positive.plus_identity(end_scale * errors.gram)
            across = errors.factor.T @ self.factor
            self.gram = _schur(self.gram, end_scale, across, self.end)
        self.whole = _Positive.plus_identity(scale * self.gram)

    def pull(self, r: State) -> Noise:
        """(I + κ C)⁻¹ f."""
        f = apply(transpose(self.factor), self._without_end(solve_lower(self.errors.sd, r)))
        return self.whole.solve(f)

    def _without_end(self, x: State) -> State:
        """E⁻¹ x in units of the errors, (1 − λ F N⁻ᵀ N⁻¹ Fᵀ) x."""
        if self.end is None:
            return x
        F = self.errors.factor
        assert F is not None
        return x - self.end_scale * apply(F, self.end.solve(apply(transpose(F), x)))

    def information(self) -> Float[Array, "k k"]:
        """H."""
        H = self.whole.solve(self.gram)
        # It is symmetric but for rounding, and is factorised.
        return 0.5 * (H + H.T)

    def solve(self, r: State) -> State:
        """(E + κ G Gᵀ)⁻¹ r."""
        return self.solved(self.scale, self.pull, r)

    def solved(self, scale: Array, pull: Callable[[State], Noise], r: State) -> State:
        """(E + c G Gᵀ)⁻¹ r for c = `scale`, `pull` giving (I + c C)⁻¹ f, with the derivative of a
        solution.
        """
        sd = self.errors.sd

        def times(x):
            x = apply(sd, x)
            moved = x + scale * apply(self.factor, apply(transpose(self.factor), x))
            if self.errors.factor is not None:
                F = self.errors.factor
                moved = moved + self.end_scale * apply(F, apply(transpose(F), x))
            return apply(sd, moved)

        def by_factors(_, r):
            # Woodbury once more: E⁻¹ (r − c G (I + c C)⁻¹ f).
            left = solve_lower(sd, r) - scale * apply(self.factor, pull(r))
            return solve_lower(sd, self._without_end(left))

        return lax.custom_linear_solve(times, r, by_factors, symmetric=True)

    def dense(self) -> Structured:
        """E + κ G Gᵀ."""
        S = self.scale * (self.factor @ self.factor.T)
        if self.errors.factor is not None:
            S = S + self.end_scale * (self.errors.factor @ self.errors.factor.T)
        return congruence(self.errors.sd, add(S, jnp.ones((), S.dtype)))


class NoiseSteering(AbstractConditionalSteering):
    """The conditional law of u given v, where r, v less its forecast at the mean, is s G u + error.

    u = Q⁻ᵀ (Q⁻¹ s (I + κ C)⁻¹ f + z): both parts of N(Π⁻¹ s (I + κ C)⁻¹ f, Π⁻¹) by one solve.
    """

    covariance: LowRank
    step: Float[Array, ""]
    """s."""
    r: State
    factor: Float[Array, "k k"]
    """Q, with Q Qᵀ = Π."""

    def __init__(self, covariance: LowRank, step, r: State):
        self.covariance = covariance
        self.step = step
        self.r = r
        self.factor = cholesky(add(step**2 * covariance.information(), jnp.ones((), r.dtype)))

    def solve(self, r):
        # I + (κ + s²) C = (I + κ C) Π
        covariance = self.covariance

        def pull(r):
            half = solve_lower(self.factor, covariance.pull(r))
            return solve_lower(self.factor, half, transposed=True)

        return covariance.solved(covariance.scale + self.step**2, pull, r)

    def _pull(self) -> Noise:
        """Q⁻¹ s (I + κ C)⁻¹ f."""
        return solve_lower(self.factor, self.step * self.covariance.pull(self.r))

    def mean(self):
        return solve_lower(self.factor, self._pull(), transposed=True)

    def drive(self, z):
        u = solve_lower(self.factor, self._pull() + z, transposed=True)
        # B = Q⁻ᵀ, so log|B| = −log|Q| for each column.
        return u, log_ratio(z, u) - columns(z) * log_diagonal(self.factor, len(u))

    def inverse(self, u):
        return apply(transpose(self.factor), u) - self._pull()

    def log_evidence(self) -> Float[Array, ""]:
        """log density of v given the present state, on the last step, where nothing but independent
        errors is left.

        By what is left of r at the mean, whose digits are those of the errors.
        """
        # log p(v) = log p(v | u) + log p(u) − log p(u | v) at any u: at the mean of u given v the
        # last is that of a normal at its mean, and log 2π cancels.
        u = self.mean()
        sd = self.covariance.errors.sd
        left = solve_lower(sd, self.r) - self.step * apply(self.covariance.factor, u)
        return (
            whitened_log_density(left, sd)
            - 0.5 * jnp.sum(u * u)
            - columns(u) * log_diagonal(self.factor, len(u))
        )
