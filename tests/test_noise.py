"""Room for the shapes in spectral and grid noise: what is lost at an edge, and how that is seen."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

import numpyro_bridges as nb

pytestmark = [pytest.mark.numpyro, pytest.mark.usefixtures("compile_quickly")]

ELL, MATCH = 0.5, nb.InexactMatch(0.01)
KERNEL = nb.GaussianKernel(0.3, ELL)


def flow(noise, kernel=KERNEL, n=3, dim=1, space=None):
    return nb.KunitaFlow(space or nb.Landmarks(n, dim), kernel, noise=noise)


def bridge(sde, x, v=None, **kwargs):
    return nb.GuidedBridge(
        sde, MATCH.at(x if v is None else v), x0=x, t1=1.0, num_steps=2, **kwargs
    )


def spread(extent, dim=1, offset=0.0):
    """Three points, the extent along the last axis."""
    x = 0.1 * np.arange(3.0)[:, None] * np.ones(dim) + offset
    x[:, -1] = extent * np.array([-0.5, 0.1, 0.5])
    return x


def covariance_error(sde, x):
    """max |σσᵀ − a| / a(x, x), a being the closed form."""
    a = np.exp(-np.sum((x[:, None] - x[None]) ** 2, -1) / (4 * ELL**2))
    scale = 0.3**2 * (np.pi * ELL**2) ** (x.shape[1] / 2)
    return np.max(np.abs(np.asarray(sde.covariance(0.0, jnp.asarray(x))) / scale - a))


def quiet(f, *args):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return f(*args)


PERIOD = 6.0
SPECTRAL = nb.SpectralNoise(30, period=PERIOD)


@pytest.mark.parametrize("dim, extent", [(1, 2.0), (1, 3.9), (1, 4.6), (2, 4.6)])
def test_wrap_around_is_the_error_of_the_covariance(dim, extent):
    """Of the widest pair of points, where no mode is missing: exp(−(P − extent)²/4ℓ²), of a state
    and of a path.
    """
    sde = flow(SPECTRAL if dim == 1 else nb.SpectralNoise(10, period=PERIOD), dim=dim)
    x, right = spread(extent, dim), np.exp(-((PERIOD - extent) ** 2) / (4 * ELL**2))
    found = quiet(sde.noise_error, x)
    np.testing.assert_allclose(found["wrap_around"], right, rtol=1e-9)
    if dim == 1:
        np.testing.assert_allclose(covariance_error(sde, x), right, rtol=1e-3, atol=1e-12)
    path = np.stack([spread(0.3, dim), x, spread(1.0, dim)])
    np.testing.assert_allclose(quiet(sde.noise_error, path)["wrap_around"], right, rtol=1e-9)
    assert abs(found["tail"]) < 1e-6


@pytest.mark.parametrize("margin", [3.0, 1.5, 0.5])
def test_the_edge_of_a_box(margin):
    """k² is a normal density of SD ℓ/√2: what lies beyond each side is lost. A coarse grid errs
    without an edge.
    """
    upper = 0.5 + margin * ELL
    x = spread(1.0)
    fine, coarse = flow(nb.GridNoise(-4.0, upper, 64)), flow(nb.GridNoise(-4.0, 6.0, 12))
    lost = norm.sf(upper, 0.5, ELL / np.sqrt(2))
    found = quiet(fine.noise_error, x)
    np.testing.assert_allclose(found["edge"], lost, rtol=1e-2, atol=1e-6)
    np.testing.assert_allclose(found["quadrature"], covariance_error(fine, x), rtol=0.05, atol=1e-6)
    found = quiet(coarse.noise_error, x)
    assert found["edge"] < 1e-3 < 0.02 < found["quadrature"]
    diagonal = np.diag(np.asarray(coarse.covariance(0.0, jnp.asarray(x)))) / (
        0.09 * np.sqrt(np.pi) * ELL
    )
    np.testing.assert_allclose(found["quadrature"], np.max(np.abs(diagonal - 1)), rtol=1e-9)


def test_noise_error_warns_above_one_percent():
    assert flow("landmark").noise_error(spread(1.0)) == {}
    for sde, x, name in (
        (flow(SPECTRAL), spread(4.4), "wrap_around"),
        (flow(nb.SpectralNoise(1, period=PERIOD)), spread(1.0), "tail"),
        (flow(nb.GridNoise(-1.0, 1.0)), spread(1.2), "edge .*quadrature"),
    ):
        with pytest.warns(UserWarning, match=f"wrong by more than 1 % .*{name}"):
            sde.noise_error(x)
    with pytest.raises(
        ValueError, match=r"`x` must be a state \(3, 1\) or a path of them; got \(2, 1\)"
    ):
        flow(SPECTRAL).noise_error(np.zeros((2, 1)))


BASIS = nb.FourierBasis(1, 2)


def circle(radius):
    x = np.zeros((3, 2))
    x[1, 0] = x[2, 1] = radius / np.sqrt(2)
    return x


NARROW = [
    ("period", flow(SPECTRAL), spread(5.5), r"extent along an axis, 5.5, .*`period`.*, 6.*diameter=8.2\)"),
    ("default-period", flow("spectral"), spread(9.0), r"`period`.*, 8.3"),
    ("beyond-the-period", flow(SPECTRAL), spread(50.0), r"100 %.*`period`"),
    ("an-axis", flow(nb.SpectralNoise(4, period=PERIOD), dim=2), spread(5.5, 2), "`period`"),
    ("curve", flow(nb.SpectralNoise(4, period=PERIOD), space=BASIS), circle(2.8), "`period`"),
    ("long-covariance", nb.KunitaFlow(
        nb.Landmarks(3, 1), covariance=nb.MaternKernel(0.1, 2.0), noise=SPECTRAL), spread(3.0), "`period`"),
    ("box", flow("grid"), spread(1.0) + 100, r"from \[99.5\] to \[100.5\], must lie about three .*-3.* to 3"),
    ("edge", flow(nb.GridNoise(-1.0, 1.0)), spread(1.9), "`GridNoise`"),
    ("corner", flow(nb.GridNoise([-3.0, -1.0], [3.0, 1.0], 24), dim=2), spread(1.9, 2), "`GridNoise`"),
    ("long", flow("grid", nb.GaussianKernel(1.0, 3.0)), spread(1.0), "`GridNoise`"),
    ("curve-in-a-box", flow("grid", space=BASIS), circle(3.0), "`GridNoise`"),
]  # fmt: skip


@pytest.mark.parametrize("name, sde, x, message", NARROW, ids=[row[0] for row in NARROW])
def test_a_start_without_room_is_refused(name, sde, x, message):
    """By bridges, laws and simulations; traced, it is NaN where half of a(x, x) or more is wrong."""
    for use in (
        lambda: bridge(sde, x),
        lambda: nb.DiffusionEndpoint(sde, x, MATCH, t1=1.0, num_steps=2),
        lambda: nb.simulate(
            sde, x, np.linspace(0, 1, 3), np.zeros((2, sde.noise_size(jnp.asarray(x)), x.shape[1]))
        ),
    ):
        with pytest.raises(ValueError, match=f"`x0` does not fit the noise.*{message}"):
            use()


@pytest.mark.parametrize("noise", ["spectral", "grid"])
def test_room_is_not_asked_for_twice(noise):
    """With room there is neither a warning nor an error, at any length scale for the default
    period.
    """
    for ell in (0.2, 1.0, 5.0) if noise == "spectral" else (0.2, 0.6):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            bridge(flow(noise, nb.GaussianKernel(0.3, ell)), spread(2.0))


@pytest.mark.parametrize("noise", [SPECTRAL, nb.GridNoise(-1.0, 1.0)], ids=["spectral", "grid"])
def test_what_is_known_is_looked_at_inside_a_traced_program(noise):
    sde, x = flow(noise), spread(5.5)
    z = np.zeros((2, sde.noise_size(jnp.asarray(spread(1.0))), 1))
    with pytest.raises(ValueError, match="`x0` does not fit the noise"):
        jax.jit(lambda z: nb.simulate(sde, x, np.linspace(0, 1, 3), z))(z)


def test_a_little_too_narrow_is_a_warning():
    for sde, x in ((flow(SPECTRAL), spread(4.2)), (flow(nb.GridNoise(-2.0, 1.2)), spread(1.0))):
        with pytest.warns(UserWarning, match="`x0` does not fit the noise"):
            bridge(sde, x, spread(0.1))
    for sde in (flow(SPECTRAL), flow("grid")):
        with pytest.warns(UserWarning, match="`condition` does not fit the noise"):
            bridge(sde, spread(1.0), spread(8.0))


def test_a_path_that_leaves_is_nan():
    """From the first state beyond the box, or with half of a(x, x) through the image: at P − extent
    = 2ℓ √log 2.
    """
    half = PERIOD - 2 * ELL * np.sqrt(np.log(2))
    x, sde = spread(1.0), flow(SPECTRAL)
    with jax.disable_jit():
        for widest, seen in ((half - 1e-3, True), (half + 1e-3, False)):
            assert np.all(np.isfinite(sde.diffusion(0.0, jnp.asarray(spread(widest))))) == seen
        for edge, seen in ((0.999, True), (1.001, False)):
            y = jnp.asarray(x).at[2].set(edge)
            assert np.all(np.isfinite(flow(nb.GridNoise(-1.0, 1.0)).diffusion(0.0, y))) == seen
        grid = flow(nb.GridNoise(-2.5, 2.5))
        noise = np.zeros((3, grid.noise_size(jnp.asarray(x)), 1))
        noise[0] = 9.0
        path = nb.simulate(grid, x, np.linspace(0, 3, 4), noise)
        assert np.max(np.abs(path[1])) > 2.5 and np.all(np.isnan(path[2:]))


@pytest.mark.parametrize("noise", ["landmark", "spectral", "grid"])
def test_a_traced_start_that_cannot_be_is_nan(noise):
    """Of a batch, that one alone: coinciding landmarks, or points beyond the noise."""
    sde, good = flow(noise), spread(1.0)
    bad = good[[0, 0, 2]] if noise == "landmark" else 20 * good
    z, starts = np.zeros((2, sde.noise_size(jnp.asarray(good)), 1)), jnp.stack([good, bad])
    path = jax.jit(jax.vmap(lambda x: nb.simulate(sde, x, np.linspace(0, 1, 3), z)[-1]))(starts)
    assert np.all(np.isfinite(path[0])) and np.any(np.isnan(path[1]))
    if noise == "landmark":
        found = jax.jit(jax.vmap(lambda x: bridge(sde, x, good).log_weight(z)))(starts)
        assert np.isfinite(found[0]) and np.isnan(found[1])


def test_the_derivative_by_the_kernel_is_untouched():
    """The test of room has none."""
    x = jnp.asarray(spread(1.0))

    def variance(ell):
        return flow(SPECTRAL, nb.GaussianKernel(0.3, ell)).covariance(0.0, x)[0, 2]

    slope, h = jax.jit(jax.grad(variance))(ELL), 1e-5
    np.testing.assert_allclose(slope, (variance(ELL + h) - variance(ELL - h)) / (2 * h), rtol=1e-6)
