"""SDEs against the same processes in plain NumPy: coefficients, steps, linearisations, simulated
laws, closed forms.
"""

import itertools

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
from helpers import as_matrix, columns, columns_of_path, exact_affine
from models import CONSTANT, CURVE, DENSE, SDES, X3, R

import numpyro_bridges as nb
from numpyro_bridges.guiding import GridNoise as NoisePath

pytestmark = pytest.mark.usefixtures("compile_quickly")


def close(found, truth, atol=1e-11):
    np.testing.assert_allclose(found, truth, rtol=0, atol=atol)


def euler_path(process, x0, ts, z):
    x, path = x0, [x0]
    for k, (s, t) in enumerate(itertools.pairwise(ts)):
        x = x + (t - s) * process.drift(s, x) + np.sqrt(t - s) * process.diffusion(s, x) @ z[k]
        path.append(x)
    return np.stack(path)


def model_path(process, x0, ts, z):
    x, path = x0, [x0]
    for k, (s, t) in enumerate(itertools.pairwise(ts)):
        mean, factor = process.step(s, t, x)
        x = mean + factor @ z[k]
        path.append(x)
    return np.stack(path)


@pytest.mark.parametrize("name", SDES)
def test_an_sde_is_its_process(name, key):
    """Drift, noise, transition, linearisation, `terms` and `simulate` at a random state and time."""
    sde, process, x0 = SDES[name]()
    key_x, key_z = jr.split(key)
    x0 = x0 + 0.1 * np.asarray(jr.normal(key_x, x0.shape))
    ts = np.array([0.2, 0.5, 0.9])
    n, x, (s, t) = len(x0), jnp.asarray(x0), ts[:2]
    b, sigma, a = (
        f(s, columns(x0)) for f in (process.drift, process.diffusion, process.covariance)
    )
    mean, factor = process.step(s, t, columns(x0))
    z = np.asarray(jr.normal(key_z, (2, max(factor.shape[1], sigma.shape[1]), b.shape[1])))
    # a diffrax solver steps σ itself
    z_model, z_euler = z[:, : factor.shape[1]], z[:, : sigma.shape[1]]
    assert sde.noise_size(x) == factor.shape[1]

    @jax.jit
    def everything(x, z_model, z_euler):
        terms, y = sde.terms(NoisePath(jnp.asarray(ts), z_euler)), x
        for s, t in itertools.pairwise(ts):
            y, *_ = diffrax.Euler().step(terms, s, t, y, None, None, False)
        s, t = ts[:2]
        parts = sde.drift(s, x), sde.noise(s, x), sde.diffusion(s, x), sde.covariance(s, x)
        steps = sde.transition(s, t, x), sde.linearised_step(s, t, x)
        return *parts, *steps, nb.simulate(sde, x, jnp.asarray(ts), z_model), y

    found = everything(x, z_model, z_euler.reshape(2, -1, *x0.shape[1:]))
    drift, noise, diffusion, covariance, law, step, path, y = found
    assert drift.shape == x0.shape
    close(columns(drift), b)
    for A, truth in zip((*noise, diffusion, covariance), (sigma, a, sigma, a), strict=True):
        close(as_matrix(A, n), truth, 1e-10)
    close(columns(law.mean), mean)
    L = as_matrix(law.factor, n)
    close(as_matrix(law.covariance, n), factor @ factor.T, 1e-10)
    close(L @ L.T, factor @ factor.T, 1e-10)
    phi, shift, C = process.affine(s, t, columns(x0))
    close(as_matrix(step.operator, n), phi)
    close(columns(step.shift), shift)
    close(as_matrix(step.covariance, n), C, 1e-10)
    close(columns_of_path(path), model_path(process, columns(x0), ts, z_model))
    close(columns(y), euler_path(process, columns(x0), ts, z_euler)[-1])
    assert sde.has_constant_covariance(x) == (name in CONSTANT or name == "user-time")


def test_diffrax_solves_it(key):
    """`terms` in `diffrax.diffeqsolve`, and on the same noise `simulate`: both step by
    Euler–Maruyama.
    """
    sde, _, x0 = SDES["user-planar"]()
    x, ts = jnp.asarray(x0), jnp.linspace(0.0, 1.0, 6)
    z = jr.normal(key, (5, sde.noise_size(x), *x0.shape[1:]))

    @jax.jit
    def both(z):
        solution = diffrax.diffeqsolve(
            sde.terms(NoisePath(ts, z)), diffrax.Euler(), ts[0], ts[-1], None, x,
            stepsize_controller=diffrax.StepTo(ts), saveat=diffrax.SaveAt(ts=ts),
        )  # fmt: skip
        return solution.ys, nb.simulate(sde, x, ts, z)

    close(*both(z))


# Linear SDEs.


def test_ornstein_uhlenbeck():
    """dX = γ (μ − X) dt + σ dW has variance σ² (1 − e^{−2γτ})/2γ and cov(X_s, X_t) = e^{−γ(t−s)}
    var X_s.
    """
    rate, mean, sigma = 1.7, 0.8, 0.6
    sde = nb.LinearSDE(-rate, sigma, rate * mean)
    law = sde.transition(0.3, 1.1, jnp.array([2.0]))
    close(law.mean, [mean + (2.0 - mean) * np.exp(-rate * 0.8)], 1e-14)
    close(law.covariance, sigma**2 * -np.expm1(-2 * rate * 0.8) / (2 * rate), 1e-15)

    count, ts = 20000, np.array([0.0, 0.5, 1.2])
    z = jr.normal(jr.key(0), (count, 2, 1, 1))
    path = np.asarray(
        jax.jit(jax.vmap(lambda z: nb.simulate(sde, jnp.array([2.0]), jnp.asarray(ts), z)))(z)
    )[..., 0]
    variance = sigma**2 * -np.expm1(-2 * rate * ts[1:]) / (2 * rate)
    truth = np.array([[variance[0], variance[0] * np.exp(-rate * 0.7)], [0.0, variance[1]]])
    truth[1, 0] = truth[0, 1]
    error = np.sqrt((np.outer(variance, variance) + truth**2) / count)  # of a covariance of normals
    assert np.all(error < 0.02 * variance[0])
    assert np.all(np.abs(np.cov(path[:, 1:].T) - truth) < 4 * error)
    center = mean + (2.0 - mean) * np.exp(-rate * ts[1:])
    assert np.all(np.abs(path[:, 1:].mean(0) - center) < 4 * np.sqrt(variance / count))


def test_stochastic_heat_equation():
    """dX_n = −κ n² X_n dt + σ dW_n: cov(X(s), X(s')) = v_0 + 2 Σ v_n cos n(s − s'), v_n = σ² (1 −
    e^{−2κn²t})/2κn².
    """
    kappa, sigma, t = 0.3, 0.5, 0.7
    space = nb.FourierBasis(4, 2)
    frequencies = (np.arange(9) + 1) // 2
    sde = nb.LinearSDE(-kappa * frequencies**2, sigma, space=space)
    x = np.linspace(-1, 1, 18).reshape(9, 2)
    law = sde.transition(0.0, t, jnp.asarray(x))
    close(law.mean, np.exp(-kappa * frequencies**2 * t)[:, None] * x, 1e-14)
    n = np.arange(1, 5)
    v = sigma**2 * np.concatenate([[t], (1 - np.exp(-2 * kappa * n**2 * t)) / (2 * kappa * n**2)])
    close(law.covariance, v[frequencies], 1e-15)
    s = np.array([0.1, 0.9, 4.0])
    phi = np.asarray(space.basis(s))
    gap = s[:, None] - s[None]
    truth = v[0] + 2 * sum(v[k] * np.cos(k * gap) for k in n)
    close(phi @ np.diag(law.covariance) @ phi.T, truth, 1e-14)


@pytest.mark.parametrize("rate", [1.0, 40.0, 400.0])
def test_stiff_matrices(rate):
    """Symmetric drift: S = U diag((e^{2λτ} − 1)/2λ) Uᵀ. Van Loan's block exponential loses it where
    λτ is large.
    """
    c, s = np.cos(0.4), np.sin(0.4)
    U, values = np.array([[c, -s], [s, c]]), np.array([-0.1, -rate])
    sde = nb.LinearSDE((U * values) @ U.T, 0.7, 0.3)
    step = jax.jit(lambda x: sde.exact_step(0.0, 1.0, x))(jnp.ones(2))
    close(step.operator, (U * np.exp(values)) @ U.T, 1e-12)
    close(step.shift, 0.3 * (U * np.expm1(values) / values) @ U.T @ np.ones(2), 1e-12)
    close(step.covariance, 0.49 * (U * np.expm1(2 * values) / (2 * values)) @ U.T, 1e-12)


def test_a_matrix_step_against_scipy():
    """e^{Bτ} from `scipy.linalg.expm`, the integrals from quadrature; a planar state, a shift for
    each column.
    """
    beta = np.array([[0.1, -0.4], [0.0, 0.2], [-1.0, 0.5]])
    sde, dt = nb.LinearSDE(DENSE, R, beta), 1.3
    x = CURVE
    law = jax.jit(lambda x: sde.transition(0.4, 0.4 + dt, x))(x)
    shift, _ = scipy.integrate.quad_vec(
        lambda u: scipy.linalg.expm(DENSE * u) @ beta, 0, dt, epsabs=1e-13
    )
    C, _ = scipy.integrate.quad_vec(
        lambda u: scipy.linalg.expm(DENSE * u) @ R @ R.T @ scipy.linalg.expm(DENSE * u).T,
        0,
        dt,
        epsabs=1e-13,
    )
    close(law.mean, scipy.linalg.expm(DENSE * dt) @ x + shift)
    close(law.factor @ law.factor.T, C)
    twice, once, rest = (exact_affine(DENSE, beta, R, u) for u in (2.0, 0.7, 1.3))
    # the referee of the other tests is a semigroup
    close(twice[2], rest[0] @ once[2] @ rest[0].T + rest[2])


def test_small_rates_are_brownian():
    """B → 0: no division by it, and finite gradients."""
    law = nb.LinearSDE(1e-9, 0.5, 0.3).transition(0.0, 2.0, jnp.array([1.0]))
    close(law.mean, [1.6], 1e-8)
    close(law.covariance, 0.5, 1e-8)
    law = nb.LinearSDE(0.0, 0.5, 0.3).transition(0.0, 2.0, jnp.array([1.0]))
    close(law.mean, [1.6], 1e-15)
    gradient = jax.grad(
        lambda b: nb.LinearSDE(b, 0.5).transition(0.0, 2.0, jnp.array([1.0])).covariance
    )
    close(gradient(1e-6), 0.25 * 2.0**2, 1e-5)  # d/db ∫ σ² e^{2bu} du = σ² τ² at b = 0
    assert np.isfinite(gradient(0.0))


# A user's SDE.


def test_law_of_euler_steps():
    """dX = μ X dt + σ X dW: E X_K = x (1 + μ dt)^K, E X_K² = x² ((1 + μ dt)² + σ² dt)^K, the SE
    below 1 %.
    """
    mu, sigma, x0, K, count = 0.3, 0.4, 1.2, 8, 20000
    sde = nb.SDE(lambda t, x, args: args[0] * x, lambda t, x, args: args[1] * x, (mu, sigma))
    ts = jnp.linspace(0.0, 1.0, K + 1)
    z = jr.normal(jr.key(1), (count, K, 1, 1))
    end = np.asarray(jax.jit(jax.vmap(lambda z: nb.simulate(sde, jnp.array([x0]), ts, z)))(z))[
        :, -1, 0
    ]
    for found, truth in (
        (end, x0 * (1 + mu / K) ** K),
        (end**2, x0**2 * ((1 + mu / K) ** 2 + sigma**2 / K) ** K),
    ):
        error = found.std() / np.sqrt(count)
        assert error < 0.01 * truth
        assert abs(found.mean() - truth) < 3.5 * error


def test_has_constant_covariance_follows_the_state():
    """Through nested programs, loops and branches; a state that is only looked at does not count."""

    def looped(t, x, args):
        return jax.lax.fori_loop(0, 3, lambda i, s: s * (1 + 0.1 * jnp.tanh(x[0])), jnp.ones(3))

    fixed = [
        lambda t, x, a: 0.5,
        lambda t, x, a: a,
        lambda t, x, a: jnp.ones(x.shape),
        lambda t, x, a: jnp.diag(a) * t,
    ]
    moving = [
        lambda t, x, a: jax.jit(jnp.sin)(x),
        looped,
        lambda t, x, a: jnp.where(x > 0, 0.1, 0.2),
    ]
    for constant, functions in ((True, fixed), (False, moving)):
        for diffusion in functions:
            sde = nb.SDE(lambda t, x, a: -x, diffusion, jnp.array([0.1, 0.2, 0.3]))
            assert sde.has_constant_covariance(jnp.asarray(X3)) == constant
            assert sde.ito_is_stratonovich(jnp.asarray(X3)) == constant


# Kunita flows.

ALPHA, ELL = 0.4, 0.6
POINTS = {
    1: np.array([[-0.7], [0.1], [0.5]]),
    2: CURVE,
    3: np.array([[0.5, 0.1, -0.3], [-0.4, 0.6, 0.2], [-0.2, -0.5, 0.4]]),
}
MODES = {1: 12, 2: 9, 3: 5}


def kunita_covariance(x, y, dim, alpha=ALPHA, ell=ELL):
    """α² (πℓ²)^{d/2} exp(−|x − x'|²/4ℓ²)."""
    return (
        alpha**2
        * (np.pi * ell**2) ** (dim / 2)
        * np.exp(-np.sum((x[:, None] - y[None]) ** 2, -1) / (4 * ell**2))
    )


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_every_noise_has_the_covariance_of_the_field(dim):
    """Landmark noise to its jitter; spectral and grid noise below 1e-6 where the box is wide and
    fine enough.
    """
    x, kernel = POINTS[dim], nb.GaussianKernel(ALPHA, ELL)
    truth = kunita_covariance(x, x, dim)
    spectral = nb.SpectralNoise(MODES[dim], period=7.0)
    noises = [
        ("landmark", 1e-9),
        (spectral, 1e-3 if dim == 3 else 1e-6),
        (nb.GridNoise(-4.0, 4.0, 20), 1e-6),
    ]
    for noise, atol in noises:
        flow = nb.KunitaFlow(nb.Landmarks(3, dim), kernel, noise=noise)
        sigma, a = jax.jit(lambda x, flow=flow: flow.noise(0.0, x))(x)
        close(a, truth, atol * truth[0, 0])
        close(sigma @ sigma.T, truth, atol * truth[0, 0])
    same = nb.KunitaFlow(nb.Landmarks(3, dim), covariance=kernel.convolved(dim))
    close(same.covariance(0.0, jnp.asarray(x)), truth, 1e-9)
    assert np.array_equal(same.drift(0.0, jnp.asarray(x)), np.zeros_like(x))


def test_spectral_noise_reports_its_error():
    """tail = 1 − Σ_ω q̂(ω)/P^d / a(0), q̂ = α² (2πℓ²)^d exp(−ℓ²ω²); wrap-around exp(−(P − D)²/4ℓ²)."""
    period, diameter, modes = 5.0, 2.5, 4
    noise = nb.SpectralNoise(modes, period=period, diameter=diameter)
    flow = nb.KunitaFlow(nb.Landmarks(3, 2), nb.GaussianKernel(ALPHA, ELL), noise=noise)
    error = jax.jit(lambda: flow.noise_error())()
    omega = (
        2 * np.pi / period * np.array(list(itertools.product(range(-modes, modes + 1), repeat=2)))
    )
    q = ALPHA**2 * (2 * np.pi * ELL**2) ** 2 * np.exp(-(ELL**2) * np.sum(omega**2, 1)) / period**2
    close(error["tail"], 1 - q.sum() / (ALPHA**2 * np.pi * ELL**2), 1e-12)
    close(error["wrap_around"], np.exp(-((period - diameter) ** 2) / (4 * ELL**2)), 1e-12)
    assert nb.KunitaFlow(nb.Landmarks(3, 2), nb.GaussianKernel(ALPHA, ELL)).noise_error() == {}


def test_the_default_period_keeps_the_wrap_around_at_1e_8():
    flow = nb.KunitaFlow(nb.Landmarks(3, 2), nb.GaussianKernel(ALPHA, ELL), noise="spectral")
    error = jax.jit(lambda: flow.noise_error())()
    assert 0 <= error["wrap_around"] < 1e-8


@pytest.mark.parametrize(
    "noise",
    [nb.SpectralNoise(9, period=9.0), nb.GridNoise(-4.0, 4.0, 20)],
    ids=["spectral", "grid"],
)
def test_projected_covariance(noise):
    """a_ij = (2π)^{-2} ∬ φ_i(s) a(x(s), x(s')) φ_j(s') ds ds' of a curve, by the trapezoidal rule
    on 96 points.
    """
    space = nb.FourierBasis(3, 2, num_quadrature=48)
    x = np.zeros((7, 2))
    x[1], x[2], x[4] = [0.6, 0.1], [0.0, 0.5], [0.1, -0.1]
    q = 96
    s = 2 * np.pi * np.arange(q) / q
    phi = np.stack(
        [np.ones(q), *(np.sqrt(2) * f(k * s) for k in (1, 2, 3) for f in (np.cos, np.sin))], 1
    )
    truth = phi.T @ kunita_covariance(phi @ x, phi @ x, 2) @ phi / q**2
    flow = nb.KunitaFlow(space, nb.GaussianKernel(ALPHA, ELL), noise=noise)
    sigma, a = jax.jit(lambda x: flow.noise(0.0, x))(x)
    close(a, truth, 2e-6 * truth[0, 0])
    close(sigma @ sigma.T, a, 1e-14)


def test_coarse_to_fine(key):
    """Noise fixed in space moves a curve alike at every resolution: landmarks pathwise, a basis by
    its leading rows.
    """
    noise, kernel = nb.SpectralNoise(5, period=8.0), nb.GaussianKernel(ALPHA, ELL)
    s = 2 * np.pi * np.arange(8) / 8
    curve = np.stack([np.cos(s), 0.7 * np.sin(s)], 1)
    coarse, fine = (nb.KunitaFlow(nb.Landmarks(n, 2), kernel, noise=noise) for n in (4, 8))
    ts = jnp.array([0.0, 0.4, 1.0])
    z = jr.normal(key, (2, coarse.noise_size(jnp.asarray(curve[::2])), 2))
    path, at_every_other = jax.jit(
        lambda z: (nb.simulate(fine, curve, ts, z), nb.simulate(coarse, curve[::2], ts, z))
    )(z)
    close(at_every_other, path[:, ::2], 1e-13)

    few, many = (
        nb.KunitaFlow(nb.FourierBasis(m, 2, num_quadrature=32), kernel, noise=noise) for m in (2, 4)
    )
    x = np.zeros((9, 2))
    x[1, 0], x[2, 1] = 0.7, 0.5
    leading, sigma = jax.jit(lambda x: (few.diffusion(0.0, x[:5]), many.diffusion(0.0, x)))(x)
    close(leading, sigma[:5], 1e-13)


@pytest.mark.parametrize("noise", ["landmark", "spectral", "grid"])
def test_ito_and_stratonovich(noise):
    """The correction ½ Σ_ω ∂_c σ_ω(x_i) σ_ω(x_i), summed over what moves point i, vanishes where
    the flow says so.
    """
    noises = {
        "landmark": "landmark",
        "spectral": nb.SpectralNoise(4, period=6.0),
        "grid": nb.GridNoise(-4.0, 4.0, 20),
    }
    flow = nb.KunitaFlow(nb.Landmarks(3, 2), nb.GaussianKernel(ALPHA, ELL), noise=noises[noise])
    x = jnp.asarray(CURVE)
    sigma, derivative = (
        flow.diffusion(0.0, x),
        jax.jit(jax.jacfwd(lambda y: flow.diffusion(0.0, y)))(x),
    )
    correction = 0.5 * np.einsum("iwjc,jw->ic", derivative, sigma)
    assert flow.ito_is_stratonovich(x) == (noise != "landmark")
    assert (np.max(np.abs(correction)) < 1e-8) == flow.ito_is_stratonovich(x)
