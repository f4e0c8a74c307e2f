"""Noise of control landmarks, and steps whose algebra is that of few noises."""

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
import scipy.stats
from jax.scipy.special import logsumexp
from numpyro.infer.util import log_density

import numpyro_bridges as nb
import numpyro_bridges.guiding._guides as guides
import numpyro_bridges.trees._told as told
from numpyro_bridges.distributions._tree import _problem

pytestmark = [pytest.mark.numpyro, pytest.mark.usefixtures("compile_quickly")]

N, NUM_STEPS = 24, 4
S = np.linspace(0, 2 * np.pi, N, endpoint=False)
X0 = np.stack([np.cos(S), 0.7 * np.sin(S)], 1)
V = 1.1 * X0 + 0.1 * np.stack([np.sin(2 * S), np.cos(S)], 1)
KERNEL, SHORT = nb.GaussianKernel(0.3, 0.9), nb.GaussianKernel(1.0, 0.2)
SEEN = np.arange(N) % 5 > 0
W = np.linspace(0.5, 1.5, N)
DOUBLE = np.where(np.arange(N)[:, None] == 2, X0[1], X0)


def flow(noise, n=N, kernel=KERNEL):
    return nb.KunitaFlow(nb.Landmarks(n, 2, weights=W if n == N else None), kernel, noise=noise)


def bridge(match, guide, noise=None, v=V):
    sde = flow(nb.ControlNoise(8) if noise is None else noise)
    return nb.GuidedBridge(sde, match.at(v), x0=X0, t1=1.3, num_steps=NUM_STEPS, guide=guide)


MATCHES = {
    "all": nb.InexactMatch(0.003),
    "mask": nb.InexactMatch(0.003, mask=SEEN),
    "own variances": nb.InexactMatch(np.linspace(0.001, 0.01, N)),
    "rows": nb.InexactMatch(0.003, np.eye(N)[SEEN]),
}


def seen(match):
    L = np.asarray(match.operator)
    return V if L.ndim == 0 else L @ V


def normal_log_density(r, S):
    return (
        -0.5 * np.sum(r * np.linalg.solve(S, r))
        - 0.5 * r.shape[1] * np.linalg.slogdet(2 * np.pi * S)[1]
    )


LED_BY = {
    "receding": (nb.RecedingGuide(), 0.0),
    "receding-mixed": (nb.RecedingGuide(0.3), 0.3),
    "frozen": (nb.FrozenGuide(), 1.0),
}


@pytest.mark.parametrize("guide", LED_BY)
@pytest.mark.parametrize("name", MATCHES)
def test_weight_is_that_of_dense_normals(name, guide, key):
    """u ~ N(AᵀS⁻¹r, I − AᵀS⁻¹A) at every step, with S of all that is seen, in NumPy."""
    match = MATCHES[name]
    guide, end_weight = LED_BY[guide]
    b = bridge(match, guide, v=seen(match))
    assert b.noise_shape == (NUM_STEPS, 8, 2)
    z = jr.normal(key, b.noise_shape)
    path, found = (np.asarray(a) for a in b.path_and_log_weight(z))
    np.testing.assert_allclose(b.noise_from_path(path), z, atol=1e-9)

    L = np.asarray(match.observation(b.sde, b.x0).operator)
    L = np.diag(np.broadcast_to(L, N)) if L.ndim < 2 else L
    variance = np.broadcast_to(np.asarray(match.variance), N) / W
    rows = L.any(axis=1)
    L, v, D = L[rows], seen(match)[rows], np.diag((np.abs(L) @ variance)[rows])
    sigmas = [np.asarray(b.sde.diffusion(0.0, jnp.asarray(x))) for x in path]
    end = np.asarray(b.sde.diffusion(0.0, b.end()[1]))
    ts = np.asarray(b.ts)
    right = 0.0
    for k in range(NUM_STEPS):
        dt, left = ts[k + 1] - ts[k], ts[-1] - ts[k + 1]
        a = (1 - end_weight) * sigmas[k] @ sigmas[k].T + end_weight * end @ end.T
        A, M, r = np.sqrt(dt) * L @ sigmas[k], D + left * L @ a @ L.T, v - L @ path[k]
        S = M + A @ A.T
        if k == NUM_STEPS - 1:
            right += normal_log_density(r, S)
            break
        u = np.linalg.lstsq(np.sqrt(dt) * sigmas[k], path[k + 1] - path[k], rcond=None)[0]
        law = np.eye(8) - A.T @ np.linalg.solve(S, A)
        right += normal_log_density(u, np.eye(8)) - normal_log_density(
            u - A.T @ np.linalg.solve(S, r), law
        )
    np.testing.assert_allclose(found, right, rtol=1e-9, atol=1e-7)


def test_geodesic_weight_does_not_depend_on_the_algebra(key, monkeypatch):
    """A path has the same weight where the algebra is that of all that is seen."""
    b = bridge(MATCHES["mask"], nb.GeodesicGuide())
    z = jr.normal(key, b.noise_shape)
    path, few = b.path_and_log_weight(z)
    jax.clear_caches()
    monkeypatch.setattr(guides, "are_few", lambda *_: False)
    np.testing.assert_allclose(b.log_weight(b.noise_from_path(path)), few, rtol=1e-9)
    jax.clear_caches()


def test_message_of_few_noises_is_dense(monkeypatch):
    b = bridge(MATCHES["all"], nb.GeodesicGuide(correction=0.5))
    few = b.log_h(0.4, X0), b.score(0.4, X0)
    jax.clear_caches()
    monkeypatch.setattr(guides, "are_few", lambda *_: False)
    np.testing.assert_allclose(b.log_h(0.4, X0), few[0], rtol=1e-9)
    np.testing.assert_allclose(b.score(0.4, X0), few[1], rtol=1e-7, atol=1e-8)
    jax.clear_caches()


def test_all_controls_are_landmark_noise():
    """One mechanism, up to rounding, whatever their order."""
    z = jr.normal(jr.key(0), (NUM_STEPS, N, 2))
    by = [
        bridge(MATCHES["all"], None, noise).log_weight(z)
        for noise in (nb.LandmarkNoise(), nb.ControlNoise(N))
    ]
    np.testing.assert_allclose(*by, rtol=1e-9)


def test_evidence_is_that_of_all_landmarks():
    """Within 3 joint standard errors, where what is missing, a(x, x)/10⁵, is little beside the
    errors, a(x, x)/80.
    """
    found = []
    for noise in (nb.LandmarkNoise(), nb.ControlNoise.within(1e-5, X0, KERNEL)):
        b = nb.GuidedBridge(flow(noise), MATCHES["all"].at(V), x0=X0, t1=1.0, num_steps=15)
        z = jr.normal(jr.key(1), (600, *b.noise_shape))
        w = jax.jit(jax.vmap(b.log_weight))(z)
        found.append(
            (
                logsumexp(w) - np.log(600),
                np.std(np.exp(w - np.max(w))) / np.mean(np.exp(w - np.max(w))),
            )
        )
    assert b.noise_shape[1] <= N / 2
    (all_landmarks, spread), (control, other) = found
    assert abs(all_landmarks - control) < 3 * np.hypot(spread, other) / np.sqrt(600)
    assert np.hypot(spread, other) / np.sqrt(600) < 0.1


def test_missing_variance():
    """1 − |σ_i|²/a(x, x) of a Gaussian field given its values at the controls, in NumPy; of the
    worst of two states.
    """
    c = np.array([0, 5, 11, 17])
    path = np.stack([X0, V])
    sde = flow(nb.ControlNoise(points=c))
    gap = np.sum((path[:, :, None] - path[:, None]) ** 2, -1)
    K = np.exp(-gap / (4 * 0.9**2))
    told = np.stack([np.diag(k[:, c] @ np.linalg.solve(k[np.ix_(c, c)], k[c])) for k in K])
    with pytest.warns(UserWarning, match="missing"):
        np.testing.assert_allclose(sde.noise_error(path)["missing"], np.max(1 - told), rtol=1e-6)
    few = nb.ControlNoise.within(1e-3, X0, KERNEL)
    m = len(few.points)
    assert float(flow(few).noise_error(X0)["missing"]) <= 1e-3
    assert float(flow(nb.ControlNoise(m - 1)).noise_error(X0)["missing"]) > 1e-3


def test_controls_are_apart_and_known_by_the_start():
    """Far points in turn: of four clusters one of each; chosen in a traced program too, and not
    moved by a path.
    """
    clusters = np.array([[0, 0], [4, 0], [0, 4], [4, 4.0]])
    x = (clusters[:, None] + 0.1 * np.random.default_rng(0).normal(size=(4, 3, 2))).reshape(12, 2)
    sde = flow(nb.ControlNoise(4), n=12, kernel=nb.GaussianKernel(0.3, 4.0))
    chosen = sde.closed(0.0, jnp.asarray(x)).noise_field.points
    np.testing.assert_array_equal(np.asarray(chosen) // 3, np.arange(4))
    traced = jax.jit(lambda x: sde.closed(0.0, x).noise_field.points)(x)
    np.testing.assert_array_equal(traced, chosen)


def test_default_noise():
    """All landmarks up to 64, controls of more; half of the variance missing is seen, not computed
    with.
    """
    assert isinstance(flow(None).noise_field, nb.LandmarkNoise)
    assert isinstance(flow(None, n=65).noise_field, nb.ControlNoise)
    s = np.linspace(0, 2 * np.pi, 80, endpoint=False)
    x = np.stack([np.cos(s), np.sin(s)], 1)

    def weight(length_scale):
        sde = nb.KunitaFlow(
            nb.Landmarks(80, 2), nb.GaussianKernel(0.3, length_scale), noise=nb.ControlNoise(16)
        )
        return nb.GuidedBridge(sde, MATCHES["all"].at(x), x0=x, t1=1.0, num_steps=3).log_weight(
            jnp.zeros((3, 16, 2))
        )

    values = jax.jit(jax.vmap(weight))(jnp.array([0.5, 0.05]))
    assert np.isfinite(values[0]) and np.isnan(values[1])


@pytest.mark.parametrize(
    "wrong, message",
    [
        (lambda: nb.ControlNoise(0), "`num_points` must be .*got 0"),
        (lambda: nb.ControlNoise(3, points=[0, 1]), "`num_points` or `points`, not both"),
        (lambda: nb.ControlNoise(points=[0, 0, 2]), "`points` must be different indices"),
        (lambda: nb.ControlNoise(points=[-1, 2]), "`points` must be different indices"),
        (
            lambda: bridge(MATCHES["all"], None, nb.ControlNoise(N + 1)),
            "`num_points` of `ControlNoise` .*24; got 25",
        ),
        (
            lambda: bridge(MATCHES["all"], None, nb.ControlNoise(points=[2, N])),
            "`points` .*below 24; got 24",
        ),
        (
            lambda: bridge(MATCHES["all"], None, nb.ControlNoise(3)),
            "`x0` does not fit the noise.*`ControlNoise",
        ),
        (
            lambda: nb.ControlNoise.within(1e-6, X0, SHORT, max_points=5),
            "`tolerance` must be .*5 controls",
        ),
        (lambda: nb.ControlNoise.within(2.0, X0, KERNEL), "`tolerance` must be between 0 and 1"),
        (lambda: nb.ControlNoise.within(1e-3, X0), "either `kernel` or `covariance`"),
        (
            lambda: nb.KunitaFlow(nb.FourierBasis(2, 2), KERNEL, noise="control"),
            '`noise="control"`.*`FourierBasis`',
        ),
        (
            lambda: nb.GuidedBridge(
                flow(nb.ControlNoise(points=[1, 2])),
                MATCHES["all"].at(V),
                x0=DOUBLE,
                t1=1.0,
                num_steps=2,
            ),
            "`x0` must have distinct landmarks; 1 and 2 coincide",
        ),
    ],
)
def test_bad_controls(wrong, message):
    with pytest.raises(ValueError, match=message):
        wrong()


# Trees.


def test_what_is_told_of_a_node_by_few_noises():
    """In noise coordinates, x = σ α: the pruning of standard Brownian motion, by NumPy, with masks
    and own errors.
    """
    rng = np.random.default_rng(0)
    sigma, times = rng.normal(size=(9, 3)), (0.4, 0.7)
    masks, variances = (np.arange(9) != 2, np.arange(9) < 7), (0.1, 0.3)
    data = rng.normal(size=(2, 9, 2))
    part = told.Part.of(jnp.asarray(sigma), jnp.asarray(sigma @ sigma.T))
    H, f, at_node = 0.0, 0.0, []
    for v, t, mask, variance in zip(data, times, masks, variances, strict=True):
        seen = nb.InexactMatch(variance, mask=mask).observation(
            nb.BrownianMotion(1.0), jnp.asarray(v)
        )
        at_node.append(
            told.told_by(
                part.seen(seen), mask[:, None] * v, jnp.asarray(t), part.a, part.of_state(v)
            )
        )
        S = variance * np.eye(mask.sum()) + t * sigma[mask] @ sigma[mask].T
        H = H + sigma[mask].T @ np.linalg.solve(S, sigma[mask])
        f = f + sigma[mask].T @ np.linalg.solve(S, v[mask])
    total = jax.tree.map(lambda a, b: a + b, *at_node)
    before = told.earlier(total, jnp.asarray(0.5), part.a)
    for message, along in ((total, np.eye(3)), (before, np.linalg.inv(np.eye(3) + 0.5 * H))):
        found = part.message(message.information)
        np.testing.assert_allclose(sigma.T @ found.H @ sigma, along @ H, rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(sigma.T @ found.F, along @ f, rtol=1e-8, atol=1e-8)
    seen, value, kappa, reference = told.as_seen(total, part.a, True)
    known, R = part.known(seen), np.asarray(part.basis) @ sigma
    S = np.asarray(seen.factor) @ np.asarray(seen.factor).T + kappa * R @ R.T
    assert kappa > 0 and known.operator.shape == (3, 9)
    np.testing.assert_allclose(R.T @ np.linalg.solve(S, R), H, rtol=1e-7)
    np.testing.assert_allclose(
        np.asarray(known.operator) @ part.lifted(reference), value, rtol=1e-9
    )


def test_tree_of_few_noises(key):
    """Small displacements are nearly linear: messages that lose nothing leave the weight no spread."""
    tree = nb.Tree.from_newick("((a:.4,b:.5):.5,c:.6);")
    small = flow(nb.ControlNoise(8), kernel=nb.GaussianKernel(0.01, 0.9))
    law = nb.DiffusionTree(small, X0, nb.InexactMatch(3e-6, mask=SEEN), tree=tree, num_steps=2)
    data = X0 + jnp.array([1.0, 0.5, -0.7])[:, None, None] * (V - X0) / 30
    z = jr.normal(key, (100, *law.noise_prior().shape()))

    @jax.jit
    def weights(z):
        problem = _problem(law.parts, data)
        return jax.vmap(problem.log_weight)(z), problem.noise_from_paths(problem.paths(z[0]), key)

    log_weights, back = weights(z)
    np.testing.assert_allclose(back, z[0], atol=1e-7)
    assert np.std(log_weights) < 0.2


@pytest.mark.slow  # as of a tree of all noises, which runs always
def test_priors_on_everything_in_both_precisions():
    """Kernel, jitter, errors, lengths, start and guide, on a tree, inside a model under jit:
    float32 within 0.02.
    """
    data = np.stack([V, 0.95 * V, 1.05 * X0])

    def everything(data):
        amplitude = numpyro.sample("amplitude", dist.LogNormal(-1.0, 0.3))
        length_scale = numpyro.sample("length_scale", dist.LogNormal(0.0, 0.3))
        noise = nb.ControlNoise(8, jitter=numpyro.sample("jitter", dist.Uniform(1e-4, 1e-2)))
        variance = numpyro.sample("variance", dist.LogNormal(-3.0, 0.3))
        rates = numpyro.sample("rates", dist.LogNormal(0.0, 0.3).expand([4]).to_event(1))
        start = numpyro.sample("start", dist.Normal(X0, 0.1).to_event(2))
        correction = numpyro.sample("correction", dist.Uniform(0.0, 1.0))
        guide = nb.GeodesicGuide(correction, numpyro.sample("end_weight", dist.Uniform(0.0, 0.5)))
        sde = flow(noise, kernel=nb.GaussianKernel(amplitude, length_scale))
        tree = nb.Tree.from_newick("((a:.4,b:.5):.5,c:.6);").scaled(rates)
        law = nb.DiffusionTree(
            sde, start, nb.InexactMatch(variance), tree=tree, num_steps=2, guide=guide
        )
        nb.sample("tips", law, obs=data)

    values = {
        "amplitude": 0.3,
        "length_scale": 1.2,
        "jitter": 1e-3,
        "variance": 0.05,
        "start": X0 + 0.01,
    }
    values |= {"rates": np.linspace(0.8, 1.2, 4), "correction": 0.6, "end_weight": 0.1}
    values |= {"tips_noise": np.random.default_rng(0).normal(size=(8, 8, 2))}

    def value_and_gradient(dtype):
        sites = {name: jnp.asarray(value, dtype) for name, value in values.items()}
        density = lambda sites: log_density(everything, (data.astype(dtype),), {}, sites)[0]  # noqa: E731
        return jax.jit(jax.value_and_grad(density))(sites)

    double, slopes = value_and_gradient(np.float64)
    with jax.enable_x64(False):
        single, single_slopes = value_and_gradient(np.float32)
    assert single.dtype == np.float32 and abs(single - double) < 0.02
    for name in values:
        largest = np.max(np.abs(slopes[name]))
        assert largest > 0
        np.testing.assert_allclose(
            single_slopes[name], slopes[name], rtol=0, atol=2e-3 * largest, err_msg=name
        )


# Brownian motion of a smooth field: as many noises as it has directions.


def test_a_smooth_covariance_on_many_points(key):
    """256 points, a length scale of 64 of them: singular to the last digit; by SciPy's dense
    normal.
    """
    s = np.linspace(0, 4, 256)
    Q = np.exp(-((s[:, None] - s[None]) ** 2) / 2)
    x0, v = np.sin(s), np.cos(s)
    expected = scipy.stats.multivariate_normal(x0, 0.7 * Q + 0.01 * np.eye(256)).logpdf(v)
    walk = nb.BrownianMotion(Q)
    assert walk.noise_size(jnp.asarray(x0)) < 30
    for sde in (walk, nb.BrownianMotion(factor=walk.factor)):
        bridge = nb.GuidedBridge(sde, nb.InexactMatch(0.01).at(v), x0=x0, t1=0.7, num_steps=3)
        weight = bridge.log_weight(jr.normal(key, bridge.noise_shape))
        np.testing.assert_allclose(weight, expected, rtol=1e-8)
    assert nb.BrownianMotion([1.0, 0.0]).factor is None and nb.BrownianMotion(
        np.ones((3, 3))
    ).factor.shape == (3, 1)


def test_a_factor_may_be_traced():
    """The slope of the log density by the scale of a factor of rank one, against SciPy."""
    F, v = np.array([[1.0], [2.0], [-0.5]]), np.array([0.3, 1.0, 0.2])

    def log_density(scale):
        walk = nb.BrownianMotion(factor=scale * F)
        bridge = nb.GuidedBridge(
            walk, nb.InexactMatch(0.1).at(v), x0=np.zeros(3), t1=1.0, num_steps=2
        )
        return bridge.log_weight(jnp.ones(bridge.noise_shape))

    value, slope = jax.jit(jax.value_and_grad(log_density))(1.3)
    low, middle, high = (
        scipy.stats.multivariate_normal(np.zeros(3), c**2 * F @ F.T + 0.1 * np.eye(3)).logpdf(v)
        for c in (1.3 - 1e-5, 1.3, 1.3 + 1e-5)
    )
    np.testing.assert_allclose(value, middle, rtol=1e-10)
    np.testing.assert_allclose(slope, (high - low) / 2e-5, rtol=1e-6)


# What a path does to other points.


NOISES = {
    "landmark": nb.LandmarkNoise(),
    "control": nb.ControlNoise(8),
    "spectral": nb.SpectralNoise(3, diameter=3.0),
}


def carried(name, num_steps=12):
    sde = flow(NOISES[name])
    z = jr.normal(jr.key(4), (num_steps, sde.noise_size(jnp.asarray(X0)), 2))
    path = nb.simulate(sde, X0, np.linspace(0, 0.5, num_steps + 1), z)
    return sde, path, jnp.asarray(np.random.default_rng(1).uniform(-1.2, 1.2, (7, 2)))


@pytest.mark.parametrize("name", NOISES)
def test_carry(name):
    """The landmarks move as they do; there and back is where one was; the map is smooth and keeps
    its orientation.
    """
    sde, path, points = carried(name)
    np.testing.assert_allclose(sde.carry(path, X0), path, atol=1e-12)
    # beside them the jitter is not
    np.testing.assert_allclose(sde.carry(path, X0 + 1e-7), path, atol=1e-4)
    there = sde.carry(path, points)
    np.testing.assert_allclose(sde.carry(path, there[-1], inverse=True), there, atol=1e-10)
    slopes = jax.jit(jax.vmap(jax.jacfwd(lambda p: sde.carry(path, p[None])[-1, 0])))(points)
    stretched = sde.jacobian(path, points)
    np.testing.assert_allclose(stretched[-1], np.linalg.det(slopes), rtol=1e-6)
    assert (
        np.all(stretched[0] == 1)
        and np.all(stretched > 0)
        and np.max(np.abs(there[-1] - points)) > 0.05
    )
    step = 1e-5
    moved = sde.carry(path, points + np.array([step, 0.0]))[-1]
    np.testing.assert_allclose((moved - there[-1]) / step, slopes[..., 0], rtol=2e-3, atol=2e-3)


def test_carry_is_kriging():
    """One step, in NumPy: a(p, c) a(c, c)⁻¹ Δc."""
    sde, path, points = carried("control", num_steps=1)
    index = np.asarray(sde.closed(0.0, jnp.asarray(X0)).noise_field.points)
    c = path[0][index]

    def a(p, q):
        return np.exp(
            -np.sum((np.asarray(p)[:, None] - np.asarray(q)[None]) ** 2, -1) / (4 * 0.9**2)
        )

    move = a(points, c) @ np.linalg.solve(a(c, c), np.asarray(path[1] - path[0])[index])
    np.testing.assert_allclose(sde.carry(path, points)[-1], points + move, atol=1e-6)


@pytest.mark.parametrize(
    "wrong, message",
    [
        (
            lambda: flow(None).carry(X0, X0),
            r"`path` must have shape \(K \+ 1, 24, 2\); got \(24, 2\)",
        ),
        (lambda: flow(None).carry(np.stack([X0, V]), X0[0]), r"`points` must have shape \(q, 2\)"),
        (lambda: flow(None).carry(np.stack([X0, V]), X0, inverse=1), "`inverse` must be"),
    ],
)
def test_bad_carry(wrong, message):
    with pytest.raises(ValueError, match=message):
        wrong()
