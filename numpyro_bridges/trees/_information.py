"""A Gaussian message of any rank as numbers that are added where branches meet."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._linalg import cholesky, solve_lower
from .._types import State, Structured
from ..conditioning import GaussianMessage, Observation

_LOG_2PI = 1.8378770664093453


class Information(NamedTuple):
    """log h(y) = c + Fᵀy − ½ yᵀHy of a displacement y from the anchor; columns share H."""

    H: Float[Array, "n n"]
    F: State
    c: Float[Array, ""]

    @classmethod
    def of(cls, message: GaussianMessage, like: State) -> "Information":
        """Of a message about states like this."""
        H, F, c = message.information(like.shape[0])

        return cls(H, F.reshape(like.shape), c)

    @classmethod
    def told_by(
        cls, seen: Observation, observed: State, factor: Structured, like: State
    ) -> "Information":
        """Of an observation whose error has this factor."""
        message = GaussianMessage(
            seen.operator, jnp.zeros_like(observed), factor, observed, seen.log_scale
        )
        return cls.of(message, like)

    def as_observation(self) -> tuple[Observation, State, Float[Array, ""]]:
        """As an observation w = Rᵀ y + N(0, I), R Rᵀ = H, and the log density that this lacks."""
        # H may have no more rank than what is seen, and a Cholesky factor needs all of it
        R = cholesky(self.H + nugget(self.H))
        w = solve_lower(R, self.F)
        one = jnp.ones((), R.dtype)
        # log N(w; Rᵀy, I) = −½ |w|² − ½ size log 2π + Fᵀy − ½ yᵀHy, since R w = F
        constant = -0.5 * jnp.sum(w * w) - 0.5 * self.F.size * _LOG_2PI
        return Observation(R.T, one, 0 * one), w, self.c - constant


def nugget(S: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Added to a matrix that may lack some directions, relative to its largest entry."""
    # above the rounding of a factorisation, 1e-16 and 1e-7 times the size of the matrix
    relative = 1e-12 if S.dtype == jnp.float64 else 1e-6
    return relative * jnp.max(jnp.diagonal(S)) * jnp.eye(S.shape[0], dtype=S.dtype)
