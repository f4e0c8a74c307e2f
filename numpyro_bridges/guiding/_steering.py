"""How a guide turns standard normal noise into the noise that drives a step.

The model's step is x' = m + σ u with u ~ N(0, I). A guide replaces u by u = μ + B z with z ~ N(0, I), μ and B being
functions of the past only, and the step's log weight is

    log p(u)/q(u) = ½|z|² − ½|u|² + dim log|B|.

For a guide that forecasts the observation from the next state, v ~ N(Λ x' + s, P Pᵀ), the best u is the conditional law
of u given v. With A = Λσ, N Nᵀ = P Pᵀ + A Aᵀ and y = N⁻¹(v − s − Λm),

    μ = Aᵀ N⁻ᵀ y,      B = I − Aᵀ N⁻ᵀ (N + P)⁻¹ A,      |B| = |P|/|N|,      B⁻¹ = I + Aᵀ (N + P)⁻ᵀ P⁻¹ A

(the square-root measurement update of Andrews 1968). Both factors are needed for the density in any case and all solves
act on states, so no triangular solve with a matrix on the right, no k × k factorisation and no inverse of a is formed; with
P = 0, an exact observation, B is the projection on the noises that the observation leaves free.
"""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._linalg import add, apply, cholesky, columns, compose, congruence, log_diagonal, solve_lower, transpose
from .._types import Noise, State, Structured
from ..conditioning import whitened_log_density
from ..sdes import Transition


class AbstractSteering(eqx.Module):
    """u = μ + B z at one step."""

    @abc.abstractmethod
    def mean(self) -> Noise:
        """μ."""

    @abc.abstractmethod
    def forward(self, z: Noise) -> Noise:
        """The driving noise u."""

    @abc.abstractmethod
    def inverse(self, u: Noise) -> Noise:
        """The z that gives u; where an exact observation leaves part of z without effect, that part is 0."""

    @abc.abstractmethod
    def log_det(self, z: Noise) -> Float[Array, ""]:
        """log|B| over all columns of z."""

    def log_ratio(self, z: Noise, u: Noise) -> Float[Array, ""]:
        """log p(u)/q(u), the log weight of the step."""
        return 0.5 * (jnp.sum(z * z) - jnp.sum(u * u)) + self.log_det(z)


class GaussianSteering(AbstractSteering):
    """The conditional law of the noise given a Gaussian observation of the next state."""

    A: Structured
    N: Structured
    P: Structured | None
    y: State

    def __init__(
        self,
        transition: Transition,
        operator: Structured,
        shift: State,
        covariance: Structured | None,
        factor: Structured | None,
        observed: State,
    ):
        """The observation is N(operator x' + shift, covariance), covariance = factor factorᵀ; an exact one has factor None."""
        S = congruence(operator, transition.covariance)
        self.A = compose(operator, transition.factor)
        self.N = cholesky(S if covariance is None else add(covariance, S))
        self.P = factor
        self.y = solve_lower(self.N, observed - shift - apply(operator, transition.mean))

    @property
    def _sum(self) -> Structured:
        return self.N if self.P is None else add(self.N, self.P)

    def _lift(self, y: State, C: Structured) -> Noise:
        return apply(transpose(self.A), solve_lower(C, y, transposed=True))

    def mean(self):
        return self._lift(self.y, self.N)

    def forward(self, z):
        return z + self._lift(self.y - solve_lower(self._sum, apply(self.A, z)), self.N)

    def inverse(self, u):
        u = u - self.mean()
        Au = apply(self.A, u)
        if self.P is None:
            return u - self._lift(solve_lower(self.N, Au), self.N)
        return u + self._lift(solve_lower(self.P, Au), self._sum)

    def without_effect(self, z: Noise) -> Noise:
        """The part of z that an exact observation leaves without effect."""
        return self._lift(solve_lower(self.N, apply(self.A, z)), self.N)

    def log_det(self, z):
        m, dim = self.y.shape[0], columns(self.y)
        return dim * (log_diagonal(self.P, m) - log_diagonal(self.N, m))

    def log_evidence(self) -> Float[Array, ""]:
        """log density of the observation given the present state: what the last step weighs."""
        return whitened_log_density(self.y, self.N)


class DriftSteering(AbstractSteering):
    """u = z + μ; with μ = σᵀ s an Euler step of the drift b + a s."""

    shift: Noise

    def mean(self):
        return self.shift

    def forward(self, z):
        return z + self.shift

    def inverse(self, u):
        return u - self.shift

    def log_det(self, z):
        return jnp.zeros((), z.dtype)
