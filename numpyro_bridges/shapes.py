"""Preparation of shapes: equal spacing, position, size, rotation, start point, mean.

A shape is an array (n, d) of n points in R^d, d = 2 or 3. Everything here is plain NumPy in float64 and runs
before inference. Size is the RMS radius r(x) = (1/n Σ_i |x_i − x̄|²)^½, which does not grow with the number
of points (the centroid size of morphometrics is √n r).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ._checks import flag, known_float, known_number, positive_integer


def resample(points: ArrayLike, num_points: int, closed: bool = True) -> NDArray:
    """Points at equal arc length along a polygon, beginning at its first point.

    **Arguments:**

    - `points`: (n, d) vertices in order. Repeated vertices are allowed, also a last one that repeats the
      first.
    - `num_points`: how many points to return.
    - `closed`: whether an edge joins the last vertex to the first. A closed curve of length ℓ is sampled at i
      ℓ/num_points (its start is not repeated), an open one at i ℓ/(num_points − 1), both ends included.

    **Returns:** (num_points, d). Spacing is even along the polygon; chords across its corners are shorter.

    **Raises:** `ValueError` for missing (NaN) points, a curve of no length, or too few points.
    """
    points, closed = _shape(points, "points"), flag(closed, "closed")
    num_points = positive_integer(num_points, "num_points", least=1 if closed else 2)
    if closed:
        points = np.concatenate([points, points[:1]])
    arc_length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    if not arc_length[-1] > 0.0:
        raise ValueError("`points` must trace a curve of positive length, got coinciding points.")
    where = np.linspace(0.0, arc_length[-1], num_points, endpoint=not closed)
    return np.stack([np.interp(where, arc_length, column) for column in points.T], axis=1)


def center(points: ArrayLike) -> NDArray:
    """Shapes (..., n, d) moved so that the mean of their points is the origin."""
    points = _shapes(points, "points")
    return points - points.mean(axis=-2, keepdims=True)


def rms_radius(points: ArrayLike) -> NDArray:
    """Root mean square distance from the centroid: (..., n, d) to (...)."""
    return np.sqrt(np.mean(np.sum(center(points) ** 2, axis=-1), axis=-1))


def unit_size(points: ArrayLike) -> NDArray:
    """Shapes (..., n, d) centred and divided by their RMS radius."""
    return _unit_size(center(points), "points")


class Alignment(NamedTuple):
    """What `procrustes_align` returns.

    - `shapes`: (N, n, d) aligned shapes, NaN where a point is missing.
    - `mean`: (n, d), without NaN; of unit RMS radius where `scale` is true.
    - `num_iterations`: rotations of all shapes onto a mean.
    - `converged`: whether the last iteration moved the mean by less than the tolerance.
    """

    shapes: NDArray
    mean: NDArray
    num_iterations: int
    converged: bool


def procrustes_align(
    shapes: ArrayLike,
    reference: ArrayLike | None = None,
    scale: bool = True,
    *,
    tolerance: float = 1e-10,
    max_iterations: int = 200,
) -> Alignment:
    """Generalised Procrustes alignment: shapes centred, sized and rotated onto their common mean.

    Minimises Σ_i ‖x_i R_i − x̄‖² over rotations R_i (det R_i = 1: mirror images stay apart) by turns: rotate
    every shape onto the mean, average (Gower 1975). With `scale`, every shape is first given unit RMS radius,
    and so is the mean (partial Procrustes: each shape keeps size one rather than being shrunk onto the mean).

    A point with a NaN coordinate is missing. In every iteration it is filled with the mean, fitted to the seen
    points of its shape by translation, rotation and size; it is returned as NaN.

    **Arguments:**

    - `shapes`: (N, n, d), row j of each shape being the same place.
    - `reference`: (n, d). Given, shapes are rotated onto it once and the mean is the average of the result.
      Without it the first shape without missing points begins the iteration, and keeps its orientation in the
      result.
    - `scale`: whether size is removed.
    - `tolerance`: stops once the mean moves by less, as a fraction of its RMS radius.
    - `max_iterations`: after these `converged` is false.

    **Returns:** an `Alignment`.

    **Raises:** `ValueError` for a wrong shape, a shape with fewer than d seen points, or no shape to begin
    from.
    """
    scale = flag(scale, "scale")
    max_iterations = positive_integer(max_iterations, "max_iterations")
    tolerance = known_number(tolerance, "tolerance", "a number from 0 on", lambda value: value >= 0)
    shapes = known_float(shapes, "shapes")
    if shapes.ndim != 3 or shapes.shape[-1] not in (2, 3) or 0 in shapes.shape:
        raise ValueError(f"`shapes` must have the shape (N, n, 2) or (N, n, 3), got {shapes.shape}.")
    if np.any(np.isinf(shapes)):
        raise ValueError("`shapes` must be finite, or NaN where a point is missing; got infinite coordinates.")
    _, num_points, dim = shapes.shape
    missing: NDArray = np.any(np.isnan(shapes), axis=-1)
    num_seen = num_points - missing.sum(axis=1)
    if num_seen.min() < dim:
        worst = int(num_seen.argmin())
        raise ValueError(
            f"`shapes[{worst}]` must have at least {dim} seen points, got {num_seen[worst]}: leave it out."
        )
    def standard(points: NDArray, name: str) -> NDArray:
        return _unit_size(center(points), name) if scale else center(points)

    if reference is None:
        complete = np.flatnonzero(~np.any(missing, axis=1))
        if complete.size == 0:
            raise ValueError("`shapes` must have one without missing points, or give a `reference`.")
        first = complete[0]
        mean = standard(shapes[first], f"shapes[{first}]")
    else:
        mean = standard(_shape(reference, "reference"), "reference")
        if mean.shape != (num_points, dim):
            raise ValueError(f"`reference` must have the shape {(num_points, dim)}, got {mean.shape}.")

    converged, iteration = False, 0
    while not converged and iteration < max_iterations:
        iteration += 1
        filled = standard(_fill(shapes, missing, mean), "shapes")
        aligned = filled @ _rotations(filled, mean)
        previous, mean = mean, standard(aligned.mean(axis=0), "shapes")
        change = np.sqrt(np.mean(np.sum((mean - previous) ** 2, axis=-1)))
        converged = reference is not None or bool(change <= tolerance * rms_radius(mean))

    if reference is None:
        back = _rotations(aligned[first], filled[first])
        aligned, mean = aligned @ back, mean @ back
    aligned[missing] = np.nan
    return Alignment(aligned, mean, iteration, converged)


def mean_shape(shapes: ArrayLike, scale: bool = True) -> NDArray:
    """Procrustes mean (n, d) of shapes (N, n, d), of unit RMS radius where `scale` is true."""
    return procrustes_align(shapes, scale=scale).mean


def align_start(shapes: ArrayLike, reference: ArrayLike) -> NDArray:
    """Closed outlines numbered from the point that corresponds to the reference's first.

    Of the n cyclic shifts of each outline, takes the one with the least Procrustes distance to `reference`
    (rotations only). The direction of travel is left as it is.

    **Arguments:**

    - `shapes`: (n, d) or (N, n, d), evenly spaced (see `resample`), no missing points.
    - `reference`: (n, d).

    **Returns:** the shapes with their points in the new order, not moved otherwise.
    """
    reference = center(_shape(reference, "reference"))
    shapes = _shapes(shapes, "shapes")
    if shapes.shape[-2:] != reference.shape or shapes.ndim > 3:
        raise ValueError(
            f"`shapes` must be one or several of the reference's shape {reference.shape}, got {shapes.shape}."
        )
    n = len(reference)
    shifts = (np.arange(n)[:, None] + np.arange(n)) % n

    def best(shape: NDArray) -> NDArray:
        shifted = shape[shifts]
        fitted = center(shifted) @ _rotations(center(shifted), reference)
        return shifted[np.argmax(np.sum(fitted * reference, axis=(1, 2)))]

    return best(shapes) if shapes.ndim == 2 else np.stack([best(shape) for shape in shapes])


def _rotations(shapes: NDArray, target: NDArray) -> NDArray:
    """Kabsch's R (..., d, d), det R = 1, that minimise ‖x R − target‖ for centred shapes x (..., n, d)."""
    u, _, vt = np.linalg.svd(np.swapaxes(shapes, -1, -2) @ target)
    u[..., -1] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return u @ vt


def _fill(shapes: NDArray, missing: NDArray, mean: NDArray) -> NDArray:
    """Shapes with missing points taken from the mean after it is fitted to the seen ones."""
    filled = shapes.copy()
    for shape, gone in zip(filled, missing, strict=True):
        if gone.any():
            seen, mean_seen = center(shape[~gone]), center(mean[~gone])
            rotation = _rotations(mean_seen, seen)
            size = np.sum((mean_seen @ rotation) * seen) / np.sum(mean_seen**2)
            offset = shape[~gone].mean(axis=0)
            shape[gone] = size * (mean[gone] - mean[~gone].mean(axis=0)) @ rotation + offset
    return filled


def _shape(points: ArrayLike, name: str) -> NDArray:
    points = known_float(points, name)
    if points.ndim != 2 or points.shape[-1] not in (2, 3) or len(points) == 0:
        raise ValueError(f"`{name}` must have the shape (n, 2) or (n, 3), got {points.shape}.")
    return _seen(points, name)


def _unit_size(points: NDArray, name: str) -> NDArray:
    """Centred shapes divided by their RMS radius."""
    size = rms_radius(points)
    if not np.all(size > 0.0):
        raise ValueError(f"`{name}` must not all coincide: a shape without extent has no unit size.")
    return points / size[..., None, None]


def _shapes(points: ArrayLike, name: str) -> NDArray:
    points = known_float(points, name)
    if points.ndim < 2 or 0 in points.shape:
        raise ValueError(f"`{name}` must have the shape (..., n, d), got {points.shape}.")
    return _seen(points, name)


def _seen(points: NDArray, name: str) -> NDArray:
    if not np.isfinite(points).all():
        raise ValueError(
            f"`{name}` must be finite, got NaN or infinite coordinates: drop missing points first "
            "(only `procrustes_align` accepts them)."
        )
    return points
