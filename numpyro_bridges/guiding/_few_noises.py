"""Steps that are driven by fewer noises than numbers are observed: the algebra of the noises.

Let k noises drive m > k observed values, v ~ N(x + s G u, E + κ G Gᵀ), u ~ N(0, I): the step, and
the time left after it. With r = v − x,

    C = Gᵀ E⁻¹ G,      f = Gᵀ E⁻¹ r,      H = (I + κ C)⁻¹ C,

the law of u given v is N(Π⁻¹ s (I + κ C)⁻¹ f, Π⁻¹), Π = I + s² H, and all matrices are k × k. E is
what no path changes: errors that are independent, and what is bridged by a covariance of the end,
E = D + λ F Fᵀ, D diagonal. With N Nᵀ = I + λ Fᵀ D⁻¹ F

    E⁻¹ = D⁻¹ − λ D⁻¹ F N⁻ᵀ N⁻¹ Fᵀ D⁻¹                                          (Woodbury).
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._linalg import (
    add,
    apply,
    cholesky,
    columns,
    congruence,
    log_diagonal,
    solve_lower,
    transpose,
)
from .._types import Noise, State, Structured
from ..conditioning import whitened_log_density
from ._steering import AbstractSteering, log_ratio


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


class LowRank(eqx.Module):
    """The covariance E + κ G Gᵀ of what is observed."""

    errors: Errors
    end_scale: Float[Array, ""]
    """λ."""
    factor: Float[Array, "m k"]
    """D^{-½} G."""
    scale: Float[Array, ""]
    """κ."""
    across: Float[Array, "q k"] | None
    """N⁻¹ Fᵀ D⁻¹ G."""
    gram: Float[Array, "k k"]
    """C."""
    root: Float[Array, "k k"]
    """Of I + κ C."""

    def __init__(self, errors: Errors, end_scale, factor: Float[Array, "m k"], scale):
        self.errors = errors
        self.end_scale = end_scale
        self.scale = scale
        # All is in units of the errors, D^{-½} on the left of every m-vector, so that E is the
        # identity but for F.
        self.factor = solve_lower(errors.sd, factor)
        self.across = None
        self.gram = self.factor.T @ self.factor
        if errors.factor is not None:
            # C = Gᵀ D⁻¹ G − λ (N⁻¹ Fᵀ D⁻¹ G)ᵀ (N⁻¹ Fᵀ D⁻¹ G)
            self.across = solve_lower(self._end_root, errors.factor.T @ self.factor)
            self.gram = self.gram - end_scale * (self.across.T @ self.across)
        self.root = self._plus_identity(scale * self.gram)

    @staticmethod
    def _plus_identity(S):
        return cholesky(add(S, jnp.ones((), S.dtype)))

    # A property and no field: it depends on λ, which may differ from step to step, and a plan is
    # made for all steps.
    @property
    def _end_root(self):
        """N."""
        assert self.errors.gram is not None
        return self._plus_identity(self.end_scale * self.errors.gram)

    def pull(self, r: State) -> Noise:
        """(I + κ C)⁻¹ f."""
        r = solve_lower(self.errors.sd, r)
        f = apply(transpose(self.factor), r)
        if self.across is not None:
            # f = Gᵀ D⁻¹ r − λ (N⁻¹ Fᵀ D⁻¹ G)ᵀ N⁻¹ Fᵀ D⁻¹ r
            assert self.errors.factor is not None
            back = solve_lower(self._end_root, apply(transpose(self.errors.factor), r))
            f = f - self.end_scale * apply(transpose(self.across), back)
        return solve_lower(self.root, solve_lower(self.root, f), transposed=True)

    def information(self) -> Float[Array, "k k"]:
        """H."""
        H = solve_lower(self.root, solve_lower(self.root, self.gram), transposed=True)
        # It is symmetric but for rounding, and is factorised.
        return 0.5 * (H + H.T)

    def solve(self, r: State) -> State:
        """(E + κ G Gᵀ)⁻¹ r."""
        sd = self.errors.sd
        F = self.errors.factor
        # Woodbury once more: E⁻¹ (r − κ G (I + κ C)⁻¹ f).
        left = solve_lower(sd, r) - self.scale * apply(self.factor, self.pull(r))
        if F is not None:
            # E⁻¹ in units of the errors, 1 − λ F N⁻ᵀ N⁻¹ Fᵀ
            N = self._end_root
            back = solve_lower(N, solve_lower(N, apply(transpose(F), left)), transposed=True)
            left = left - self.end_scale * apply(F, back)
        return solve_lower(sd, left)

    def dense(self) -> Structured:
        """E + κ G Gᵀ."""
        S = self.scale * (self.factor @ self.factor.T)
        if self.errors.factor is not None:
            S = S + self.end_scale * (self.errors.factor @ self.errors.factor.T)
        return congruence(self.errors.sd, add(S, jnp.ones((), S.dtype)))


class NoiseSteering(AbstractSteering):
    """The conditional law of u given v, where r, v less its forecast at the mean, is s G u + error.

    u = Q⁻ᵀ (Q⁻¹ s (I + κ C)⁻¹ f + z): both parts of N(Π⁻¹ s (I + κ C)⁻¹ f, Π⁻¹) by one solve.
    """

    covariance: LowRank
    step: Float[Array, ""]
    """s."""
    r: State
    factor: Float[Array, "k k"]
    """Q, with Q Qᵀ = Π."""
    pull: Noise
    """Q⁻¹ s (I + κ C)⁻¹ f."""

    def __init__(self, covariance: LowRank, step, r: State):
        self.covariance = covariance
        self.step = step
        self.r = r
        self.factor = cholesky(add(step**2 * covariance.information(), jnp.ones((), r.dtype)))
        self.pull = solve_lower(self.factor, step * covariance.pull(r))

    def mean(self):
        return solve_lower(self.factor, self.pull, transposed=True)

    def drive(self, z):
        u = solve_lower(self.factor, self.pull + z, transposed=True)
        # B = Q⁻ᵀ, so log|B| = −log|Q| for each column.
        return u, log_ratio(z, u) - columns(z) * log_diagonal(self.factor, len(u))

    def inverse(self, u):
        return apply(transpose(self.factor), u) - self.pull

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
