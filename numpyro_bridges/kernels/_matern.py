"""Matérn kernels of half-integer order, a polynomial times an exponential.

In the scaling r = |x - y| / length_scale, without the factor √(2ν) of much of the literature,

    M_p(r) = Σ_i c_i r^i e^{-r},   c_{p-i} = p! (p + i)! 2^{p-i} / ((2p)! i! (p - i)!),
    ν = p + 1/2.
"""

from functools import partial
from math import exp, factorial, lgamma, log, pi
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Float

from .._checks import positive_integer, require
from ._base import AbstractKernel, AbstractRadialKernel
from ._parameters import positive_scalar, squared_frequency

_MAX_ORDER = 1000
"""The polynomial is written out, one term for each order."""


def _coefficients(p: int) -> list[float]:
    """c_p, ..., c_0: the highest power first."""
    top = factorial(2 * p)
    return [
        factorial(p) * factorial(p + i) * 2 ** (p - i) / (top * factorial(i) * factorial(p - i))
        for i in range(p + 1)
    ]


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _matern(p: int, s: Float[Array, "..."]) -> Float[Array, "..."]:
    """M_p at the squared distance s = r².

    The derivative is a Matérn function again, dM_p/ds = -M_{p-1} / (2 (2p - 1)), so derivatives up
    to order p are exact at s = 0, where those of √s are infinite. M_0 = e^{-r} has none there, and
    0 stands for it: the mean of the two sides.
    """
    r = jnp.sqrt(s)
    # Horner's scheme
    polynomial = jnp.zeros_like(r)
    for c in _coefficients(p):
        polynomial = polynomial * r + c
    return polynomial * jnp.exp(-r)


@_matern.defjvp
def _(p, primals, tangents):
    (s,) = primals
    (ds,) = tangents
    if p > 0:
        slope = _matern(p - 1, s) / (-2.0 * (2 * p - 1))
    else:
        # the inner `select` keeps an infinite slope out of derivatives of this one
        r = jnp.sqrt(lax.select(s > 0, s, jnp.ones_like(s)))
        slope = lax.select(s > 0, -0.5 * jnp.exp(-r) / r, jnp.zeros_like(s))
    return _matern(p, s), slope * ds


def _order(value: Any) -> int:
    order = positive_integer(value, "order", least=0)
    require(
        order <= _MAX_ORDER,
        f"`order` must be at most {_MAX_ORDER}; got {order}. Smoothness is ν = order + 1/2; a "
        "limit of large orders is `GaussianKernel`.",
    )
    return order


class MaternKernel(AbstractRadialKernel):
    """k(x, y) = amplitude · M_order(r), r = |x - y| / length_scale, of smoothness ν = order + 1/2.

    Orders 0, 1 and 4 are e^{-r}, (1 + r) e^{-r} and
    (1 + r + 45/105 r² + 10/105 r³ + 1/105 r⁴) e^{-r}. The convolution with itself has smoothness
    2ν + dim/2: in odd dimensions another kernel of this class, in even ones a Bessel function of
    integer order, which has no closed form here (`ValueError`).

    **Arguments:** `amplitude` and `length_scale` are positive scalars; `order` is an integer from 0
    on.
    """

    amplitude: Float[Array, ""] = eqx.field(converter=positive_scalar("amplitude"))
    length_scale: Float[Array, ""] = eqx.field(converter=positive_scalar("length_scale"))
    order: int = eqx.field(static=True, default=4, converter=_order)

    if TYPE_CHECKING:  # mypy knows nothing of converters

        def __init__(
            self, amplitude: ArrayLike, length_scale: ArrayLike, order: int = 4
        ) -> None: ...

    def profile(self, s: Float[Array, "..."]) -> Float[Array, "..."]:
        return _matern(self.order, s)

    def convolved_with(self, other: AbstractKernel, dim: int) -> "MaternKernel":
        """With itself, in odd dimensions: order 2 · order + (dim + 1)/2, the same length scale."""
        dim = positive_integer(dim, "dim")
        # The same object: traced length scales cannot be compared, and of two different ones there
        # is no closed form.
        if other is not self or dim % 2 == 0:
            other_name = f"with an `other`, {type(other).__name__}"
            what = f"in dimension {dim}" if other is self else other_name
            raise ValueError(
                "a `MaternKernel` has a closed convolution with itself in odd dimensions only; "
                f"got one {what}. Give the covariance itself (`covariance=`), or a "
                "`QuadratureCovariance`."
            )
        amplitude, length_scale = self.scales()
        # Of spectral densities the product: (1 + ℓ²|ω|²)^{−2(ν + dim/2)} is that of order ν' with
        # ν' + dim/2 = 2ν + dim. Masses are q̂(0) at unit scales.
        order = 2 * self.order + (dim + 1) // 2
        mass = exp(2 * _log_mass(self.order, dim) - _log_mass(order, dim))
        return MaternKernel(amplitude**2 * mass * length_scale**dim, length_scale, order)

    def spectral_density(self, omega: Float[Array, "... dim"], dim: int) -> Float[Array, "..."]:
        """q̂(ω) = α (2 √π ℓ)^dim Γ(ν + dim/2) / Γ(ν) · (1 + ℓ² |ω|²)^{-ν - dim/2}."""
        square = squared_frequency(omega, dim)
        amplitude, length_scale = self.scales(square.dtype)
        decay = (1.0 + jnp.square(length_scale) * square) ** (-(self.order + 0.5 + dim / 2))
        return amplitude * exp(_log_mass(self.order, dim)) * length_scale**dim * decay


def _log_mass(p: int, dim: int) -> float:
    """log ∫ M_p(|x|) dx over R^dim, which is q̂(0) at unit amplitude and length scale."""
    return dim * log(2 * pi**0.5) + lgamma(p + 0.5 + dim / 2) - lgamma(p + 0.5)
