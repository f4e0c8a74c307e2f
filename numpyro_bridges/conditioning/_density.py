"""Conditions by their density: any smooth positive function ψ of the end state.

A path is led by a Gaussian ψ̃ and weighed by ψ: with all steps guided to what ψ̃ sees,

    E[exp(log weight under ψ̃) ψ(X_T) / ψ̃(X_T)] = E ψ(X_T),

exactly for any ψ̃, so that a poor one costs variance and no bias. It is found where the law
N(m, S Sᵀ) of the end state, of the SDE linearised along its path without noise, meets ψ best: at
the mode of log ψ(m + S ξ) − ½ |ξ|². There ψ is replaced by the Gaussian of the same slope whose
precision is W,

    ψ̃(x) = N(v; L x, I),      Lᵀ L = W,      v = L x* + L⁻ᵀ ∇log ψ(x*).

Where ψ has heavier tails than that, weights have no variance. Then each path has a ψ̃ of its own,
N(v; L x, I/τ) with log τ ~ N(0, s²), and what ψ is divided by is their mixture (the balance
heuristic of Veach and Guibas 1995).
"""

from abc import abstractmethod
from collections.abc import Callable
from copy import copy
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from .._checks import as_float, concrete, require, require_finite
from .._closed import Closed, close
from .._linalg import solve_lower
from .._types import State, Structured
from ..kernels._parameters import positive_scalar
from ..sdes import AbstractSDE, Flattened, for_every_column, wrapped
from ._base import AbstractCondition, AbstractMatch, Observation, Target
from ._message import gaussian_log_density

_MOST_STEPS = 20
"""Of Gauss and Newton, to the mode."""
_POLISHINGS = 5
"""Of Newton alone, near it."""
_PARTS = 0.5 ** np.arange(8)
"""Of a step, the best of which is taken."""
_GRID = np.linspace(-8.0, 8.0, 401)
"""For integrals over the normal z of log τ = s z: what falls to 0 the trapezoidal rule has nearly
exactly.
"""
_FLAT = 1e-3
"""Least curvature of log ψ̃ beside that of the law of the end state: with less, v would be so far
that its digits are lost.
"""
_LOG_2PI = 1.8378770664093453


class AbstractDensityMatch(AbstractMatch):
    """A match that is known by log ψ(x), the log density of what is observed of the end state x.

    A subclass gives `log_density`. Where it is no density of an observation, such as a kernel of a
    distance between curves, evidence is that of the kernel: ratios of it compare parameters of the
    SDE, whereas the kernel's own parameters have no likelihood. It then draws no observation, and
    `sample` says so; where it is one, a subclass overrides `sample`.
    """

    @property
    def spread(self) -> Float[Array, ""] | None:
        """s, the standard deviation of log τ, for a ψ whose tails are heavier than normal ones."""
        return None

    @abstractmethod
    def log_density(self, sde: AbstractSDE, x: State, observed: State) -> Float[Array, ""]:
        """log ψ(x), twice differentiable in x near where the data lead; `x` is a state of `sde`."""

    def precision(self, sde: AbstractSDE, x: State, observed: State) -> Float[Array, "N N"]:
        """W of the Gaussian that guides, for x.reshape(-1): the positive part of −∂² log ψ(x).

        For ψ = exp(−½ |r(x)|²) the matrix of Gauss and Newton, of the Jacobian of r, is better.
        """

        def log_density(y):
            return self.log_density(sde, y.reshape(x.shape), observed)

        return positive_part(-jax.hessian(log_density)(x.reshape(-1)))

    def at(self, observed) -> AbstractCondition:
        """The condition that `observed` was seen."""
        observed = as_float(observed, "observed")
        require_finite(observed, "observed")
        return _DensityCondition(self, observed)

    def sample(self, key: PRNGKeyArray, sde: AbstractSDE, x: State) -> Array:
        raise ValueError(
            f"{type(self).__name__} weighs the end state and is no law of an observation, so "
            "nothing can be drawn from it. Draw end states by `simulate`, or give the match a "
            "`sample` of its own."
        )

    def example(self, sde: AbstractSDE, x: State) -> Array:
        """An observation: the end state x itself, unless a subclass says how data look."""
        return x

    def check_density(self) -> None:
        pass


class DensityMatch(AbstractDensityMatch):
    """The end state is weighed by a user's function.

    **Arguments:**

    - `log_density`: `f(x, observed, args)`, log ψ(x) for the datum `observed`: a finite number,
      smooth in x.
    - `args`: its parameters, a pytree of arrays. What a prior is put on belongs here; then ψ must
      be normalised as a density of `observed`.
    - `sample`: `f(key, x, args)`, a draw of what is observed of the end state x. Without it laws
      have a density and draw nothing, and data are shaped like states.
    - `spread`: for a ψ with heavy tails, the standard deviation of the log of a factor by which
      each path widens the normal density that leads it, such as 1.0 in few dimensions; it costs a
      row of noise.

    The function is held as it is when a bridge or a law is made, as for `SDE`.
    """

    function: Any
    """`None` where the program is held in its place."""
    args: Any
    log_scale_sd: Float[Array, ""] | None
    sampler: Callable | None = eqx.field(static=True)
    program: Closed | None

    def __init__(
        self,
        log_density: Callable,
        args: Any = None,
        *,
        sample: Callable | None = None,
        spread=None,
    ):
        for name, f in (("log_density", log_density), ("sample", sample)):
            good = callable(f) or (f is None and name == "sample")
            shape = "(x, observed, args)" if name == "log_density" else "(key, x, args)"
            require(good, f"`{name}` must be a function f{shape}; got {f!r}.")
        self.function = wrapped(log_density)
        self.sampler = sample
        self.args = jax.tree.map(lambda leaf: as_float(leaf, "args"), args)
        self.log_scale_sd = None if spread is None else positive_scalar("spread")(spread)
        self.program = None

    @property
    def spread(self):
        return self.log_scale_sd

    def closed(self, x: State, observed: State) -> Self:
        if self.program is not None:
            return self
        # A copy whose fields are set: a module is frozen, and its constructor takes other arguments
        # than fields. Without the function, conditions that compute the same are equal to `jit`.
        closed = copy(self)
        object.__setattr__(closed, "program", close(self.function, x, observed, self.args))
        object.__setattr__(closed, "function", None)
        return closed

    def log_density(self, sde, x, observed):
        function = self.function if self.program is None else self.program
        return jnp.asarray(function(x, observed, self.args), x.dtype)

    def sample(self, key, sde, x):
        if self.sampler is None:
            return super().sample(key, sde, x)
        return jnp.asarray(self.sampler(key, x, self.args), x.dtype)

    def example(self, sde, x):
        return x if self.sampler is None else self.sample(jax.random.key(0), sde, x)


class _Guiding(eqx.Module):
    """ψ̃, as a function of x.reshape(-1)."""

    anchor: State
    """x*."""
    operator: Float[Array, "N N"]
    """L."""
    value: Float[Array, " N"]
    """v."""
    log_scale: Float[Array, ""]
    """That ψ̃ is to be scaled by to be ψ at the anchor."""

    def log_density(self, y: Float[Array, " N"]) -> Float[Array, ""]:
        """log N(v; L y, I)."""
        return gaussian_log_density(self.value - self.operator @ y, jnp.ones((), y.dtype))


class _DensityCondition(AbstractCondition):
    """A match by its density at its datum."""

    match: AbstractDensityMatch
    observed: State
    guiding: _Guiding | None
    draw: Float[Array, "1 k *dim"] | None
    """The row of noise whose first number is log τ / s."""
    exact: ClassVar[bool] = False
    is_approximated: ClassVar[bool] = True

    def __init__(self, match: AbstractDensityMatch, observed: State):
        self.match = match
        self.observed = observed
        self.guiding = None  # until it is `anchored`
        self.draw = None  # until it is `drawn`

    @property
    def num_extra_noises(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return int(self.match.spread is not None)

    def _with(self, **fields) -> "_DensityCondition":
        other = copy(self)
        for name, value in fields.items():
            object.__setattr__(other, name, value)
        return other

    def drawn(self, extra):
        return self if self.match.spread is None else self._with(draw=extra)

    def draw_of(self, x, shape, key):
        # The row's other numbers have no effect. The first has the law of z given x, by inversion
        # of its distribution function on the grid; without a key it is the median.
        rest = jnp.zeros(shape, x.dtype) if key is None else jr.normal(key, shape, x.dtype)
        log_mass = self._log_terms(x)
        place = 0.5 if key is None else jr.uniform(jr.fold_in(key, 1), dtype=x.dtype)
        cumulative = jnp.cumsum(jax.nn.softmax(log_mass))
        z = jnp.interp(place, cumulative, jnp.asarray(_GRID, x.dtype))
        return rest.reshape(-1).at[0].set(z).reshape(shape)

    def _log_scale(self) -> Array:
        """log τ."""
        if self.draw is None or self.match.spread is None:
            return jnp.zeros((), self._known.value.dtype)
        return self.match.spread.astype(self.draw.dtype) * self.draw.reshape(-1)[0]

    def _log_terms(self, x: State) -> Float[Array, " grid"]:
        """log of N(z; 0, 1) N(v; L x, I/τ(z)) dz at the z of the grid."""
        assert self.match.spread is not None
        z = jnp.asarray(_GRID, x.dtype)
        log_scale = self.match.spread.astype(x.dtype) * z
        r = self._known.value - self._known.operator @ x.reshape(-1)
        square = jnp.exp(log_scale) * jnp.sum(r * r)
        log_density = 0.5 * len(r) * (log_scale - _LOG_2PI) - 0.5 * square
        log_prior = -0.5 * z * z - 0.5 * _LOG_2PI
        return log_density + log_prior + jnp.log(z[1] - z[0])

    def closed(self, x):
        return self._with(match=self.match.closed(x, self.observed))

    def check(self, sde, x):
        shape = jax.eval_shape(lambda: self._log_density(sde, x)).shape
        require(
            shape == (),
            f"`log_density` must return one number; got shape {shape} for a state {x.shape} and "
            f"an observation {self.observed.shape}.",
        )

    def _log_density(self, sde: AbstractSDE, x: State):
        # A match is written for states; here they may be flattened.
        if isinstance(sde, Flattened):
            x = sde.rows(x)
            sde = sde.sde
        return self.match.log_density(sde, x, self.observed)

    def anchored(self, sde, find_law):
        if self.guiding is not None:
            return self
        guiding, slope = _guiding(self.match, self.observed, sde, *find_law())
        # Asked where paths are led to: elsewhere ψ may be what it likes.
        for what, values in (("", slope[0]), ("slope of ", slope[1])):
            values = concrete(values)
            require(
                values is None or jnp.all(jnp.isfinite(values)),
                f"`log_density` must be finite and smooth; the {what}log density is {values} at "
                f"the state {concrete(guiding.anchor)}, where paths are led to by it.",
            )
        return self._with(guiding=guiding)

    @property
    def _known(self) -> _Guiding:
        assert self.guiding is not None, "`anchored` comes first"
        return self.guiding

    def correction(self, sde, x):
        if self.draw is not None:
            # Over all τ that could have led a path here, not the one that has: the balance
            # heuristic, by which no weight is large where some τ is wide enough.
            told = jax.nn.logsumexp(self._log_terms(x))
        else:
            told = self._known.log_density(x.reshape(-1))
        return self._log_density(sde, x) - told - self._known.log_scale

    def observation(self, sde, x):
        sd = jnp.exp(-0.5 * self._log_scale()).astype(x.dtype)
        operator = self._known.operator.astype(x.dtype)
        return Observation(operator, sd, self._known.log_scale.astype(x.dtype))

    def reference(self, sde, x):
        return self._known.anchor.reshape(x.shape)

    def displaced(self, shift):
        return eqx.tree_at(lambda c: c.guiding.value, self, self._known.value - shift)

    def log_value(self, law_mean, law_factor):
        return gaussian_log_density(self._known.value - law_mean, law_factor)

    def target(self, law_mean, law_factor, noise):
        return Target(self._known.value, jnp.zeros((), law_mean.dtype))

    def noise_from_target(self, law_mean, law_factor, seen):
        return jnp.zeros((0, *seen.shape), seen.dtype) if self.draw is None else self.draw


@eqx.filter_jit
def _guiding(
    match: AbstractDensityMatch,
    observed: State,
    sde: AbstractSDE,
    mean: State,
    covariance: Structured,
):
    """ψ̃ at the mode, and log ψ and its slope there."""

    def log_density(y):
        return match.log_density(sde, y.reshape(mean.shape), observed)

    def precision(y):
        return match.precision(sde, y.reshape(mean.shape), observed)

    # All columns have one covariance, and ψ sees them together.
    root = for_every_column(_root(covariance), mean.size // mean.shape[0])
    y = mean.reshape(-1) + root @ _mode(log_density, precision, mean.reshape(-1), root)
    value, slope = jax.value_and_grad(log_density)(y)
    W = precision(y)
    # Eigenvalues of at least the floor: max(λ, floor) = floor + max(λ − floor, 0).
    prior = jnp.max(jnp.diagonal(covariance))
    floor = _FLAT / prior * jnp.eye(len(W), dtype=W.dtype)
    R = _root(floor + positive_part(W - floor))
    # L = Rᵀ, so that Lᵀ L = W, and v = L y + L⁻ᵀ ∇log ψ(y) gives ψ̃ the slope of ψ at y.
    observed_by_it = R.T @ y + solve_lower(R, slope)
    guiding = _Guiding(y.reshape(mean.shape), R.T, observed_by_it, jnp.zeros_like(value))
    # The scale gives it the value too, so that log ψ − log ψ̃ is 0 there, with its slope.
    log_scale = value - guiding.log_density(y)
    return eqx.tree_at(lambda g: g.log_scale, guiding, log_scale), (value, slope)


def _root(S: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """A Cholesky factor of S, whose directions without variance get that of a rounding error."""
    n = S.shape[0]
    nugget = 10 * n * jnp.finfo(S.dtype).eps * jnp.max(jnp.diagonal(S)) + jnp.finfo(S.dtype).tiny
    return jnp.linalg.cholesky(S + nugget * jnp.eye(n, dtype=S.dtype))


def _mode(
    log_density: Callable, precision: Callable, mean: Float[Array, " N"], root: Float[Array, "N N"]
):
    """The ξ of the largest log ψ(m + S ξ) − ½ |ξ|², by Gauss and Newton.

    In ξ the law is standard, so that no inverse of its covariance is needed. Derivatives are those
    of the implicit function, not of the iterations.
    """

    def loss(xi):
        return 0.5 * jnp.sum(xi * xi) - log_density(mean + root @ xi)

    def slope(xi):
        return xi - root.T @ jax.grad(log_density)(mean + root @ xi)

    def step(_, xi):
        # The best of a step and its halves, none of which is taken if it makes things worse; a NaN
        # is passed over.
        H = jnp.eye(len(xi), dtype=xi.dtype) + root.T @ precision(mean + root @ xi) @ root
        factor = jnp.linalg.cholesky(H)
        direction = solve_lower(factor, solve_lower(factor, slope(xi)), transposed=True)
        tried = xi[None] - jnp.asarray(_PARTS, xi.dtype)[:, None] * direction[None]
        losses = jax.vmap(loss)(tried)
        best = jnp.nanargmin(losses)
        return jnp.where(losses[best] < loss(xi), tried[best], xi)

    def polish(_, xi):
        """A step of Newton: the loss is flat to rounding where its slope is not."""
        moved = xi - jnp.linalg.solve(jax.jacfwd(slope)(xi), slope(xi))
        is_better = jnp.sum(slope(moved) ** 2) < jnp.sum(slope(xi) ** 2)
        return jnp.where(is_better, moved, xi)

    def solve(_, start):
        xi = jax.lax.fori_loop(0, _MOST_STEPS, step, start)
        return jax.lax.fori_loop(0, _POLISHINGS, polish, xi)

    def tangent_solve(linear, y):
        # `linear` is the Jacobian of `slope`, as a function: its columns are its values at e_i.
        matrix = jax.vmap(linear, out_axes=1)(jnp.eye(len(y), dtype=y.dtype))
        return jnp.linalg.solve(matrix, y)

    return jnp.asarray(jax.lax.custom_root(slope, jnp.zeros_like(mean), solve, tangent_solve))


@jax.custom_jvp
def positive_part(S: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The symmetric matrix with the eigenvalues of S that are positive, and 0 for the others.

    Its derivative is by divided differences of λ ↦ max(λ, 0), which are finite where eigenvalues
    coincide, as those of eigenvectors are not (Daleckii and Krein 1965).
    """
    values, vectors = jnp.linalg.eigh(0.5 * (S + S.T))
    return (vectors * jnp.maximum(values, 0.0)[None]) @ vectors.T


@positive_part.defjvp
def _(primals, tangents):
    (S,) = primals
    (dS,) = tangents
    values, vectors = jnp.linalg.eigh(0.5 * (S + S.T))
    # With f(λ) = max(λ, 0) and S = V diag(λ) Vᵀ: d f(S) = V (Q ∘ Vᵀ dS V) Vᵀ,
    # Q_ij = (f(λ_i) − f(λ_j))/(λ_i − λ_j), and f'(λ_i) where eigenvalues are equal to rounding.
    kept = jnp.maximum(values, 0.0)
    gap = values[:, None] - values[None, :]
    same = jnp.abs(gap) <= 1e-6 * jnp.max(jnp.abs(values))
    divisor = jnp.asarray(jnp.where(same, 1.0, gap))
    quotient = (kept[:, None] - kept[None, :]) / divisor
    differences = jnp.where(same, jnp.where(values > 0, 1.0, 0.0)[:, None], quotient)
    change = vectors.T @ (0.5 * (dS + dS.T)) @ vectors
    return (vectors * kept[None]) @ vectors.T, vectors @ (differences * change) @ vectors.T
