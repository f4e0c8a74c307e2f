"""The Kunita flow of shapes, dX(t, s) = ∫ k(X(t, s), y) dW(t, y): points carried by a Gaussian field of noise.

The covariance of two points is a(x, x') = ∫ k(x, y) k(x', y) dy, for the Gaussian kernel in R^d
α² (πℓ²)^{d/2} exp(−|x − x'|²/4ℓ²); the coordinates are independent given the points. Kunita (1997); for shapes
Sommer, Schauer, van der Meulen (2021), and Baker et al. (2024), section 2.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._checks import concrete, require, require_instance
from .._types import RealScalar, State, Structured
from ..kernels import AbstractKernel
from ..spaces import AbstractSpace, Landmarks
from ._base import AbstractSDE
from ._noise import NOISES, AbstractNoise, LandmarkNoise


class KunitaFlow(AbstractSDE):
    """The Kunita flow of landmarks or of curves.

    **Arguments:**

    - `space`: `Landmarks` or `FourierBasis`; with the latter the noise field is evaluated at the basis's quadrature
      points and projected.
    - `kernel`: k, which is convolved with itself; or
    - `covariance`: the covariance function a itself (some of the literature writes its kernel there).
    - `noise`: `"landmark"` (for landmarks only), `"spectral"`, `"grid"`, or a `LandmarkNoise`,
      `SpectralNoise`, `GridNoise` with its own settings.
    """

    space: AbstractSpace
    kernel: AbstractKernel | None
    covariance_kernel: AbstractKernel
    noise_field: AbstractNoise

    def __init__(
        self,
        space: AbstractSpace,
        kernel: AbstractKernel | None = None,
        *,
        covariance: AbstractKernel | None = None,
        noise: str | AbstractNoise = "landmark",
    ):
        require(
            (kernel is None) != (covariance is None),
            "Give either `kernel`, which is convolved with itself, or `covariance`, the covariance function itself; "
            f"got {'both' if kernel is not None else 'neither'}.",
        )
        require_instance(space, AbstractSpace, "space", "a space, such as `Landmarks(num_points, dim)`")
        for name, k in (("kernel", kernel), ("covariance", covariance)):
            if k is not None:
                require_instance(k, AbstractKernel, name, "a kernel, such as `GaussianKernel(amplitude, length_scale)`")
        if isinstance(noise, str):
            require(noise in NOISES, f"`noise` must be one of {sorted(NOISES)} or a noise object; got {noise!r}.")
            noise_field: AbstractNoise = NOISES[noise]()
        else:
            require_instance(noise, AbstractNoise, "noise", f"one of {sorted(NOISES)} or a noise object")
            noise_field = noise
        require(
            isinstance(space, Landmarks) or not isinstance(noise_field, LandmarkNoise),
            '`noise="landmark"` is attached to landmarks, and the coefficients of a `FourierBasis` are none: '
            'their covariance has no points to be factored at. Use `noise="spectral"` or `noise="grid"`.',
        )
        if kernel is not None:
            covariance = kernel.convolved(space.dim)
        assert covariance is not None  # one of the two is given
        self.space = space
        self.kernel = kernel
        self.covariance_kernel = covariance
        self.noise_field = noise_field

    def drift(self, t: RealScalar, x: State) -> State:
        return jnp.zeros_like(x)

    def noise(self, t: RealScalar, x: State) -> tuple[Structured, Structured]:
        sigma, a = self.noise_field.factor_and_covariance(self.kernel, self.covariance_kernel, self.space.to_points(x))
        if isinstance(self.space, Landmarks):
            return sigma, a
        sigma = self.space.from_points(sigma)
        return sigma, sigma @ sigma.T

    def covariance_divergence(self, t: RealScalar, x: State) -> State:
        if not isinstance(self.space, Landmarks):
            return super().covariance_divergence(t, x)
        slope = jax.grad(self.covariance_kernel, argnums=1)
        return jnp.sum(jax.vmap(lambda p: jax.vmap(lambda q: slope(p, q))(x))(x), axis=1)

    def covariance_double_divergence(self, t: RealScalar, x: State) -> Float[Array, ""]:
        if not isinstance(self.space, Landmarks):
            return super().covariance_double_divergence(t, x)

        def mixed(p, q):
            """tr ∂²k/∂p∂q."""
            return jnp.trace(jax.jacfwd(jax.grad(self.covariance_kernel, argnums=1))(p, q))

        pairs = jax.vmap(lambda p: jax.vmap(lambda q: mixed(p, q))(x))(x)
        return jnp.sum(pairs) - jnp.trace(pairs)  # a(x, x) is constant

    def linearised_drift(self, t: RealScalar, x: State) -> tuple[Structured, State]:
        return jnp.zeros((), x.dtype), jnp.zeros_like(x)

    def has_constant_covariance(self, x: State) -> bool:
        return False

    def is_autonomous(self, x: State) -> bool:
        return True

    def ito_is_stratonovich(self, x: State) -> bool:
        return self.noise_field.fixed_in_space

    def noise_error(self) -> dict:
        """What a spectral representation leaves out, relative to a(x, x); empty for the others."""
        error = getattr(self.noise_field, "error", None)
        return {} if error is None else error(self.kernel, self.covariance_kernel, self.space.dim)

    def check_state(self, x: State) -> None:
        shape = (self.space.size, self.space.dim)
        require(x.shape == shape, f"`x0`, a state of this `space`, must have shape {shape}; got {x.shape}.")
        jax.eval_shape(self.noise, 0.0, x)
        value = concrete(x)
        if value is not None and isinstance(self.noise_field, LandmarkNoise) and len(value) > 1:
            gap = np.linalg.norm(value[:, None] - value[None], axis=-1) + np.where(np.eye(len(value)), np.inf, 0)
            i, j = np.unravel_index(np.argmin(gap), gap.shape)
            require(
                gap[i, j] > 1e-6 * np.ptp(value),
                f"`x0` must have distinct landmarks; {min(i, j)} and {max(i, j)} coincide (distance {gap[i, j]:.1e}): "
                "they move as one point and their covariance is singular. Remove one of them, or use "
                '`noise="spectral"`.',
            )
