"""A stochastic differential equation on H, dX = b(t, X) dt + σ(t, X) dW (Itô), and its steps.

States are `(n, dim)` or `(n,)`; σ acts on the first axis, so a = σσᵀ is n × n and the same for
every column.
"""

import abc
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.extend.core import Literal
from jaxtyping import Array, Float

from .._checks import require, require_instance
from .._linalg import add, apply, promote, safe_sqrt
from .._types import RealScalar, State, Structured
from ..spaces import AbstractSpace

_MAX_LINEARISED = 64
"""Largest state, n · dim numbers, whose drift is linearised by its full Jacobian."""


class Transition(eqx.Module):
    """One step of the time-discretised model, x' = start + increment + factor u with u ~ N(0, I).

    `covariance` is factor factorᵀ. The increment is held, and not the mean, since a step may be
    short beside the state: bridges add it to what is left of the way to the observed end.
    """

    start: State
    increment: State
    factor: Structured
    covariance: Structured

    @property
    def mean(self) -> State:
        """start + increment."""
        return self.start + self.increment


class AffineStep(eqx.Module):
    """One step of a linear process, x' ~ N(operator x + shift, covariance)."""

    operator: Structured
    shift: State
    covariance: Structured


class DiffusionTerm(diffrax.AbstractTerm):
    """σ(t, x) dW as a diffrax term: σ acts on the first axis of the increment `(k, dim)`."""

    vector_field: Callable
    control: diffrax.AbstractPath

    def vf(self, t, y, args):
        return self.vector_field(t, y)

    def contr(self, t0, t1, **kwargs):
        return self.control.evaluate(t0, t1, **kwargs)

    def prod(self, vf, control):
        return jax.tree.map(lambda dw: apply(vf, dw), control)


class AbstractSDE(eqx.Module):
    """dX = b(t, X) dt + σ(t, X) dW.

    A subclass gives `drift`, `noise`, `space` and `has_constant_covariance`. Parameters are array
    leaves, so that they can be traced and have priors. Times and states are those of one path; σ is
    a scalar, a diagonal `(n,)` or a matrix `(n, k)`.

        class GeometricBrownianMotion(nb.AbstractSDE):
            growth: Array
            volatility: Array
            space: ClassVar[None] = None

            def drift(self, t, x):
                return self.growth * x

            def noise(self, t, x):
                sigma = self.volatility * x  # a diagonal: one noise for each row of x, (n,)
                return sigma, sigma**2

            def has_constant_covariance(self, x):
                return False

    Its steps are those of Euler and Maruyama; one with another scheme overrides `transition`.
    """

    if TYPE_CHECKING:  # no argument of a constructor, and a subclass may make it a property

        @property
        def space(self) -> AbstractSpace | None: ...

    else:
        space: eqx.AbstractVar[AbstractSpace | None]
    """Where states live; `None` is Euclidean space."""

    has_exact_transition: ClassVar[bool] = False
    """Whether a step of any length has its exact law, so that one is enough."""

    @abc.abstractmethod
    def drift(self, t: RealScalar, x: State) -> State:
        """b(t, x), shaped like x."""

    @abc.abstractmethod
    def noise(self, t: RealScalar, x: State) -> tuple[Structured, Structured]:
        """σ(t, x) and a(t, x) = σσᵀ, computed together."""

    @abc.abstractmethod
    def has_constant_covariance(self, x: State) -> bool:
        """Whether a(t, x) is known not to depend on x; decides the default guide."""

    def is_autonomous(self, x: State) -> bool:
        """Whether b and σ are known not to depend on t; it is then shown the time since t0."""
        return not depends_on(lambda t, y: (self.drift(t, y), self.noise(t, y)), x, 0)

    def frame(
        self, x0: State, end: State, elapsed: Float[Array, " K+1"], clock: RealScalar
    ) -> "Frame":
        """Displacements from `end`; an SDE may let the origin move along its noise-free path."""
        return still_frame(self, x0, end, elapsed, clock)

    def diffusion(self, t: RealScalar, x: State) -> Structured:
        """σ(t, x)."""
        return self.noise(t, x)[0]

    def covariance(self, t: RealScalar, x: State) -> Structured:
        """a(t, x) = σσᵀ: `()`, `(n,)` or `(n, n)`."""
        return self.noise(t, x)[1]

    def energy(self, t: RealScalar, x: State, p: State) -> Float[Array, ""]:
        """½ Σ pᵀ a(t, x) p over columns, without a where few noises make it."""
        sigma, a = self.noise(t, x)
        if sigma.ndim == 2 and sigma.shape[1] < x.shape[0]:
            # |σᵀ p|²; that a is formed as well is left to the compiler, which drops it
            return 0.5 * jnp.sum(apply(sigma.T, p) ** 2)
        return 0.5 * jnp.sum(p * apply(a, p))

    def covariance_divergence(self, t: RealScalar, x: State) -> State:
        """(div a)_i = Σ_j ∂a_ij/∂x_j, shaped like x."""
        if self.has_constant_covariance(x):
            return jnp.zeros_like(x)
        jacobian = jax.jacfwd(lambda y: promote(self.covariance(t, y), 2, x.shape[0]))(x)
        return jnp.einsum("ijj...->i...", jacobian)

    def covariance_double_divergence(self, t: RealScalar, x: State) -> Float[Array, ""]:
        """∇·div a = Σ_ij ∂²a_ij/∂x_i∂x_j."""
        if self.has_constant_covariance(x):
            return jnp.zeros((), x.dtype)
        return divergence(lambda y: self.covariance_divergence(t, y), x)

    def closed(self, t: RealScalar, x: State) -> "AbstractSDE":
        """The same SDE for states shaped like x, with what a user's functions read frozen.

        An SDE whose coefficients are computed from its own leaves is that already.
        """
        return self

    def noise_size(self, x: State) -> int:
        """Number k of driving noises per column."""
        factor = at_any_time(self.diffusion, x)
        return factor.shape[1] if len(factor.shape) == 2 else x.shape[0]

    def transition(self, t0: RealScalar, t1: RealScalar, x: State) -> Transition:
        """The model's step from t0 to t1; Euler–Maruyama unless the class has its exact law."""
        dt = t1 - t0
        factor, covariance = self.noise(t0, x)
        # The covariance as the SDE has it: of smooth noise it is a kernel matrix, cheaper and more
        # accurate than the square of its factor. A step may have no length, where √ has no slope.
        return Transition(x, dt * self.drift(t0, x), safe_sqrt(dt) * factor, dt * covariance)

    def transition_from(
        self, origin: State, t0: RealScalar, t1: RealScalar, y: State
    ) -> Transition:
        """The step of the displacement y = x − origin."""
        # The increment is that of x, and is added to y, which is small near the end of a bridge.
        return replace(self.transition(t0, t1, origin + y), start=y)

    def linearised_drift(self, t: RealScalar, x: State) -> tuple[Structured, State]:
        """B and β with b(t, y) ≈ B y + β near x; B = 0 for states of more than 64 numbers.

        B acts on the first axis: for `dim` > 1 it is the mean over columns of the Jacobian's
        diagonal blocks.
        """
        b = self.drift(t, x)
        if x.size > _MAX_LINEARISED:
            return jnp.zeros((), x.dtype), b
        jacobian = jax.jacfwd(self.drift, argnums=1)(t, x)
        # of shape (n, dim, n, dim) where a state has columns
        B = jacobian if x.ndim == 1 else jnp.einsum("idjd->ij", jacobian) / x.shape[1]
        return B, b - apply(B, x)

    def linearised_step(self, t0: RealScalar, t1: RealScalar, x: State) -> AffineStep:
        """The model's step with drift and covariance linearised at x."""
        dt = t1 - t0
        B, beta = self.linearised_drift(t0, x)
        operator = add(jnp.ones((), x.dtype), dt * B)
        return AffineStep(operator, dt * beta, dt * self.covariance(t0, x))

    def auxiliary_step(
        self, auxiliary: "AbstractSDE", t0: RealScalar, t1: RealScalar, x: State
    ) -> AffineStep:
        """A linear auxiliary process, stepped by the scheme that steps this SDE."""
        # By Euler's scheme, even where the auxiliary process has an exact one: a guide that equals
        # the SDE then has the same transitions, and its weights do not depend on the noise.
        dt = t1 - t0
        B, beta = auxiliary.linearised_drift(t0, x)
        operator = add(jnp.ones((), x.dtype), dt * B)
        return AffineStep(operator, dt * beta, dt * auxiliary.covariance(t0, x))

    def ito_is_stratonovich(self, x: State) -> bool:
        """Whether the Itô and the Stratonovich reading coincide: then solvers of both are right."""
        return self.has_constant_covariance(x)

    def terms(self, control: diffrax.AbstractPath) -> diffrax.MultiTerm:
        """diffrax terms, driven by `control` with values `(k, dim)`."""
        return diffrax.MultiTerm(
            diffrax.ODETerm(lambda t, y, args: self.drift(jnp.asarray(t), y)),
            DiffusionTerm(self.diffusion, control),
        )

    def start(self, x: State) -> State:
        """x, a start; NaN where `check_state` would refuse it but cannot, since x is traced."""
        return x

    def check_end(self, find: Callable[[], State]) -> None:
        """Warns where the state `find()`, to which paths are led, is beyond this SDE."""
        return None

    def check_error(self, find: Callable[[], Structured | None], duration: RealScalar) -> None:
        """Warns where the error of observation that `find()` returns, a factor of its covariance,
        is as small as what the SDE adds to itself for the sake of its digits, in a time.
        """
        return None

    def check_state(self, x: State) -> None:
        """`ValueError` where x cannot be a state. The time is traced, none in particular."""
        require_space(self.space, x)
        factor, drift = at_any_time(lambda t, y: (self.diffusion(t, y), self.drift(t, y)), x)
        if drift.shape != x.shape:
            raise ValueError(
                f"`drift` must return an array shaped like the state, {x.shape}; got "
                f"{drift.shape}. A parameter with a batch axis does this too: vmap over it."
            )
        if factor.shape and (factor.shape[0] != x.shape[0] or 0 in factor.shape):
            raise ValueError(
                f"`diffusion` must be a scalar, a diagonal ({x.shape[0]},) or a matrix "
                f"({x.shape[0]}, k); got {factor.shape} for a state {x.shape}."
            )


class Frame(NamedTuple):
    """Displacements y = x − o(t) from a path o that ends where the end state is to be."""

    sde: Any
    """The SDE of y, in the time that has elapsed: a `Displaced` where the origin does not move."""
    origins: Float[Array, "K+1 n *dim"]
    """o at the grid times, the last being the state that meets the condition."""
    start: State
    """y at t0."""


class Displaced(AbstractSDE):
    """The process Y = X − origin of an SDE, in the time that has elapsed: plus `clock`, the SDE's.

    y keeps its digits where it is small beside x; x = origin + y is formed only to evaluate b and σ
    there.
    """

    sde: AbstractSDE
    origin: State
    clock: Float[Array, ""]

    def __init__(self, sde: AbstractSDE, origin: State, clock: RealScalar):
        self.sde = sde
        self.origin = origin
        self.clock = jnp.asarray(clock)

    @property
    def space(self) -> AbstractSpace | None:
        return self.sde.space

    def alongside(self, other: AbstractSDE) -> "Displaced":
        """Another SDE, seen from the same origin."""
        return Displaced(other, self.origin, self.clock)

    def drift(self, t: RealScalar, x: State) -> State:
        return self.sde.drift(self.clock + t, self.origin + x)

    def noise(self, t: RealScalar, x: State) -> tuple[Structured, Structured]:
        return self.sde.noise(self.clock + t, self.origin + x)

    def energy(self, t: RealScalar, x: State, p: State) -> Float[Array, ""]:
        return self.sde.energy(self.clock + t, self.origin + x, p)

    def has_constant_covariance(self, x: State) -> bool:
        return self.sde.has_constant_covariance(self.origin + x)

    def is_autonomous(self, x: State) -> bool:
        return self.sde.is_autonomous(self.origin + x)

    def ito_is_stratonovich(self, x: State) -> bool:
        return self.sde.ito_is_stratonovich(self.origin + x)

    def noise_size(self, x: State) -> int:
        return self.sde.noise_size(self.origin + x)

    def check_state(self, x: State) -> None:
        self.sde.check_state(self.origin + x)

    def transition(self, t0: RealScalar, t1: RealScalar, x: State) -> Transition:
        return self.sde.transition_from(self.origin, self.clock + t0, self.clock + t1, x)

    def linearised_drift(self, t: RealScalar, x: State) -> tuple[Structured, State]:
        # β anew, and not β + B o: the tangent at y passes through b there.
        B, _ = self.sde.linearised_drift(self.clock + t, self.origin + x)
        return B, self.drift(t, x) - apply(B, x)

    def linearised_step(self, t0: RealScalar, t1: RealScalar, x: State) -> AffineStep:
        """Tangent to `transition` at x, whose increment has digits that the shift of X has lost."""
        step = self.sde.linearised_step(self.clock + t0, self.clock + t1, self.origin + x)
        shift = self.transition(t0, t1, x).mean - apply(step.operator, x)
        return AffineStep(step.operator, shift, step.covariance)

    def auxiliary_step(
        self, auxiliary: AbstractSDE, t0: RealScalar, t1: RealScalar, x: State
    ) -> AffineStep:
        return self.sde.auxiliary_step(self.alongside(auxiliary), t0, t1, x)


def still_frame(
    sde: AbstractSDE, x0: State, end: State, elapsed: Float[Array, " K+1"], clock: RealScalar
) -> Frame:
    """Displacements from `end`, at all times."""
    origins = jnp.broadcast_to(end, (elapsed.shape[0], *end.shape))
    return Frame(Displaced(sde, end, clock), origins, x0 - end)


def depends_on(f: Callable, x: State, argument: int) -> bool:
    """Whether f(t, x) is computed from t, argument 0, or from x, argument 1, by the traced program.

    The argument is followed from equation to equation: a `True` may be over-cautious.
    """
    # JAX keeps what it has traced by the function, so a new one is made at each call.
    time = jax.ShapeDtypeStruct((), x.dtype)
    jaxpr = jax.make_jaxpr(lambda t, y: f(t, y))(time, x).jaxpr
    # Equations come in order: one pass reaches all that depends on the argument.
    reached = {jaxpr.invars[argument]}
    for eqn in jaxpr.eqns:
        if any(not isinstance(v, Literal) and v in reached for v in eqn.invars):
            reached.update(eqn.outvars)
    return any(not isinstance(v, Literal) and v in reached for v in jaxpr.outvars)


def at_any_time(coefficient: Callable, x: State):
    """Shapes of a coefficient (t, x), which may be defined on [t0, t1] only: the time is traced."""
    time = jax.ShapeDtypeStruct((), x.dtype)
    # a new function at each call: JAX keeps shapes by the function
    return jax.eval_shape(lambda t, y: coefficient(t, y), time, x)


def require_space(space: AbstractSpace | None, x: State | None = None) -> None:
    """`space` is a space or `None`, and x is one of its states."""
    if space is None:
        return
    require_instance(
        space, AbstractSpace, "space", "a space, such as `Landmarks(num_points, dim)`, or `None`"
    )
    if x is not None:
        shape = (space.size, space.dim)
        require(
            x.shape == shape or (x.shape == shape[:1] and space.dim == 1),
            f"`x0`, a state of this `space`, must have shape {shape}; got {x.shape}. Give the "
            "space of these states, or none.",
        )


def divergence(field: Callable, x: State) -> Float[Array, ""]:
    """∇·field at x, for a field shaped like x."""
    return jnp.trace(jax.jacfwd(field)(x).reshape(x.size, x.size))


def as_state_shift(shift, x: State) -> State:
    """β, scalar, `(n,)` or `(n, dim)`, shaped like x."""
    shift = shift[:, None] if shift.ndim == 1 and x.ndim == 2 else shift
    return jnp.broadcast_to(shift, x.shape)
