"""Resampling and Procrustes alignment against SciPy, formulas and other people's alignments."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.spatial
from scipy.spatial.transform import Rotation

from numpyro_bridges import io, shapes


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def turn(rng, dim):
    """A random rotation."""
    matrix = np.linalg.qr(rng.normal(size=(dim, dim)))[0]
    matrix[0] *= np.linalg.det(matrix)
    return matrix


def scatter(rng, num_shapes=6, num_points=9, dim=2, noise=0.1):
    """Noisy copies of one shape, moved, turned and sized at random."""
    base = rng.normal(size=(num_points, dim))
    copies = [
        rng.uniform(0.2, 5.0) * (base + noise * rng.normal(size=base.shape)) @ turn(rng, dim)
        + 10.0 * rng.normal(size=dim)
        for _ in range(num_shapes)
    ]
    return base, np.stack(copies)


class TestResample:
    def test_square(self):
        square = jnp.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]])
        expected = [[0, 0], [1, 0], [2, 0], [2, 1], [2, 2], [1, 2], [0, 2], [0, 1]]
        np.testing.assert_allclose(shapes.resample(square, 8), expected, atol=1e-14)

    def test_open_curve_keeps_both_ends(self):
        bend = [[0.0, 0.0], [1.0, 0.0], [1.0, 3.0]]
        np.testing.assert_allclose(
            shapes.resample(bend, 5, closed=False),
            [[0, 0], [1, 0], [1, 1], [1, 2], [1, 3]],
            atol=1e-14,
        )

    @pytest.mark.parametrize("dim", [2, 3])
    @pytest.mark.parametrize("closed", [True, False])
    def test_equal_steps_along_a_smooth_curve(self, dim, closed):
        t = (
            np.linspace(0.0, 1.0, 4000, endpoint=not closed) ** 2
            * 2.0
            * np.pi
            * (1.0 if closed else 0.9)
        )
        curve = np.stack([3.0 * np.cos(t), np.sin(t), 0.5 * np.sin(2.0 * t)], axis=1)[:, :dim]
        points = shapes.resample(curve, 800, closed)
        ends = np.concatenate([points, points[:1]]) if closed else points
        steps = np.linalg.norm(np.diff(ends, axis=0), axis=1)
        assert points.shape == (800, dim)
        np.testing.assert_array_equal(points[0], curve[0])
        assert np.ptp(steps) < 2e-3 * steps.mean()

    def test_repeated_vertices_do_not_matter(self, rng):
        points = rng.normal(size=(7, 2))
        repeated = np.concatenate([np.repeat(points, 2, axis=0), points[:1]])
        np.testing.assert_allclose(
            shapes.resample(repeated, 20), shapes.resample(points, 20), atol=1e-12
        )

    @pytest.mark.parametrize(
        ("points", "num_points", "message"),
        [
            (np.zeros((4, 2)), 3, "positive length, got coinciding points"),
            ([[0.0, np.nan], [1.0, 1.0]], 3, "`points` must be finite.*drop missing points"),
            (np.zeros((2, 4, 2)), 3, r"shape \(n, 2\) or \(n, 3\), got \(2, 4, 2\)"),
            (np.zeros((4, 4)), 3, r"got \(4, 4\)"),
            (np.zeros((0, 2)), 3, r"got \(0, 2\)"),
            (np.eye(2), 0, "`num_points` must be a positive integer; got 0"),
        ],
    )
    def test_errors(self, points, num_points, message):
        with pytest.raises(ValueError, match=message):
            shapes.resample(points, num_points)

    def test_open_curve_needs_two_points(self):
        with pytest.raises(ValueError, match="at least 2"):
            shapes.resample(np.eye(2), 1, closed=False)


def test_size_and_position(rng):
    points = rng.normal(size=(4, 5, 3)) + 3.0
    expected = np.sqrt(np.mean(np.sum((points - points.mean(1, keepdims=True)) ** 2, -1), -1))
    np.testing.assert_allclose(shapes.rms_radius(points), expected)
    unit = shapes.unit_size(points)
    np.testing.assert_allclose(unit.mean(axis=1), 0.0, atol=1e-14)
    np.testing.assert_allclose(np.mean(np.sum(unit**2, -1), -1), 1.0)
    with pytest.raises(ValueError, match="must not all coincide"):
        shapes.unit_size(np.ones((3, 2)))
    with pytest.raises(ValueError, match="must be finite"):
        shapes.center([[np.nan, 0.0], [1.0, 1.0]])


class TestProcrustes:
    @pytest.mark.parametrize("dim", [2, 3])
    def test_exact_copies_fall_on_one_another(self, rng, dim):
        base, copies = scatter(rng, dim=dim, noise=0.0)
        aligned, mean, _, converged = shapes.procrustes_align(copies)
        assert converged
        np.testing.assert_allclose(aligned, np.broadcast_to(mean, aligned.shape), atol=1e-12)
        # the first one's orientation
        np.testing.assert_allclose(mean, shapes.unit_size(copies[0]), atol=1e-12)

    @pytest.mark.parametrize("dim", [2, 3])
    def test_pair_against_scipy(self, rng, dim):
        _, (one, two) = scatter(rng, num_shapes=2, dim=dim)
        # SciPy fits the second shape's size too: ‖one − s two‖² = 1 − ⟨one, two⟩² at unit centroid
        # size.
        _, _, disparity = scipy.spatial.procrustes(one, two)
        aligned = shapes.procrustes_align(two[None], reference=one).shapes[0]
        inner = np.sum(aligned * shapes.unit_size(one)) / len(one)
        assert 1.0 - inner**2 == pytest.approx(disparity, rel=1e-9)

    @pytest.mark.parametrize("scale", [True, False])
    @pytest.mark.parametrize("dim", [2, 3])
    def test_optimal_and_stationary(self, rng, dim, scale):
        _, copies = scatter(rng, dim=dim)
        aligned, mean, _, converged = shapes.procrustes_align(copies, scale=scale)
        assert converged
        average = aligned.mean(axis=0)
        np.testing.assert_allclose(mean, shapes.unit_size(average) if scale else average, atol=1e-9)
        for shape in aligned:  # no rotation brings a shape nearer to the mean
            best, _ = Rotation.align_vectors(
                *(np.pad(x, ((0, 0), (0, 3 - dim))) for x in (mean, shape))
            )
            np.testing.assert_allclose(best.as_matrix(), np.eye(3), atol=1e-7)
        sizes = shapes.rms_radius(aligned)
        np.testing.assert_allclose(sizes, 1.0 if scale else shapes.rms_radius(copies))

    def test_result_does_not_depend_on_pose(self, rng):
        _, copies = scatter(rng)
        moved = np.stack([3.0 * shape @ turn(rng, 2) + 1.0 for shape in copies])
        one, two = shapes.procrustes_align(copies), shapes.procrustes_align(moved)
        gap = shapes.procrustes_align(two.mean[None], one.mean).shapes[0] - one.mean
        np.testing.assert_allclose(gap, 0.0, atol=1e-8)

    def test_first_complete_shape_keeps_its_orientation(self, rng):
        _, copies = scatter(rng, noise=0.5)
        copies[0, 0] = np.nan
        aligned = shapes.procrustes_align(copies)
        np.testing.assert_allclose(aligned.shapes[1], shapes.unit_size(copies[1]), atol=1e-12)

    def test_rotates_but_never_reflects(self, rng):
        base, _ = scatter(rng)
        mirrored = base * [-1.0, 1.0]
        with pytest.warns(UserWarning, match="the mirror image fits far better: `shapes.0.`"):
            aligned = shapes.procrustes_align(mirrored[None], reference=base).shapes[0]
        sign = np.linalg.det(np.linalg.lstsq(shapes.unit_size(mirrored), aligned, rcond=None)[0])
        assert sign == pytest.approx(1.0)
        assert np.abs(aligned - shapes.unit_size(base)).max() > 0.1

    @pytest.mark.parametrize("scale", [True, False])
    def test_missing_points_of_exact_copies(self, rng, scale):
        base, copies = scatter(rng, dim=3, noise=0.0)
        complete = shapes.procrustes_align(copies, scale=scale)
        missing = np.zeros(copies.shape[:2], bool)
        missing[[1, 1, 4], [0, 5, 8]] = True
        holed = np.where(missing[..., None], np.nan, copies)
        aligned = shapes.procrustes_align(holed, scale=scale)
        assert aligned.converged
        np.testing.assert_array_equal(np.isnan(aligned.shapes).all(-1), missing)
        np.testing.assert_allclose(aligned.mean, complete.mean, atol=1e-8)
        np.testing.assert_allclose(aligned.shapes[~missing], complete.shapes[~missing], atol=1e-8)

    def test_missing_points_of_noisy_copies_move_the_mean_little(self, rng):
        _, copies = scatter(rng, num_shapes=30, noise=0.02)
        holed = copies.copy()
        holed[3, 2, 1] = np.nan  # one coordinate is enough
        full, part = shapes.procrustes_align(copies), shapes.procrustes_align(holed)
        assert part.converged and np.isnan(part.shapes).sum() == 2
        assert 0.0 < np.abs(full.mean - part.mean).max() < 0.01

    def test_reports_when_it_stops_early(self, rng):
        _, copies = scatter(rng, noise=1.0)
        with pytest.warns(UserWarning, match="did not converge in `max_iterations=1`"):
            stopped = shapes.procrustes_align(copies, max_iterations=1)
        assert not stopped.converged and stopped.num_iterations == 1

    def test_errors(self, rng):
        _, copies = scatter(rng)
        with pytest.raises(ValueError, match=r"shape \(N, n, 2\) or \(N, n, 3\), got \(9, 2\)"):
            shapes.procrustes_align(copies[0])
        with pytest.raises(
            ValueError, match=r"`reference` must have the shape \(9, 2\), got \(4, 2\)"
        ):
            shapes.procrustes_align(copies, copies[0, :4])
        with pytest.raises(ValueError, match=r"`reference` must be finite"):
            shapes.procrustes_align(copies, np.full((9, 2), np.nan))
        holed = copies.copy()
        holed[2, 1:] = np.nan
        with pytest.raises(
            ValueError, match=r"`shapes\[2\]` must have at least 2 seen points, got 1"
        ):
            shapes.procrustes_align(holed)
        holed = copies.copy()
        holed[:, 0] = np.nan
        with pytest.raises(ValueError, match=r"each point in one shape.*; \[0\] are missing"):
            shapes.procrustes_align(holed)
        assert shapes.procrustes_align(holed, copies[0]).converged
        with pytest.raises(ValueError, match="infinite"):
            shapes.procrustes_align(np.where(copies == copies[0, 0, 0], np.inf, copies))


class TestMirrorImages:
    """Referee: which shapes the test has mirrored."""

    @pytest.mark.parametrize("dim", [2, 3])
    @pytest.mark.parametrize("few", [[2], [1, 4, 7], [0], [0, 3, 5, 9]])
    def test_the_minority_is_named(self, rng, dim, few):
        _, copies = scatter(rng, num_shapes=12, dim=dim, noise=0.05)
        right = shapes.procrustes_align(copies)
        assert not right.mirrored.any() and not right.outliers.any()
        turned = copies.copy()
        turned[few, :, dim - 1] *= -1.0
        specimens = [io.Specimen(shape, id=f"w{i}") for i, shape in enumerate(turned)]
        listed = ", ".join(rf"`shapes\[{i}\]` \('w{i}'\)" for i in few)
        with pytest.warns(UserWarning, match=f'fits far better: {listed}. .*`reflect="auto"`'):
            left = shapes.procrustes_align(specimens)
        assert np.flatnonzero(left.mirrored).tolist() == few
        mended = shapes.procrustes_align(specimens, reflect="auto")  # without a word
        assert np.flatnonzero(mended.mirrored).tolist() == few
        np.testing.assert_allclose(mended.distances, right.distances, atol=1e-9)
        assert mended.num_iterations == right.num_iterations
        assert mended.names == tuple(f"w{i}" for i in range(12))

    def test_missing_points_and_sizes(self, rng):
        _, copies = scatter(rng, num_shapes=9, dim=3, noise=0.05)
        copies[4] *= [1.0, -1.0, 1.0]
        copies[[1, 4, 5], [0, 3, 8]] = np.nan
        mended = shapes.procrustes_align(copies, scale=False, reflect="auto")
        assert np.flatnonzero(mended.mirrored).tolist() == [4]
        np.testing.assert_array_equal(np.isnan(mended.shapes), np.isnan(copies))
        copies[4] *= [1.0, -1.0, 1.0]
        right = shapes.procrustes_align(copies, scale=False)
        np.testing.assert_allclose(mended.distances, right.distances, atol=1e-8)

    @pytest.mark.parametrize("halves", [slice(0, 4), slice(4, 8)])
    def test_of_two_halves_the_first_is_right(self, rng, halves):
        _, copies = scatter(rng, num_shapes=8, noise=0.05)
        copies[halves] *= [1.0, -1.0]
        found = shapes.procrustes_align(copies, reflect="auto")
        assert np.flatnonzero(found.mirrored).tolist() == [4, 5, 6, 7]
        np.testing.assert_allclose(found.shapes[0], shapes.unit_size(copies[0]), atol=1e-12)

    def test_no_false_alarms(self, rng):
        """Of shapes that are nearly their own mirror images, flat in space, or mere noise."""
        noise = rng.normal(size=(20, 12, 3))
        line = rng.normal(size=(1, 12, 2)) * [1.0, 0.0] + 1e-3 * noise[..., :2]
        flat = (rng.normal(size=(1, 12, 3)) + 0.1 * noise) * [1.0, 1.0, 0.0]
        for some in (line, flat, flat + 1e-3 * noise, noise, noise[..., :2]):
            assert not shapes.procrustes_align(some, max_iterations=1000).mirrored.any()

    def test_bends_to_both_sides_are_no_mirror_images(self, rng):
        """Nearer to the mirror image, as many are; and a strong bend, not much nearer to it."""
        s = np.linspace(-1.0, 1.0, 12)

        def bent(by):
            return np.stack([np.broadcast_to(s, (len(by), 12)), np.outer(by, s**2)], axis=-1)

        assert not shapes.procrustes_align(bent(0.02 + 0.1 * rng.normal(size=40))).mirrored.any()
        found = shapes.procrustes_align(bent(np.r_[0.05 + 0.01 * rng.normal(size=20), -0.4]))
        assert not found.mirrored.any() and np.flatnonzero(found.outliers).tolist() == [20]

    def test_a_long_list_is_cut_short(self, rng):
        _, copies = scatter(rng, num_shapes=30, noise=0.02)
        copies[15:27] *= [1.0, -1.0]
        with pytest.warns(UserWarning, match=r"`shapes\[22\]` and 4 more. Seen"):
            shapes.procrustes_align(copies)


class TestDistances:
    def test_are_what_they_say(self, rng):
        _, copies = scatter(rng, noise=0.1)
        copies[2, 3] = np.nan
        for scale in (True, False):
            found = shapes.procrustes_align(copies, scale=scale)
            rms = [
                np.sqrt(np.mean([np.sum((p - q) ** 2) for p, q in pairs if np.isfinite(p).all()]))
                for pairs in (zip(shape, found.mean, strict=True) for shape in found.shapes)
            ]
            np.testing.assert_allclose(found.distances, rms / shapes.rms_radius(found.mean))

    def test_outliers(self, rng):
        _, copies = scatter(rng, num_shapes=40, noise=0.02)
        assert not shapes.procrustes_align(copies).outliers.any()
        copies[7, [2, 5]] = copies[7, [5, 2]]  # two landmarks in the wrong order
        found = shapes.procrustes_align(copies)
        assert np.flatnonzero(found.outliers).tolist() == [7] == [int(found.distances.argmax())]
        assert not found.mirrored.any()
        assert not shapes.procrustes_align(copies[5:9]).outliers.any()  # of four who is to say

    def test_unpacks_as_ever(self, rng):
        _, copies = scatter(rng)
        found = shapes.procrustes_align(copies)
        aligned, mean, num_iterations, converged = found
        assert aligned is found.shapes and mean is found.mean
        assert (num_iterations, converged) == (found.num_iterations, True)
        assert found.names == (None,) * 6


class TestNoCompleteShape:
    def test_begins_from_the_least_incomplete(self, rng):
        """Exact copies: the mean is that of complete ones."""
        _, copies = scatter(rng, noise=0.0)
        complete = shapes.procrustes_align(copies)
        missing = np.zeros(copies.shape[:2], bool)
        missing[np.arange(6), np.arange(6)] = True
        missing[[0, 0, 3], [3, 4, 8]] = True
        found = shapes.procrustes_align(np.where(missing[..., None], np.nan, copies))
        assert found.converged
        onto = shapes.procrustes_align(found.mean[None], complete.mean).shapes[0]
        np.testing.assert_allclose(onto, complete.mean, atol=1e-8)
        seen = np.where(missing[1][:, None], np.nan, shapes.unit_size(copies[1]))
        np.testing.assert_allclose(found.shapes[1], seen, atol=1e-8)  # the first with one missing

    def test_several_fill_up_the_first(self, rng):
        _, copies = scatter(rng, num_shapes=3, dim=3, noise=0.0)
        holed = copies.copy()
        for shape, gone in zip(holed, ([0, 1], [1, 2], [0, 2]), strict=True):
            shape[gone] = np.nan
        found = shapes.procrustes_align(holed)
        np.testing.assert_allclose(found.mean, shapes.procrustes_align(copies).mean, atol=1e-8)

    def test_says_when_it_cannot(self, rng):
        _, copies = scatter(rng, num_shapes=2, num_points=6)
        copies[0, :3] = np.nan
        copies[1, 3:] = np.nan
        with pytest.raises(ValueError, match="no two have enough points in common .*`reference`"):
            shapes.procrustes_align(copies)

    def test_names_the_specimen(self):
        few = io.Specimen([[1.0, 2.0], [np.nan, 3.0], [np.nan, 1.0]], id="crushed")
        with pytest.raises(ValueError, match=r"`shapes\[1\]` \('crushed'\) must have at least 2"):
            shapes.procrustes_align([io.Specimen(np.eye(3)[:, :2], id="whole"), few])
        with pytest.raises(ValueError, match=r"`specimens\[1\]` \('crushed'\) has 3 landmarks"):
            shapes.procrustes_align([io.Specimen(np.eye(2), id="whole"), few])


def test_mean_shape(rng):
    _, copies = scatter(rng)
    np.testing.assert_array_equal(shapes.mean_shape(copies), shapes.procrustes_align(copies).mean)
    assert shapes.rms_radius(shapes.mean_shape(copies)) == pytest.approx(1.0)


@pytest.mark.parametrize("dim", [2, 3])
def test_align_start(rng, dim):
    base = rng.normal(size=(11, dim))
    shifts = [0, 3, 10]
    moved = np.stack(
        [2.0 * np.roll(base, shift, axis=0) @ turn(rng, dim) + 5.0 for shift in shifts]
    )
    found = shapes.align_start(moved, base)
    for shape, original, shift in zip(found, moved, shifts, strict=True):
        np.testing.assert_array_equal(shape, np.roll(original, -shift, axis=0))
    np.testing.assert_array_equal(shapes.align_start(moved[1], base), found[1])
    with pytest.raises(ValueError, match=r"reference's shape \(4, .\), got"):
        shapes.align_start(moved, base[:4])


def test_alignment_of_papilio_is_geomorphs(shared_data):
    """The consensus that the R package geomorph finds for the same 40 outlines of 1000 points."""
    data = np.load(shared_data / "papilio" / "papilio.npz")
    alignment = shapes.procrustes_align(data["raw"])
    mean = shapes.procrustes_align(alignment.mean[None], data["mean"]).shapes[0] / np.sqrt(1000.0)
    assert alignment.converged
    np.testing.assert_allclose(mean, data["mean"], atol=1e-8)


def test_rats_turn_back_from_their_registration(shared_data):
    """Vilmann's rats are registered on two landmarks, so some coordinates are constant; aligned,
    none is.
    """
    rats = np.stack([rat.landmarks for rat in io.read_tps(shared_data / "rats" / "rats.tps")])
    assert np.ptp(rats[:, 4], axis=0).max() == 0.0
    alignment = shapes.procrustes_align(rats, scale=False)
    assert alignment.converged and alignment.shapes.std(axis=0).min() > 0.0
    np.testing.assert_allclose(shapes.rms_radius(alignment.shapes), shapes.rms_radius(rats))


def test_real_shapes_raise_no_alarm(shared_data):
    """In space too, with large differences between species; one of 911 that is mirrored is found."""
    with np.load(shared_data / "steinmanella" / "steinmanella.npz") as data:
        shells = data["shapes"]
    with np.load(shared_data / "ptychomya" / "outlines.npz") as data:
        outlines = data["outlines"]
    wings = io.stack(io.read(shared_data / "morpho" / "hindwings.csv.gz")).shapes
    tails = io.read(shared_data / "tyrannus" / "tyrannus.tps")
    butterflies = io.read(shared_data / "papilio" / "papilio_raw_10.tps")
    for some in (shells, outlines, wings, tails, butterflies):
        found = shapes.procrustes_align(some)
        assert found.converged and not found.mirrored.any() and not found.outliers.any()
    wings[500] *= [1.0, -1.0]
    with pytest.warns(UserWarning, match=r"far better: `shapes\[500\]`\."):
        assert shapes.procrustes_align(wings).outliers[500]
