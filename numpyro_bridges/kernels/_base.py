"""What a kernel is: values, and two closed forms.

A kernel k(x, y) plays one of two roles. It is a covariance function; or it smears white noise over
space, dX(t, s) = ∫ k(X(t, s), y) dW(t, y), and then the covariance is its convolution with itself,

    a(x, x') = ∫ k(x, y) k(x', y) dy.
"""

from abc import abstractmethod
from functools import reduce
from operator import add

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ._parameters import point, positive_scalar, scalar, squared_distances


class AbstractKernel(eqx.Module):
    """A symmetric positive definite function on R^dim. `k1 + k2`, `c * k` (c > 0) are kernels.

    A subclass gives values for points, and two closed forms or a `ValueError` where there is none.
    A kernel of the distance alone is shorter as an `AbstractRadialKernel`, which asks for its
    profile. Here lengths are measured in a metric, |x − y|²_G = (x − y)ᵀ G (x − y):

        class StretchedKernel(AbstractKernel):
            amplitude: Array
            root: Array  # (dim, dim), with rootᵀ root = G

            def matrix(self, x, y):
                unit = nb.GaussianKernel(1.0, 1.0)
                return self.amplitude * unit.matrix(x @ self.root.T, y @ self.root.T)

            @property
            def variance(self):
                return self.amplitude

            def convolved_with(self, other, dim):
                raise ValueError("pass a `StretchedKernel` as `covariance=`.")

            def spectral_density(self, omega, dim):
                square = jnp.sum((omega @ jnp.linalg.inv(self.root)) ** 2, axis=-1)
                volume = (2 * jnp.pi) ** (dim / 2) / jnp.abs(jnp.linalg.det(self.root))
                return self.amplitude * volume * jnp.exp(-0.5 * square)
    """

    __array_ufunc__ = None  # a NumPy number on the left leaves the product to `__rmul__`

    @abstractmethod
    def matrix(self, x: Float[Array, "n dim"], y: Float[Array, "m dim"]) -> Float[Array, "n m"]:
        """The values k(x_i, y_j), in the precision of the points."""

    @property
    @abstractmethod
    def variance(self) -> Float[Array, ""]:
        """k(x, x)."""

    @abstractmethod
    def convolved_with(self, other: "AbstractKernel", dim: int) -> "AbstractKernel":
        """The kernel ∫ k(x, y) other(x', y) dy over R^dim; `ValueError` without a closed form."""

    @abstractmethod
    def spectral_density(self, omega: Float[Array, "... dim"], dim: int) -> Float[Array, "..."]:
        """q̂(ω) with k(x, y) = (2π)^{-dim} ∫ q̂(ω) cos(ω · (x - y)) dω.

        This takes the kernel as a covariance; where it smears white noise, the covariance has the
        density q̂².
        """

    def convolved(self, dim: int) -> "AbstractKernel":
        """The covariance of the flow that this kernel drives, ∫ k(x, y) k(x', y) dy over R^dim."""
        return self.convolved_with(self, dim)

    def __call__(self, x: Float[Array, " dim"], y: Float[Array, " dim"]) -> Float[Array, ""]:
        """k(x, y) of two points."""
        return self.matrix(point(x, "x")[None], point(y, "y")[None])[0, 0]

    # Sums are flat: a sum of sums has one list of terms, whose pairs are convolved.
    def __add__(self, other: "AbstractKernel") -> "AbstractKernel":
        if not isinstance(other, AbstractKernel):
            return NotImplemented
        pairs = _terms(self) + _terms(other)
        return KernelCombination(*zip(*pairs, strict=True))

    def __mul__(self, factor: ArrayLike) -> "AbstractKernel":
        factor = positive_scalar("factor")(factor)
        pairs = [(factor * c.astype(factor.dtype), k) for c, k in _terms(self)]
        return KernelCombination(*zip(*pairs, strict=True))

    __rmul__ = __mul__


class AbstractRadialKernel(AbstractKernel):
    """amplitude · profile(|x - y|² / length_scale²): an implementation says what its profile is."""

    amplitude: eqx.AbstractVar[Float[Array, ""]]
    length_scale: eqx.AbstractVar[Float[Array, ""]]

    @abstractmethod
    def profile(self, s: Float[Array, "..."]) -> Float[Array, "..."]:
        """The kernel of unit amplitude and length scale at the squared distance s; 1 at 0."""

    def scales(self, dtype: jnp.dtype | None = None) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Amplitude and length scale in one precision; `ValueError` if either has an axis."""
        dtype = self.amplitude.dtype if dtype is None else dtype
        amplitude = scalar(self.amplitude, "amplitude", dtype)
        return amplitude, scalar(self.length_scale, "length_scale", dtype)

    def matrix(self, x: Float[Array, "n dim"], y: Float[Array, "m dim"]) -> Float[Array, "n m"]:
        # Of squares: √ has no slope where points coincide, and a smooth profile needs none.
        amplitude, length_scale = self.scales()
        distances = squared_distances(x, y, length_scale)
        return amplitude.astype(distances.dtype) * self.profile(distances)

    @property
    def variance(self) -> Float[Array, ""]:
        return self.scales()[0]


class KernelCombination(AbstractKernel):
    """Σ c_i k_i with positive coefficients; written `c * k` and `k1 + k2`.

    Its convolution is that of every pair of terms, so every pair must have a closed form.
    """

    coefficients: tuple[Float[Array, ""], ...]
    kernels: tuple[AbstractKernel, ...]

    def _sum(self, values: list[Array]) -> Array:
        """Σ c_i values_i, in the precision of the values."""
        pairs = zip(self.coefficients, values, strict=True)
        return reduce(add, (scalar(c, "factor", v.dtype) * v for c, v in pairs))

    def matrix(self, x: Float[Array, "n dim"], y: Float[Array, "m dim"]) -> Float[Array, "n m"]:
        return self._sum([k.matrix(x, y) for k in self.kernels])

    @property
    def variance(self) -> Float[Array, ""]:
        return self._sum([k.variance for k in self.kernels])

    def convolved_with(self, other: AbstractKernel, dim: int) -> AbstractKernel:
        # Bilinear; and where it is with itself, the terms are the same objects, as a
        # `MaternKernel` asks for.
        pairs = [
            (c * d.astype(c.dtype), first.convolved_with(second, dim))
            for c, first in _terms(self)
            for d, second in _terms(other)
        ]
        return KernelCombination(*zip(*pairs, strict=True))

    def spectral_density(self, omega: Float[Array, "... dim"], dim: int) -> Float[Array, "..."]:
        return self._sum([k.spectral_density(omega, dim) for k in self.kernels])


def _terms(kernel: AbstractKernel) -> list[tuple[Float[Array, ""], AbstractKernel]]:
    """Coefficients and kernels of a combination; one term of weight 1 otherwise."""
    if isinstance(kernel, KernelCombination):
        return list(zip(kernel.coefficients, kernel.kernels, strict=True))
    return [(jnp.ones(()), kernel)]
