"""Every kind of SDE twice: an SDE of the package, and its process in plain NumPy
(`helpers.Process`).
"""

import jax.numpy as jnp
import lineax as lx
import numpy as np
from helpers import Process, as_matrix, columns, linear_process

import numpyro_bridges as nb

X3 = np.array([0.3, -0.9, 0.8])
CURVE = np.array([[1.0, 0.1], [-0.4, 0.9], [-0.6, -0.8]])
W = np.array([0.5, 0.2, 0.3])
CHAIN = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-0.5, -1.0, -0.8]])
DENSE = np.array([[-0.5, 0.2, 0.0], [0.1, -0.8, 0.3], [-0.2, 0.0, -0.3]])
Q = np.array([[0.5, 0.1, 0.05], [0.1, 0.4, -0.1], [0.05, -0.1, 0.3]])
R = np.array([[0.4, 0.1], [0.0, 0.3], [0.2, -0.2]])


# SDEs. A user's functions are written once, for NumPy (np) and for JAX (jnp) alike.


def sine(xp):
    return lambda t, x: 0.5 * xp.sin(x) - 0.3 * x**2


def coupled(xp):
    return lambda t, x: xp.asarray(DENSE) @ x + 0.2 * xp.sin(3 * t) * x[::-1] + 0.1 * xp.cos(x)


def scalar_noise(xp):
    return lambda t, x: 0.4 + 0.1 * xp.sin(xp.sum(x))


def diagonal_noise(xp):
    return lambda t, x: 0.5 + 0.2 * xp.cos(x)


def tall_noise(xp):
    return lambda t, x: (
        xp.asarray(R) * (1 + 0.3 * xp.sin(x[:1])) + 0.1 * xp.asarray(R)[::-1] * xp.cos(x[1:2])
    )


def wide_noise(xp):
    wide = xp.asarray(np.hstack([0.5 * np.eye(3), R]))
    return lambda t, x: wide * (1 + 0.2 * xp.sin(x))


def square_noise(xp):
    return lambda t, x: xp.asarray(Q) * (1 + 0.2 * xp.sin(x) * (1 + t))


def time_noise(xp):
    return lambda t, x: xp.asarray(Q) * (1 + t)


def planar_noise(xp):
    return lambda t, x: xp.asarray(Q) + 0.1 * xp.exp(-xp.sum((x[:, None] - x[None]) ** 2, -1))


def user(drift, diffusion, x0, wrap=lambda sigma: sigma):
    """The same SDE twice."""
    b, sigma = drift(jnp), diffusion(jnp)
    sde = nb.SDE(
        lambda t, x, args: b(t, x if x.ndim == 2 else x[:, None]).reshape(x.shape),
        lambda t, x, args: wrap(_shaped(sigma(t, x if x.ndim == 2 else x[:, None]))),
    )
    n, dense = len(x0), diffusion(np)
    return sde, Process(drift(np), lambda t, x: as_matrix(_shaped(dense(t, x)), n)), x0


def _shaped(sigma):
    return sigma[:, 0] if sigma.ndim == 2 and sigma.shape[1] == 1 else sigma


def gaussian(x, y, scale):
    return np.exp(-np.sum((x[:, None] - y[None]) ** 2, -1) / (2 * scale**2))


def kunita(noise, factor, covariance=None, space=None, x0=CURVE):
    flow = nb.KunitaFlow(
        space or nb.Landmarks(3, 2, weights=W), nb.GaussianKernel(0.3, 0.7), noise=noise
    )
    return flow, Process(lambda t, x: np.zeros_like(x), lambda t, x: factor(x)), x0


def landmark_factor(x):
    K = 0.3**2 * np.pi * 0.7**2 * gaussian(x, x, np.sqrt(2) * 0.7)
    return np.linalg.cholesky(K + 1e-10 * K[0, 0] * np.eye(len(K)))


def spectral_factor(x, period=6.0, num_modes=1):
    """(cos ω·x, sin ω·x) √(2 q̂(ω)/P²) over half the lattice, q̂ = α² (2πℓ²)² exp(−ℓ²|ω|²)."""
    half = [
        (a, b)
        for a in range(-num_modes, num_modes + 1)
        for b in range(-num_modes, num_modes + 1)
        if (a, b) > (0, 0)
    ]
    q = lambda w: 0.3**2 * (2 * np.pi * 0.7**2) ** 2 * np.exp(-(0.7**2) * np.sum(w**2)) / period**2  # noqa: E731
    waves = [2 * np.pi / period * np.array(w) for w in half]
    cosines = [np.sqrt(2 * q(w)) * np.cos(x @ w) for w in waves]
    sines = [np.sqrt(2 * q(w)) * np.sin(x @ w) for w in waves]
    return np.stack([np.full(len(x), np.sqrt(q(np.zeros(2)))), *cosines, *sines], 1)


def grid_factor(x, lower=-2.0, upper=2.0, cells=3):
    centers = lower + (upper - lower) / cells * (np.arange(cells) + 0.5)
    y = np.array([(a, b) for a in centers for b in centers])
    return 0.3 * gaussian(x, y, 0.7) * (upper - lower) / cells


def fourier_factor(x, q=32):
    s = 2 * np.pi * np.arange(q) / q
    phi = np.stack([np.ones(q), np.sqrt(2) * np.cos(s), np.sqrt(2) * np.sin(s)], 1)
    return phi.T @ spectral_factor(phi @ x) / q


def brownian(Q):
    return (
        nb.BrownianMotion(Q),
        linear_process(0.0, np.linalg.cholesky(as_matrix(Q, 3)), 0.0, 3, exact=False),
        X3,
    )


def linear(B, sigma, beta, x0=X3):
    return (
        nb.LinearSDE(B, sigma, beta),
        linear_process(B, sigma, beta, len(x0), columns(x0).shape[1]),
        x0,
    )


CONSTANT = {
    "BM-scalar": lambda: brownian(0.5),
    "BM-diagonal": lambda: brownian(np.array([0.5, 0.2, 0.9])),
    "BM-matrix": lambda: brownian(Q),
    "linear-scalar": lambda: linear(-0.7, 0.4, 0.3),
    "linear-scalar-rectangular": lambda: linear(-0.7, np.hstack([Q, R]), 0.3),
    "linear-diagonal": lambda: linear(
        np.array([-0.7, 0.0, 0.4]), np.array([0.3, 0.5, 0.4]), np.array([0.1, 0.0, -1.0])
    ),
    "linear-diagonal-matrix": lambda: linear(np.array([-0.7, 0.0, 0.4]), Q, 0.3, CURVE),
    "linear-matrix": lambda: linear(DENSE, 0.4, np.array([0.1, 0.0, -1.0])),
    "linear-hypoelliptic": lambda: linear(CHAIN, np.array([[0.0], [0.0], [1.0]]), 0.2),
}
CURVED = {
    "user-scalar": lambda: user(sine, scalar_noise, X3),
    "user-diagonal": lambda: user(coupled, diagonal_noise, X3),
    "user-tall": lambda: user(sine, tall_noise, X3),
    "user-wide": lambda: user(sine, wide_noise, X3),
    "user-square": lambda: user(coupled, square_noise, X3),
    "user-time": lambda: user(coupled, time_noise, X3),
    "user-planar": lambda: user(coupled, planar_noise, CURVE),
    "lineax-matrix": lambda: user(sine, square_noise, X3, lx.MatrixLinearOperator),
    "lineax-diagonal": lambda: user(sine, diagonal_noise, X3, lx.DiagonalLinearOperator),
    "kunita-landmark": lambda: kunita("landmark", landmark_factor),
    "kunita-spectral": lambda: kunita(nb.SpectralNoise(1, period=6.0), spectral_factor),
    "kunita-grid": lambda: kunita(nb.GridNoise(-2.0, 2.0, 3), grid_factor),
    "kunita-fourier": lambda: kunita(
        nb.SpectralNoise(1, period=6.0), fourier_factor, space=nb.FourierBasis(1, 2)
    ),
}
SDES = CONSTANT | CURVED
