"""The Kunita flow of shapes, dX(t, s) = ∫ k(X(t, s), y) dW(t, y): points carried by a Gaussian
field of noise.

The covariance of two points is a(x, x') = ∫ k(x, y) k(x', y) dy, for the Gaussian kernel in R^d α²
(πℓ²)^{d/2} exp(−|x − x'|²/4ℓ²); the coordinates are independent given the points. Kunita (1997);
for shapes Sommer, Schauer, van der Meulen (2021), and Baker et al. (2024), section 2.
"""

import warnings
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from .._checks import as_float, concrete, flag, require, require_instance, words
from .._types import RealScalar, State, Structured
from ..kernels import AbstractKernel
from ..spaces import AbstractSpace, Landmarks
from ._base import AbstractSDE, at_any_time
from ._noise import MOST_CONTROLS, NOISES, AbstractNoise, ControlNoise, LandmarkNoise, name_of

_COINCIDE = 1e-6
"""Distance of two landmarks, relative to the size of the shape, at which they are one."""

_NEWTON = 8
"""Steps of Newton's method: the digits are doubled by each."""

_FELT = 0.1
"""Variance of the jitter, relative to that of an observation, from which on there is a warning."""

_SEEN = 0.01
_REFUSED = 0.1
"""Wrong parts of a(x, x) from which on there is a warning, and an error."""


class KunitaFlow(AbstractSDE):
    """The Kunita flow of landmarks or of curves.

    **Arguments:**

    - `space`: `Landmarks` or `FourierBasis`; with the latter the noise field is evaluated at the
      basis's quadrature points and projected.
    - `kernel`: k, which is convolved with itself; or
    - `covariance`: the covariance function a itself (some of the literature writes its kernel
      there).
    - `noise`: `"landmark"`, `"control"` (both for landmarks), `"spectral"`, `"grid"`, or a
      `LandmarkNoise`, `ControlNoise`, `SpectralNoise`, `GridNoise` with its own settings. By
      default `"landmark"`, which is exact, and `"control"` for more than 64 landmarks, which costs
      as much as they are many.
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
        noise: str | AbstractNoise | None = None,
    ):
        require(
            (kernel is None) != (covariance is None),
            "Give either `kernel`, which is convolved with itself, or `covariance`, the "
            f"covariance function itself; got {'both' if kernel is not None else 'neither'}.",
        )
        require_instance(
            space, AbstractSpace, "space", "a space, such as `Landmarks(num_points, dim)`"
        )
        for name, k in (("kernel", kernel), ("covariance", covariance)):
            if k is not None:
                require_instance(
                    k,
                    AbstractKernel,
                    name,
                    "a kernel, such as `GaussianKernel(amplitude, length_scale)`",
                )
        if noise is None:
            noise = (
                "control"
                if isinstance(space, Landmarks) and space.size > MOST_CONTROLS
                else "landmark"
            )
        if isinstance(noise, str):
            require(
                noise in NOISES,
                f"`noise` must be one of {sorted(NOISES)} or a noise object; got {noise!r}.",
            )
            noise_field: AbstractNoise = NOISES[noise]()
        else:
            require_instance(
                noise, AbstractNoise, "noise", f"one of {sorted(NOISES)} or a noise object"
            )
            noise_field = noise
        require(
            isinstance(space, Landmarks) or noise_field.fixed_in_space,
            f'`noise="{name_of(noise_field)}"` is attached to landmarks, and the coefficients of a '
            "`FourierBasis` are none: their covariance has no points to be factored at. Use "
            '`noise="spectral"` or `noise="grid"`.',
        )
        if kernel is not None:
            covariance = kernel.convolved(space.dim)
        assert covariance is not None  # one of the two is given
        self.space = space
        self.kernel = kernel
        self.covariance_kernel = covariance
        self.noise_field = noise_field

    def closed(self, t: RealScalar, x: State) -> "KunitaFlow":
        if x.shape != (self.space.size, self.space.dim):
            return self  # no state: `check_state` says so
        chosen = self.noise_field.chosen(self.space.to_points(x))
        return eqx.tree_at(lambda flow: flow.noise_field, self, chosen)

    def drift(self, t: RealScalar, x: State) -> State:
        return jnp.zeros_like(x)

    def noise(self, t: RealScalar, x: State) -> tuple[Structured, Structured]:
        sigma, a = self.noise_field.factor_and_covariance(
            self.kernel, self.covariance_kernel, self.space.to_points(x)
        )
        if isinstance(self.space, Landmarks):
            return sigma, a
        sigma = self.space.from_points(sigma)
        return sigma, sigma @ sigma.T

    def energy(self, t: RealScalar, x: State, p: State) -> Float[Array, ""]:
        if isinstance(self.noise_field, ControlNoise):
            return self.noise_field.energy(self.covariance_kernel, x, p)
        return super().energy(t, x, p)

    def covariance_divergence(self, t: RealScalar, x: State) -> State:
        if isinstance(self.noise_field, ControlNoise) or not isinstance(self.space, Landmarks):
            return super().covariance_divergence(t, x)
        slope = jax.grad(self.covariance_kernel, argnums=1)
        return jnp.sum(jax.vmap(lambda p: jax.vmap(lambda q: slope(p, q))(x))(x), axis=1)

    def covariance_double_divergence(self, t: RealScalar, x: State) -> Float[Array, ""]:
        if isinstance(self.noise_field, ControlNoise) or not isinstance(self.space, Landmarks):
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

    def noise_error(self, x: ArrayLike | None = None) -> dict:
        """What noise that is not exact gets wrong, relative to a(x, x); empty for landmark noise.

        **Arguments:** `x`: a state, or a path `(K + 1, n, dim)`, of which the worst state counts.
        Without it spectral noise answers for shapes of its `diameter`.

        **Returns:** a dictionary. Of control noise at x, `missing`, the variance that the controls,
        those of a bridge from the first state if they are not given, do not tell at the worst
        landmark. Of spectral noise, `tail`, the variance that is missing at each point for want of
        modes, and `wrap_around`, the covariance of the ends of the shape through the periodic
        image. Of grid noise at x, `edge`, the variance that is lost where points are too near the
        edge of the box, and `quadrature`, the whole error of a(x, x). A `UserWarning` says which of
        them are above 1 %.

        A start with 10 % or more of `missing`, `wrap_around` or `edge` is refused. A path that
        comes to half of a(x, x), at the edge of a box, is NaN from there on, and so is its weight;
        what lies between is seen here only.
        """
        points = None
        if x is not None:
            x = jnp.asarray(x)
            shape = (self.space.size, self.space.dim)
            require(
                x.ndim in (2, 3) and x.shape[-2:] == shape,
                f"`x` must be a state {shape} or a path of them; got {x.shape}. Use vmap for a "
                "batch.",
            )
            points = jax.vmap(self.space.to_points)(x.reshape(-1, *shape))
        error = self.noise_field.error(self.kernel, self.covariance_kernel, self.space.dim, points)
        large = [
            f"{name} {float(e):.2g}"
            for name, e in error.items()
            if concrete(e) is not None and e > _SEEN
        ]
        if large:
            warnings.warn(
                f"the noise is wrong by more than 1 % of a(x, x): {', '.join(large)}.", stacklevel=2
            )
        return error

    def point_sd(self, t: RealScalar = 1.0) -> Float[Array, ""]:
        """The standard deviation of a coordinate of a point after a time t: √(t a(x, x)).

        It is what an amplitude means, in the units of the shapes: for the Gaussian kernel in the
        plane √(π t) αℓ. It is exact at every t, as a point that the flow carries is a martingale
        whose noise has the covariance a(x, x) wherever it is. What spectral or grid noise leaves
        out of a(x, x), `noise_error` says; a point of a curve in a `FourierBasis` moves less, by
        what the basis leaves out of the noise.

        **Arguments:** `t`: from 0 on.
        """
        t = as_float(t, "t")
        known = concrete(t)
        require(
            t.ndim == 0 and (known is None or known >= 0),
            f"`t` must be a number from 0 on; got {words(t)}. Use vmap for several.",
        )
        return jnp.sqrt(t * self.covariance_kernel.variance.astype(t.dtype))

    def carry(
        self,
        path: Float[Array, "K+1 n dim"],
        points: Float[Array, "q dim"],
        *,
        inverse: bool = False,
    ) -> Float[Array, "K+1 q dim"]:
        """The flow that a path of landmarks belongs to, applied to any further points: where they
        are at its times.

        In a step a point p moves by the field that moves the landmarks, a(p, c) a(c, c)⁻¹ Δc, c
        being the landmarks that drive the flow, all or the controls; of spectral or grid noise the
        field of least noise. Points that are landmarks of the path move as these do, to the last
        digit.

        **Arguments:** `path`: the states of a bridge, or of one branch of a tree. `points`: at the
        first time, or, where `inverse`, at the last: then the way back, by solving each step for
        the point that it moves there.
        """
        shapes, points, velocity_at = self._carrying(path, points)
        inverse = flag(inverse, "inverse")

        def step(p, inputs):
            velocity = velocity_at(*inputs)
            p = _origin_of(velocity, p) if inverse else p + velocity(p)
            return p, p

        _, moved = lax.scan(step, points, (shapes[:-1], jnp.diff(shapes, axis=0)), reverse=inverse)
        moved = jnp.concatenate([moved, points[None]] if inverse else [points[None], moved])
        same = jnp.all(points[:, None] == shapes[-1 if inverse else 0][None], axis=-1)
        return jnp.where(
            jnp.any(same, axis=1)[None, :, None], shapes[:, jnp.argmax(same, axis=1)], moved
        )

    def jacobian(
        self, path: Float[Array, "K+1 n dim"], points: Float[Array, "q dim"]
    ) -> Float[Array, "K+1 q"]:
        """By how much `carry` stretches the neighbourhood of points, the determinant of its
        derivative, at its times.

        It is positive where steps are short enough for what is carried to be a diffeomorphism.
        """
        shapes, points, velocity_at = self._carrying(path, points)

        def step(p, inputs):
            velocity = velocity_at(*inputs)
            slope = jax.vmap(jax.jacfwd(lambda q: q + velocity(q[None])[0]))(p)
            return p + velocity(p), jnp.linalg.det(slope)

        _, stretched = lax.scan(step, points, (shapes[:-1], jnp.diff(shapes, axis=0)))
        return jnp.concatenate([jnp.ones_like(stretched[:1]), jnp.cumprod(stretched, axis=0)])

    def _carrying(self, path, points) -> tuple[Array, Array, Callable[[Array, Array], Callable]]:
        """The points of the path's shapes, the points to be carried, and the field that moves a
        shape like this.
        """
        path = as_float(path, "path")
        points = as_float(points, "points")
        n = self.space.size
        dim = self.space.dim
        require(
            path.ndim == 3 and path.shape[1:] == (n, dim) and len(path) > 1,
            f"`path` must have shape (K + 1, {n}, {dim}); got {path.shape}. Use vmap for a batch.",
        )
        require(
            points.ndim == 2 and points.shape[1] == dim,
            f"`points` must have shape (q, {dim}); got {points.shape}.",
        )
        shapes = jax.vmap(self.space.to_points)(path)
        field = self.noise_field.chosen(shapes[0])
        return (
            shapes,
            points,
            lambda shape, moves: field.velocity(self.kernel, self.covariance_kernel, shape, moves),
        )

    def start(self, x: State) -> State:
        index = self.noise_field.factored_at(x)
        if concrete(x) is not None or index is None or len(index) == 1:
            return x
        y = lax.stop_gradient(x)[index]
        apart = jnp.min(_distances(jnp, y)) > _COINCIDE * (jnp.max(y) - jnp.min(y))
        return jnp.where(apart, x, jnp.nan)

    def check_state(self, x: State) -> None:
        shape = (self.space.size, self.space.dim)
        require(
            x.shape == shape,
            f"`x0`, a state of this `space`, must have shape {shape}; got {x.shape}.",
        )
        at_any_time(self.noise, x)
        index = self.noise_field.factored_at(x)
        value = concrete(x)
        index = None if index is None else concrete(index)
        if value is not None and index is not None and len(index) > 1:
            gap = _distances(np, value[index])
            i, j = np.unravel_index(np.argmin(gap), gap.shape)
            require(
                gap[i, j] > _COINCIDE * np.ptp(value),
                f"`x0` must have distinct landmarks; {index[min(i, j)]} and {index[max(i, j)]} "
                f"coincide (distance {gap[i, j]:.1e}): they move as one point and their "
                "covariance is singular. Remove one of them, or "
                'use `noise="spectral"`.',
            )
        self._check_room("x0", x, refuse=True)

    def check_end(self, find: Callable[[], State]) -> None:
        if not isinstance(self.noise_field, LandmarkNoise) and _known(self):
            self._check_room("condition", find(), refuse=False)

    def check_error(self, find: Callable[[], Structured | None], duration: RealScalar) -> None:
        variance = self.covariance_kernel.variance
        jitter = self.noise_field.own_jitter(variance.dtype)
        factor = None if jitter is None or not _known((variance, jitter, duration)) else find()
        if jitter is None or factor is None or concrete(factor) is None:
            return
        with jax.ensure_compile_time_eval():  # inside a traced program too
            own = np.sqrt(float(jitter) * float(variance) * float(duration))
            error = float(
                jnp.min(jnp.linalg.norm(factor, axis=1) if factor.ndim == 2 else jnp.abs(factor))
            )
        if own**2 > _FELT * error**2:
            warnings.warn(
                f"the jitter of the noise, {float(jitter):.0e} of a(x, x), moves a landmark by "
                f"{own:.2g}, beside an "
                f"error of observation of SD {error:.2g}: it is felt in the result. Give "
                "`LandmarkNoise(jitter=...)` a smaller one, use double precision "
                '(`jax.config.update("jax_enable_x64", True)`), or a larger error.',
                stacklevel=3,
            )

    def _check_room(self, name: str, x: State, refuse: bool) -> None:
        """Where it can be known, says whether the noise has room for a state."""
        if isinstance(self.noise_field, LandmarkNoise) or not _known((self, x)):
            return
        with jax.ensure_compile_time_eval():  # inside a traced program too
            lost = float(_misfit(self, x))
            if lost <= _SEEN:
                return
            points = np.asarray(self.space.to_points(x))
            room = self.noise_field.room(self.kernel, self.covariance_kernel, points)
        message = (
            f"`{name}` does not fit the noise, which is wrong there by {100 * lost:.0f} % of a(x, "
            f"x): {room}."
        )
        require(not refuse or lost < _REFUSED, message)
        warnings.warn(message, stacklevel=3)


def _origin_of(velocity: Callable, points: Float[Array, "q d"]) -> Float[Array, "q d"]:
    """The p with p + velocity(p) = points, by Newton's method from the points themselves."""

    def residual(p, end):
        return p + velocity(p[None])[0] - end

    def newton(_, p):
        slope = jax.vmap(jax.jacfwd(residual))(p, points)
        return p - jnp.linalg.solve(slope, jax.vmap(residual)(p, points)[..., None])[..., 0]

    return lax.fori_loop(0, _NEWTON, newton, points)


def _known(tree) -> bool:
    return all(concrete(leaf) is not None for leaf in jax.tree.leaves(tree))


@eqx.filter_jit
def _misfit(flow: KunitaFlow, x: State) -> Array:
    points = flow.space.to_points(x)
    return flow.noise_field.misfit(flow.kernel, flow.covariance_kernel, points)


def _distances(xp, x):
    """|x_i − x_j|, infinite for i = j."""
    square = xp.sum((x[:, None] - x[None]) ** 2, axis=-1)
    return xp.where(xp.eye(len(x), dtype=bool), xp.inf, xp.sqrt(square))
