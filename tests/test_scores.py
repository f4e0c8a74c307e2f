"""Learned scores: the targets of the regressions, the gradient of the bound, what training does and
does not change.

Referees: closed forms of linear SDEs and of geometric Brownian motion, quadrature for nonlinear
scalar models, plain differences, and identities that hold for any density.
"""

import functools
import re
import sys
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import numpyro
import optax
import pytest
import scipy.linalg
import scipy.stats
from helpers import exact_affine, killed_and_ended

import numpyro_bridges as nb
from numpyro_bridges.guiding._score import Standard
from numpyro_bridges.scores import ScoreGuide, _training as training_module
from numpyro_bridges.scores._clouds import (
    _tempered,
    adjoint_cloud,
    ends,
    forward_cloud,
    guided_cloud,
    reversal_cloud,
    reversed_bridge,
)
from numpyro_bridges.scores._fit import Problem, _gain, adjoint, residual
from numpyro_bridges.scores._reversed import ReversedSDE
from numpyro_bridges.scores._training import train
from numpyro_bridges.sdes import AbstractSDE

pytestmark = [
    pytest.mark.usefixtures("compile_quickly"),
    # trainings of a few updates, whose gain is not what is tested
    pytest.mark.filterwarnings("ignore:.*brought nothing:UserWarning"),
]

# Clouds.

K = 40
TS = np.linspace(0, 1, K + 1)


def linear(B, sigma, beta, x0, v, variance):
    """A bridge, ∇log h and ∇log p(t, ·), by dense Gaussians."""
    B, sigma, beta, x0, v = (np.asarray(a, float) for a in (B, sigma, beta, x0, v))
    dense = [np.diag(a) if a.ndim == 1 else a for a in (B, sigma)]

    def law(t):
        return exact_affine(dense[0], beta[:, None], dense[1], t)

    def score(t, x):
        phi, shift, C = law(1 - t)
        return (
            np.linalg.solve(C + variance * np.eye(len(v)), (v - x @ phi.T - shift[:, 0]).T).T @ phi
        )

    def score_forward(t, x):
        phi, shift, C = law(t)
        return -np.linalg.solve(C, (x - phi @ x0 - shift[:, 0]).T).T

    match = nb.InexactMatch(variance) if variance else nb.ExactMatch()
    return (
        nb.GuidedBridge(nb.LinearSDE(B, sigma, beta), match.at(v), x0=x0, ts=TS),
        score,
        score_forward,
    )


RATE, NOISE, FROM, TO = 0.3, 0.4, 1.0, 1.5


def geometric():
    """dX = RATE X dt + NOISE X dW: log X is a Brownian motion with drift m."""
    m = RATE - NOISE**2 / 2
    sde = nb.SDE(lambda t, x, args: RATE * x, lambda t, x, args: NOISE * x)
    bridge = nb.GuidedBridge(sde, nb.ExactMatch().at([TO]), x0=[FROM], ts=TS)
    return (
        bridge,
        lambda t, x: (np.log(TO / x) - m * (1 - t)) / (NOISE**2 * (1 - t) * x),
        geometric_forward,
    )


def geometric_forward(t, x, xp=np):
    return -1 / x - (xp.log(x / FROM) - (RATE - NOISE**2 / 2) * t) / (NOISE**2 * t * x)


def plain_standard(shape=(), context=0, duration=1.0):
    """Nothing is rescaled."""
    zeros, ones = jnp.zeros(shape), jnp.ones(shape)
    return Standard(jnp.asarray(duration), ones, zeros, ones, jnp.zeros(context), jnp.ones(context))


MODELS = {
    "ou": lambda: linear([-0.3], [0.7], [0.4], [0.2], [0.9], 0.0),
    "vector": lambda: linear(
        [[-0.2, 0.2], [-0.1, -0.3]],
        [[0.6, 0.2], [0.0, 0.5]],
        [0.3, -0.1],
        [0.4, -0.3],
        [0.7, -0.2],
        0.1,
    ),
    "geometric": geometric,
}


def clouds(bridge, method, guide=None):
    """`make(key, size, rho)`, and the times of its points in the SDE's own clock."""
    if method == "adjoint":
        return functools.partial(adjoint_cloud, bridge), bridge.ts[:-1]
    if method == "reversal":
        return functools.partial(reversal_cloud, bridge, guide), bridge.ts[:-1]
    # paths of a guide that is wrong, by all of their weights; it fits ρ by itself
    if method == "matching":
        wrong = bridge.with_guide(
            nb.FrozenGuide(nb.BrownianMotion(bridge.sde.covariance(0.0, bridge.x0)))
        )
        return lambda key, size, rho=None: guided_cloud(wrong, key, size, least=0.0), bridge.ts[:-1]
    back = reversed_bridge(bridge, bridge.end()[1])
    return functools.partial(forward_cloud, back), 1 - back.ts[:-1]


def mean_and_error(values):
    """Over the first axis."""
    return values.mean(0), values.std(0, ddof=1) / np.sqrt(len(values))


@pytest.mark.parametrize(
    "model, method",
    [("ou", "adjoint"), ("ou", "reversal"), ("vector", "adjoint"), ("vector", "forward"), ("geometric", "adjoint"),
     ("geometric", "forward"), ("vector", "matching"), ("geometric", "matching")],
)  # fmt: skip
def test_targets_are_scores_on_average(model, method):
    """E (g − s) φ(x) = 0 for s the closed form and φ = 1, x: within 3 SE, and 2 % for the steps'
    length, at any ρ.

    In units in which φ = x gives 1 for an error of the whole of s.
    """
    bridge, score, score_forward = MODELS[model]()
    make, times = clouds(bridge, method)
    # all start at x0
    truth, first = score_forward if method == "forward" else score, int(method == "matching")
    draw = jax.jit(lambda keys, rho: jax.lax.map(lambda key: make(key, 500, rho), keys))
    fitted = jax.jit(lambda key: make(key, 500).rho)(jr.key(2))
    half = jnp.where(fitted > 0, 0.5, 0.0)  # an end that is fixed does not move

    for rho in (fitted,) if method == "matching" else (fitted, 0 * half, half):
        cloud = draw(jr.split(jr.key(1), 20), rho)
        x, g, w = (
            np.asarray(a)[:, first:] for a in (cloud.x, cloud.score, cloud.weights[..., None])
        )
        np.testing.assert_allclose(np.sum(w, 2), 1.0, rtol=1e-10)
        flat = np.moveaxis(x, 1, 0).reshape(K - first, -1, x.shape[-1])
        known = zip(np.asarray(times)[first:], flat, strict=True)
        s = np.stack([truth(t, y).reshape(x[:, 0].shape) for t, y in known], 1)
        mean = np.mean(np.sum(w * x, 2, keepdims=True), 0, keepdims=True)
        sd = np.sqrt(np.mean(np.sum(w * (x - mean) ** 2, 2, keepdims=True), 0, keepdims=True))
        gap = (g - s) * sd
        gaps = np.concatenate(
            [np.mean(np.sum(w * gap * phi, 2), 1) for phi in (1.0, (x - mean) / sd)], 1
        )
        gap, error = mean_and_error(gaps)
        print(gap, error)
        assert np.all(error < 0.015)
        assert np.all(np.abs(gap) < 3 * error + 0.02)


@pytest.mark.parametrize(
    "guide", [nb.Unguided(), nb.FrozenGuide(nb.BrownianMotion(1.5))], ids=["unguided", "wrong"]
)
def test_end_states_are_those_of_the_conditioned_process(guide):
    """A normal posterior, whatever the guide: prior N(0, 0.5), observed with variance 0.1."""
    match = nb.InexactMatch(0.1).at([1.0])
    bridge = nb.GuidedBridge(
        nb.BrownianMotion(0.5), match, x0=[0.0], t1=1.0, num_steps=3, guide=guide
    )
    found = np.asarray(jax.jit(lambda key: ends(bridge, key, 20000))(jr.key(0)))[:, 0]
    variance = 0.5 * 0.1 / 0.6
    error = np.sqrt(variance / 5000)  # an ESS of at least a quarter
    assert error < 0.005 and abs(found.mean() - 0.5 / 0.6) < 4 * error
    np.testing.assert_allclose(found.var(), variance, rtol=0.08)


def test_rho_takes_the_noise_from_the_targets():
    """Brownian motion to an exact end: g = −(x − v)/(1 − t) without noise at ρ_j = j/(j + 1),
    unlike at ρ = 0.
    """
    bridge, score, _ = linear([0.0], [1.0], [0.0], [0.2], [0.9], 0.0)

    def noise(rho):
        cloud = jax.jit(lambda key: adjoint_cloud(bridge, key, 1000, rho))(jr.key(0))
        s = np.stack([score(t, x) for t, x in zip(TS, np.asarray(cloud.x), strict=False)])
        return np.var(cloud.score - s), cloud.rho

    fitted, rho = noise(None)
    assert fitted < 1e-3 * noise(jnp.zeros(K))[0]
    np.testing.assert_allclose(rho[::-1], np.arange(K) / np.arange(1, K + 1), atol=0.06)


# Drifts that grow faster than linearly, whose reversed processes explode.

WELL = nb.SDE(lambda t, x, args: -12 * x * (x * x - 1), lambda t, x, args: 1.0)


@pytest.mark.parametrize("method", ["adjoint", pytest.param("reversal", marks=pytest.mark.slow)])
def test_clouds_do_not_explode(method):
    """Between two wells, from the default guide, which is not the linearised one; without a bound
    no loss is finite.
    """
    training = nb.scores.Training(4, 16, interval=2, held_out=32)
    small = nb.scores.MLP((1, 1), key=jr.key(1), width=4, depth=1)
    score = nb.scores.fit(
        WELL, nb.ExactMatch().at([-1.0]), x0=[1.0], t1=1.0, num_steps=100, key=jr.key(0), method=method,
        network=small, training=training, progress=False,
    )  # fmt: skip
    assert isinstance(score.guide.auxiliary, nb.BrownianMotion)
    assert score.history["update"][-1] == 4 and np.all(np.isfinite(score.history["loss"][1:]))


def test_a_cloud_without_particles_has_no_weight():
    """All are killed at once where no step is short enough; the targets stay finite."""
    bridge = nb.GuidedBridge(WELL, nb.ExactMatch().at([-0.5]), x0=[1.0], ts=TS)
    cloud = jax.jit(lambda key: adjoint_cloud(bridge, key, 16, stride=1e-6))(jr.key(0))
    assert (
        not np.any(cloud.weights) and np.all(np.isfinite(cloud.score)) and np.all(cloud.x == -0.5)
    )


def test_weights_are_tempered_until_enough_are_left():
    """The largest power that leaves them, 1 where it does; what is not a number has no weight."""
    spread = jnp.append(jnp.linspace(-60.0, 0.0, 99), jnp.nan)
    for log_weights, power in ((0.001 * spread, 1.0), (spread, None)):
        found = np.asarray(_tempered(log_weights, 0.2))
        assert found[-1] == -np.inf and found[-2] == 0
        power = found[0] / log_weights[0] if power is None else power
        np.testing.assert_allclose(found[:-1], power * log_weights[:-1], rtol=1e-6)
        ess = float(nb.weights.effective_sample_size(found))
        assert ess >= 20 and (power == 1 or ess < 25)


# A weighted cloud with a rate c that varies.

SINE = nb.SDE(lambda t, x, args: 2 - 2 * jnp.sin(8 * x), lambda t, x, args: 0.5)
TANH = nb.SDE(
    lambda t, x, args: jnp.sin(2 * x) - 0.5 * x, lambda t, x, args: 0.5 + 0.2 * jnp.tanh(x)
)
SCALARS = {
    "sine": (SINE, lambda x: 2 - 2 * np.sin(8 * x), lambda x: 0.5 + 0 * x, np.pi / 2, 1.0),
    "tanh": (TANH, lambda x: np.sin(2 * x) - 0.5 * x, lambda x: 0.5 + 0.2 * np.tanh(x), 0.9, 1.0),
}


def backward_density(drift, diffusion, v, left, steps=512):
    """h(T − left, ·) on a grid, by powers of the kernel of short Euler steps."""
    grid, dt = np.linspace(-2.5, 4.0, 900), left / steps

    def step(y):
        return scipy.stats.norm.pdf(
            y, (grid + dt * drift(grid))[:, None], np.sqrt(dt) * diffusion(grid)[:, None]
        )

    last = step(np.array([v]))[:, 0]
    power, P = None, step(grid[None]) * (grid[1] - grid[0])
    for bit in reversed(f"{steps - 1:b}"):
        if bit == "1":
            power = P if power is None else power @ P
        P = P @ P
    return grid, power @ last


@pytest.mark.parametrize("name", list(SCALARS))
def test_the_weighted_adjoint_process_is_h(name):
    """E φ over the cloud against ∫ h φ / ∫ h by quadrature; E g φ = −E φ', which makes g the score
    of the cloud.
    """
    sde, drift, diffusion, v, scale = SCALARS[name]
    ts = np.linspace(0, 1, 201)
    bridge = nb.GuidedBridge(sde, nb.ExactMatch().at([v]), x0=[0.0], ts=ts)
    rho = jax.jit(lambda key: adjoint_cloud(bridge, key, 1000).rho)(jr.key(1))
    draw = jax.jit(
        lambda keys: jax.lax.map(lambda key: adjoint_cloud(bridge, key, 1000, rho), keys)
    )
    cloud = draw(jr.split(jr.key(0), 20))
    ts, x, g, w = (
        ts[:-1],
        *(np.asarray(a) for a in (cloud.x[..., 0], cloud.score[..., 0], cloud.weights)),
    )
    for k in (100, 150):
        grid, h = backward_density(drift, diffusion, v, 1 - ts[k])
        for f, slope in (
            (lambda x: x, lambda x: 1.0),
            (lambda x: np.cos(8 * x), lambda x: -8 * np.sin(8 * x)),
        ):
            truth = np.sum(h * f(grid)) / np.sum(h)
            sd = np.sqrt(np.sum(h * (f(grid) - truth) ** 2) / np.sum(h))
            found, error = mean_and_error(np.sum(w[:, k] * f(x[:, k]), 1) / sd)
            print(name, k, found - truth / sd, error)
            assert error < 0.02 and abs(found - truth / sd) < 3 * error + 0.01
            size = np.sqrt(np.sum(h * slope(grid) ** 2) / np.sum(h))
            found, error = mean_and_error(
                np.sum(w[:, k] * (g[:, k] * (f(x[:, k]) - truth) + slope(x[:, k])), 1) / size
            )
            print(name, k, "score", found, error)
            assert error < 0.08 and abs(found) < 3 * error


def test_rate_and_drift_of_the_reversed_process(key):
    """c = ½ ∂i∂j a_ij − ∂i b_i and −b + div a, by hand, for σ = R (1 + sin x)."""
    R = np.array([[0.4, 0.1, 0.2], [0.0, 0.3, -0.1]])
    A, B = R @ R.T, np.array([[-0.5, 0.4], [-0.2, -0.8]])
    sde = nb.SDE(
        lambda t, x, args: B @ x + t * jnp.sin(x),
        lambda t, x, args: (2 + t) * jnp.asarray(R) * (2 + jnp.sin(x))[:, None],
    )
    x, clock = jr.normal(key, (2,)), 1.3
    reverse = ReversedSDE(sde, jnp.asarray(clock))
    s, c, y = 2 + np.sin(x), np.cos(x), np.asarray(x)
    t = clock - 0.4
    # a_ij = (2 + t)² A_ij s_i s_j
    scale = (2 + t) ** 2
    first = [
        scale * (sum(A[i, j] * s[i] * c[j] for j in range(2)) + A[i, i] * c[i] * s[i])
        for i in range(2)
    ]
    second = sum(
        scale * A[i, j] * (c[i] * c[j] if i != j else 2 * c[i] ** 2 - 2 * np.sin(y[i]) * s[i])
        for i in range(2)
        for j in range(2)
    )
    np.testing.assert_allclose(
        reverse.drift(0.4, x), np.array(first) - B @ y - t * np.sin(y), rtol=1e-10
    )
    np.testing.assert_allclose(
        reverse.rate(0.4, x), 0.5 * second - np.trace(B) - t * np.sum(c), rtol=1e-10
    )


def test_divergence_of_a_kunita_flow(key):
    """(div a)_i = Σ_j ∇_{x_j} a(x_i, x_j), against a formula and against autodiff."""
    alpha, ell = 0.3, 0.7
    flow = nb.KunitaFlow(nb.Landmarks(4, 2), nb.GaussianKernel(alpha, ell))
    x = np.asarray(jr.normal(key, (4, 2)))
    d = x[:, None] - x[None]
    K = alpha**2 * np.pi * ell**2 * np.exp(-np.sum(d**2, -1) / (4 * ell**2))
    found = flow.covariance_divergence(0.0, jnp.asarray(x))
    np.testing.assert_allclose(found, np.sum(K[..., None] * d, 1) / (2 * ell**2), rtol=1e-10)
    np.testing.assert_allclose(
        found, AbstractSDE.covariance_divergence(flow, 0.0, jnp.asarray(x)), rtol=1e-10
    )
    again = flow.covariance_double_divergence(0.0, jnp.asarray(x))
    square = np.sum(d**2, -1)
    np.testing.assert_allclose(
        again, np.sum(K * (1 - np.eye(4)) * (2 - square / (2 * ell**2))) / (2 * ell**2), rtol=1e-10
    )
    np.testing.assert_allclose(
        again, AbstractSDE.covariance_double_divergence(flow, 0.0, jnp.asarray(x)), rtol=1e-10
    )


# The gradient of the evidence bound.


class Affine(eqx.Module):
    """A user's own network: s in proportion to p_0 + p_1 x̂."""

    p: jax.Array

    def __call__(self, t, x, v, theta):
        return self.p[0] + self.p[1] * x


def loss_of(method, bridge, network, batch_size):
    """What a method minimises."""
    found = []
    shape = bridge.x0.reshape(bridge.x0.shape[0], -1).shape
    guide = ScoreGuide(bridge.guide, network, plain_standard(shape))
    training = nb.scores.Training(batch_size=batch_size)
    method(
        Problem(
            lambda key: bridge, False, guide, training, lambda _, loss, *rest: found.append(loss)
        ),
        jr.key(0),
    )
    return found[0]


def gradient_and_loss(loss, network):
    arrays, static = eqx.partition(network, eqx.is_inexact_array)

    def value(arrays, key):
        return loss(eqx.combine(arrays, static), key)[0]

    return jax.grad(value), value, arrays


def test_an_exact_guide_has_no_gradient(key):
    """For every noise, with a network that is 0: training does not spoil it. A wrong guide has one."""
    network = nb.scores.MLP((2, 1), key=key, width=4, depth=1)
    for sde, small in (
        (nb.BrownianMotion(np.array([0.5, 0.2])), True),
        (nb.LinearSDE(-0.5, 0.4, 0.3), False),
    ):
        guide = nb.FrozenGuide(nb.BrownianMotion(np.array([0.5, 0.2])))
        bridge = nb.GuidedBridge(
            sde, nb.ExactMatch().at([0.3, 0.1]), x0=[0.0, 0.2], t1=1.0, num_steps=4, guide=guide
        )
        gradient, _, arrays = gradient_and_loss(loss_of(residual, bridge, network, 3), network)
        largest = max(
            float(jnp.max(jnp.abs(g))) for g in jax.tree.leaves(jax.jit(gradient)(arrays, key))
        )
        assert largest < 1e-12 if small else largest > 1e-3


def test_a_learned_guide_can_be_corrected():
    """Score matching asks for what guide and network together lack: here minus what was put on an
    exact guide.
    """
    bridge = nb.GuidedBridge(
        nb.BrownianMotion(0.3), nb.ExactMatch().at([0.5]), x0=[0.0], t1=1.0, num_steps=6
    )
    added = Affine(jnp.array([0.7, -0.4]))
    spoilt = bridge.with_guide(ScoreGuide(bridge.guide, added, plain_standard((1, 1))))
    nothing, opposite = Affine(0 * added.p), Affine(-added.p)
    noise, right, wrong = (
        float(loss_of(adjoint, b, network, 8)(network, jr.key(1))[0])
        for b, network in ((bridge, nothing), (spoilt, opposite), (spoilt, nothing))
    )
    np.testing.assert_allclose(right, noise, rtol=1e-10)
    assert wrong > 2 * noise


def test_the_gradient_of_the_bound_is_unbiased():
    """Its mean is the difference quotient of E log w, for a wrong guide and a network that is not
    0.
    """
    guide = nb.FrozenGuide(nb.BrownianMotion(0.3))
    bridge = nb.GuidedBridge(
        nb.LinearSDE(-1.0, 0.7, 0.5),
        nb.ExactMatch().at([0.9]),
        x0=[0.2],
        t1=1.0,
        num_steps=6,
        guide=guide,
    )
    network, h = Affine(jnp.array([0.3, -0.4])), 1e-4
    gradient, value, arrays = gradient_and_loss(loss_of(residual, bridge, network, 500), network)

    def both(key):
        moved = [value(Affine(arrays.p + s * d), key) for d in h * np.eye(2) for s in (1.0, -1.0)]
        return gradient(arrays, key).p, (jnp.stack(moved[::2]) - jnp.stack(moved[1::2])) / (2 * h)

    found, quotient = jax.jit(lambda keys: jax.lax.map(both, keys))(jr.split(jr.key(0), 40))
    gap, error = mean_and_error(np.asarray(found - quotient))
    assert np.all(error < 0.02 * np.abs(np.mean(quotient, 0)))
    assert np.all(np.abs(gap) < 3 * error)


OPTIMA = {"drift": (nb.LinearSDE(0.0, 1.0, 1.0), 0.5, 50), "ou-1": (nb.LinearSDE(-1.0, 1.0), -0.41928, 200),
          "ou-5": (nb.LinearSDE(-5.0, 1.0), -1.15132, 400),
          "ou-10": (nb.LinearSDE(-10.0, 1.0), -1.49787, 800)}  # fmt: skip


@pytest.mark.parametrize(
    "case", ["drift", *(pytest.param(c, marks=pytest.mark.slow) for c in OPTIMA if c != "drift")]
)
def test_the_bound_reaches_its_optimum(case):
    """−E log(w/h̃(0, x0)) within 1 % of log(h̃/h)(0, x0): a Brownian motion guides what it is not."""
    sde, optimum, num_steps = OPTIMA[case]
    guide, match = nb.FrozenGuide(nb.BrownianMotion(1.0)), nb.ExactMatch().at([0.0])
    score = nb.scores.fit(
        sde,
        match,
        x0=[0.0],
        t1=1.0,
        num_steps=num_steps,
        guide=guide,
        network=nb.scores.MLP((1, 1), key=jr.key(1), width=16, depth=2),
        training=nb.scores.Training(400, 32, learning_rate=1e-2, interval=200),
        key=jr.key(0),
        progress=False,
    )
    bridge = nb.GuidedBridge(sde, match, x0=[0.0], t1=1.0, num_steps=num_steps, guide=score)
    log_weight = np.asarray(
        jax.jit(jax.vmap(bridge.log_weight))(jr.normal(jr.key(2), (4000, num_steps, 1, 1)))
    )
    found, error = mean_and_error(scipy.stats.norm.logpdf(0.0) - log_weight)
    assert error < 0.004 * abs(optimum)
    assert abs(found - optimum) < 0.01 * abs(optimum)


# Training.


def quadratic(network, key):
    """A loss with noise, smallest at w = (1, 2)."""
    return jnp.sum((network - jnp.array([1.0, 2.0]) + 0.1 * jr.normal(key, (2,))) ** 2), network


def judged(network):
    value = -jnp.sum((network - jnp.array([1.0, 2.0])) ** 2)
    return value, value, jnp.ones(())


def trained(training=None, key=0, loss=quadratic, judge=judged, **kwargs):
    training = (
        nb.scores.Training(20, interval=5, learning_rate=0.1) if training is None else training
    )
    return train(jnp.zeros(2), loss, judge, jr.key(key), training, progress=False, **kwargs)


def test_what_is_learned_from_is_prepared_anew(monkeypatch):
    """After two updates, and after a look at three: 0, 2, 5, 17, 35."""
    monkeypatch.setattr(training_module, "_PREPARED", 2)

    def loss(network, key, prepared):
        return -jnp.sum(network * prepared), network

    training = nb.scores.Training(
        6, optimizer=optax.sgd(1.0), interval=3, average=0.0, patience=None
    )
    network, _ = trained(training, loss=loss, prepare=lambda network, key: 1 + network)
    np.testing.assert_allclose(network, 5 + 2 * 6 + 18)


def test_training_goes_on_where_it_was_killed(tmp_path, monkeypatch):
    """The same network and history, bit by bit, as without the interruption; nothing is left to do
    a third time.
    """
    whole, history = trained()
    saved, looks = training_module._save, []

    def killed(*args):
        saved(*args)
        looks.append(1)
        if len(looks) == 2:
            raise KeyboardInterrupt

    file = tmp_path / "a" / "training.eqx"
    with monkeypatch.context() as m:
        m.setattr(training_module, "_save", killed)
        with pytest.raises(KeyboardInterrupt):
            trained(file=file)
    for _ in range(2):
        again, resumed = trained(file=file)
        assert np.array_equal(again, whole)
        for name in set(history) - {"seconds"}:
            np.testing.assert_array_equal(resumed[name], history[name])
    np.testing.assert_array_equal(history["update"], [0, 5, 10, 15, 20])
    assert np.all(np.diff(resumed["seconds"]) > 0)
    assert not np.array_equal(trained(key=1)[0], whole)


def long_training(folder):
    sde, condition = (
        nb.SDE(lambda t, x, a: jnp.sin(x), lambda t, x, a: 0.5),
        nb.ExactMatch().at(jnp.ones(1)),
    )
    training = nb.scores.Training(600, 4, interval=5, held_out=8, patience=None)
    settings = {
        "x0": jnp.zeros(1),
        "t1": 1.0,
        "num_steps": 4,
        "training": training,
        "progress": False,
    }
    return nb.scores.fit(sde, condition, key=jr.key(0), directory=folder, **settings)


@pytest.mark.parametrize("num_kills", [1, pytest.param(10, marks=pytest.mark.slow)])
def test_training_survives_kills(num_kills, tmp_path):
    """By SIGKILL: the parameters and the history are those of an uninterrupted training."""
    file = tmp_path / "run" / "residual.eqx"

    def written():
        return file.stat().st_mtime_ns if file.exists() else 0

    killed_and_ended(
        __file__, file.parent, progress=written, num_kills=num_kills, within=0.3 / num_kills
    )
    stamp = written()
    found, whole = long_training(file.parent), long_training(tmp_path / "whole")
    assert written() == stamp  # nothing was left to do
    for guide in (found, whole):
        guide.history.pop("seconds")
    jax.tree.map(
        np.testing.assert_array_equal,
        eqx.filter(found, eqx.is_array),
        eqx.filter(whole, eqx.is_array),
    )


def test_a_directory_belongs_to_one_training(tmp_path):
    file = tmp_path / "training.eqx"
    trained(file=file, problem={"x0": jnp.zeros(2)})
    others = {
        "problem": dict(problem={"x0": jnp.ones(2)}),
        "key": dict(problem={"x0": jnp.zeros(2)}, key=1),
        "training.interval": dict(
            problem={"x0": jnp.zeros(2)}, training=nb.scores.Training(20, interval=4)
        ),
    }
    for name, other in others.items():
        with pytest.raises(
            ValueError, match=rf"`directory` holds .* differs in {name}\. .*another directory"
        ):
            trained(file=file, **other)
    file.write_bytes(b"something else")
    with pytest.raises(ValueError, match="`directory` holds the training of something else"):
        trained(file=file)


def test_training_stops_at_a_loss_that_is_not_finite():
    """With the last good network: updates of size 1 make the loss of this network infinite at w >
    12.
    """

    def loss(network, key):
        return jnp.sum(jnp.where(network > 12, jnp.nan, -network)), network

    def judge(network):
        return jnp.sum(network), jnp.sum(network), jnp.ones(())

    for patience in (5, None):
        training = nb.scores.Training(
            40, optimizer=optax.sgd(1.0), interval=5, average=0.0, patience=patience
        )
        with pytest.warns(
            UserWarning, match="stopped: the loss was not finite at update 13. .*`learning_rate`"
        ):
            network, history = trained(training, loss=loss, judge=judge)
        np.testing.assert_allclose(network, 10.0)
        np.testing.assert_allclose(history["update"], [0, 5, 10])


def test_the_best_network_is_kept():
    """Judged at each look, the one at the start included; training ends after `patience` looks
    without a better one.
    """

    def worse(network):
        return -jnp.sum(network**2), jnp.zeros(()), jnp.ones(())

    training = nb.scores.Training(100, interval=5, patience=3)
    network, history = trained(training, judge=worse)
    assert np.array_equal(network, [0.0, 0.0]) and history["update"][-1] == 15
    np.testing.assert_array_equal(history["kept"], [1, 0, 0, 0])
    last, history = trained(nb.scores.Training(30, interval=5, patience=None), judge=worse)
    assert np.all(last != 0) and history["update"][-1] == 30
    assert np.all(history["kept"] == 1)


def test_a_network_of_half_the_ess_is_not_kept():
    """However much better its bound is; and it does not count as a look without a better one."""

    def judge(network):
        far = jnp.sum(network)
        ess = jnp.where(
            far < 0.35, 1.0, jnp.where(far < 0.85, 0.45, jnp.where(far < 1.35, 0.55, jnp.nan))
        )
        return far, far, ess

    def loss(network, key):
        return -jnp.sum(network), network

    def run(most, patience=1):
        training = nb.scores.Training(
            most, optimizer=optax.sgd(0.05), interval=1, average=0.0, patience=patience
        )
        return trained(training, loss=loss, judge=judge)

    # what is not known is no objection
    for most, kept in ((3, 0.3), (8, 0.3), (9, 0.9), (13, 1.3), (20, 2.0)):
        network, history = run(most)
        assert float(jnp.sum(network)) == pytest.approx(kept)
        assert history["update"][-1] == most
        last = np.flatnonzero(history["kept"])[-1]
        assert history["bound"][last] == pytest.approx(kept)
    assert float(jnp.sum(run(8, patience=None)[0])) == pytest.approx(0.8)


def test_training_makes_no_more_updates_than_asked(tmp_path):
    """The last look is after fewer updates than the others, and a resumed training has the same."""
    training = nb.scores.Training(
        12, interval=5, optimizer=optax.sgd(0.05), average=0.0, patience=None
    )
    counted = lambda network, key: (-jnp.sum(network), network)  # noqa: E731
    network, history = trained(training, loss=counted, file=tmp_path / "training.eqx")
    np.testing.assert_array_equal(history["update"], [0, 5, 10, 12])
    np.testing.assert_allclose(network, 12 * 0.05)
    np.testing.assert_allclose(history["loss"][1:], [-0.2, -0.7, -1.05])
    again, history = trained(training, loss=counted, file=tmp_path / "training.eqx")
    np.testing.assert_array_equal(again, network)
    np.testing.assert_array_equal(history["update"], [0, 5, 10, 12])


def test_training_is_watched():
    """At each look, with the network as it is and the history so far, the start included."""
    seen = []
    network, _ = trained(
        nb.scores.Training(10, interval=5, patience=None),
        watch=lambda network, history: seen.append((network, history)),
    )
    assert [list(history["update"]) for _, history in seen] == [[0], [0, 5], [0, 5, 10]]
    np.testing.assert_array_equal(seen[-1][0], network)


SPREAD = 0.2 * np.sqrt(64) * scipy.stats.zscore(np.random.default_rng(0).normal(size=64), ddof=1)
GAINS = {
    # value of the guide, its bounds, those of the network, what is said
    "nothing-to-learn": (
        np.inf,
        5.0,
        5.0 + 0 * SPREAD,
        "brought nothing: the weights of the guide are equal",
    ),
    "kept": (
        5.0,
        5.0,
        5.0 + 0 * SPREAD,
        "brought nothing: no network was better than the guide alone",
    ),
    "within-its-error": (
        5.0,
        5.0,
        5.3 + SPREAD,
        "brought nothing: .* is 0.3 ± 0.2 nats above .*ESS 60 % .50 %.",
    ),
    "lower": (5.0, 5.0, 4.0 + SPREAD, "brought nothing: its bound is -1 ± 0.2 nats above"),
    "few": (
        5.0,
        5.0,
        6.0 + SPREAD[:8],
        "may have brought nothing: 8 .* differences are too few to tell",
    ),
    "gain": (5.0, 5.0, 6.0 + SPREAD, None),
    "a-guide-that-fails": (-np.inf, np.nan, 6.0 + SPREAD, None),
    "both-fail": (-np.inf, np.nan, np.nan * SPREAD, "brought nothing: its bound is nan"),
}


@pytest.mark.parametrize(("value", "guide", "network", "said"), GAINS.values(), ids=GAINS)
def test_what_training_has_brought(value, guide, network, said):
    """The mean of the differences, path by path, and its standard error; a warning where it is
    nothing.
    """
    before = jnp.array(value), jnp.array(guide), jnp.array(0.5), jnp.full(network.size, guide)
    after = jnp.zeros(()), jnp.mean(network), jnp.array(0.6), jnp.asarray(network)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = _gain("residual", before, after)
    assert len(caught) == (said is not None)
    if said is not None:
        assert re.match(f"residual {said}", str(caught[0].message)), caught[0].message
    np.testing.assert_allclose(found["gain"], network.mean() - guide, atol=1e-12)
    known = network.size >= 16 and np.isfinite(guide)
    error = network.std(ddof=1) / np.sqrt(network.size) if known else np.nan
    np.testing.assert_allclose(found["gain_error"], error, rtol=1e-12)


# Networks.


def randomised(network, key):
    """Every leaf random, so that nothing is 0 by construction."""
    arrays, static = eqx.partition(network, eqx.is_inexact_array)
    leaves, tree = jax.tree.flatten(arrays)
    keys = jr.split(key, len(leaves))
    moved = [a + 0.2 * jr.normal(k, a.shape) for a, k in zip(leaves, keys, strict=True)]
    return eqx.combine(jax.tree.unflatten(tree, moved), static)


def curve(n):
    s = 2 * np.pi * np.arange(n) / n
    return np.stack([np.cos(s), np.sin(s) + 0.2 * np.cos(2 * s)], 1), 0.2 * np.stack(
        [np.sin(3 * s), np.cos(s)], 1
    )


def test_networks_start_at_zero(key):
    v, x = curve(5)
    for make in (
        lambda: nb.scores.MLP((5, 2), 1, key=key),
        lambda: nb.scores.PointNetwork(2, 1, key=key),
    ):
        assert not np.any(make()(jnp.array(0.3), x, v, jnp.ones(1)))


def test_the_singular_part_of_a_network(key):
    """(network(t, x/l, v, θ) + g(t) x/l)/l with l = √(1 − t + softness); 0 as long as its parts
    are.
    """
    v, x = (jnp.asarray(a) for a in curve(5))
    network = nb.scores.Singular(nb.scores.MLP((5, 2), 1, key=key), key=key, softness=0.01)
    t, theta = jnp.array(0.9), jnp.ones(1)
    assert not np.any(network(t, x, v, theta))
    network = randomised(network, key)
    length = np.sqrt(0.11)
    here, doubled = (
        network(t, c * x, v, theta) - network.network(t, c * x / length, v, theta) / length
        for c in (1, 2)
    )
    gain = np.asarray(here)[1, 0] * 0.11 / np.asarray(x)[1, 0]
    assert abs(gain) > 1e-3
    np.testing.assert_allclose(here, gain * x / 0.11, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(doubled, 2 * here, rtol=1e-6, atol=1e-9)


def test_a_point_network_sees_a_set_of_points(key):
    """It commutes with relabelling, and has a limit in the number of points, reached fast on a
    smooth curve.
    """
    network = eqx.filter_jit(randomised(nb.scores.PointNetwork(2, 1, key=key, width=8), key))
    t, theta = jnp.array(0.3), jnp.ones(1)
    v, x = (jnp.asarray(a) for a in curve(8))
    order = np.random.default_rng(0).permutation(8)
    found = network(t, x, v, theta)
    np.testing.assert_allclose(
        network(t, x[order], v[order], theta), found[order], rtol=1e-8, atol=1e-10
    )
    assert np.ptp(np.asarray(found)) > 1e-3
    limit = network(t, *(jnp.asarray(a) for a in curve(128)[::-1]), theta)[::16]
    gaps = []
    for n in (8, 16, 32):
        coarse = network(t, *(jnp.asarray(a) for a in curve(n)[::-1]), theta)[:: n // 8]
        gaps.append(float(jnp.max(jnp.abs(coarse - limit)) / jnp.std(limit)))
    assert gaps[0] > gaps[1] > gaps[2] and gaps[2] < 0.02


def test_a_guide_of_landmarks_does_not_see_translations(key):
    v, x0 = curve(6)
    network = randomised(nb.scores.PointNetwork(2, 0, key=key, width=8), key)
    guide = ScoreGuide(nb.scores.Unguided(), network, plain_standard())

    @jax.jit
    def network_score(shift):
        flow = nb.KunitaFlow(nb.Landmarks(6, 2), nb.GaussianKernel(0.3, 0.7))
        bridge = nb.GuidedBridge(
            flow, nb.InexactMatch(0.1).at(v + shift[None]), x0=v, ts=[0.0, 0.5, 1.0], guide=guide
        )
        return bridge.score(0.5, v + 0.3 * x0 + shift[None])

    here, there = network_score(jnp.zeros(2)), network_score(jnp.array([0.7, -1.2]))
    assert np.max(np.abs(here)) > 1e-3
    np.testing.assert_allclose(here, there, rtol=1e-6, atol=1e-9)


def test_a_network_with_running_means():
    """A U-net like the published one trains from nothing, and its batch normalisation keeps means."""
    network = nb.scores.UNet.build((1, 2), (4, 2), 4, key=jr.key(1))
    score = nb.scores.fit(
        nb.BrownianMotion(0.5),
        nb.InexactMatch(0.1).at([[0.3, 0.1]]),
        x0=[[0.0, 0.2]],
        t1=1.0,
        num_steps=3,
        key=jr.key(0),
        method="adjoint",
        guide=nb.scores.Unguided(),
        network=network,
        training=nb.scores.Training(4, 8, interval=2, held_out=8, patience=None, one_step=True),
        progress=False,
    )
    assert isinstance(score.network, nb.scores.WithState)
    before, after = (jax.tree.leaves(n.state) for n in (network, score.network))
    assert any(not np.array_equal(a, b) for a, b in zip(before, after, strict=True))
    assert np.all(np.isfinite(score.history["loss"][1:]))
    assert score.network(
        jnp.array(0.5), jnp.ones((1, 2)), jnp.ones((1, 2)), jnp.zeros(0)
    ).shape == (1, 2)


# All of it.

QUICK = nb.scores.Training(10, 8, interval=5, held_out=8)


@pytest.mark.parametrize(
    "method", ["residual", "adjoint", pytest.param("reversal", marks=pytest.mark.slow)]
)
def test_an_exact_guide_is_not_spoilt(method):
    """Weights stay constant: Brownian motion and its own guide; and it is said that there was
    nothing to learn.
    """
    sde, match = nb.LinearSDE(-0.5, 0.4, 0.3), nb.InexactMatch(0.1).at([0.3])
    if method == "reversal":
        sde, match = nb.BrownianMotion(0.5), nb.ExactMatch().at([0.3])
    small = nb.scores.MLP((1, 1), key=jr.key(1), width=4, depth=1)
    with pytest.warns(UserWarning, match=f"{method} brought nothing: .*nothing to learn"):
        score = nb.scores.fit(
            sde, match, x0=[0.0], t1=1.0, num_steps=4, key=jr.key(0), method=method, network=small, training=QUICK,
            progress=False,
        )  # fmt: skip
    assert abs(score.history["gain"]) < 1e-10
    bridge = nb.GuidedBridge(sde, match, x0=[0.0], t1=1.0, num_steps=4)
    z = jr.normal(jr.key(1), (50, *bridge.noise_shape))
    found = jax.jit(jax.vmap(bridge.with_guide(score).log_weight))(z)
    assert np.ptp(np.asarray(found)) < 1e-10
    np.testing.assert_allclose(found[0], bridge.log_weight(z[0]), rtol=1e-10)


def test_an_amortised_guide_serves_other_parameters_and_targets():
    """Trained over (rate, target): more effective paths than its guide has, at pairs not drawn in
    training.
    """
    guide, match = nb.FrozenGuide(nb.BrownianMotion(0.25)), nb.ExactMatch()

    def draw(key):
        rate, v = jr.uniform(key, (2,))
        return (
            nb.LinearSDE(-0.5 - 3 * rate, 0.5),
            match.at(jnp.stack([2 * v - 1])),
            jnp.array([0.3]),
        )

    sde, condition, x0 = draw(jr.key(0))
    score = nb.scores.fit(
        sde,
        condition,
        x0=x0,
        t1=1.0,
        num_steps=10,
        key=jr.key(1),
        guide=guide,
        network=nb.scores.MLP((1, 1), 1, key=jr.key(2), width=16, depth=2),
        draw=draw,
        context=lambda sde: jnp.stack([sde.drift_operator]),
        training=nb.scores.Training(200, 64, learning_rate=1e-2, interval=200),
        progress=False,
    )

    @jax.jit
    def lost(key):
        """1 − ESS as a fraction, with the guide and with the network on it."""
        sde, condition, x0 = draw(key)
        bridge = nb.GuidedBridge(sde, condition, x0=x0, t1=1.0, num_steps=10, guide=guide)
        z = jr.normal(key, (200, *bridge.noise_shape))
        log_weights = [jax.vmap(b.log_weight)(z) for b in (bridge, bridge.with_guide(score))]
        return jnp.stack([1 - nb.weights.effective_sample_size(w) / 200 for w in log_weights])

    before, after = np.mean([lost(key) for key in jr.split(jr.key(3), 20)], axis=0)
    print(before, after)
    assert after < 0.25 * before

    def log_density(rate, z):
        law = nb.DiffusionEndpoint(
            nb.LinearSDE(-rate, 0.5), x0, match, t1=1.0, num_steps=10, guide=score
        )

        def model():
            numpyro.factor("fixed", 0.0)
            numpyro.sample("seen", law.given(z), obs=jnp.array([0.2]))

        return numpyro.infer.util.log_density(model, (), {}, {})[0]

    z = jr.normal(jr.key(4), (10, 1, 1))
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        found = jax.jit(log_density)(1.7, z)
        bridge = nb.GuidedBridge(
            nb.LinearSDE(-1.7, 0.5), match.at([0.2]), x0=x0, t1=1.0, num_steps=10, guide=score
        )
        np.testing.assert_allclose(found, bridge.log_weight(z), rtol=1e-10)


def sine_evidence(ts, v=np.pi / 2):
    """Of the Euler model on the grid, by quadrature."""
    grid = np.linspace(-2.5, 4.0, 1300)

    def step(x, y, dt):
        return scipy.stats.norm.pdf(y, x + dt * (2 - 2 * np.sin(8 * x)), 0.5 * np.sqrt(dt))

    h, dts = step(grid, v, ts[-1] - ts[-2]), np.diff(ts)
    for dt in dts[-2:0:-1]:
        h = step(grid[:, None], grid[None], dt) @ h * (grid[1] - grid[0])
    return np.log(np.sum(step(0.0, grid, dts[0]) * h) * (grid[1] - grid[0]))


@pytest.mark.parametrize(
    "method", ["residual", "matching", "adjoint", pytest.param("reversal", marks=pytest.mark.slow)]
)
def test_the_sine_bridge(method):
    """A multimodal bridge, where a Brownian guide has an ESS of 0.3 %: twenty times that; the
    evidence within 3 SE.
    """
    match = nb.ExactMatch().at([np.pi / 2])
    guide = nb.FrozenGuide(nb.BrownianMotion(0.25))
    score = nb.scores.fit(
        SINE,
        match,
        x0=[0.0],
        t1=1.0,
        num_steps=40,
        key=jr.key(0),
        method=method,
        guide=guide,
        network=nb.scores.MLP((1, 1), key=jr.key(1), width=24, depth=2),
        training=nb.scores.Training(300, 64, learning_rate=1e-2, interval=150),
        progress=False,
    )
    bridge = nb.GuidedBridge(SINE, match, x0=[0.0], t1=1.0, num_steps=40, guide=guide)
    z = jr.normal(jr.key(2), (4000, *bridge.noise_shape))
    plain, log_weight = (
        np.asarray(jax.jit(jax.vmap(b.log_weight))(z)) for b in (bridge, bridge.with_guide(score))
    )
    truth = sine_evidence(np.asarray(bridge.ts))
    assert abs(truth + 0.2610) < 0.02  # the Euler model of 40 steps and the diffusion
    weight = np.exp(log_weight - truth)
    error = weight.std() / np.sqrt(len(weight))
    ess = [float(nb.weights.effective_sample_size(w)) for w in (plain, log_weight)]
    print(method, truth, weight.mean(), error, ess, score.history["bound"])
    assert error < 0.1 and abs(weight.mean() - 1) < 3 * error
    assert ess[1] > 20 * ess[0]
    gained, own = (log_weight - plain).mean(), (log_weight - plain).std() / np.sqrt(len(plain))
    gain, error = score.history["gain"], score.history["gain_error"]
    assert 0 < error < 0.1 * gain and abs(gain - gained) < 4 * np.hypot(error, own)


# Trees.

SPLITS = nb.Tree.from_newick("((a:.5,b:.7):.4,c:.6);")
AT_TIPS = np.array([[0.9], [-0.4], [0.2]])


def pulled(rate, guide=None):
    """A tree of an Ornstein-Uhlenbeck process, led as if nothing pulled, or exactly."""
    sde, match = nb.LinearSDE(-rate, 1.0), nb.InexactMatch(0.05)
    return nb.DiffusionTree(sde, np.ones(1), match, tree=SPLITS, num_steps=8, guide=guide)


PULLED_BY_NOTHING = nb.FrozenGuide(nb.BrownianMotion(1.0))


@pytest.mark.parametrize("amortised", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_one_network_for_all_branches(amortised):
    """The bound comes near the log evidence, which the exact guide knows, and the mean weight is
    the evidence.
    """

    def draw(key):
        rate = jr.uniform(key, minval=2.0, maxval=4.0)
        return pulled(rate, PULLED_BY_NOTHING), AT_TIPS

    network = nb.scores.MLP((1, 1), int(amortised), key=jr.key(1), width=16, depth=2)
    training = nb.scores.Training(200, 32, learning_rate=1e-2, held_out=128)
    guide = nb.scores.fit_tree(
        pulled(3.0, PULLED_BY_NOTHING), AT_TIPS, key=jr.key(0), network=network, training=training,
        draw=draw if amortised else None, progress=False,
        context=(lambda sde: jnp.ravel(sde.drift_operator)) if amortised else None,
    )  # fmt: skip
    assert guide.history["gain"] > 4 * guide.history["gain_error"]
    assert np.all(np.isnan(guide.history["ess"]))

    @jax.jit
    def log_weights(rate):
        noise = jr.normal(jr.key(2), (4000, *pulled(rate).noise_prior().shape()))

        def of(law):
            return jax.vmap(lambda z: law.given(z).log_prob(AT_TIPS))(noise)

        return [of(pulled(rate, by)) for by in (PULLED_BY_NOTHING, guide)] + [of(pulled(rate))[0]]

    before, after, truth = log_weights(3.0)
    # a network moves the noise of a step and does not narrow it, which is lost at any length of it
    assert truth - np.mean(after) < 0.3 * (truth - np.mean(before))
    ratio = np.exp(after - truth)
    error = ratio.std() / np.sqrt(ratio.size)
    assert error < 0.01 and abs(ratio.mean() - 1) < 4 * error
    # a step of the model with the network in it, as a kernel takes one
    gradient = jax.grad(
        lambda rate: (
            pulled(rate, guide)
            .given(jnp.zeros(pulled(3.0).noise_prior().shape()))
            .log_prob(AT_TIPS)
        )
    )
    assert np.isfinite(jax.jit(gradient)(3.0))


def test_several_trees_at_once_are_refused():
    law = pulled(3.0).expand((2,))
    with pytest.raises(ValueError, match=r"`law` must be of one tree; it has batch shape \(2,\)"):
        nb.scores.fit_tree(law, AT_TIPS, key=jr.key(0))


if __name__ == "__main__":
    long_training(sys.argv[1])
