"""Linear SDEs, stepped by their exact law.

dX = (B X + β) dt + σ dW:
X_{t+τ} | X_t ~ N(e^{Bτ} X_t + ∫₀^τ e^{Bu} β du,  ∫₀^τ e^{Bu} σσᵀ e^{Bᵀu} du)
"""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._checks import as_float, concrete, require, require_finite
from .._linalg import add, apply, compose, semidefinite_cholesky, symmetric, transpose
from .._types import RealScalar, State, Structured
from ..spaces import AbstractSpace
from ._base import AbstractSDE, AffineStep, Frame, Transition, as_state_shift, require_space
from ._exponential import exponential_noise_size, exponential_transition, flow


class BrownianMotion(AbstractSDE):
    """Brownian motion with a covariance operator, dX = Q^½ dW.

    **Arguments:**

    - `covariance`: Q, `()`, `(n,)` (a diagonal) or `(n, n)`, positive semi-definite: that of a
      smooth field on many points is singular to the last digit, and is held by a factor of as many
      columns as it has directions. A traced matrix must be definite, since its directions cannot be
      counted.
    - `factor`: F `(n, m)` instead, with Q = F Fᵀ; also traced, and of any rank.
    - `space`: where states live, for the H-norm of conditions; Euclidean if not given.
    """

    covariance_operator: Structured | None
    factor: Float[Array, "n m"] | None
    space: AbstractSpace | None
    has_exact_transition: ClassVar[bool] = True

    def __init__(
        self,
        covariance: ArrayLike | None = None,
        *,
        factor: ArrayLike | None = None,
        space: AbstractSpace | None = None,
    ):
        require(
            (covariance is None) != (factor is None),
            "Give `covariance` or `factor`, one of the two.",
        )
        if factor is not None:
            Q = None
            F = as_float(factor, "factor")
            require_finite(F, "factor")
            require(
                F.ndim == 2 and F.size > 0,
                f"`factor` must be a matrix (n, m); got shape {F.shape}.",
            )
        else:
            Q = _as_symmetric(covariance, "covariance")
            F = _factor_of_singular(Q, "covariance")
        # One of the two is held: leaves that say the same could be changed apart.
        self.covariance_operator = Q if F is None else None
        self.factor = F
        require_space(space)
        self.space = space

    def drift(self, t: RealScalar, x: State) -> State:
        return jnp.zeros_like(x)

    def noise(self, t: RealScalar, x: State) -> tuple[Structured, Structured]:
        if self.factor is not None:
            return self.factor, compose(self.factor, transpose(self.factor))
        assert self.covariance_operator is not None
        # A traced Q may be any matrix: a slope is taken along symmetric ones.
        Q = symmetric(self.covariance_operator)
        return semidefinite_cholesky(Q), Q

    def linearised_drift(self, t: RealScalar, x: State) -> tuple[Structured, State]:
        return jnp.zeros((), x.dtype), jnp.zeros_like(x)

    def has_constant_covariance(self, x: State) -> bool:
        return True

    def is_autonomous(self, x: State) -> bool:
        return True


class LinearSDE(AbstractSDE):
    """A linear SDE, dX = (B X + β) dt + σ dW, with its exact transition.

    Ornstein–Uhlenbeck: `LinearSDE(-rate, sigma, rate * mean)`. The stochastic heat equation on a
    `FourierBasis`: `LinearSDE(-diffusivity * frequencies**2, sigma)`, a diagonal.

    **Arguments:**

    - `drift`: B, `()`, `(n,)` (a diagonal) or `(n, n)`.
    - `diffusion`: σ, `()`, `(n,)` or `(n, k)`; k < n is allowed (hypo-elliptic noise).
    - `shift`: β, `()`, `(n,)` or `(n, dim)`.
    - `space`: where states live; Euclidean if not given.
    """

    drift_operator: Structured
    diffusion_operator: Structured
    shift: Array
    space: AbstractSpace | None
    has_exact_transition: ClassVar[bool] = True

    def __init__(
        self,
        drift: ArrayLike,
        diffusion: ArrayLike,
        shift: ArrayLike = 0.0,
        *,
        space: AbstractSpace | None = None,
    ):
        self.drift_operator = as_float(drift, "drift")
        self.diffusion_operator = as_float(diffusion, "diffusion")
        self.shift = as_float(shift, "shift")
        require_space(space)
        self.space = space
        for name, value in (
            ("drift", self.drift_operator),
            ("diffusion", self.diffusion_operator),
            ("shift", self.shift),
        ):
            require_finite(value, name)
            require(
                value.ndim <= 2,
                f"`{name}` must be a scalar, a vector or a matrix; got shape {value.shape}.",
            )
            require(value.size > 0, f"`{name}` must not be empty; got shape {value.shape}.")
        # Sizes are compared with those of a state, by `check_state`: a diagonal does not say n.
        B = self.drift_operator
        require(
            B.ndim < 2 or B.shape[0] == B.shape[1], f"`drift` must be square; got shape {B.shape}."
        )

    def check_state(self, x: State) -> None:
        require_space(self.space, x)
        n = x.shape[0]
        for name, A, full in (
            ("drift", self.drift_operator, f"({n}, {n})"),
            ("diffusion", self.diffusion_operator, f"({n}, k)"),
        ):
            require(
                A.ndim == 0 or A.shape[0] == n,
                f"`{name}` must be a scalar, a diagonal ({n},) or a matrix {full} for a state "
                f"{x.shape}; got shape {A.shape}. A parameter with a batch axis does this too: "
                "vmap over it.",
            )
        require(
            self.shift.shape in ((), (n,), x.shape),
            f"`shift` must be a scalar, ({n},) or shaped like the state, {x.shape}; got shape "
            f"{self.shift.shape}.",
        )

    def drift(self, t: RealScalar, x: State) -> State:
        return apply(self.drift_operator, x) + as_state_shift(self.shift, x)

    def noise(self, t: RealScalar, x: State) -> tuple[Structured, Structured]:
        sigma = self.diffusion_operator
        return sigma, compose(sigma, transpose(sigma))

    def linearised_drift(self, t: RealScalar, x: State) -> tuple[Structured, State]:
        return self.drift_operator, as_state_shift(self.shift, x)

    def has_constant_covariance(self, x: State) -> bool:
        return True

    def is_autonomous(self, x: State) -> bool:
        return True

    def exact_step(self, t0: RealScalar, t1: RealScalar, x: State) -> AffineStep:
        """The exact affine Gaussian law of X at t1 given X at t0, for states shaped like x."""
        shift = as_state_shift(self.shift, x)
        growth, shift, S = flow(self.drift_operator, shift, self.covariance(t0, x), t1 - t0)
        return AffineStep(add(jnp.ones((), x.dtype), growth), shift, S)

    def transition(self, t0: RealScalar, t1: RealScalar, x: State) -> Transition:
        shift = as_state_shift(self.shift, x)
        return exponential_transition(self.drift_operator, shift, self.noise(t0, x), t1 - t0, x)

    def _displaced(self, drift: State) -> "LinearSDE":
        """The process seen from an origin where it has this drift."""
        return eqx.tree_at(lambda sde: sde.shift, self, drift)

    def transition_from(
        self, origin: State, t0: RealScalar, t1: RealScalar, y: State
    ) -> Transition:
        # With y = x − o: dY = (B Y + (B o + β)) dt + σ dW, linear too, so that no step of x, whose
        # digits may be lost, is formed.
        return self._displaced(self.drift(t0, origin)).transition(t0, t1, y)

    def frame(
        self, x0: State, end: State, elapsed: Float[Array, " K+1"], clock: RealScalar
    ) -> Frame:
        """Displacements from the noise-free path, moved to end at `end`: as small as the noise is.

        From `end` itself where that is nearer to the start: the noise-free path of an unstable
        equation may be far from where it is conditioned to go.
        """

        none = jnp.zeros((), x0.dtype)

        def moved(t):
            """How far the noise-free path has come."""
            growth, shift, _ = flow(self.drift_operator, as_state_shift(self.shift, x0), none, t)
            return apply(growth, x0) + shift

        way = end - x0
        # A choice of coordinates, which changes no result and has no derivative.
        distance = jnp.max(jnp.abs(jax.lax.stop_gradient(way - moved(elapsed[-1]))))
        moves = distance <= jnp.max(jnp.abs(way))  # False of NaN too
        # The still frame is the same formula at no time: the path stays at x0, and the gap is all
        # of the way.
        times = jnp.where(moves, elapsed, 0.0)
        gap = way - moved(times[-1])
        # o(t) = x(t) + gap, x(t) the noise-free path, so y = X − o has the drift B y + B gap; from
        # a point `end` it has B y + b(end).
        drift = jnp.where(moves, apply(self.drift_operator, gap), self.drift(clock, end))
        # The last origin is `end` itself, to the last digit.
        origins = jax.vmap(moved)(times[:-1]) + (x0 + gap)[None]
        return Frame(self._displaced(drift), jnp.concatenate([origins, end[None]]), -gap)

    def linearised_step(self, t0: RealScalar, t1: RealScalar, x: State) -> AffineStep:
        return self.exact_step(t0, t1, x)

    def auxiliary_step(
        self, auxiliary: AbstractSDE, t0: RealScalar, t1: RealScalar, x: State
    ) -> AffineStep:
        # By its own exact law, as this SDE is stepped by its own.
        return auxiliary.linearised_step(t0, t1, x)

    def noise_size(self, x: State) -> int:
        return exponential_noise_size(self.drift_operator, self.diffusion_operator.shape, x)


def as_covariance(value, name: str) -> Array:
    """A scalar, diagonal or matrix that is positive definite, where that can be known."""
    Q = _as_symmetric(value, name)
    require(
        _is_definite(concrete(Q)),
        f"`{name}` must be positive definite; its Cholesky factorisation fails. Remove duplicated "
        "points, or add a small multiple of the identity.",
    )
    return Q


def _as_symmetric(value, name: str) -> Array:
    Q = as_float(value, name)
    require_finite(Q, name)
    require(
        Q.ndim < 2 or (Q.ndim == 2 and Q.shape[0] == Q.shape[1]),
        f"`{name}` must be (), (n,) or (n, n); got {Q.shape}.",
    )
    require(
        Q.ndim < 2 or concrete(Q) is None or jnp.allclose(Q, Q.T),
        f"`{name}` must be symmetric; it differs from its transpose by "
        f"{concrete(jnp.max(jnp.abs(Q - Q.T)))}. Give the covariance, no factor of it.",
    )
    return Q


def _is_definite(Q: np.ndarray | None) -> bool:
    """Whether it is, or is not known. In NumPy: inside a traced program JAX would not say."""
    if Q is None or Q.ndim < 2:
        return Q is None or bool(np.all(Q > 0))
    try:
        return bool(np.all(np.diagonal(np.linalg.cholesky(Q)) > 0))
    except np.linalg.LinAlgError:
        return False


def _factor_of_singular(Q: Array, name: str) -> Array | None:
    """F with F Fᵀ = Q for a matrix known to have fewer directions than rows; `None` for others."""
    value = concrete(Q)
    if value is None or _is_definite(value):
        return None
    eigenvalues, vectors = np.linalg.eigh(value) if Q.ndim == 2 else (np.atleast_1d(value), None)
    least = eigenvalues.min()
    largest = eigenvalues.max()
    # Of a semi-definite matrix in this precision: eigenvalues as small are 0 but for rounding.
    rounding = 10 * len(eigenvalues) * np.finfo(value.dtype).eps * largest
    require(
        largest > 0 and least >= -rounding,
        f"`{name}` must be positive semi-definite, and not 0; its eigenvalues are from {least:.3g} "
        f"to {largest:.3g}.",
    )
    if vectors is None:
        return None  # a diagonal with zeros has a root as it is
    kept = eigenvalues > rounding
    return jnp.asarray(vectors[:, kept] * np.sqrt(eigenvalues[kept]))
