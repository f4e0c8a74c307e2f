"""What the kernels are made of, against linear algebra and NumPyro."""

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
import scipy.linalg
import scipy.optimize
from numpyro.infer.util import potential_energy
from scipy.linalg import expm

import numpyro_bridges as nb
from numpyro_bridges.infer._posterior import driven_by, energies_of, misfit
from numpyro_bridges.infer._reference import Reference, laplace, start_windows, update_windows
from numpyro_bridges.infer._rotation import kick, metropolis, rotate

RNG = np.random.default_rng(0)
X, P, FORCE = RNG.normal(size=(3, 4))


def test_rotation_is_the_flow_of_the_oscillator():
    expected = expm(0.7 * np.array([[0.0, 1.0], [-1.0, 0.0]])) @ np.stack([X, P])
    np.testing.assert_allclose(np.stack(rotate(X, P, 0.7)), expected, rtol=1e-12)
    (turned, still), _ = rotate((X, X), (P, P), (0.7, 0.0))
    np.testing.assert_allclose(turned, expected[0], rtol=1e-12)
    np.testing.assert_array_equal(still, X)


def test_kick_reports_its_work():
    new, change = kick(P, FORCE, 0.3)
    np.testing.assert_allclose(new, P + 0.3 * FORCE, rtol=1e-12)
    np.testing.assert_allclose(change, (np.asarray(new) ** 2 - P**2) / 2, rtol=1e-12)


def test_decisions():
    rates, decisions = metropolis(jr.key(0), jnp.array([0.5, -1.0, jnp.nan, jnp.inf, -jnp.inf]))
    np.testing.assert_allclose(rates, [np.exp(-0.5), 1, 0, 0, 1])
    assert list(decisions[1:]) == [True, False, False, True]
    _, many = metropolis(jr.key(1), jnp.full(20000, 0.5))
    assert abs(float(jnp.mean(many)) - np.exp(-0.5)) < 4 * 0.5 / np.sqrt(20000)


def test_reference():
    """Gradients by the chain rule, with a factor that is not symmetric."""
    reference = Reference(jnp.array([1.0, -2.0]), jnp.array([[2.0, 0.0], [-3.0, 0.5]]))
    y, slope = jnp.array([0.3, -0.4]), jnp.array([1.0, 7.0])
    theta = reference.colour(y)
    np.testing.assert_allclose(theta, [1.6, -3.1])
    np.testing.assert_allclose(reference.whiten(theta), y, rtol=1e-12)
    gradient = jax.grad(lambda y: slope @ reference.colour(y))(y)
    np.testing.assert_allclose(reference.whiten_gradient(slope), gradient, rtol=1e-12)
    np.testing.assert_allclose(reference.colour_gradient(gradient), slope, rtol=1e-12)


def badly_scaled(x):
    return (
        0.5 * x @ jnp.array([[400.0, 6.0, 0.0], [6.0, 0.5, 0.05], [0.0, 0.05, 0.02]]) @ x
        - x[0]
        + x[2]
    )


def bent(x):
    """A valley, and a wall of NaN, beyond which the first step leads."""
    valley = 10 * (x[1] - x[0] ** 2) ** 2 + (1 - x[0]) ** 2
    return jnp.where(x[0] > 1.5, jnp.nan, valley + 0.5 * x[2] ** 2)


POTENTIALS = [(badly_scaled, [3.0, -1.0, 2.0]), (bent, [-1.2, 1.0, 0.3]), (bent, [1.4, -3.0, 0.0])]


@pytest.mark.parametrize("potential, start", POTENTIALS)
def test_laplace(potential, start):
    """The mode as SciPy finds it, and the inverse Hessian there, to a factor: a first mass matrix."""
    found = jax.jit(lambda x: laplace(potential, x)[0])(jnp.asarray(start))
    mode = scipy.optimize.minimize(
        potential, np.ones(3), jac=jax.grad(potential), method="BFGS", tol=1e-9
    ).x
    covariance = found.scale @ found.scale.T
    np.testing.assert_allclose(found.mean, mode, atol=1e-3 * np.sqrt(np.diag(covariance)).max())
    ratios = scipy.linalg.eigvalsh(covariance, np.linalg.inv(jax.hessian(potential)(mode)))
    assert np.all((ratios > 1 / 1.5) & (ratios < 1.5)), ratios


def test_laplace_in_single_precision():
    """Rounding near the mode does not get into the inverse Hessian, from any start: SDs to a factor
    of 2.
    """
    data = (2000 + np.random.default_rng(1).normal(size=(200, 20))).astype(np.float32)

    def potential(x):
        z = (data.astype(x.dtype) - x[0]) * jnp.exp(-x[1])
        return jnp.sum(0.5 * z * z) + data.size * x[1]

    with jax.enable_x64(False):
        starts = np.random.default_rng(0).normal([2000.0, 0.5], 0.3, (20, 2)).astype(np.float32)
        found = jax.jit(jax.vmap(lambda x: laplace(potential, x)[0]))(starts)
    mode = scipy.optimize.minimize(
        potential, np.array([2000.0, 0.0]), jac=jax.grad(potential), method="BFGS"
    ).x
    covariance = np.linalg.inv(jax.hessian(potential)(mode))
    for mean, scale in zip(
        np.asarray(found.mean, float), np.asarray(found.scale, float), strict=True
    ):
        assert np.all(np.abs(mean - mode) < 0.5 * np.sqrt(np.diag(covariance)))
        ratios = scipy.linalg.eigvalsh(scale @ scale.T, covariance)
        assert np.all((ratios > 1 / 4) & (ratios < 4)), ratios


def test_laplace_visits_starts():
    """Value and gradient where chains start, for draws from the very reference that is found."""
    draws = RNG.normal(size=(4, 3))
    noises = jnp.asarray(RNG.normal(size=(4, 2)))

    def potential(x, noise):
        return bent(x) + jnp.sum(jnp.cos(noise + x[:2]))

    def visit(reference):
        return jax.vmap(reference.colour)(draws), noises

    still = jnp.zeros(2)
    first = jnp.array([-1.2, 1.0, 0.3])
    alone, none = jax.jit(lambda: laplace(potential, first, still))()
    found, (values, slopes) = jax.jit(lambda: laplace(potential, first, still, visit=visit))()
    assert none is None
    np.testing.assert_allclose(found.mean, alone.mean, rtol=1e-12)
    np.testing.assert_allclose(found.scale, alone.scale, rtol=1e-12)
    points = visit(found)
    expected = jax.vmap(jax.value_and_grad(potential, (0, 1)))(*points)
    for a, b in zip(jax.tree.leaves((values, slopes)), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10)


def test_laplace_visits_where_there_is_nothing_to_search():
    def potential(x, noise):
        return jnp.sum(noise**2) + jnp.sum(x)

    noises = jnp.array([[1.0], [2.0], [3.0]])
    nothing = jnp.zeros(0)
    found, (values, (_, forces)) = jax.jit(
        lambda: laplace(potential, nothing, noises[0], visit=lambda _: (jnp.zeros((3, 0)), noises))
    )()
    assert found.mean.size == 0
    np.testing.assert_allclose(values, [1.0, 4.0, 9.0])
    np.testing.assert_allclose(forces, 2 * noises)


def test_laplace_without_a_start():
    found = jax.jit(lambda x: laplace(bent, x)[0])(jnp.array([2.0, 0.0, 1.0]))
    assert np.array_equal(found.mean, [2.0, 0.0, 1.0]) and np.array_equal(found.scale, np.eye(3))


def test_windows():
    """The second window's draws alone make the last reference, and none after it do."""
    draws = RNG.normal(size=(40, 2)) @ np.array([[1.0, 0.8], [0.0, 0.5]])
    windows, renewals = start_windows(Reference(jnp.zeros(2), jnp.eye(2))), []
    for i, draw in enumerate(draws):
        windows, renewed = update_windows(windows, jnp.array(i), 40, jnp.asarray(draw))
        renewals += [i] if renewed else []
    assert renewals == [11, 35]
    covariance = np.cov(draws[12:36].T)
    covariance[0, 1] = covariance[1, 0] = covariance[0, 1] * 24 / 29
    np.testing.assert_allclose(windows.reference.mean, draws[12:36].mean(0), rtol=1e-12)
    np.testing.assert_allclose(
        windows.reference.scale @ windows.reference.scale.T, covariance, rtol=1e-12
    )


def several(data):
    """Two kinds of data with noise of their own, a datum without, and a factor."""
    mean = numpyro.sample("mean", dist.LogNormal(0.0, 1.0))
    law = nb.DiffusionEndpoint(
        nb.LinearSDE(-1.0, 0.6, mean), np.zeros(1), nb.InexactMatch(0.1), t1=1.0, num_steps=2
    )
    with numpyro.plate("specimen", 2):
        nb.sample("wing", law, obs=data)
    nb.sample("leg", law, obs=data[0])
    numpyro.sample("size", dist.Normal(mean, 1.0), obs=0.3)
    numpyro.factor("more", -(mean**2))


def test_energies_add_up():
    """With the prior of the noise, to NumPyro's potential energy, however they are grouped."""
    data = RNG.normal(size=(2, 1))
    z = {
        "mean": jnp.array(0.4),
        "wing_noise": RNG.normal(size=(2, 2, 1, 1)),
        "leg_noise": RNG.normal(size=(2, 1, 1)),
    }
    noise = [z["wing_noise"], z["leg_noise"]]
    prior = sum(np.sum(u**2 + np.log(2 * np.pi)) / 2 for u in noise)
    expected = potential_energy(numpyro.handlers.seed(several, 0), (data,), {}, z) - prior
    owners = driven_by(several, (data,), {}, z, ("wing_noise", "leg_noise"))
    assert owners == {"wing_noise": "wing", "leg_noise": "leg"}
    np.testing.assert_allclose(misfit(several, (data,), {}, z), expected, rtol=1e-12)
    for owned, shapes in ((owners, [(), (2,)]), (None, [()])):
        rest, energies = energies_of(several, (data,), {}, z, owned)
        assert [energy.shape for energy in energies] == shapes
        np.testing.assert_allclose(rest + sum(map(jnp.sum, energies)), expected, rtol=1e-12)


def test_energies_under_scale():
    """`handlers.scale` multiplies the noise's prior too: what it adds is part of the misfit, and no
    datum's own.
    """
    data, scale = RNG.normal(size=(2, 1)), 2.5
    scaled = numpyro.handlers.scale(several, scale=scale)
    z = {
        "mean": jnp.array(0.4),
        "wing_noise": RNG.normal(size=(2, 2, 1, 1)),
        "leg_noise": RNG.normal(size=(2, 1, 1)),
    }
    prior = sum(np.sum(z[k] ** 2 + np.log(2 * np.pi)) / 2 for k in ("wing_noise", "leg_noise"))
    whole = potential_energy(numpyro.handlers.seed(several, 0), (data,), {}, z)
    np.testing.assert_allclose(misfit(scaled, (data,), {}, z), scale * whole - prior, rtol=1e-12)
    assert driven_by(scaled, (data,), {}, z, ("wing_noise", "leg_noise")) is None
