"""The state at the root: given, or drawn from a Gaussian prior and the message of all data.

With C = K Kᵀ the root is x = x0 + K u, u ~ N(0, I), and the message at it, as a function of u,

    h(x) = exp(c + Fᵀu − ½ uᵀHu).

With N Nᵀ = 1 + H its integral against the prior is exp(c + ½ |N⁻¹F|²) / |N|. The root is drawn from
the posterior under h, u = N⁻ᵀ(N⁻¹F + z), of log density −½ |z|² + log|N| up to what N(u; 0, I) has
too.
"""

from typing import TypeAlias

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, Float, PRNGKeyArray

from .._linalg import (
    apply,
    cholesky,
    columns,
    congruence,
    log_diagonal,
    solve_lower,
    symmetric,
    transpose,
)
from .._types import State, Structured

Message: TypeAlias = tuple[Float[Array, "n n"], State, Float[Array, ""]]
"""H, F and c of a function of the displacement from an anchor."""


class Root(eqx.Module):
    """N(x0, K Kᵀ), or x0 where K is `None`."""

    x0: State
    factor: Structured | None
    anchor: State
    """Messages are functions of displacements from here."""

    @classmethod
    def of(cls, x0: State, covariance: Structured | None) -> "Root":
        """Near x0."""
        # the derivative of a factorisation holds for symmetric matrices, and C may be a parameter
        factor = None if covariance is None else cholesky(symmetric(covariance).astype(x0.dtype))
        return cls(x0, factor, x0)

    def num_rows(self, k: int) -> int:
        """Rows of k noises each that the root takes."""
        # ⌈n / k⌉: n numbers for each column, in rows as long as those of the steps
        return 0 if self.factor is None else -(-self.x0.shape[0] // k)

    def prior(self, noise: Float[Array, "rows k *dim"]) -> State:
        """A draw from the prior."""
        return self.x0 if self.factor is None else self.x0 + apply(self.factor, self._used(noise))

    def posterior(
        self, message: Message, noise: Float[Array, "rows k *dim"]
    ) -> tuple[State, Float[Array, ""]]:
        """A draw from the posterior, and log prior/posterior there."""
        if self.factor is None:
            return self.x0, jnp.zeros((), self.x0.dtype)
        N, pull, _ = self._solved(message)
        z = self._used(noise)
        u = solve_lower(N, pull + z, transposed=True)
        # log prior −½ |u|², log posterior −½ |z|² + log|N|, for each column
        difference = 0.5 * jnp.sum(z * z) - 0.5 * jnp.sum(u * u)
        log_ratio = difference - columns(u) * log_diagonal(N, len(u))
        return self.x0 + apply(self.factor, u), log_ratio

    def noise_of(
        self, message: Message, x: State, k: int, key: PRNGKeyArray
    ) -> Float[Array, "rows k *dim"]:
        """The noise with which x is drawn; what has no effect is drawn with the key."""
        free = jr.normal(key, (self.num_rows(k), k, *x.shape[1:]), x.dtype)
        if self.factor is None:
            return free
        N, pull, _ = self._solved(message)
        # `posterior` solved for z
        z = N.T @ solve_lower(self.factor, x - self.x0) - pull
        # the last row may be longer than what is left of z: its rest keeps free draws
        return free.reshape(-1, *x.shape[1:]).at[: len(z)].set(z).reshape(free.shape)

    def log_evidence(self, message: Message) -> Float[Array, ""]:
        """log of the message's integral against the prior."""
        if self.factor is None:
            return message[2]  # the anchor is x0
        N, pull, c = self._solved(message)
        # ∫ N(u; 0, I) exp(c + Fᵀu − ½ uᵀHu) du = exp(c + ½ |N⁻¹F|²) / |N|
        return c + 0.5 * jnp.sum(pull * pull) - columns(pull) * log_diagonal(N, len(pull))

    def _used(self, noise) -> State:
        return noise.reshape(-1, *self.x0.shape[1:])[: self.x0.shape[0]]

    def _solved(self, message: Message) -> Message:
        """N, N⁻¹F and c of the message as a function of u."""
        H, F, c = message
        K = self.factor
        d = self.x0 - self.anchor
        assert K is not None
        # a displacement from the anchor is d + K u: KᵀHK, Kᵀ(F − Hd) and c + Fᵀd − ½ dᵀHd
        N = cholesky(jnp.eye(len(H), dtype=H.dtype) + congruence(transpose(K), H))
        pull = solve_lower(N, apply(transpose(K), F - H @ d))
        return N, pull, c + jnp.sum(F * d) - 0.5 * jnp.sum(d * (H @ d))
