"""A Gaussian reference N(μ, L Lᵀ) of the posterior of the unconstrained parameters, θ = μ + L y.

It starts as a Laplace approximation with the noise at zero, and is renewed from the draws at the
end of each of two windows of the warm-up. y has the role of the noise: N(0, I) but for what the
kernels correct.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.scipy.linalg import solve_triangular
from numpyro.infer.hmc_util import welford_covariance

from ._rotation import choose


class Reference(NamedTuple):
    """μ `(d,)` and L `(d, d)`, lower triangular."""

    mean: Array
    scale: Array

    def whiten(self, theta):
        """y = L⁻¹ (θ - μ)."""
        return solve_triangular(self.scale, theta - self.mean, lower=True) if theta.size else theta

    def colour(self, y):
        """θ = μ + L y."""
        return self.mean + self.scale @ y

    def whiten_gradient(self, gradient):
        """∇_y = Lᵀ ∇_θ."""
        return self.scale.T @ gradient

    def colour_gradient(self, gradient):
        """∇_θ = L⁻ᵀ ∇_y."""
        return solve_triangular(self.scale.T, gradient, lower=False) if gradient.size else gradient


def laplace(potential, theta: Array, *others, visit=None):
    """Mode and inverse Hessian of exp(-potential(θ, *others)) by BFGS from θ, with the others as
    they are; N(θ, I) where that fails.

    `visit`: a function of that reference which gives points `(θ, *others)`, stacked, at which value
    and gradient are wanted as well. They are evaluated one by one, in the loop of the search, which
    holds the only copy of the gradient: compiling it is most of what the start of a chain takes.

    Returns the reference, and values and gradients of the visits, stacked; None without any.
    """
    # the Hessian as BFGS has it: differentiation would compile derivatives of the gradient
    value_and_grad = jax.value_and_grad(potential, tuple(range(1 + len(others))))
    start = Reference(theta, jnp.eye(theta.size, dtype=theta.dtype))

    # a model of noise alone
    if not theta.size:
        if visit is None:
            return start, None
        return start, jax.lax.map(lambda point: value_and_grad(*point), visit(start))

    def found_by(search: _Search) -> Reference:
        mode = jnp.where(jnp.isfinite(search.value), search.x, jnp.nan)
        return if_finite(Reference(mode, jnp.linalg.cholesky(search.inverse)), start)

    num_visits = 0 if visit is None else len(visit(start)[0])

    def go_on(carry):
        search, i, _ = carry
        return _goes_on(search) | (i < num_visits)

    def body(carry):
        search, i, found = carry
        searching = _goes_on(search)
        point = (search.x + search.step, *others)
        if visit is not None:
            visited = jax.tree.map(lambda x: x[i], visit(found_by(search)))
            point = choose(searching, point, visited)
        value, gradient = value_and_grad(*point)
        search = choose(searching, _updated(search, value, gradient[0]), search)
        if visit is not None:
            place = jnp.where(searching, num_visits, i)  # out of bounds while it searches
            found = jax.tree.map(
                lambda all, x: all.at[place].set(x, mode="drop"), found, (value, gradient)
            )
        return search, jnp.where(searching, i, i + 1), found

    one = (jnp.zeros((), theta.dtype), (theta, *others))
    found = jax.tree.map(lambda x: jnp.zeros((num_visits, *x.shape), x.dtype), one)
    first = _start_search(theta), jnp.zeros((), int), found
    search, _, found = jax.lax.while_loop(go_on, body, first)
    return found_by(search), None if visit is None else found


_MAX_EVALUATIONS = 100
_GRADIENT_TOLERANCE = 1e-5
_ROUNDING = 100.0
"""Rounding of a potential, a sum of many terms, relative to it, in units of the precision."""


class _Search(NamedTuple):
    """A minimum by BFGS with backtracking (Nocedal and Wright, 2006, algorithm 6.1): the best x so
    far, with value, slope and inverse Hessian; x + step is tried next.

    `jax.scipy.optimize.minimize` evaluates the function at six places of its program.
    """

    x: Array
    value: Array
    slope: Array
    inverse: Array
    step: Array
    num_evaluations: Array


def _start_search(x: Array) -> _Search:
    # the start has the value ∞ and the step 0: the first evaluation is of x itself, and accepted
    infinite = jnp.asarray(jnp.inf, x.dtype)
    none = jnp.zeros_like(x)
    return _Search(x, infinite, none, jnp.eye(x.size, dtype=x.dtype), none, jnp.zeros((), int))


def _goes_on(search: _Search) -> Array:
    # a step that promises less than rounding would fill the inverse Hessian with noise
    rounding = _ROUNDING * jnp.finfo(search.x.dtype).eps
    promised = -search.slope @ search.step
    steep = jnp.max(jnp.abs(search.slope)) > _GRADIENT_TOLERANCE
    moves = steep & (promised > rounding * (1 + jnp.abs(search.value)))
    # before the first evaluation the slope is 0, and means nothing
    moves = moves | (search.num_evaluations == 0)
    return moves & (search.num_evaluations < _MAX_EVALUATIONS)


def _updated(search: _Search, new_value: Array, new_slope: Array) -> _Search:
    """After the evaluation at x + step."""
    x, value, slope, inverse, step, count = search
    # Armijo's rule; a NaN is no descent, so that the step is halved there too
    enough = new_value <= value + 1e-4 * slope @ step
    good = enough & jnp.all(jnp.isfinite(new_slope))
    updated = _inverse_update(inverse, step, new_slope - slope)
    inverse = choose(good & (count > 0), updated, inverse)
    x, value, slope = choose(good, (x + step, new_value, new_slope), (x, value, slope))
    full = -inverse @ slope
    # The first direction is the gradient, whose length is in no unit of x: at most 1. Then at most
    # twice the step before: along directions that no step has tried the inverse Hessian is a guess.
    most = jnp.where(count == 0, 1.0, 2 * jnp.linalg.norm(step))
    length = jnp.minimum(1.0, most / jnp.linalg.norm(full))
    step = choose(good, length * full, _shorter(search, new_value) * step)
    return _Search(x, value, slope, inverse, step, count + 1)


def _shorter(search: _Search, new_value: Array) -> Array:
    """The part of a step to be tried next: where the parabola through both values is least."""
    slope = search.slope @ search.step
    part = -0.5 * slope / (new_value - search.value - slope)
    # half, where there is none
    return jnp.clip(jnp.where(jnp.isfinite(part), part, 0.5), 0.1, 0.5)


def _inverse_update(inverse: Array, step: Array, change: Array) -> Array:
    """The BFGS update of the inverse Hessian; none without positive curvature."""
    # (I − ρ s yᵀ) H⁻¹ (I − ρ y sᵀ) + ρ s sᵀ with ρ = 1 / yᵀs, positive definite for yᵀs > 0
    curvature = step @ change
    curved = curvature > 1e-12 * jnp.linalg.norm(step) * jnp.linalg.norm(change)
    rho = 1 / jnp.where(curved, curvature, 1.0)
    left = jnp.eye(step.size, dtype=step.dtype) - rho * jnp.outer(step, change)
    return jnp.where(curved, left @ inverse @ left.T + rho * jnp.outer(step, step), inverse)


class Windows(NamedTuple):
    """The reference in use; mean, sum of squares and number of the draws of this window."""

    reference: Reference
    moments: tuple[Array, Array, Array]


_no_moments, _add, _ = welford_covariance(diagonal=False)


def start_windows(reference: Reference) -> Windows:
    mean, m2, n = _no_moments(reference.mean.size)
    return Windows(reference, (mean, m2, n))


def update_windows(
    windows: Windows, i: Array, num_warmup: int, theta: Array
) -> tuple[Windows, Array]:
    """Adds draw i of the warm-up, renews the reference at the end of a window, says if it did."""
    starts, ends = _schedule(num_warmup)
    # too few draws for a covariance, or no parameters
    if num_warmup < 20 or not theta.size:
        return windows, jnp.array(False)
    inside = (i >= starts[0]) & (i < ends[-1])
    ends = jnp.any(i + 1 == jnp.array(ends))
    moments = choose(inside, _add(theta, windows.moments), windows.moments)
    renewed = start_windows(if_finite(from_moments(*moments), windows.reference))
    return choose(ends, renewed, windows._replace(moments=moments)), ends


def _schedule(num_warmup: int):
    """Starts and ends of two windows, without a tenth before them and after them."""
    cuts = [int(fraction * num_warmup) for fraction in (0.1, 0.3, 0.9)]
    return cuts[:2], cuts[1:]


def from_moments(mean, m2, n) -> Reference:
    """Shrinks correlations as if 5 more draws had none, so that there always is a factor."""
    covariance = m2 / (n - 1)
    covariance = (n * covariance + 5 * jnp.diag(jnp.diag(covariance))) / (n + 5)
    return Reference(mean, jnp.linalg.cholesky(covariance))


def if_finite(new: Reference, old: Reference) -> Reference:
    # a coordinate that never moved has no variance, and cannot be whitened
    finite = jnp.all(jnp.isfinite(new.scale)) & jnp.all(jnp.isfinite(new.mean))
    good = finite & jnp.all(jnp.diag(new.scale) > 0)
    return choose(good, new, old)
