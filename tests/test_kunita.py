"""The Kunita flow: its covariance, three representations of its noise, and guides on simulated and
on real shapes.

Referees: quadrature in the plane, formulas retyped in NumPy, ends simulated in NumPy, and long runs
of other code.
"""

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import numpyro_bridges as nb

ALPHA, LENGTH = 0.3, 0.7
POINTS = np.array([[1.0, 0.1], [0.2, 0.9], [-0.8, 0.5], [-0.6, -0.7], [0.4, -0.9]])


def covariance(x, alpha=ALPHA, length=LENGTH):
    square = np.sum((x[..., :, None, :] - x[..., None, :, :]) ** 2, -1)
    return alpha**2 * np.pi * length**2 * np.exp(-square / (4 * length**2))


def flow_covariance(noise):
    flow = nb.KunitaFlow(
        nb.Landmarks(len(POINTS), 2), nb.GaussianKernel(ALPHA, LENGTH), noise=noise
    )
    sigma, a = jax.jit(lambda x: flow.noise(0.0, x))(POINTS)
    np.testing.assert_allclose(sigma @ sigma.T, a, atol=1e-9 * a[0, 0])
    return flow, np.asarray(a)


# Covariance.


def test_covariance_is_the_integral_over_the_plane():
    """∫ k(x, y) k(x', y) dy by the trapezium rule, exact to rounding for a Gaussian."""
    width = 0.1
    axis = np.arange(-6, 6, width)
    y = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    k = ALPHA * np.exp(-np.sum((POINTS[:, None] - y[None]) ** 2, -1) / (2 * LENGTH**2))
    integral = k @ k.T * width**2
    np.testing.assert_allclose(covariance(POINTS), integral, rtol=1e-12)
    _, found = flow_covariance(nb.LandmarkNoise(jitter=0.0))
    np.testing.assert_allclose(found, integral, rtol=1e-12)


def test_point_sd():
    """The SD of a coordinate of simulated ends, by Euler steps in NumPy, within 4 SE of 0.6 %."""
    flow = nb.KunitaFlow(nb.Landmarks(len(POINTS), 2), nb.GaussianKernel(ALPHA, LENGTH))
    found = float(flow.point_sd(0.5))
    np.testing.assert_allclose(found, np.sqrt(0.5 * np.pi) * ALPHA * LENGTH)
    rng = np.random.default_rng(1)
    num_steps, shape = 5, (2000, *POINTS.shape)
    x = np.broadcast_to(POINTS, shape)
    for _ in range(num_steps):
        a = covariance(x) + 1e-12 * np.eye(len(POINTS))
        x = x + np.linalg.cholesky(0.5 / num_steps * a) @ rng.normal(size=shape)
    moves = (x - POINTS).reshape(len(x), -1)
    mean_square = np.mean(moves**2, axis=1)  # of one path; the points of a path move together
    error = np.std(mean_square) / np.sqrt(len(x)) / (2.0 * found)
    assert error < 0.008 * found
    assert abs(np.sqrt(mean_square.mean()) - found) < 4.0 * error

    own = nb.KunitaFlow(flow.space, covariance=nb.MaternKernel(0.25, 1.0, 1))  # its variance is 1/4
    np.testing.assert_allclose(own.point_sd(), 0.5)
    for t in (-1.0, np.nan, np.ones(2)):
        with pytest.raises(ValueError, match="`t` must be a number from 0 on"):
            flow.point_sd(t)


@pytest.mark.filterwarnings("ignore:the noise is wrong by more than 1 %")
@pytest.mark.parametrize("modes, period", [(2, None), (4, None), (7, None), (12, None), (12, 4.5)])
def test_spectral_covariance(modes, period):
    """Within what the representation says that it leaves out; 1e-8 with the default period and 12
    modes.
    """
    diameter = 2.1  # of the points
    assert np.max(np.linalg.norm(POINTS[:, None] - POINTS[None], axis=-1)) < diameter
    flow, found = flow_covariance(nb.SpectralNoise(modes, period, diameter))
    truth = covariance(POINTS)
    error = np.abs(found - truth) / truth[0, 0]
    tail, wrap_around = (float(flow.noise_error()[name]) for name in ("tail", "wrap_around"))
    P = diameter + 8.6 * LENGTH if period is None else period
    np.testing.assert_allclose(
        wrap_around, np.exp(-((P - diameter) ** 2) / (4 * LENGTH**2)), rtol=1e-9
    )
    # images at the four sides of the box; the tail is the largest error, that on the diagonal
    assert np.max(error) < 1.01 * tail + 4 * wrap_around + 1e-14
    if wrap_around < 1e-3 * tail:
        np.testing.assert_allclose(np.max(error), tail, rtol=0.01)
    if modes == 12:
        assert np.max(error) < (1e-8 if period is None else 2e-1)


def test_grid_covariance():
    """The error of Σ_y k k Δy falls faster than any power of the cells' width, down to what the
    border cuts off.
    """
    errors = []
    for cells in (4, 8, 12, 16, 24):
        _, found = flow_covariance(nb.GridNoise(-5.0, 5.0, cells))
        errors.append(np.max(np.abs(found - covariance(POINTS))) / covariance(POINTS)[0, 0])
    for error, bound in zip(errors, (1.5, 0.2, 5e-3, 3e-5, 1e-8), strict=True):
        assert error < bound
    assert np.all(np.diff(errors) < 0)


# Evidence.

STEPS, X0 = 8, POINTS
DATUM = POINTS * [1.2, 0.9] + [0.15, -0.1]
VARIANCE = 0.03
SEEN = nb.InexactMatch(VARIANCE)


def simulated_log_evidence(count):
    """The mean density of the datum over ends that are simulated from Cholesky factors, and its
    standard error.
    """
    rng, n = np.random.default_rng(5), len(X0)
    x = np.broadcast_to(X0, (count, n, 2))
    for _ in range(STEPS):
        K = (covariance(x) + 1e-10 * np.eye(n)) / STEPS
        x = x + np.linalg.cholesky(K) @ rng.normal(size=(count, n, 2))
    variance = VARIANCE * n
    log_density = -0.5 * np.sum((DATUM - x) ** 2, axis=(1, 2)) / variance - n * np.log(
        2 * np.pi * variance
    )
    top = log_density.max()
    w = np.exp(log_density - top)
    return np.log(w.mean()) + top, w.std() / w.mean() / np.sqrt(count)


def test_evidence_of_the_same_flow_in_three_representations():
    """Each within 3 SE of the mean over simulated ends, and of the others."""
    noises = {
        "landmark": "landmark",
        "spectral": nb.SpectralNoise(5, diameter=3.0),
        "grid": nb.GridNoise(-3.5, 3.5, 11),
    }
    found = {"simulated": simulated_log_evidence(60_000)}
    for i, (name, noise) in enumerate(noises.items()):
        flow = nb.KunitaFlow(
            nb.Landmarks(len(X0), 2), nb.GaussianKernel(ALPHA, LENGTH), noise=noise
        )
        bridge = nb.GuidedBridge(flow, SEEN.at(DATUM), x0=X0, ts=np.linspace(0, 1, STEPS + 1))
        result = nb.estimate_evidence(bridge, jr.key(i), 1500, batch_size=1500)
        assert result.pareto_k < 0.7
        found[name] = float(result.log_evidence), float(result.standard_error)
    print(found)
    for value, error in found.values():
        assert error < 0.015
        for other, its in found.values():
            assert value == other or abs(value - other) < 3 * np.hypot(error, its)


# Guides on a strongly nonlinear flow.


def log_weights(flow, match, x0, data, num_steps, guide, count):
    """(data, count), from one program for all data."""

    @jax.jit
    def run(data, z):
        def one(v):
            bridge = nb.GuidedBridge(
                flow, match.at(v), x0=x0, ts=np.linspace(0, 1, num_steps + 1), guide=guide
            )
            return jax.lax.map(bridge.log_weight, z, batch_size=100)

        return jax.lax.map(one, data)

    return np.asarray(
        run(jnp.asarray(data), jr.normal(jr.key(0), (count, num_steps, *np.shape(x0))))
    )


REFERENCE = {0: (24.75, 0.08), 1: (16.40, 0.09), 2: (9.65, 0.11)}


@pytest.fixture(scope="module")
def simulated_targets(shared_data):
    data = np.load(shared_data / "kunita_cases" / "kunita_cases.npz")
    space = nb.Landmarks(16, 2, weights=1.0)
    flow = nb.KunitaFlow(
        space, covariance=nb.MaternKernel(0.1, 0.25, order=4), noise=nb.LandmarkNoise(jitter=1e-5)
    )
    setting = flow, nb.InexactMatch(1e-3), data["root"], data["edge_targets"], 100
    counts = (nb.RecedingGuide(), 2500), (nb.FrozenGuide(), 300), (nb.GeodesicGuide(), 1000)
    return [log_weights(*setting, guide, count) for guide, count in counts]


@pytest.mark.parametrize("target", REFERENCE)
def test_simulated_targets(simulated_targets, target):
    """Evidence as in the table, whose runs have an effective size of 80 to 160, as these; spread of
    the guides.
    """
    receding, frozen, geodesic = (x[target] for x in simulated_targets)
    value, own = REFERENCE[target]
    found = float(nb.weights.log_mean_exp(receding))
    weight = np.exp(receding - found)
    # of the weights drawn: the tails of some are not to be trusted
    error = weight.std(ddof=1) / np.sqrt(weight.size)
    k = float(nb.weights.pareto_k(receding))
    print(
        f"log evidence {found:.2f} ± {error:.2f}, k {k:.2f}, SD {receding.std():.2f} and "
        f"{frozen.std():.2f}"
    )
    assert error < 0.2
    assert abs(found - value) < 3 * np.hypot(error, own)
    assert receding.std() < 3
    assert frozen.std() > 3 * receding.std()
    assert geodesic.std() < 1.2
    assert abs(float(nb.weights.log_mean_exp(geodesic)) - found) < 0.5


def test_a_simulated_tree(shared_data):
    """Nine tips, 12 branches of 100 steps. Decided before the run: Ψ of mean at least 72 and of SD
    at most 8.
    """
    data = np.load(shared_data / "kunita_cases" / "kunita_cases.npz")
    space, steps = nb.Landmarks(16, 2, weights=1.0), 100
    flow = nb.KunitaFlow(
        space, covariance=nb.MaternKernel(0.1, 0.25, order=4), noise=nb.LandmarkNoise(jitter=1e-5)
    )
    tree = nb.Tree.from_newick("((a:1,b:1,c:1):1,(d:1,e:1,f:1):1,(g:1,h:1,i:1):1);")
    law = nb.DiffusionTree(flow, data["root"], nb.InexactMatch(1e-3), tree=tree, num_steps=steps)

    def weighed(z):
        bound = law.given(z)
        return bound.log_prob(data["tree_leaves"]), bound.path(data["tree_leaves"])[:, -1]

    z = jr.normal(jr.key(1), (100, *law.noise_prior().shape()))
    found, nodes = jax.jit(lambda z: jax.lax.map(weighed, z, batch_size=20))(z)
    tips = [node - 1 for node in tree.tips]  # branch i leads to node i + 1
    off = float(np.sqrt(np.mean((nodes[:, np.array(tips)] - data["tree_leaves"][None]) ** 2)))
    print(
        f"mean {found.mean():.1f}, SD {found.std():.2f}, tips {off:.4f} from what is seen, whose "
        "SD is 0.0316"
    )
    assert found.mean() > 72 and found.std() < 8
    assert off < 1.2 * np.sqrt(1e-3)


def test_real_wings():
    """Within a genus, from the mean, at a point SD of 0.005 and a field whose SD, 0.035, is that of
    the wings.

    Decided before the run: median SD of the log weight 0.6 to 1.3 end-frozen and 0.2 to 0.5
    receding.
    """
    pytest.importorskip("ktch", reason="the wings are in the package ktch")
    wings, space = nb.datasets.mosquito_wings(32, "CX"), nb.Landmarks(32, 2)
    flow = nb.KunitaFlow(space, nb.GaussianKernel(0.05, 0.4))
    setting = flow, nb.InexactMatch.from_point_sd(0.005, space), wings.mean, wings.points[:5], 50
    frozen = log_weights(*setting, nb.FrozenGuide(), 100).std(axis=1)
    receding = log_weights(*setting, nb.RecedingGuide(), 100).std(axis=1)
    print(f"end-frozen {np.round(frozen, 2)}, receding {np.round(receding, 2)}")
    assert 0.6 < np.median(frozen) < 1.3
    assert 0.2 < np.median(receding) < 0.5
    assert np.all(frozen > 1.3 * receding)
