"""A process whose columns are one below the other, for what is seen of several together."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._linalg import diagonal_matrix
from .._types import RealScalar, State, Structured
from ._base import AbstractSDE, AffineStep, Transition


class Flattened(AbstractSDE):
    """Y = X.reshape(-1) of a process X with states `(n, dim)`: entry i · dim + d of y is column d
    of row i.

    Columns of X have independent noises and share σ, a and every linear map; those of Y are their
    Kronecker products with the identity. A condition may see all entries of y at once.
    """

    sde: AbstractSDE
    dim: int = eqx.field(static=True)

    def __init__(self, sde: AbstractSDE, dim: int):
        self.sde = sde
        self.dim = dim

    @property
    def space(self) -> None:
        """Euclidean: who needs the H-norm asks `sde`."""
        return None

    @property
    def has_exact_transition(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.sde.has_exact_transition

    def rows(self, y: State) -> State:
        """y as the state X."""
        return y.reshape(-1, self.dim)

    def drift(self, t: RealScalar, x: State) -> State:
        return self.sde.drift(t, self.rows(x)).reshape(-1)

    def noise(self, t: RealScalar, x: State) -> tuple[Structured, Structured]:
        sigma, a = self.sde.noise(t, self.rows(x))
        return for_every_column(sigma, self.dim), for_every_column(a, self.dim)

    def energy(self, t: RealScalar, x: State, p: State) -> Float[Array, ""]:
        return self.sde.energy(t, self.rows(x), self.rows(p))

    def has_constant_covariance(self, x: State) -> bool:
        return self.sde.has_constant_covariance(self.rows(x))

    def is_autonomous(self, x: State) -> bool:
        return self.sde.is_autonomous(self.rows(x))

    def ito_is_stratonovich(self, x: State) -> bool:
        return self.sde.ito_is_stratonovich(self.rows(x))

    def noise_size(self, x: State) -> int:
        return self.sde.noise_size(self.rows(x)) * self.dim

    def check_state(self, x: State) -> None:
        self.sde.check_state(self.rows(x))

    def transition(self, t0: RealScalar, t1: RealScalar, x: State) -> Transition:
        step = self.sde.transition(t0, t1, self.rows(x))
        factor = for_every_column(step.factor, self.dim)
        covariance = for_every_column(step.covariance, self.dim)
        return Transition(x, step.increment.reshape(-1), factor, covariance)

    # The linear parts are those of `sde`, not of a Jacobian in y, so that they stay products with
    # the identity, and steps stay its own scheme's.

    def linearised_drift(self, t: RealScalar, x: State) -> tuple[Structured, State]:
        B, beta = self.sde.linearised_drift(t, self.rows(x))
        return for_every_column(B, self.dim), beta.reshape(-1)

    def linearised_step(self, t0: RealScalar, t1: RealScalar, x: State) -> AffineStep:
        return self._flat(self.sde.linearised_step(t0, t1, self.rows(x)))

    def auxiliary_step(
        self, auxiliary: AbstractSDE, t0: RealScalar, t1: RealScalar, x: State
    ) -> AffineStep:
        return self._flat(self.sde.auxiliary_step(auxiliary, t0, t1, self.rows(x)))

    def _flat(self, step: AffineStep) -> AffineStep:
        operator = for_every_column(step.operator, self.dim)
        covariance = for_every_column(step.covariance, self.dim)
        return AffineStep(operator, step.shift.reshape(-1), covariance)


def for_every_column(A: Structured, dim: int) -> Structured:
    """A ⊗ I: the map on y = x.reshape(-1) that is A on every column of x."""
    if A.ndim == 0:
        return A
    if A.ndim == 1:
        return jnp.repeat(A, dim)
    # `jnp.kron`, as one product that JAX can fuse with what follows
    one = diagonal_matrix(jnp.ones((), A.dtype), dim)
    return jnp.einsum("ij,de->idje", A, one).reshape(A.shape[0] * dim, A.shape[1] * dim)
