"""Curves that are matched as sets of edges: no point of one corresponds to a point of the other.

A curve with edges of centres c_i and vectors τ_i is seen as μ = Σ_i δ(c_i, τ_i), and two of them
are compared by the norm of a reproducing kernel, ‖μ − ν‖² = ⟨μ, μ⟩ − 2 ⟨μ, ν⟩ + ⟨ν, ν⟩,

    currents              ⟨μ, ν⟩ = Σ_ij exp(−|c_i − d_j|²/ℓ²) τ_i · σ_j
    oriented varifolds    ⟨μ, ν⟩ = Σ_ij exp(−|c_i − d_j|²/ℓ²) exp(−|τ̂_i − σ̂_j|²/s²) |τ_i| |σ_j|,

τ̂ = τ/|τ|: midpoint rules for double integrals along both curves. Glaunès, Qiu, Miller and Younes
(2008); Kaltenmark, Charlier and Charon (2017), whose exp(2u/s²) of u = τ̂ · σ̂ is this up to a
constant.
"""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._checks import as_float, concrete, flag, positive_integer, require
from .._types import State
from ..kernels._parameters import positive_scalar, squared_distances
from ..sdes import AbstractSDE
from ._base import AbstractCondition
from ._density import AbstractDensityMatch

Points = Float[Array, "n dim"]


class AbstractCurveMatch(AbstractDensityMatch):
    """ψ(x) = exp(−‖μ_x − μ_v‖² / 2 variance), a kernel and no density of the curve v.

    A subclass gives `inner`.
    """

    variance: eqx.AbstractVar[Float[Array, ""]]
    closed_curve: eqx.AbstractVar[bool]
    num_points: eqx.AbstractVar[int | None]

    @abstractmethod
    def inner(self, x: Points, y: Points) -> Float[Array, ""]:
        """⟨μ_x, μ_y⟩ of two curves, given by their points."""

    def squared_distance(self, x: Points, y: Points) -> Float[Array, ""]:
        """‖μ_x − μ_y‖²."""
        return self.inner(x, x) - 2 * self.inner(x, y) + self.inner(y, y)

    def log_density(self, sde, x, observed):
        points = _points(sde, x)
        square = self.squared_distance(points, observed.astype(x.dtype))
        return -0.5 * square / self.variance.astype(x.dtype)

    def precision(self, sde, x, observed):
        """By Gauss and Newton: ∂_x ∂_y ⟨μ_x, μ_y⟩ at y = x, divided by the variance."""

        def inner(y, z):
            return self.inner(_points(sde, y.reshape(x.shape)), _points(sde, z.reshape(x.shape)))

        # With J the Jacobian of x ↦ μ_x, ∂_y ∂_z ⟨μ_y, μ_z⟩ at z = y is Jᵀ J: the curvature of
        # ½ ‖μ_x − μ_v‖² without the term in the residual. It is never negative, and needs no v.
        y = x.reshape(-1)
        W = jax.jacfwd(jax.grad(inner), 1)(y, y) / self.variance.astype(x.dtype)
        return 0.5 * (W + W.T)

    def at(self, observed) -> AbstractCondition:
        """The condition that a curve was seen, `(q, dim)`, of as many points as it has."""
        observed = as_float(observed, "observed")
        require(
            observed.ndim == 2 and len(observed) >= 3 - (not self.closed_curve),
            f"`observed` must hold the points of a curve, (q, dim); got shape {observed.shape}.",
        )
        points = concrete(observed)
        if points is not None and np.all(np.isfinite(points)):
            # A closed curve has an edge from its last point to its first: `append` is one point
            # or none, by a slice of 1 or 0 of them.
            edges = np.diff(points, axis=0, append=points[: self.closed_curve])
            lengths = np.linalg.norm(edges, axis=1)
            require(
                np.all(lengths > 0),
                f"`observed` must have distinct neighbours; points {np.flatnonzero(lengths == 0)} "
                "are repeated by the next one. Remove repeated points; the last point of a closed "
                "curve is not the first.",
            )
        return super().at(observed)

    def example(self, sde: AbstractSDE, x: State) -> Array:
        points = _points(sde, x)
        if self.num_points is None:
            return points
        # Only the number of points matters: they are put on the polygon, evenly in its index.
        last = len(points) - (not self.closed_curve)
        place = np.linspace(0.0, last, self.num_points, endpoint=not self.closed_curve)
        before = place.astype(int)
        part = jnp.asarray(place - before, x.dtype)[:, None]
        after = (before + 1) % len(points)
        return (1 - part) * points[before] + part * points[after]


class CurrentMatch(AbstractCurveMatch):
    """Curves as currents, ψ(x) = exp(−‖μ_x − μ_v‖² / 2 variance).

    Parts that run to and fro cancel each other; otherwise as `VarifoldMatch`.
    """

    variance: Float[Array, ""]
    length_scale: Float[Array, ""]
    closed_curve: bool = eqx.field(static=True)
    num_points: int | None = eqx.field(static=True)

    def __init__(
        self, variance, length_scale, *, closed_curve: bool = True, num_points: int | None = None
    ):
        self.variance = positive_scalar("variance")(variance)
        self.length_scale = positive_scalar("length_scale")(length_scale)
        self.closed_curve = flag(closed_curve, "closed_curve")
        self.num_points = _count(num_points)

    def inner(self, x, y):
        c, edges = _edges(x, self.closed_curve)
        d, others = _edges(y, self.closed_curve)
        return jnp.sum(_gaussian(c, d, self.length_scale) * (edges @ others.T))


class VarifoldMatch(AbstractCurveMatch):
    """Curves as oriented varifolds, ψ(x) = exp(−‖μ_x − μ_v‖² / 2 variance): outlines without
    correspondence.

    The points of the end state, those of the curve where states are coefficients, and of the datum
    may differ in number and in where they are on the curve. The norm is that of the curves, nearly,
    where edges are short beside `length_scale`.

    **Arguments:**

    - `variance`: of the distance, in units of length squared.
    - `length_scale`: ℓ of exp(−|c − d|²/ℓ²), in units of length: what is nearer is one place.
    - `angle_scale`: s of exp(−|τ̂ − σ̂|²/s²), τ̂ and σ̂ unit tangents.
    - `closed_curve`: `False` for curves whose ends do not meet.
    - `num_points`: of data, for laws; as many as the end state has if not given.

    **Errors:** `ValueError` for data with repeated neighbours. In the plane and in space.
    """

    variance: Float[Array, ""]
    length_scale: Float[Array, ""]
    angle_scale: Float[Array, ""]
    closed_curve: bool = eqx.field(static=True)
    num_points: int | None = eqx.field(static=True)

    def __init__(
        self,
        variance,
        length_scale,
        angle_scale=1.0,
        *,
        closed_curve: bool = True,
        num_points: int | None = None,
    ):
        self.variance = positive_scalar("variance")(variance)
        self.length_scale = positive_scalar("length_scale")(length_scale)
        self.angle_scale = positive_scalar("angle_scale")(angle_scale)
        self.closed_curve = flag(closed_curve, "closed_curve")
        self.num_points = _count(num_points)

    def inner(self, x, y):
        c, edges = _edges(x, self.closed_curve)
        d, others = _edges(y, self.closed_curve)
        # Data have no edge of length 0, which `at` refuses, and states have one with probability 0.
        lengths = jnp.linalg.norm(edges, axis=1)
        other_lengths = jnp.linalg.norm(others, axis=1)
        tangents = edges / lengths[:, None]
        other_tangents = others / other_lengths[:, None]
        near = _gaussian(c, d, self.length_scale)
        along = _gaussian(tangents, other_tangents, self.angle_scale)
        return lengths @ (near * along) @ other_lengths


def _points(sde: AbstractSDE, x: State) -> Points:
    return x if sde.space is None else sde.space.to_points(x)


def _edges(points: Points, closed_curve: bool) -> tuple[Points, Points]:
    """Centres and vectors."""
    first = points if closed_curve else points[:-1]
    second = jnp.roll(points, -1, axis=0) if closed_curve else points[1:]
    return 0.5 * (first + second), second - first


def _gaussian(x: Points, y: Points, scale) -> Float[Array, "n m"]:
    return jnp.exp(-squared_distances(x, y, scale))


def _count(num_points: int | None) -> int | None:
    return None if num_points is None else positive_integer(num_points, "num_points", least=3)
