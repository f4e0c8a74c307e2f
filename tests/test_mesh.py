"""The likelihood does not depend on the mesh: evidences and posteriors of one curve, coarse and
fine.

`normalised=False`: the expectation of exp(−‖X_T − v‖²/2σ) has a limit, the Lebesgue density has
none.
"""

import functools

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
import scipy.stats

import numpyro_bridges as nb

VARIANCE, LENGTH = 0.01, 0.5


def angles(n):
    return 2 * np.pi * np.arange(n) / n


def start(s):
    return np.stack([np.cos(s), np.sin(s)], 1)


def datum(s):
    return np.stack([1.3 * np.cos(s) + 0.1 + 0.05 * np.cos(3 * s), 0.8 * np.sin(s) - 0.2], 1)


def projection(num_modes, q):
    """Φᵀ/q for the functions 1, √2 cos ns, √2 sin ns at q points."""
    s = angles(q)
    waves = [f(n * s) for n in range(1, num_modes + 1) for f in (np.cos, np.sin)]
    return np.stack([np.ones(q), *(np.sqrt(2) * w for w in waves)]) / q


# Brownian motion with the covariance of a Kunita flow frozen at the circle, in both spaces.


def landmarks(n):
    s = angles(n)
    return nb.Landmarks(n, 2), np.eye(n), s


def fourier(n):
    space = nb.FourierBasis(n // 2, 2)
    return space, projection(n // 2, space.num_quadrature), angles(space.num_quadrature)


# Gauss–Legendre nodes of log α.
NODES, NODE_WEIGHTS = np.polynomial.legendre.leggauss(60)
ALPHAS = np.exp(np.interp(NODES, [-1, 1], np.log([0.005, 3.0])))


@functools.lru_cache
def frozen(make, n):
    """The log evidence at α = 0.2, and the posterior SD of α under a LogNormal(0, 1) prior."""
    space, project, s = make(n)
    x = start(s)
    C = (
        project
        @ (np.pi * LENGTH**2 * np.exp(-np.sum((x[:, None] - x[None]) ** 2, -1) / (4 * LENGTH**2)))
        @ project.T
    )
    C, x0, v = C + 1e-13 * np.eye(len(C)), project @ x, project @ datum(s)

    @jax.jit
    def log_evidence(alphas):
        def one(alpha):
            sde = nb.BrownianMotion(alpha**2 * C, space=space)
            seen = nb.InexactMatch(VARIANCE, normalised=False).at(v)
            return nb.GuidedBridge(sde, seen, x0=x0, ts=np.linspace(0, 1, 2)).log_weight(
                jnp.ones((1, len(C), 2))
            )

        return jax.lax.map(one, alphas)

    found = np.asarray(log_evidence(np.append(ALPHAS, 0.2)))
    w = (
        NODE_WEIGHTS
        * ALPHAS
        * np.exp(found[:-1] - found.max())
        * scipy.stats.lognorm.pdf(ALPHAS, 1.0)
    )
    mean = np.sum(w * ALPHAS) / np.sum(w)
    return found[-1], np.sqrt(np.sum(w * (ALPHAS - mean) ** 2) / np.sum(w))


@pytest.mark.parametrize("make", [landmarks, fourier])
def test_frozen_flow(make):
    """From 32 to 256 points or functions, within 1e-3; and as in the table."""
    (coarse, coarse_sd), (fine, fine_sd) = frozen(make, 32), frozen(make, 256)
    assert abs(fine / coarse - 1) < 1e-3
    assert abs(fine_sd / coarse_sd - 1) < 1e-3
    for evidence, sd in (frozen(make, 32), frozen(make, 256)):
        np.testing.assert_allclose(evidence, -5.716044, atol=1e-5)
        np.testing.assert_allclose(sd, 0.0916, atol=6e-5)


# The flow itself. Spectral noise is the same noise for every number of points, so that two meshes
# share it.

STEPS, BATCHES, PER_BATCH = 5, 4, 2
LOG_AMPLITUDE, LOG_LENGTH = (
    np.linspace(np.log(0.05), np.log(0.5), 6),
    np.linspace(np.log(0.3), np.log(1.7), 6),
)
GRID = np.stack(np.meshgrid(LOG_AMPLITUDE, LOG_LENGTH, indexing="ij"), -1).reshape(-1, 2)


def log_prior(theta):
    return scipy.stats.norm.logpdf(theta, [np.log(0.25), np.log(0.8)], [0.5, 0.35]).sum(-1)


@functools.lru_cache
def flow_log_weights(n):
    """(parameters, batches, particles): every parameter value with the same noise."""
    s, space = angles(n), nb.Landmarks(n, 2)
    x0, v = start(s), datum(s)

    @jax.jit
    def run(grid, noise):
        def one(theta, z):
            amplitude, length = jnp.exp(theta)
            flow = nb.KunitaFlow(
                space, nb.GaussianKernel(amplitude, length), noise=nb.SpectralNoise(4, period=8.0)
            )
            seen = nb.InexactMatch(VARIANCE, normalised=False).at(v)
            return nb.GuidedBridge(flow, seen, x0=x0, ts=np.linspace(0, 1, STEPS + 1)).log_weight(z)

        return jax.lax.map(lambda theta: jax.lax.map(lambda z: one(theta, z), noise), grid)

    noise = jr.normal(jr.key(0), (BATCHES * PER_BATCH, STEPS, 81, 2))
    return np.asarray(run(GRID, noise)).reshape(len(GRID), BATCHES, PER_BATCH)


def posterior(log_weights):
    """Mean and SD of log amplitude and log length on the grid, (2,) each, from (parameters,
    particles).
    """
    w = np.exp(log_weights - log_weights.max()).mean(1) * np.exp(log_prior(GRID))
    w /= w.sum()
    mean = w @ GRID
    return mean, np.sqrt(w @ (GRID - mean) ** 2), w


@pytest.mark.parametrize("coarse, fine", [(32, 128)])
def test_flow(coarse, fine):
    """Posterior means of amplitude and length move by less than 0.1 posterior SD, with the noise of
    four batches.
    """
    first, second = flow_log_weights(coarse), flow_log_weights(fine)
    (mean, sd, w), (fine_mean, _, _) = (
        posterior(x.reshape(len(GRID), -1)) for x in (first, second)
    )
    shift = (fine_mean - mean) / sd
    batches = np.array(
        [(posterior(second[:, i])[0] - posterior(first[:, i])[0]) / sd for i in range(BATCHES)]
    )
    error = batches.std(axis=0, ddof=1) / np.sqrt(BATCHES)
    border = w.reshape(6, 6)
    border = max(border[0].sum(), border[-1].sum(), border[:, 0].sum(), border[:, -1].sum())
    print(f"shift {shift} ± {error}, mean {mean}, sd {sd}, weight on a side of the grid {border}")
    assert border < 0.1 and 1 / np.sum(w**2) > 4, "the grid does not fit the posterior"
    assert np.all(error < 0.03)
    assert np.all(np.abs(shift) < 0.1)
