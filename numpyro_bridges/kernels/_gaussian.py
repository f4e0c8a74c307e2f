"""The Gaussian kernel, closed under convolution."""

from typing import TYPE_CHECKING

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._checks import positive_integer
from ._base import AbstractKernel, AbstractRadialKernel
from ._parameters import positive_scalar, squared_frequency


class GaussianKernel(AbstractRadialKernel):
    """k(x, y) = amplitude · exp(-|x - y|² / 2 length_scale²).

    Convolved with itself over R^dim it is the Gaussian kernel

        a(x, x') = amplitude² (π length_scale²)^{dim/2} exp(-|x - x'|² / 4 length_scale²).

    **Arguments:** `amplitude` and `length_scale` are positive scalars (a value of k, a distance).
    """

    amplitude: Float[Array, ""] = eqx.field(converter=positive_scalar("amplitude"))
    length_scale: Float[Array, ""] = eqx.field(converter=positive_scalar("length_scale"))

    if TYPE_CHECKING:  # mypy knows nothing of converters

        def __init__(self, amplitude: ArrayLike, length_scale: ArrayLike) -> None: ...

    def profile(self, s: Float[Array, "..."]) -> Float[Array, "..."]:
        return jnp.exp(-0.5 * s)

    def convolved_with(self, other: AbstractKernel, dim: int) -> "GaussianKernel":
        """With another Gaussian kernel of amplitude β and length scale m,

        α β (2π ℓ² m² / (ℓ² + m²))^{dim/2} exp(-|x - x'|² / 2(ℓ² + m²)).
        """
        if not isinstance(other, GaussianKernel):
            raise ValueError(
                "`other` must be a `GaussianKernel` too, or there is no closed convolution; got "
                f"{type(other).__name__}. Give the covariance itself (`covariance=`), or a "
                "`QuadratureCovariance`."
            )
        dim = positive_integer(dim, "dim")
        alpha, ell = self.scales()
        beta, m = other.scales(alpha.dtype)
        width = jnp.hypot(ell, m)
        # (ℓ m / width)² = ℓ² m² / (ℓ² + m²)
        volume = (2 * jnp.pi * jnp.square(ell * m / width)) ** (dim / 2)
        return GaussianKernel(alpha * beta * volume, width)

    def spectral_density(self, omega: Float[Array, "... dim"], dim: int) -> Float[Array, "..."]:
        """q̂(ω) = amplitude (2π length_scale²)^{dim/2} exp(-length_scale² |ω|² / 2)."""
        square = squared_frequency(omega, dim)
        amplitude, length_scale = self.scales(square.dtype)
        scale = jnp.square(length_scale)
        return amplitude * (2 * jnp.pi * scale) ** (dim / 2) * jnp.exp(-0.5 * scale * square)
