"""Preparation of shapes: equal spacing, position, size, rotation, start point, mean.

A shape is an array (n, d) of n points in R^d, d = 2 or 3. Everything here is plain NumPy in
float64 and runs before inference. Size is the RMS radius r(x) = (1/n Σ_i |x_i − x̄|²)^½, which does
not grow with the number of points (the centroid size of morphometrics is √n r).
"""

import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ._checks import choice, flag, known_float, known_number, positive_integer
from .io import Specimen, stack

_ROUNDS = 5
"""Rotations onto a mean that show which shapes are mirrored."""

_FAR = 2.0
"""How much nearer a mirror image must be, and how much farther off than usual an outlier."""

_USUAL = 3.0
"""How far off a mirrored shape must be, in distances of most."""

_MOST = 0.75
"""Mirror images are told where so many shapes are either; else shapes bend to both sides."""

_SEEN = 1e-3
"""Distances below this part of the size of the mean are not looked at."""

_DEVIATIONS = 5.0
"""Robust standard deviations of log distances beyond which there are outliers."""


def resample(points: ArrayLike, num_points: int, closed: bool = True) -> NDArray:
    """Points at equal arc length along a polygon, beginning at its first point.

    **Arguments:**

    - `points`: (n, d) vertices in order. Repeated vertices are allowed, also a last one that
      repeats the first.
    - `num_points`: how many points to return.
    - `closed`: whether an edge joins the last vertex to the first. A closed curve of length ℓ is
      sampled at i ℓ/num_points (its start is not repeated), an open one at i ℓ/(num_points − 1),
      both ends included.

    **Returns:** (num_points, d). Spacing is even along the polygon; chords across its corners are
    shorter.

    **Raises:** `ValueError` for missing (NaN) points, a curve of no length, or too few points.
    """
    points = _shape(points, "points")
    closed = flag(closed, "closed")
    num_points = positive_integer(num_points, "num_points", least=1 if closed else 2)
    if closed:
        points = np.concatenate([points, points[:1]])
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    arc_length = np.concatenate([[0.0], np.cumsum(lengths)])
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


@dataclass(frozen=True, eq=False)
class Alignment:
    """What `procrustes_align` returns. As a tuple it is `(shapes, mean, num_iterations,
    converged)`.

    - `shapes`: (N, n, d) aligned shapes, NaN where a point is missing.
    - `mean`: (n, d), without NaN; of unit RMS radius where `scale` is true.
    - `num_iterations`: rotations of all shapes onto a mean.
    - `converged`: whether the last iteration moved the mean by less than the tolerance.
    - `distances`: (N,) RMS distance of the seen points of each shape from the mean, in RMS radii of
      the mean.
    - `outliers`: (N,) whether that distance is at least twice the median one, and its logarithm is
      more than five robust standard deviations above the median. None among fewer than five.
    - `mirrored`: (N,) whether the mirror image of a shape fits far better: see `procrustes_align`.
    - `names`: of the specimens, `None` where there are none.
    """

    shapes: NDArray
    mean: NDArray
    num_iterations: int
    converged: bool
    distances: NDArray
    outliers: NDArray
    mirrored: NDArray
    names: tuple[str | None, ...]

    def __iter__(self) -> Iterator[Any]:
        return iter((self.shapes, self.mean, self.num_iterations, self.converged))


def procrustes_align(
    shapes: ArrayLike | Iterable[Specimen],
    reference: ArrayLike | None = None,
    scale: bool = True,
    *,
    reflect: str = "warn",
    tolerance: float = 1e-10,
    max_iterations: int = 200,
) -> Alignment:
    """Generalised Procrustes alignment: shapes centred, sized and rotated onto their common mean.

    Minimises Σ_i ‖x_i R_i − x̄‖² over rotations R_i (det R_i = 1: mirror images stay apart) by
    turns: rotate every shape onto the mean, average (Gower 1975). With `scale`, every shape is
    first given unit RMS radius, and so is the mean (partial Procrustes: each shape keeps size one
    rather than being shrunk onto the mean).

    A point with a NaN coordinate is missing. In every iteration it is filled with the mean, fitted
    to the seen points of its shape by translation, rotation and size; it is returned as NaN.

    A specimen that was seen from the other side, or whose y points down, is *mirrored*: a
    `UserWarning` names it. Its mirror image is at most half as far from the mean as itself, which
    is three times as far off as most; and three quarters of the shapes are far like this from their
    own mirror images or those of others, so that they do not just bend to both sides. With a
    `reference` it is mirrored to that, otherwise to the majority, or to the first of two halves.

    **Arguments:**

    - `shapes`: (N, n, d), row j of each shape being the same place; or `Specimen`s, of which
      `io.stack` makes such an array.
    - `reference`: (n, d). Given, shapes are rotated onto it once and the mean is the average of the
      result. Without it the first shape without missing points begins the iteration, and keeps its
      orientation in the result; if there is none, the first of the least incomplete ones, filled up
      by others that share the most points with it.
    - `scale`: whether size is removed.
    - `reflect`: `"warn"` leaves shapes that are mirrored as they are, and tells of them; `"auto"`
      reflects them, without a word but in the result's `mirrored`.
    - `tolerance`: stops once the mean moves by less, as a fraction of its RMS radius.
    - `max_iterations`: after these `converged` is false, and a `UserWarning` says so.

    **Returns:** an `Alignment`.

    **Raises:** `ValueError` for a wrong shape, specimens that differ in their points, a shape with
    fewer than d seen points, or no shape to begin from.
    """
    scale = flag(scale, "scale")
    choice(reflect, "reflect", ("warn", "auto"))
    max_iterations = positive_integer(max_iterations, "max_iterations")
    tolerance = known_number(tolerance, "tolerance", "a number from 0 on", lambda value: value >= 0)
    shapes, names = _with_names(shapes)
    missing = _missing(shapes, names)
    first, start = _start(shapes, missing, reference)
    mirrored = _mirrored(shapes, ~missing, start, first)
    if reflect == "auto":
        # in the first coordinate; a rotation makes that any other plane
        other_side = np.r_[-1.0, np.ones(shapes.shape[-1] - 1)]
        shapes = np.where(mirrored[:, None, None], shapes * other_side, shapes)
        start = start * other_side if first is not None and mirrored[first] else start
    elif mirrored.any():
        _warn_of_mirrored(mirrored, names)

    def standard(points: NDArray, name: str) -> NDArray:
        return _unit_size(center(points), name) if scale else center(points)

    mean = standard(start, "reference" if first is None else f"shapes[{first}]")
    converged = False
    iteration = 0
    while not converged and iteration < max_iterations:
        iteration += 1
        # missing points anew each time: they follow the mean
        filled = standard(_fill(shapes, missing, mean), "shapes")
        aligned = filled @ _rotations(filled, mean)
        previous = mean
        mean = standard(aligned.mean(axis=0), "shapes")
        change = np.sqrt(np.mean(np.sum((mean - previous) ** 2, axis=-1)))
        # onto a reference shapes are rotated once
        converged = first is None or bool(change <= tolerance * rms_radius(mean))
    if not converged:
        warnings.warn(
            f"alignment did not converge in `max_iterations={max_iterations}`: the mean still "
            f"moves by more than {tolerance:g} of its size. Are points in the same order in all "
            "shapes?",
            stacklevel=2,
        )
    if first is not None:
        # all are turned back together, so that the first keeps its orientation
        back = _rotations(aligned[first], filled[first])
        aligned = aligned @ back
        mean = mean @ back
    aligned[missing] = np.nan
    squares = np.sum((aligned - mean) ** 2, axis=-1)
    distances = np.sqrt(np.nanmean(squares, axis=1)) / rms_radius(mean)
    outliers = _far_off(distances)
    return Alignment(aligned, mean, iteration, converged, distances, outliers, mirrored, names)


def _with_names(shapes: Any) -> tuple[NDArray, tuple[str | None, ...]]:
    """An array, and the names of specimens, `None` where there are none."""
    if isinstance(shapes, (list, tuple)) and any(isinstance(one, Specimen) for one in shapes):
        stacked = stack(shapes)
        return stacked.shapes, tuple(stacked.names)
    array = known_float(shapes, "shapes")
    if array.ndim != 3 or array.shape[-1] not in (2, 3) or 0 in array.shape:
        raise ValueError(f"`shapes` must have the shape (N, n, 2) or (N, n, 3), got {array.shape}.")
    return array, (None,) * len(array)


def _missing(shapes: NDArray, names: tuple[str | None, ...]) -> NDArray:
    """Which points (N, n) are missing; every shape must have enough others."""
    if np.any(np.isinf(shapes)):
        raise ValueError(
            "`shapes` must be finite, or NaN where a point is missing; got infinite coordinates."
        )
    _, num_points, dim = shapes.shape
    missing = np.any(np.isnan(shapes), axis=-1)
    num_seen = num_points - missing.sum(axis=1)
    # d points fix a rotation, which fewer do not
    if num_seen.min() < dim:
        worst = int(num_seen.argmin())
        raise ValueError(
            f"{_called(names, worst)} must have at least {dim} seen points, got {num_seen[worst]}: "
            "leave it out."
        )
    return missing


def _start(
    shapes: NDArray, missing: NDArray, reference: ArrayLike | None
) -> tuple[int | None, NDArray]:
    """What the iteration begins with, and which of the shapes that is: `None` of a reference."""
    if reference is None:
        return _least_incomplete(shapes, missing)
    start = _shape(reference, "reference")
    if start.shape != shapes.shape[1:]:
        raise ValueError(f"`reference` must have the shape {shapes.shape[1:]}, got {start.shape}.")
    return None, start


def _warn_of_mirrored(mirrored: NDArray, names: tuple[str | None, ...]) -> None:
    listed = ", ".join(_called(names, i) for i in np.flatnonzero(mirrored)[:8])
    more = f" and {mirrored.sum() - 8} more" if mirrored.sum() > 8 else ""
    warnings.warn(
        f"the mirror image fits far better: {listed}{more}. Seen from the other side, or y "
        "pointing down? Leave them out, correct them, or let them be reflected by "
        '`reflect="auto"`.',
        stacklevel=3,
    )


def _called(names: tuple[str | None, ...], i: int) -> str:
    """How messages speak of one of several shapes."""
    return f"`shapes[{i}]`" + (f" ({names[i]!r})" if names[i] is not None else "")


def _least_incomplete(shapes: NDArray, missing: NDArray) -> tuple[int, NDArray]:
    """The first shape with the fewest missing points, and itself with these filled in.

    They come from other shapes, that with the most points in common first, fitted by translation,
    rotation and size.
    """
    never = np.flatnonzero(missing.all(axis=0))
    if never.size:
        raise ValueError(
            f"`shapes` must have each point in one shape at least; {never.tolist()} are missing in "
            "all. Leave these points out, or give a `reference`."
        )
    first = int(missing.sum(axis=1).argmin())
    filled = shapes[first].copy()
    gone = missing[first].copy()
    while gone.any():
        # how many points that are known here by now another shape shares
        common = np.sum(~gone & ~missing, axis=1)
        common[~np.any(gone & ~missing, axis=1)] = 0  # it has none of those that are sought
        other = int(common.argmax())
        if common[other] < shapes.shape[-1]:
            raise ValueError(
                "`shapes` must overlap: no two have enough points in common to begin from. "
                "Give a `reference`."
            )
        seen = ~missing[other]
        filled[seen] = _fill(filled[None, seen], gone[None, seen], shapes[other, seen])[0]
        gone &= missing[other]
    return first, filled


def _mirrored(shapes: NDArray, seen: NDArray, start: NDArray, first: int | None) -> NDArray:
    """Which shapes (N,) are mirror images of most, or of the start where that is a reference.

    The mean of shapes some of which are mirrored is flat, and tells nothing. So all are brought
    onto a mean by rotations and reflections, and then those are told apart that are near to it by
    the one or the other.
    """
    mean = start
    for _ in range(0 if first is None else _ROUNDS):
        # U Vᵀ of the singular value decomposition, whatever its determinant: rotations and
        # reflections
        x, onto, size, place = _in_common(shapes, seen, mean)
        u, _, vt = np.linalg.svd(np.swapaxes(x, -1, -2) @ onto)
        fitted = size * x @ (u @ vt) + place
        mean = np.nanmean(np.where(seen[..., None], fitted, np.nan), axis=0)
    x, onto, _, _ = _in_common(shapes, seen, mean)
    u, values, vt = np.linalg.svd(np.swapaxes(x, -1, -2) @ onto)
    # Of unit sizes the cosine of the angle between shapes is the sum of the singular values; for
    # the other hand the smallest one counts negative. √(1 − cos²) is the distance.
    best = values.sum(axis=-1)
    of_other_hand = best - 2.0 * values[:, -1]
    rotates = np.linalg.det(u @ vt) > 0.0
    cosines = np.where(rotates, best, of_other_hand), np.where(rotates, of_other_hand, best)
    by_rotation, by_reflection = (np.sqrt(1.0 - np.clip(cos, 0.0, 1.0) ** 2) for cos in cosines)
    usual = _USUAL * np.median(np.minimum(by_rotation, by_reflection))
    rotated = (_FAR * by_rotation <= by_reflection) & (by_reflection > max(usual, _SEEN))
    reflected = (_FAR * by_reflection <= by_rotation) & (by_rotation > max(usual, _SEEN))
    told = np.flatnonzero(rotated | reflected)
    if told.size < _MOST * len(shapes):
        return np.zeros(len(shapes), bool)
    # to a reference, or to the majority; of two halves to that of the first shape that is told
    if first is None or rotated.sum() > reflected.sum():
        return reflected
    halves = rotated.sum() == reflected.sum()
    return reflected if halves and rotated[told[0]] else rotated


def _in_common(
    shapes: NDArray, seen: NDArray, mean: NDArray
) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """The seen points of shapes, and the same of the mean, both centred and of unit size.

    Those that are not seen are 0. Beside them the size and the place of the mean's points.
    """

    def centred(points: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        points = np.where(seen[..., None], points, 0.0)
        place = points.sum(axis=1, keepdims=True) / seen.sum(axis=1)[:, None, None]
        points = np.where(seen[..., None], points - place, 0.0)
        size = np.linalg.norm(points, axis=(1, 2), keepdims=True)
        return points / np.where(size > 0.0, size, 1.0), size, place

    x, _, _ = centred(shapes)
    onto, size, place = centred(np.broadcast_to(mean, shapes.shape))
    return x, onto, size, place


def _far_off(distances: NDArray) -> NDArray:
    """Which distances are outliers, for their logarithms and by a robust standard deviation."""
    # logarithms, since distances are positive and skewed
    logs = np.log(np.maximum(distances, _SEEN))
    above = logs - np.median(logs)
    spread = 1.4826 * np.median(np.abs(above))  # of a normal distribution the standard deviation
    far = above > max(_DEVIATIONS * spread, np.log(_FAR))
    return far & (len(distances) >= 5)


def mean_shape(shapes: ArrayLike | Iterable[Specimen], scale: bool = True) -> NDArray:
    """Procrustes mean (n, d) of shapes (N, n, d), of unit RMS radius where `scale` is true."""
    return procrustes_align(shapes, scale=scale).mean


def align_start(shapes: ArrayLike, reference: ArrayLike) -> NDArray:
    """Closed outlines numbered from the point that corresponds to the reference's first.

    Of the n cyclic shifts of each outline, takes the one with the least Procrustes distance to
    `reference` (rotations only). The direction of travel is left as it is.

    **Arguments:**

    - `shapes`: (n, d) or (N, n, d), evenly spaced (see `resample`), no missing points.
    - `reference`: (n, d).

    **Returns:** the shapes with their points in the new order, not moved otherwise.
    """
    reference = center(_shape(reference, "reference"))
    shapes = _shapes(shapes, "shapes")
    if shapes.shape[-2:] != reference.shape or shapes.ndim > 3:
        raise ValueError(
            f"`shapes` must be one or several of the reference's shape {reference.shape}, got "
            f"{shapes.shape}."
        )
    n = len(reference)
    # row k has the numbers of the points where the outline begins at its point k
    shifts = (np.arange(n)[:, None] + np.arange(n)) % n

    def best(shape: NDArray) -> NDArray:
        shifted = shape[shifts]
        # of one size and centred, the nearest has the largest inner product
        fitted = center(shifted) @ _rotations(center(shifted), reference)
        return shifted[np.argmax(np.sum(fitted * reference, axis=(1, 2)))]

    return best(shapes) if shapes.ndim == 2 else np.stack([best(shape) for shape in shapes])


def _rotations(shapes: NDArray, target: NDArray) -> NDArray:
    """Kabsch's R (..., d, d), det R = 1, with least ‖x R − target‖, of centred x (..., n, d)."""
    u, _, vt = np.linalg.svd(np.swapaxes(shapes, -1, -2) @ target)
    # of the best orthogonal map, where it is a reflection, the least important axis is turned
    u[..., -1] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return u @ vt


def _fill(shapes: NDArray, missing: NDArray, mean: NDArray) -> NDArray:
    """Shapes with missing points taken from the mean after it is fitted to the seen ones."""
    filled = shapes.copy()
    for shape, gone in zip(filled, missing, strict=True):
        if gone.any():
            seen = center(shape[~gone])
            mean_seen = center(mean[~gone])
            rotation = _rotations(mean_seen, seen)
            # the least squares of seen = size · mean_seen R
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
        raise ValueError(
            f"`{name}` must not all coincide: a shape without extent has no unit size."
        )
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
