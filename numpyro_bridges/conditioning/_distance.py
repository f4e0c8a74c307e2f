"""Matches by a distance in the H-norm: with heavy tails, and to a shape wherever it lies.

With r² = Σ_i w_i |x_i − v_i|² / variance, m numbers in all and w the weights of the space,

    Student    c (1 + r²/ν)^{−(ν + m)/2}
    Huber      c exp(−ρ(r)),    ρ(r) = r²/2 up to the threshold k, k r − k²/2 beyond.
"""

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
from jax.scipy.special import gammainc, gammaincc, gammaln, polygamma
from jaxtyping import Array, Float, PRNGKeyArray

from .._checks import choice, require
from .._linalg import rows
from .._types import State
from ..kernels._parameters import positive_scalar
from ..sdes import AbstractSDE
from ..spaces import Landmarks
from ._density import AbstractDensityMatch

_LOG_PI = 1.1447298858494002


class StudentMatch(AbstractDensityMatch):
    """The end state is seen with an error from a multivariate Student distribution: `InexactMatch`
    with heavy tails.

    All numbers of a datum share one scale of the error, drawn anew for each datum, so that a datum
    that lies far off counts less.

    **Arguments:** `variance`: as of `InexactMatch`, a number, at infinitely many degrees of
    freedom. `degrees_of_freedom`: ν, positive.
    """

    variance: Float[Array, ""]
    degrees_of_freedom: Float[Array, ""]

    def __init__(self, variance, degrees_of_freedom):
        self.variance = positive_scalar("variance")(variance)
        self.degrees_of_freedom = positive_scalar("degrees_of_freedom")(degrees_of_freedom)

    @property
    def spread(self):
        """That of the logarithm of the precision of the error, which has the law of Gamma(ν/2)."""
        return jnp.sqrt(polygamma(1, 0.5 * self.degrees_of_freedom))

    def log_density(self, sde, x, observed):
        square, log_scale = _square(self.variance, sde, x, observed)
        nu = self.degrees_of_freedom.astype(x.dtype)
        half = 0.5 * (nu + x.size)
        constant = gammaln(half) - gammaln(0.5 * nu) - 0.5 * x.size * (jnp.log(nu) + _LOG_PI)
        return constant - log_scale - half * jnp.log1p(square / nu)

    def precision(self, sde, x, observed):
        square, _ = _square(self.variance, sde, x, observed)
        nu = self.degrees_of_freedom.astype(x.dtype)
        return _reweighted((nu + x.size) / (nu + square), self.variance, sde, x)

    def sample(self, key: PRNGKeyArray, sde: AbstractSDE, x: State) -> Array:
        key_error, key_scale = jr.split(key)
        nu = self.degrees_of_freedom.astype(x.dtype)
        precision = jr.gamma(key_scale, 0.5 * nu, dtype=x.dtype) / (0.5 * nu)
        error = jr.normal(key_error, x.shape, x.dtype) / jnp.sqrt(precision)
        return x + rows(jnp.sqrt(self.variance.astype(x.dtype) / _weights(sde, x)), x) * error


class HuberMatch(AbstractDensityMatch):
    """The end state is seen with an error whose density is normal near 0 and falls exponentially
    far away.

    **Arguments:** `variance`: as of `InexactMatch`, a number. `threshold`: k, the distance, in
    standard deviations, from which on the loss is linear. In many numbers m the distance is about
    √m.
    """

    variance: Float[Array, ""]
    threshold: Float[Array, ""]

    def __init__(self, variance, threshold=1.345):
        self.variance = positive_scalar("variance")(variance)
        self.threshold = positive_scalar("threshold")(threshold)

    @property
    def spread(self):
        # An exponential tail is heavier than every normal one. How wide a mixture leads paths is a
        # choice: weights are right for any.
        return jnp.asarray(1.0)

    def log_density(self, sde, x, observed):
        square, log_scale = _square(self.variance, sde, x, observed)
        k = self.threshold.astype(x.dtype)
        m = x.size
        far = square > k * k
        # √ has no slope at 0: it is asked for where r is beyond k only.
        distance = jnp.sqrt(jnp.where(far, square, 1.0))
        loss = jnp.where(far, k * distance - 0.5 * k * k, 0.5 * square)
        # 1/c is the integral over R^m in spherical coordinates: the area of the sphere times
        #     ∫₀^k r^{m−1} e^{−r²/2} dr      and      ∫_k^∞ r^{m−1} e^{−k r + k²/2} dr.
        area = jnp.log(2.0) + 0.5 * m * _LOG_PI - gammaln(0.5 * m)
        within = jnp.log(gammainc(0.5 * m, 0.5 * k * k))
        inner = (0.5 * m - 1) * jnp.log(2.0) + gammaln(0.5 * m) + within
        outer = 0.5 * k * k - m * jnp.log(k) + gammaln(1.0 * m) + jnp.log(gammaincc(1.0 * m, k * k))
        return -loss - log_scale - area - jnp.logaddexp(inner, outer)

    def precision(self, sde, x, observed):
        square, _ = _square(self.variance, sde, x, observed)
        k = self.threshold.astype(x.dtype)
        far = square > k * k
        weight = jnp.where(far, k / jnp.sqrt(jnp.where(far, square, 1.0)), 1.0)
        return _reweighted(weight, self.variance, sde, x)


class ProcrustesMatch(AbstractDensityMatch):
    """ψ(x) = exp(−d²/2 variance), d the H-norm distance of x to a shape wherever it lies: a set of
    states.

    d is the least distance over all motions of the datum. It is a kernel and no density of the
    datum.

    **Arguments:** `variance`: as of `InexactMatch`, a number. `up_to`: the motions:
    `"translation"`, `"rigid"`, with rotations, or `"similarity"`, with scale too. Reflections are
    none of them. Shapes in the plane or in space.
    """

    variance: Float[Array, ""]
    up_to: str = eqx.field(static=True)

    def __init__(self, variance, up_to: str = "similarity"):
        self.variance = positive_scalar("variance")(variance)
        self.up_to = choice(up_to, "up_to", ("translation", "rigid", "similarity"))

    def log_density(self, sde, x, observed):
        are_points = sde.space is None or isinstance(sde.space, Landmarks)
        dims = (1, 2, 3) if self.up_to == "translation" else (2, 3)
        require(
            are_points and x.ndim == 2 and x.shape[1] in dims,
            "`x0` must hold points in the plane or in space, (n, 2) or (n, 3); got a state "
            f"{x.shape} of {sde.space}.",
        )
        # The best translation takes mean to mean. What is left, over rotations R and scales s, is
        # |x|² + s² |v|² − 2 s tr(R vᵀ x): the largest trace, and then s = tr/|v|².
        weights = _weights(sde, x)
        v = _centred(weights, _like(observed, x))
        x = _centred(weights, x)
        own = jnp.sum(x * x)
        other = jnp.sum(v * v)
        if self.up_to == "translation":
            square = jnp.sum((x - v) ** 2)
        elif self.up_to == "rigid":
            square = own + other - 2 * _largest_trace(v.T @ x)
        else:
            square = own - _largest_trace(v.T @ x) ** 2 / other
        return -0.5 * square / self.variance.astype(x.dtype)


def _largest_trace(A: Float[Array, "d d"]) -> Float[Array, ""]:
    """max tr(R A) over rotations R."""
    if len(A) == 2:
        # tr(R A) = (A₀₀ + A₁₁) cos φ + (A₀₁ − A₁₀) sin φ, or with the other sign of φ
        return jnp.sqrt((A[0, 0] + A[1, 1]) ** 2 + (A[0, 1] - A[1, 0]) ** 2)
    # Over all orthogonal R it is Σ s; where that is reached by a reflection, the smallest
    # singular value changes its sign (Kabsch).
    U, s, Vt = jnp.linalg.svd(A)
    return jnp.sum(s) - (1 - jnp.linalg.det(U @ Vt)) * s[-1]


def _centred(weights: Float[Array, " n"], x: State) -> State:
    """√w (x − the mean of x)."""
    w = rows(weights, x)
    return jnp.sqrt(w) * (x - jnp.sum(w * x, axis=0, keepdims=True) / jnp.sum(w))


def _weights(sde: AbstractSDE, x: State) -> Float[Array, " n"]:
    n = x.shape[0]
    return jnp.ones((n,), x.dtype) if sde.space is None else sde.space.weights.astype(x.dtype)


def _square(variance, sde: AbstractSDE, x: State, observed: State):
    """r², and the logarithm of the product of all √(variance/w)."""
    weights = _weights(sde, x)
    variance = variance.astype(x.dtype)
    difference = x - _like(observed, x)
    square = jnp.sum(rows(weights, x) * difference * difference) / variance
    log_scale = 0.5 * (x.size / x.shape[0]) * jnp.sum(jnp.log(variance / weights))
    return square, log_scale


def _reweighted(weight: Array, variance: Array, sde: AbstractSDE, x: State) -> Float[Array, "N N"]:
    """The precision of least squares that are weighted again and again, alike in all directions."""
    # The loss ρ(r) has slope `weight` · r: the parabola of that slope, which lies above ρ, has the
    # curvature `weight`. It is positive also where ρ itself bends the other way.
    precision = weight * _weights(sde, x) / variance.astype(x.dtype)
    return jnp.diag(jnp.repeat(precision, x.size // x.shape[0]))


def _like(observed: State, x: State) -> State:
    require(
        observed.shape == x.shape,
        f"`observed` must be shaped like a state, {x.shape}; got {observed.shape}.",
    )
    return observed.astype(x.dtype)
