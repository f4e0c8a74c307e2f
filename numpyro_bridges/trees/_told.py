"""What is seen below a node, for guides whose covariances follow the state.

A guide that follows wants of a node what it wants of an observation, and beside it the time beyond:
a law

    value = L x + N(0, Σ + κ L a Lᵀ)

of the state x, for whatever covariance a the process has where a path is. With a = a₀ frozen,
messages of a Brownian motion give H = Lᵀ (Σ + κ L a₀ Lᵀ)⁻¹ L and F = H x̂. The part κ is the time
to the tips of a tree on which nothing but branches counts, where the tips' errors are at most the
true ones; parallel sums of positive matrices are monotone, so what is left, Σ, is a covariance:

- everything seen:      L = 1,    Σ = H⁻¹ − κ a₀,       value H⁻¹ F;
- some of it:           L = Rᵀ,   Σ = 1 − κ Rᵀ a₀ R,    value R⁻¹ F,     R Rᵀ = H.

A subtree is a tip whose branch is longer (Felsenstein 1973), and Σ is its error. a₀ is one for the
tree.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from .._linalg import add, cholesky, compose, congruence, diagonal, promote, solve_lower
from .._types import State, Structured
from ..conditioning import Observation
from ..guiding import are_few
from ._information import Information

_KEPT = 0.01
"""The part of κ a that does not follow: rounding, of whatever precision, is less than it and so
leaves a covariance.
"""


class Part(NamedTuple):
    """What messages are about: of a displacement x from the root all, or y = Q x where few noises
    drive it.

    With σ = Qᵀ R at the root, Q of orthonormal rows, a = R Rᵀ is the covariance of y, and a state
    is taken for Qᵀ y: so are all that the noise reaches where σ stays as it is.
    """

    basis: Float[Array, "k n"] | None
    """Q; `None` for all of x."""
    a: Structured

    @classmethod
    def of(cls, sigma: Structured, a: Structured) -> "Part":
        """For a process with this σ and a."""
        if not are_few(sigma, len(sigma) if sigma.ndim else 0):
            return cls(None, a)
        # σ = Q R with Q (n, k) of orthonormal columns, so that a = Q (R Rᵀ) Qᵀ
        Q, R = jnp.linalg.qr(sigma)
        return cls(Q.T, R @ R.T)

    def of_state(self, x: State) -> State:
        """Of a displacement, or a state like it."""
        return x if self.basis is None else self.basis @ x

    def seen(self, seen: Observation) -> Observation:
        """What is seen of a state, of y."""
        if self.basis is None:
            return seen
        # L x with x = Qᵀ y
        return Observation(compose(seen.operator, self.basis.T), seen.factor, seen.log_scale)

    def known(self, seen: Observation) -> Observation:
        """What is known of y, of a state."""
        if self.basis is None:
            return seen
        return Observation(compose(seen.operator, self.basis), seen.factor, seen.log_scale)

    def lifted(self, y: State) -> State:
        """A displacement with this y."""
        return y if self.basis is None else self.basis.T @ y

    def message(self, message: Information) -> Information:
        """Of a displacement."""
        Q = self.basis
        return (
            message if Q is None else Information(Q.T @ message.H @ Q, Q.T @ message.F, message.c)
        )


class Told(NamedTuple):
    """Sums over branches that meet, and over what is seen of a node."""

    information: Information
    """Of the state, where a is a₀."""
    rate: Float[Array, ""]
    """1/κ."""


def told_by(seen: Observation, observed: State, time: Array, a: Structured, like: State) -> Told:
    """What an observation tells of the state a time before, which is like this."""
    # the message of a Brownian motion of covariance a₀: Σ + t L a₀ Lᵀ
    factor = cholesky(add(seen.covariance, time * congruence(seen.operator, a)))
    information = Information.told_by(seen, observed, factor, like)
    if seen.factor is None:
        # without an error all of the time t is κ
        return Told(information, 1 / time)
    # an error counts as time behind the tip, of so much covariance at most, to which t is added
    error = Information.told_by(seen, observed, seen.factor, like)
    # κ a for the κ of which this is the rate is no more than the error, for whatever direction
    rate = jnp.trace(error.H) * jnp.sum(diagonal(a, like.shape[0]))
    return Told(information, _after(rate, time))


def earlier(told: Told, time: Array, a: Structured) -> Told:
    """What is told of a node tells of the state a time before."""
    # an observation Rᵀ y + N(0, I), to which a branch of length t adds t Rᵀ a₀ R
    seen, w, c = told.information.as_observation()
    one = jnp.eye(len(w), dtype=w.dtype)
    factor = cholesky(one + time * promote(congruence(seen.operator, a), 2, len(w)))
    information = Information.told_by(seen, w, factor, told.information.F)
    return Told(information._replace(c=information.c + c), _after(told.rate, time))


def _after(rate, time):
    """1/(κ + t)."""
    # from the rate, which is finite where κ is infinite: where nothing is seen
    return rate / (1 + time * rate)


class Seen(NamedTuple):
    """What is told as an observation of the node."""

    seen: Observation
    value: State
    beyond: Array
    """κ."""
    reference: State
    """A state that agrees with it."""


def as_seen(told: Told, a: Structured, everything: bool) -> Seen:
    """`everything`: whether all of every state is seen."""
    seen, value, _ = told.information.as_observation()
    operator = seen.operator
    R = operator.T
    n = len(value)
    dtype = value.dtype
    # of w = Rᵀ x + N(0, I): the covariance of all its error, and x̂ = R⁻ᵀ w
    whole = jnp.eye(n, dtype=dtype)
    mean = solve_lower(R, value, transposed=True)
    if everything:
        # the same as x̂ = x + N(0, H⁻¹), H⁻¹ = R⁻ᵀ R⁻¹, whose operator is 1
        inverse = solve_lower(R, whole)
        operator = jnp.ones((), dtype)
        value = mean
        whole = inverse.T @ inverse
    # the inner `where` keeps a division by 0 out of the derivative
    kappa = jnp.where(told.rate > 0, 1 / jnp.where(told.rate > 0, told.rate, 1.0), 0.0)
    kappa = (1 - _KEPT) * kappa
    error = whole - kappa * promote(congruence(operator, a), 2, n)
    # where rounding has left no covariance nothing follows, and what is factorised then is
    # another matrix: the derivative of a factor that is NaN would be NaN too
    found = jnp.all(jnp.isfinite(cholesky(lax.stop_gradient(error))))
    factor = cholesky(jnp.where(found, error, whole))
    return Seen(
        Observation(operator, factor, jnp.zeros((), dtype)),
        value,
        jnp.where(found, kappa, 0.0),
        mean,
    )
