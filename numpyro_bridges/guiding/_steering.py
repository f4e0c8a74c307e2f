"""How a guide turns standard normal noise into the noise that drives a step.

The model's step is x' = m + σ u with u ~ N(0, I). A guide replaces u by u = μ + B z with
z ~ N(0, I), μ and B being functions of the past only, and the step's log weight is

    log p(u)/q(u) = ½|z|² − ½|u|² + dim log|B|.

For a guide that forecasts the observation from the next state, v ~ N(Λ x' + s, P Pᵀ), the best u is
the conditional law of u given v. With A = Λσ, N Nᵀ = P Pᵀ + A Aᵀ and y = N⁻¹(v − s − Λm),

    μ = Aᵀ N⁻ᵀ y,      B = I − Aᵀ N⁻ᵀ (N + P)⁻¹ A,
    |B| = |P|/|N|,     B⁻¹ = I + Aᵀ (N + P)⁻ᵀ P⁻¹ A

(the square-root measurement update of Andrews 1968). Both factors are needed for the density in any
case and all solves act on states, so no triangular solve with a matrix on the right, no k × k
factorisation and no inverse of a is formed; with P = 0, an exact observation, B is the projection
on the noises that the observation leaves free.
"""

import abc
from typing import Self

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._linalg import (
    add,
    apply,
    as_columns,
    cholesky,
    columns,
    compose,
    congruence,
    filled,
    log_diagonal,
    solve_lower,
    solve_positive,
    transpose,
    without_variance,
)
from .._types import Noise, State, Structured
from ..conditioning import where_possible, whitened_log_density
from ..sdes import Transition
from ._drive import drive


class AbstractSteering(eqx.Module):
    """u = μ + B z at one step."""

    @abc.abstractmethod
    def mean(self) -> Noise:
        """μ."""

    @abc.abstractmethod
    def drive(self, z: Noise) -> tuple[Noise, Float[Array, ""]]:
        """The driving noise u and the log weight of the step."""

    @abc.abstractmethod
    def inverse(self, u: Noise) -> Noise:
        """The z that gives u; 0 for what of it an exact observation leaves without effect."""


class AbstractConditionalSteering(AbstractSteering):
    """The law of u given what is observed, whose distance from its forecast at the mean is r with
    covariance S.
    """

    r: eqx.AbstractVar[State]

    @abc.abstractmethod
    def solve(self, r: State) -> State:
        """S⁻¹ r."""

    def moved(self, change: State) -> Self:
        """The same, of what is observed moved."""
        return eqx.tree_at(lambda steering: steering.r, self, self.r + change)


def log_ratio(z: Noise, u: Noise) -> Float[Array, ""]:
    """log N(u; 0, I) − log N(z; 0, I)."""
    return 0.5 * (jnp.sum(z * z) - jnp.sum(u * u))


class GaussianSteering(AbstractConditionalSteering):
    """The conditional law of the noise given v ~ N(operator x' + shift, covariance); covariance
    None is exact.

    Where v is a forecast of something seen without noise, `may_be_empty`, a part of it may have no
    variance at all, and then tells nothing of the noise of the step: it is filled with a variance
    of 1, and `log_evidence` alone asks whether it is as it must be.
    """

    A: Structured
    """Λσ."""
    S: Structured
    """N Nᵀ."""
    M: Structured | None
    """P Pᵀ, `None` for 0."""
    r: State
    """v − s − Λm."""
    empty: Bool[Array, "..."]
    """Which numbers of v have no variance at all."""

    def __init__(
        self,
        transition: Transition,
        operator: Structured,
        shift: State,
        covariance: Structured | None,
        observed: State,
        may_be_empty: bool = False,
    ):
        self.A = compose(operator, transition.factor)
        # Λ a Λᵀ from a, which a transition has beside σ, and not by squaring A.
        S = congruence(operator, transition.covariance)
        S = S if covariance is None else add(covariance, S)
        if may_be_empty:
            # With 1 in both, N = P there, and neither μ nor |P|/|N| feels it.
            self.empty = without_variance(S)
            self.S = filled(S, self.empty)
            self.M = None if covariance is None else filled(covariance, self.empty)
        else:
            self.empty = jnp.zeros((), bool)
            self.S = S
            self.M = covariance
        self.r = observed - shift - apply(operator, transition.mean)

    def solve(self, r):
        return solve_positive(self.S, r)

    def _factors(self) -> tuple[Structured, Structured, State]:
        """N, N + P and y."""
        N = cholesky(self.S)
        total = N if self.M is None else add(N, cholesky(self.M))
        return N, total, solve_lower(N, self.r)

    def _lift(self, C: Structured, y: State) -> Noise:
        """Aᵀ C⁻ᵀ y."""
        return apply(transpose(self.A), solve_lower(C, y, transposed=True))

    def mean(self):
        N, _, y = self._factors()
        return self._lift(N, y)

    def drive(self, z):
        if self.M is not None and self.A.ndim == self.S.ndim == self.M.ndim == 2:
            # matrices, as in flows: the same formula with a derivative by hand
            u, log_det = drive(self.A, self.S, self.M, as_columns(self.r), as_columns(z))
            u = u.reshape(z.shape)
        else:
            # μ and B z share the solve with Nᵀ: u = z + Aᵀ N⁻ᵀ (y − (N + P)⁻¹ A z).
            N, total, y = self._factors()
            u = z + self._lift(N, y - solve_lower(total, apply(self.A, z)))
            if self.M is None:
                # A projection has no density. The last step onto an exact datum asks for u alone,
                # and weighs by `log_evidence`.
                log_det = -jnp.inf
            else:
                m = self.r.shape[0]
                log_det = log_diagonal(cholesky(self.M), m) - log_diagonal(N, m)
        return u, log_ratio(z, u) + columns(z) * log_det

    def inverse(self, u):
        N, total, y = self._factors()
        u = u - self._lift(N, y)
        Au = apply(self.A, u)
        if self.M is None:
            # P = 0: B is a projection, and inverts itself on its range.
            return u - self._lift(N, solve_lower(N, Au))
        return u + self._lift(total, solve_lower(cholesky(self.M), Au))

    def without_effect(self, z: Noise) -> Noise:
        """The part of z that an exact observation leaves without effect."""
        N = cholesky(self.S)
        return self._lift(N, solve_lower(N, apply(self.A, z)))

    def log_evidence(self) -> Float[Array, ""]:
        """log density of the observation given the present state: what the last step weighs."""
        N, _, y = self._factors()
        # v − s − Λm ~ N(0, N Nᵀ), and N was filled: what has no variance is asked for by itself.
        return where_possible(self.r, self.empty, whitened_log_density(y, N))


class DriftSteering(AbstractSteering):
    """u = z + μ; with μ = σᵀ s an Euler step of the drift b + a s."""

    shift: Noise

    def mean(self):
        return self.shift

    def drive(self, z):
        u = z + self.shift
        return u, log_ratio(z, u)

    def inverse(self, u):
        return u - self.shift
