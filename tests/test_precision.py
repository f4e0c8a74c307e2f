"""Single precision, large time origins, and times between those of the grid.

Where the guide is exact, every log weight is log p(v | x0), known from the dense Gaussian in double
precision: in single precision neither its spread over the noise nor its error may grow with the
steps, the states or the time origin.
"""

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from helpers import as_matrix, exact_affine, log_normal

import numpyro_bridges as nb
from numpyro_bridges.sdes import time_grid

pytestmark = pytest.mark.usefixtures("compile_quickly")

B, SIGMA = np.array([[-0.5, 0.4], [-0.2, -0.8]]), np.array([[0.5, 0.1], [0.0, 0.4]])
CHAIN, PUSH, FIRST = (
    np.array([[0.0, 1.0], [0.0, -1.0]]),
    np.array([[0.0], [1.0]]),
    np.array([[1.0, 0.0]]),
)
SIZES = np.array([1.0, 1e4], np.float32)


def euler(size):
    return nb.SDE(
        lambda t, x, shift: jnp.asarray(B, x.dtype) @ x + shift, lambda t, x, _: SIGMA, 0.3 * size
    )


# whatever the time
STILL = nb.SDE(lambda t, x, _: -jnp.sin(x), lambda t, x, _: 0.5 + 0.1 * jnp.cos(x))

# name: drift, diffusion, shift at size 1, what is seen, the SDE at a size
KINDS = {
    "brownian": (0.0, SIGMA, 0.0, None, lambda size: nb.BrownianMotion(SIGMA @ SIGMA.T)),
    "scalar": (-0.5, 0.7, 0.3, None, lambda size: nb.LinearSDE(-0.5, 0.7, 0.3 * size)),
    "diagonal": (B[0], SIGMA[0], 0.3, None, lambda size: nb.LinearSDE(B[0], SIGMA[0], 0.3 * size)),
    "dense": (B, SIGMA, 0.3, None, lambda size: nb.LinearSDE(B, SIGMA, 0.3 * size)),
    "hypo-elliptic": (CHAIN, PUSH, 0.0, FIRST, lambda size: nb.LinearSDE(CHAIN, PUSH)),
    "euler": (B, SIGMA, 0.3, None, euler),
}
VARIANCES = np.array([0.1, 1e-6], np.float32)


def law_of_the_end(kind, size, x0, ts):
    """Mean and covariance of the end state in double precision."""
    drift, diffusion, shift, *_ = KINDS[kind]
    beta, sigma = np.full((2, 1), shift * float(size)), as_matrix(diffusion, 2)
    x0 = x0.astype(float)[:, None]
    if kind != "euler":
        phi, moved, C = exact_affine(drift, beta, sigma, 1.0)
        return phi @ x0 + moved, C
    mean, C = x0, np.zeros((2, 2))
    for dt in np.diff(ts):
        step = np.eye(2) + dt * drift
        mean, C = mean + dt * (drift @ mean + beta), step @ C @ step.T + dt * sigma @ sigma.T
    return mean, C


@pytest.mark.parametrize(
    "kind, exact, num_steps",
    [
        *((kind, True, 800) for kind in KINDS),
        ("hypo-elliptic", True, 50),
        ("hypo-elliptic", False, 800),
    ],
)
def test_constant_log_weights(kind, exact, num_steps):
    """Sizes and variances in one program, both grids in it; an error of 2 % of a standard deviation
    would be seen.
    """
    *_, operator, make = KINDS[kind]
    L = np.eye(2) if operator is None else operator
    x0 = SIZES[:, None] * np.array([1.0, 0.5], np.float32)
    z = np.random.default_rng(0).normal(size=(32, num_steps, 2, 1)).astype(np.float32)

    def log_weights(size, x0, v, variance, grid):
        match = nb.ExactMatch(operator) if exact else nb.InexactMatch(variance, operator)
        bridge = nb.GuidedBridge(make(size), match.at(v), x0=x0, ts=grid)
        return jax.vmap(bridge.log_weight)(z)

    over_sizes = jax.vmap(log_weights, (0, 0, 0, None, None))
    with jax.enable_x64(False):
        program = jax.jit(jax.vmap(over_sizes, (None, None, 0, 0, None)))
        for graded in (True, False):
            grid = time_grid(0.0, 1.0, num_steps, None, graded=graded)
            laws = [
                law_of_the_end(kind, *start, np.asarray(grid))
                for start in zip(SIZES, x0, strict=True)
            ]
            noises = [np.zeros(())] if exact else VARIANCES
            totals = [
                [L @ C @ L.T + float(noise) * np.eye(len(L)) for _, C in laws] for noise in noises
            ]
            v = np.stack(
                [
                    [
                        (L @ m)[:, 0] + 0.7 * np.sqrt(np.diag(S))
                        for (m, _), S in zip(laws, row, strict=True)
                    ]
                    for row in totals
                ]
            ).astype(np.float32)
            found = np.asarray(program(SIZES, x0, v, np.float32(noises), grid), float)
            for i, j in np.ndindex(found.shape[:2]):
                truth = log_normal(v[i, j].astype(float)[:, None], L @ laws[j][0], totals[i][j])
                assert found[i, j].std() < 1e-2
                np.testing.assert_allclose(found[i, j].mean(), truth, rtol=0, atol=1e-2)


@pytest.mark.parametrize("seen", ["whole", "mask", "set"])
def test_ends_to_the_last_digit(seen):
    """A path begins at x0 and ends at an exact datum bit by bit, and in a set inside its bounds."""
    start, end = 1e4 * np.array([0.3, -1.1, 0.7]), 1e4 * np.array([0.31, 0.0, 0.77])
    mask = np.array([True, False, True])
    with jax.enable_x64(False):
        box = nb.CylinderSet(end[:2], end[:2] + np.array([0.001, 0.0]))
        sde, condition = {
            "whole": (STILL, nb.ExactMatch().at(end)),
            "mask": (nb.LinearSDE(-0.5, 0.5, 1e4), nb.ExactMatch(mask=mask).at(end[mask])),
            "set": (nb.LinearSDE(-0.5, 0.5, 1e4), box),
        }[seen]
        bridge = nb.GuidedBridge(sde, condition, x0=start, t1=1.0, num_steps=3)
        path = np.asarray(bridge.path(jr.normal(jr.key(0), bridge.noise_shape)))
        assert np.array_equal(path[0], np.asarray(bridge.x0))
        if seen == "set":
            assert np.all((path[-1][:2] >= box.lower) & (path[-1][:2] <= box.upper))
        else:
            assert np.array_equal(
                path[-1][mask] if seen == "mask" else path[-1], np.asarray(condition.observed)
            )


@pytest.mark.parametrize("noise", ["landmark", "control"])
def test_errors_as_small_as_the_jitter(noise):
    """SD √(1e-5 a(x, x)) = 0.00056 beside an error of 0.001, in single precision; nothing in
    double, or beside 0.01.
    """
    ellipses = nb.datasets.ellipses(8)

    def bridge(point_sd):
        flow = nb.KunitaFlow(nb.Landmarks(8, 2), nb.GaussianKernel(0.2, 0.5), noise=noise)
        seen = nb.InexactMatch.from_point_sd(point_sd, flow.space).at(ellipses.points[1])
        return nb.GuidedBridge(flow, seen, x0=ellipses.points[0], t1=1.0, num_steps=2)

    bridge(0.001)  # warnings are errors
    with jax.enable_x64(False):
        bridge(0.01)
        with pytest.warns(
            UserWarning, match="1e-05 of a.x, x., moves .* by 0.00056, .* SD 0.001: it is felt"
        ):
            bridge(0.001)


# Time origins.

SEASONAL = nb.SDE(lambda t, x, _: jnp.sin(t) * jnp.ones_like(x), lambda t, x, _: 0.5)
LATE = 1e9 + 0.25  # seconds since 1970, in 2001


def shifted_bridge(sde, t0, t1, **settings):
    return nb.GuidedBridge(
        sde, nb.ExactMatch().at([0.4, 0.1]), x0=[0.2, 0.3], t0=t0, t1=t1, num_steps=5, **settings
    )


def test_the_time_origin_makes_no_difference_to_an_autonomous_sde():
    """The same numbers bit by bit: grid, weights, free paths, log h̃ between grid times. Times stay
    the user's.
    """
    with jax.enable_x64(False), jax.disable_jit():
        early, late = shifted_bridge(STILL, 0.0, 2.0), shifted_bridge(STILL, LATE, LATE + 2.0)
        assert np.array_equal(early.grid.elapsed, late.grid.elapsed)
        np.testing.assert_allclose(
            np.asarray(late.ts, float), LATE + np.asarray(early.ts, float), rtol=0, atol=1e-6
        )
        z = jr.normal(jr.key(0), early.noise_shape)
        assert early.log_weight(z) == late.log_weight(z)
        moved = late.with_guide(nb.FrozenGuide())
        assert moved.log_weight(z) == early.with_guide(nb.FrozenGuide()).log_weight(z)
        assert early.log_h(0.75, early.x0) == late.log_h(LATE + 0.75, late.x0)
        ts = np.array([0.0, 0.5, 2.0])
        paths = [nb.simulate(STILL, jnp.array([0.2, 0.3]), t0 + ts, z[:2]) for t0 in (0.0, LATE)]
        assert np.array_equal(*paths)
        laws = [
            nb.DiffusionEndpoint(STILL, [0.2, 0.3], nb.InexactMatch(0.1), ts=t0 + ts)
            for t0 in (0.0, LATE)
        ]
        assert np.array_equal(*(law.sample(jr.key(1)) for law in laws))
        assert np.array_equal(np.asarray(laws[1].parts["ts"]), LATE + ts)


def test_an_sde_that_depends_on_the_time_sees_it():
    """dX = sin t dt + σ dW, Euler steps of the user's clock: v ~ N(x0 + Σ dt sin t, σ² T), for
    every noise.
    """
    for t0 in (3.0, 1e5):
        bridge = shifted_bridge(SEASONAL, t0, t0 + 2.0)
        with jax.disable_jit():
            found = bridge.log_weight(jr.normal(jr.key(0), bridge.noise_shape))
        ts = np.asarray(bridge.ts)
        mean = np.array([0.2, 0.3]) + np.diff(ts) @ np.sin(ts[:-1])
        residual = (np.array([0.4, 0.1]) - mean)[:, None]
        np.testing.assert_allclose(found, log_normal(residual, 0.0, 0.5 * np.eye(2)), rtol=1e-9)
    assert SEASONAL.is_autonomous(jnp.ones(2)) is False and STILL.is_autonomous(jnp.ones(2)) is True


def brownian(**settings):
    return nb.GuidedBridge(nb.BrownianMotion(0.5), nb.ExactMatch().at([0.1]), x0=[0.0], **settings)


def free(ts, x0=(0.0,)):
    return nb.simulate(nb.BrownianMotion(0.5), jnp.asarray(x0), ts, np.zeros((2, 1, 1)))


@pytest.mark.parametrize(
    "build, message",
    [
        (
            lambda: shifted_bridge(SEASONAL, LATE, LATE + 2.0),
            "`t0` must leave.*depends on the time.*64.0 apart.*x64",
        ),
        (
            lambda: brownian(t1=1.0, num_steps=10_000),
            "`num_steps` must leave steps.*float32 are .*e-07 apart.*x64",
        ),
        (
            lambda: brownian(ts=[0.0, 1.0, 1.0 + 1e-9]),
            "`ts` must leave steps that can be told apart.*fewer steps",
        ),
        (lambda: free([0.0, 1.0, 1.0 + 1e-9]), "`ts` must leave"),
        (lambda: free(None), "`ts` must be a number"),
        (lambda: free([0.0, 1.0, 2.0], 1.0), r"`x0` must be one state.*got shape \(\)"),
        (
            lambda: brownian(ts=[1.0, 2.0], t0=0.0),
            r"`ts` must begin at `t0`; got ts\[0\] = 1.0 and t0 = 0.0",
        ),
        (lambda: brownian(ts=[0.0, 1.0], t1="1"), "`t1` must be a number"),
        (lambda: brownian(ts=[0.0, 1.0], t0="0"), "`t0` must be a number"),
        (lambda: brownian(t1=1.0, num_steps=2).log_h(None, [0.0]), "`t` must be a number"),
        (
            lambda: brownian(t1=1.0, num_steps=2).log_h(1.0, [0.0]),
            r"`t` must lie in \[0.0, 1.0\), before the end",
        ),
        (
            lambda: brownian(t1=1.0, num_steps=2).score(np.zeros(2), [0.0]),
            r"`t` must be one time; got shape \(2,\)",
        ),
    ],
)
def test_refused_times(build, message):
    with jax.enable_x64(False), pytest.raises(ValueError, match=message):
        build()


def test_what_double_precision_represents_is_accepted():
    assert np.all(np.diff(brownian(t1=1.0, num_steps=10_000).ts) > 0)
    assert np.all(np.diff(shifted_bridge(SEASONAL, LATE, LATE + 2.0).ts) > 0)
    with jax.enable_x64(False):
        assert np.all(np.diff(brownian(t1=1.0, num_steps=2000).ts) > 0)
        assert np.all(np.diff(shifted_bridge(STILL, LATE, LATE + 2.0).ts) > 0)


# log h̃ and its score at any time.


@pytest.mark.parametrize("kind", ["brownian", "scalar", "dense"])
def test_log_h_between_grid_times(kind):
    """The law from x over the time that is left, dense; derivatives by t and x from central
    differences of that.
    """
    drift, diffusion, shift, _, make = KINDS[kind]
    x, v, h = np.array([0.3, -0.2]), np.array([[0.5], [0.1]]), 1e-5

    def truth(t, x):
        phi, moved, C = exact_affine(drift, np.full((2, 1), shift), as_matrix(diffusion, 2), 1 - t)
        return log_normal(v, phi @ x[:, None] + moved, C + 0.05 * np.eye(2))

    @jax.jit
    @jax.vmap
    def found(t):
        condition = nb.InexactMatch(0.05).at(v[:, 0])
        bridge = nb.GuidedBridge(make(1.0), condition, x0=[0.0, 0.0], ts=[0.0, 0.5, 1.0])
        return *jax.value_and_grad(bridge.log_h)(t, jnp.asarray(x)), bridge.score(t, jnp.asarray(x))

    times = np.array([0.01, 0.2, 0.5, 0.9])  # one of them is on the grid
    for t, value, by_time, score in zip(times, *map(np.asarray, found(times)), strict=True):
        np.testing.assert_allclose(value, truth(t, x), rtol=1e-10)
        np.testing.assert_allclose(
            by_time, (truth(t + h, x) - truth(t - h, x)) / (2 * h), rtol=1e-6
        )
        slopes = [(truth(t, x + h * e) - truth(t, x - h * e)) / (2 * h) for e in np.eye(2)]
        np.testing.assert_allclose(score, slopes, rtol=1e-7)


@pytest.mark.parametrize(
    "guide", [nb.RecedingGuide(), nb.FrozenGuide(nb.LinearSDE(-0.3, 0.6, 0.1))]
)
def test_log_h_is_that_of_the_bridge_from_there(guide):
    """A bridge that starts at (t, x), on what is left of the grid."""
    ts, x = np.array([0.0, 0.4, 0.7, 1.0]), jnp.array([0.3, -0.2])
    condition = nb.InexactMatch(0.05).at([0.5, 0.1])
    whole = nb.GuidedBridge(STILL, condition, x0=[0.0, 0.0], ts=ts, guide=guide)
    with jax.disable_jit():
        for t in (0.3, 0.4):
            rest = nb.GuidedBridge(STILL, condition, x0=x, ts=[t, *ts[ts > t]], guide=guide)
            np.testing.assert_allclose(whole.log_h(t, x), rest.log_h(t, x), rtol=1e-10)
            np.testing.assert_allclose(whole.score(t, x), rest.score(t, x), rtol=1e-10)
        path = whole.path(jr.normal(jr.key(0), whole.noise_shape))
        along = [whole.score(t, y) for t, y in zip(ts[:-1], path[:-1], strict=True)]
        np.testing.assert_allclose(whole.scores(path), along, rtol=1e-10)


def test_the_density_by_the_end_time():
    """∂/∂t1 of log N(v; x0 e^{−γ t1}, …), the time traced."""

    def log_weight(t1):
        bridge = nb.GuidedBridge(
            nb.LinearSDE(-0.5, 0.7), nb.ExactMatch().at([0.4]), x0=[1.0], t1=t1, num_steps=3
        )
        return bridge.log_weight(jr.normal(jr.key(0), bridge.noise_shape))

    def truth(t):
        return log_normal(np.array([[0.4]]), np.exp(-0.5 * t), 0.49 * -np.expm1(-t) * np.eye(1))

    value, slope = jax.jit(jax.value_and_grad(log_weight))(1.3)
    np.testing.assert_allclose(value, truth(1.3), rtol=1e-10)
    np.testing.assert_allclose(slope, (truth(1.3 + 1e-5) - truth(1.3 - 1e-5)) / 2e-5, rtol=1e-6)


# The noise of a path.


@pytest.mark.parametrize(
    "condition, path, message",
    [
        (
            nb.InexactMatch(0.1).at([0.1, 0.2]),
            np.ones((4, 2)),
            "`path` must start at `x0`; its first state is 1.0",
        ),
        (
            nb.ExactMatch().at([0.1, 0.2]),
            np.zeros((4, 2)),
            "`path` must end where `condition` is met.*0.2 away",
        ),
        (
            nb.ExactMatch([[1.0, 1.0]]).at([0.1]),
            np.zeros((4, 2)),
            "`path` must end where `condition` is met",
        ),
        (
            nb.CylinderSet([0.1], [1.0]),
            np.zeros((4, 2)),
            "`path` must end where `condition` is met.*0.1 away",
        ),
    ],
)
def test_a_path_of_another_bridge_is_refused(condition, path, message):
    bridge = nb.GuidedBridge(nb.BrownianMotion(0.5), condition, x0=[0.0, 0.0], t1=1.0, num_steps=3)
    with jax.disable_jit(), pytest.raises(ValueError, match=message):
        bridge.noise_from_path(path)


def test_a_path_kept_in_single_precision_is_not():
    condition = nb.ExactMatch().at([1.0 / 3, 200.1])
    bridge = nb.GuidedBridge(
        nb.BrownianMotion(0.5), condition, x0=[0.1, 200.0], t1=1.0, num_steps=3
    )
    with jax.disable_jit():
        path = bridge.path(jr.normal(jr.key(0), bridge.noise_shape)).astype(np.float32)
        assert np.all(np.isfinite(bridge.noise_from_path(path)))
