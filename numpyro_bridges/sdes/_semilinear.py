"""Semilinear SDEs: a generator of a semigroup, and what is not linear, held over a step."""

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from .._checks import as_float, choice, require, require_finite
from .._linalg import add, apply, compose, congruence
from .._types import RealScalar, State, Structured
from ..spaces import AbstractSpace
from ._base import AbstractSDE, AffineStep, Transition, at_any_time
from ._exponential import affine_step, exponential_noise_size, exponential_transition, flow
from ._sde import AbstractFunctionSDE

_MAX_LINEARISED = 64
"""Largest state, n · dim numbers, for a full Jacobian of the nonlinearity; beyond, its diagonal."""


class SemilinearSDE(AbstractFunctionSDE):
    """dX = (A X + F(t, X)) dt + B(t, X) dW, stepped by exponential Euler.

    x' = e^{A dt} x + ∫₀^dt e^{Au} du F(t, x) + N(0, ∫₀^dt e^{Au} B Bᵀ e^{Aᵀu} du), F and B held at
    the start of a step: the exact law where F = 0 and B is constant, and stable however fast the
    modes of A decay, where a step of Euler–Maruyama must be short beside the fastest. For a
    reaction–diffusion equation A is ν Δ,

        space = FourierBasis(32, 1)

        def reaction(t, x, args):
            return space.from_points(f(space.to_points(x)))

        SemilinearSDE(0.1 * space.laplacian, reaction, sigma)

    **Arguments:**

    - `linear`: A, `()`, `(n,)` where it is diagonal in the basis of the states, or `(n, n)`.
    - `nonlinearity`: F, `f(t, x, args)`, shaped like x, for t in [t0, t1].
    - `diffusion`: B, an array, `()`, `(n,)` or `(n, k)`, or a function `f(t, x, args)` that returns
      one.
    - `args`: the parameters of the functions, a pytree of arrays, as for `SDE`.
    - `space`: where states live, for the H-norm of conditions; Euclidean if not given.
    - `scheme`: `"euler"`, or `"midpoint"`, which takes F and B where half a step without noise
      leads, and stretches the noise of the step by e^{½ dt F'}, F' its diagonal (beyond 64 numbers
      one for all, by one product with F'). For B that does not depend on x what is left of the
      error is of second order where F is linear and diagonal, and smaller than Euler's elsewhere; a
      step costs two to three times as much.

    Lord, Powell and Shardlow (2014), An Introduction to Computational Stochastic PDEs, section
    10.8.
    """

    linear: Structured
    nonlinearity_function: Any
    scheme: str = eqx.field(static=True)
    pull: ClassVar[str] = "nonlinearity"

    def __init__(
        self,
        linear: ArrayLike,
        nonlinearity: Callable,
        diffusion: ArrayLike | Callable,
        args: Any = None,
        *,
        space: AbstractSpace | None = None,
        scheme: str = "euler",
    ):
        self.scheme = choice(scheme, "scheme", ("euler", "midpoint"))
        self.linear = as_float(linear, "linear")
        shape = self.linear.shape
        require(
            len(shape) < 2 or shape == shape[:1] * 2,
            "`linear` must be a scalar, a diagonal (n,) or a square matrix (n, n); got shape "
            f"{shape}. An operator that the basis does not diagonalise is given as its matrix in "
            "the basis.",
        )
        require_finite(self.linear, "linear")
        if not callable(diffusion):
            # A module, whose value is a leaf: it may be traced, and have a prior.
            diffusion = _Constant(as_float(diffusion, "diffusion"))
            require_finite(diffusion.value, "diffusion")
        super().__init__(nonlinearity, diffusion, args, space)

    def drift(self, t: RealScalar, x: State) -> State:
        return apply(self._generator(x), x) + self.pulled(t, x)

    def _generator(self, x: State) -> Structured:
        """A in the precision of the state."""
        return self.linear.astype(x.dtype)

    def transition(self, t0: RealScalar, t1: RealScalar, x: State) -> Transition:
        dt = t1 - t0
        A = self._generator(x)
        F = self.pulled(t0, x)
        if self.scheme == "euler":
            return exponential_transition(A, F, self.noise(t0, x), dt, x)
        # Midpoint: half a step without noise, and then the whole step with F and B from there.
        still = jnp.zeros((), x.dtype)
        growth, shift, _ = flow(A, F, still, 0.5 * dt)
        half = x + apply(growth, x) + shift
        t = t0 + 0.5 * dt
        step = exponential_transition(A, self.pulled(t, half), self.noise(t, half), dt, x)
        # The noise at time u of a step is carried on by e^{(A + F') (dt − u)}. What A does is in
        # the exact step; F', by its diagonal, enters as for the half step that is left on average.
        stretch = jnp.exp(0.5 * dt * self._mean_slope(t, half))
        factor = compose(stretch, step.factor)
        return Transition(x, step.increment, factor, congruence(stretch, step.covariance))

    def _mean_slope(self, t: RealScalar, x: State) -> Structured:
        """The diagonal of F'; of large states its mean, vᵀ F' v / n for one v of random signs."""
        if x.size <= _MAX_LINEARISED:
            return self._diagonal_slope(t, x)
        # Always the same signs: a step is a function of the state, not of a draw.
        signs = jnp.asarray(np.random.default_rng(0).choice([-1.0, 1.0], x.shape), x.dtype)
        _, along = jax.jvp(lambda y: self.pulled(t, y), (x,), (signs,))
        return jnp.sum(signs * along) / x.size

    def linearised_drift(self, t: RealScalar, x: State) -> tuple[Structured, State]:
        """A + F'(x) and β; beyond 64 numbers F' is its diagonal, so that a diagonal A stays one."""
        slope, beta = self._linearised(t, x)
        return add(self._generator(x), slope), beta

    def linearised_step(self, t0: RealScalar, t1: RealScalar, x: State) -> AffineStep:
        # Tangent to exponential Euler, also where the midpoint scheme steps: a guide need not be
        # exact. `Displaced` puts the tangent through the step's own mean.
        slope, beta = self._linearised(t0, x)
        return affine_step(self._generator(x), slope, beta, self.covariance(t0, x), t1 - t0)

    def auxiliary_step(
        self, auxiliary: AbstractSDE, t0: RealScalar, t1: RealScalar, x: State
    ) -> AffineStep:
        # B = A + (B − A): A by its semigroup, and the rest held, as F is.
        B, beta = auxiliary.linearised_drift(t0, x)
        A = self._generator(x)
        return affine_step(A, add(B, -A), beta, auxiliary.covariance(t0, x), t1 - t0)

    def noise_size(self, x: State) -> int:
        return exponential_noise_size(self.linear, at_any_time(self.diffusion, x).shape, x)

    def check_state(self, x: State) -> None:
        n = x.shape[0]
        require(
            self.linear.ndim == 0 or self.linear.shape[0] == n,
            f"`linear` must be a scalar, a diagonal ({n},) or a matrix ({n}, {n}) for a state "
            f"{x.shape}; got shape {self.linear.shape}. An operator A on values at q points, such "
            "as one that the basis does not diagonalise, is Φᵀ A Φ / q for coefficients, Φ = "
            "`space.basis(space.grid)`. A parameter with a batch axis does this too: vmap over it.",
        )
        pulled = at_any_time(self.pulled, x)
        require(
            pulled.shape == x.shape,
            f"`nonlinearity` must return an array shaped like the state, {x.shape}; got "
            f"{pulled.shape}. A parameter with a batch axis does this too: vmap over it.",
        )
        super().check_state(x)

    def _linearised(self, t: RealScalar, x: State) -> tuple[Structured, State]:
        """F' and β with F(t, y) ≈ F' y + β near x; F' acts on rows, and is a mean over columns."""
        value = self.pulled(t, x)
        if x.size <= _MAX_LINEARISED:
            jacobian = jax.jacfwd(self.pulled, argnums=1)(t, x)
            slope = jacobian if x.ndim == 1 else jnp.einsum("idjd->ij", jacobian) / x.shape[1]
        else:
            slope = self._diagonal_slope(t, x)
        return slope, value - apply(slope, x)

    def _diagonal_slope(self, t: RealScalar, x: State) -> Structured:
        """The diagonal of F', one product with it at a time, so that no n × n matrix is held."""
        _, along = jax.linearize(lambda y: self.pulled(t, y), x)

        def entry(i):
            """eᵢᵀ F' eᵢ."""
            direction = jnp.zeros_like(x).reshape(-1).at[i].set(1.0).reshape(x.shape)
            return along(direction).reshape(-1)[i]

        entries = jax.lax.map(entry, jnp.arange(x.size), batch_size=_MAX_LINEARISED)
        return jnp.mean(entries.reshape(x.shape[0], -1), axis=1)


class _Constant(eqx.Module):
    """A coefficient that is the same everywhere."""

    value: Array

    def __call__(self, t, x, args):
        return self.value
