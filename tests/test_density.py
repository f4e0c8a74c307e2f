"""Conditions by their density: normal ones against `InexactMatch`, others against quadrature, SciPy
and NumPy.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
import scipy.integrate
import scipy.spatial
import scipy.stats

import numpyro_bridges as nb
from numpyro_bridges.conditioning._density import positive_part

pytestmark = [pytest.mark.numpyro, pytest.mark.usefixtures("compile_quickly")]


def close(found, truth, atol):
    np.testing.assert_allclose(found, truth, rtol=0, atol=atol)


LINEAR = nb.LinearSDE(-0.5, 0.7)
BROWNIAN = nb.BrownianMotion(0.5)
VECTOR = np.array([0.3, -0.2])
POINTS = np.array([[0.3, -0.2], [0.1, 0.4]])
TREE = nb.Tree.from_newick("((a:1,b:1)c:0.5,d:2)r;").observing(["a", "b", "c", "d"])


def normal(x, observed, args):
    return -0.5 * jnp.sum((x - observed) ** 2) / args - 0.5 * x.size * jnp.log(2 * jnp.pi * args)


def with_error(key, x, args):
    return x + jnp.sqrt(args) * jr.normal(key, x.shape, x.dtype)


# A normal density is an inexact match: every noise, path and score.


@pytest.mark.parametrize("x0", [VECTOR, POINTS], ids=["vector", "points"])
def test_a_normal_density_is_an_inexact_match(x0, key):
    v = x0 + 0.8
    matches = nb.DensityMatch(normal, 0.1, sample=with_error), nb.InexactMatch(0.1)
    bridges = [nb.GuidedBridge(LINEAR, m.at(v), x0=x0, t1=1.0, num_steps=4) for m in matches]
    found, truth = bridges
    z = jr.normal(key, truth.noise_shape)
    path, log_weight = found.path_and_log_weight(z)
    close(log_weight, truth.log_weight(z), 1e-10)
    close(path, truth.path(z), 1e-10)
    close(found.score(0.3, x0), truth.score(0.3, x0), 1e-10)
    close(found.scores(path), truth.scores(path), 1e-10)
    close(found.log_h(0.3, x0), truth.log_h(0.3, x0), 1e-10)
    close(found.noise_from_path(path), z, 1e-10)
    close(found.path(found.with_guide(nb.FrozenGuide()).noise_from_path(path)), path, 1e-10)


def endpoint(match):
    return nb.DiffusionEndpoint(LINEAR, VECTOR, match, t1=1.0, num_steps=3)


def along_a_tree(match):
    return nb.DiffusionTree(LINEAR, POINTS, match, tree=TREE, num_steps=2, root_covariance=0.3)


@pytest.mark.parametrize("make", [endpoint, along_a_tree])
def test_laws_of_a_normal_density(make, key):
    """Density, paths, nodes and terms by node; and data with their noise."""
    matches = nb.DensityMatch(normal, 0.1, sample=with_error), nb.InexactMatch(0.1)
    found, truth = map(make, matches)
    v = np.random.default_rng(0).normal(size=truth.event_shape)
    z = jr.normal(key, truth.noise_prior().event_shape)

    @jax.jit
    def told(law, key):
        bound = law.given(z)
        values = [bound.log_prob(v), bound.path(v)]
        if isinstance(law, nb.DiffusionTree):
            values += [bound.nodes(v), bound.log_prob_by_node(v)]
        seen, noise = law.sample_with_noise(key)
        return [*values, seen, noise, law.given(noise).log_prob(seen)]

    jax.tree.map(lambda a, b: close(a, b, 1e-9), told(found, key), told(truth, key))


# Any other: evidence by quadrature.


def product_of_columns(x, v, args):
    """One number of both columns, and a normal factor."""
    return -0.5 * jnp.sum((x[:, 0] * x[:, 1] - v) ** 2) / args - jnp.sum((x - 1) ** 2)


EVIDENCES = {
    "student": (nb.StudentMatch(0.25, 3.0), [1.5], [0.0]),
    "huber": (nb.HuberMatch(0.09, 1.3), [1.5], [0.0]),
    "product of columns": (nb.DensityMatch(product_of_columns, 0.1), [1.0], [[0.5, 0.2]]),
}


@pytest.mark.parametrize("name", EVIDENCES)
def test_evidence_is_that_of_quadrature(name):
    """Within 4 standard errors, each below 0.02: 6 % would be seen, and tails that are not reached."""
    match, v, x0 = EVIDENCES[name]
    v, x0 = np.array(v), np.array(x0)
    bridge = nb.GuidedBridge(BROWNIAN, match.at(v), x0=x0, t1=1.0, num_steps=3)
    found = nb.estimate_evidence(bridge, jr.key(0), 8000)
    axis = np.linspace(-7, 7, 4001 if x0.size == 1 else 601)
    grid = np.stack(np.meshgrid(*[axis] * x0.size, indexing="ij"), -1).reshape(-1, *x0.shape)
    log_psi = jax.vmap(lambda x: match.log_density(BROWNIAN, x, jnp.asarray(v)))(grid)
    log_prior = np.sum(
        scipy.stats.norm.logpdf(grid - x0, scale=np.sqrt(0.5)), axis=tuple(range(1, grid.ndim))
    )
    truth = scipy.special.logsumexp(log_psi + log_prior) + x0.size * np.log(axis[1] - axis[0])
    assert found.standard_error < 0.02
    assert nb.weights.pareto_k(found.log_weights) < 0.7
    assert abs(found.log_evidence - truth) < 4 * found.standard_error


def test_a_path_of_heavy_tails_has_a_noise(key):
    """Whatever factor is drawn; and that by its law given the path: joint draws against weighed
    independent ones.
    """
    match, x0 = nb.StudentMatch(0.05, 3.0), np.zeros(1)
    law = nb.DiffusionEndpoint(BROWNIAN, x0, match, t1=1.0, num_steps=2)
    bridge = nb.GuidedBridge(BROWNIAN, match.at([1.2]), x0=x0, t1=1.0, num_steps=2)
    path = bridge.path(jr.normal(key, bridge.noise_shape))
    close(bridge.path(bridge.noise_from_path(path)), path, 1e-10)
    close(bridge.path(bridge.noise_from_path(path, key)), path, 1e-10)

    seen, noise = law.sample_with_noise(jr.key(0), (20_000,))
    proposal = dist.StudentT(3.0, 0.0, 1.0)
    key_value, key_noise = jr.split(jr.key(1))
    value = proposal.sample(key_value, (20_000, 1))
    other = jr.normal(key_noise, noise.shape)
    log_weight = jax.jit(jax.vmap(lambda v, z: law.given(z).log_prob(v)))(value, other)
    weight = jnp.exp(log_weight - proposal.log_prob(value)[:, 0])
    for far in (0.0, 1.5):  # all data, and those for which the factor matters
        drawn = noise[:, 0, 0, 0] * (jnp.abs(seen[:, 0]) > far)
        weighed = weight * other[:, 0, 0, 0] * (jnp.abs(value[:, 0]) > far)
        errors = jnp.std(drawn) / np.sqrt(20_000), jnp.std(weighed) / np.sqrt(20_000)
        assert np.hypot(*errors) < 0.03
        assert abs(jnp.mean(drawn) - jnp.mean(weighed)) < 4 * np.hypot(*errors)
    assert abs(jnp.mean(drawn)) > 0.03  # not by 0 on both sides


def test_a_tilt_has_no_curvature():
    """ψ = exp(a · x), of which the Gaussian that guides is nearly flat: log E exp(a · X) = a · m +
    ½ aᵀ C a.
    """
    a = np.array([0.7, -1.2])
    match = nb.DensityMatch(lambda x, v, args: jnp.sum(args * x), a)
    bridge = nb.GuidedBridge(BROWNIAN, match.at(0.0), x0=VECTOR, t1=1.0, num_steps=3)
    found = nb.estimate_evidence(bridge, jr.key(0), 2000)
    assert found.standard_error < 1e-3 and nb.weights.pareto_k(found.log_weights) < 0.7
    assert abs(found.log_evidence - (a @ VECTOR + 0.25 * a @ a)) < 4 * found.standard_error


def test_a_module_is_a_function():
    """Its arrays are parameters."""

    class Tilt(eqx.Module):
        a: jax.Array

        def __call__(self, x, observed, args):
            return -0.5 * jnp.sum((x - observed - self.a) ** 2)

    def log_weight(a):
        bridge = nb.GuidedBridge(
            BROWNIAN, nb.DensityMatch(Tilt(a)).at(VECTOR), x0=VECTOR, t1=1.0, num_steps=2
        )
        return bridge.log_weight(np.zeros(bridge.noise_shape))

    value, slope = jax.jit(jax.value_and_grad(log_weight))(0.5)
    close(value, -0.5 * 2 * 0.25 / 1.5 - np.log(1.5), 1e-9)
    close(slope, -2 * 0.5 / 1.5, 1e-9)


# Densities.


def test_student_is_that_of_scipy():
    x, v = POINTS, POINTS + np.array([[0.3, -0.5], [0.1, 0.9]])
    space = nb.Landmarks(2, 2, [0.3, 0.8])
    scale = np.diag(np.repeat(0.04 / np.array([0.3, 0.8]), 2))
    truth = scipy.stats.multivariate_t(x.ravel(), scale, 4.0).logpdf(v.ravel())
    match = nb.StudentMatch(0.04, 4.0)
    close(
        match.log_density(nb.LinearSDE(0.0, 1.0, space=space), jnp.asarray(x), jnp.asarray(v)),
        truth,
        1e-12,
    )
    law = nb.DiffusionEndpoint(nb.BrownianMotion(1e-12), POINTS, match, t1=1.0, num_steps=1)
    draws = np.asarray(law.sample(jr.key(0), (20_000,))) - POINTS
    distance = np.sqrt(np.sum(draws**2, (1, 2)) / (4 * 0.04))  # √F(4, 4)
    assert scipy.stats.kstest(distance**2, scipy.stats.f(4, 4.0).cdf).pvalue > 1e-4


@pytest.mark.parametrize("size", [1, 2])
def test_huber_has_mass_one(size):
    match = nb.HuberMatch(0.04, 1.3)
    axis = np.linspace(-5, 5, 4001 if size == 1 else 801)
    grid = jnp.asarray(np.stack(np.meshgrid(*[axis] * size, indexing="ij"), -1).reshape(-1, size))
    density = jnp.exp(jax.vmap(lambda v: match.log_density(BROWNIAN, jnp.zeros(size), v))(grid))
    close(jnp.sum(density) * (axis[1] - axis[0]) ** size, 1.0, 1e-6)


@pytest.mark.parametrize("dim", [2, 3])
def test_procrustes_is_that_of_scipy(dim):
    """Where the best map is no reflection; and the motions that cost nothing."""
    rng = np.random.default_rng(dim)
    x = rng.normal(size=(6, dim))
    v = x + 0.1 * rng.normal(size=(6, dim))
    turn = scipy.spatial.transform.Rotation.from_rotvec([0.0, 0.0, 0.7]).as_matrix()[:dim, :dim]

    def log_density(up_to, v):
        return float(
            nb.ProcrustesMatch(0.01, up_to).log_density(BROWNIAN, jnp.asarray(x), jnp.asarray(v))
        )

    *_, disparity = scipy.spatial.procrustes(x, v)
    close(
        log_density("similarity", v), -0.5 * disparity * np.sum((x - x.mean(0)) ** 2) / 0.01, 1e-9
    )
    moved = {"translation": x + 1.0, "rigid": x @ turn + 1.0, "similarity": 2 * x @ turn + 1.0}
    free = [[log_density(up_to, shape) for shape in moved.values()] for up_to in moved]
    close(np.tril(free), np.zeros((3, 3)), 1e-9)
    assert np.max(np.triu(free, 1)[np.triu_indices(3, 1)]) < -1
    flip = np.where(np.arange(dim) == 0, -1.0, 1.0)
    assert log_density("similarity", x * flip) < -1


# Curves.

SCALES = {"length_scale": 0.4, "angle_scale": 0.8}


def inner_by_loops(x, y, closed):
    """⟨μ, ν⟩ of oriented varifolds and of currents, a pair of edges at a time."""

    def edges(points):
        ends = np.roll(points, -1, axis=0) if closed else points[1:]
        starts = points if closed else points[:-1]
        return [(0.5 * (a + b), b - a) for a, b in zip(starts, ends, strict=True)]

    varifold, current = 0.0, 0.0
    for c, e in edges(x):
        for d, f in edges(y):
            near = np.exp(-np.sum((c - d) ** 2) / SCALES["length_scale"] ** 2)
            lengths = np.linalg.norm(e), np.linalg.norm(f)
            apart = np.sum((e / lengths[0] - f / lengths[1]) ** 2)
            varifold += near * np.exp(-apart / SCALES["angle_scale"] ** 2) * lengths[0] * lengths[1]
            current += near * np.dot(e, f)
    return varifold, current


@pytest.mark.parametrize("closed, dim", [(True, 2), (False, 3)])
def test_distances_of_curves(closed, dim, key):
    """Values and slopes against double sums in NumPy, of curves with other numbers of points."""
    x, y = (np.asarray(jr.normal(k, (n, dim))) for k, n in zip(jr.split(key), (5, 7), strict=True))
    matches = (
        nb.VarifoldMatch(0.3, **SCALES, closed_curve=closed),
        nb.CurrentMatch(0.3, 0.4, closed_curve=closed),
    )
    for which, match in enumerate(matches):

        def log_density(x, which=which):
            own, mixed, other = (
                inner_by_loops(*pair, closed)[which] for pair in ((x, x), (x, y), (y, y))
            )
            return -0.5 * (own - 2 * mixed + other) / 0.3

        value, slope = jax.value_and_grad(
            lambda x, m=match: m.log_density(BROWNIAN, x, jnp.asarray(y))
        )(jnp.asarray(x))
        close(value, log_density(x), 1e-10)
        steps = 1e-5 * np.eye(x.size).reshape(-1, *x.shape)
        differences = [(log_density(x + step) - log_density(x - step)) / 2e-5 for step in steps]
        close(np.ravel(slope), differences, 1e-7)


def test_curves_do_not_depend_on_their_points():
    """Resampled, begun elsewhere, and with points that are not evenly spread: within 1 % at 64
    points.
    """
    match = nb.VarifoldMatch(0.01, 0.3)

    def ellipse(count, start=0.0, uneven=0.0, width=1.0):
        s = start + np.linspace(0, 2 * np.pi, count, endpoint=False)
        s = s + uneven * np.sin(s)
        return jnp.asarray(np.stack([width * np.cos(s), 0.6 * np.sin(s)], 1))

    truth = match.squared_distance(ellipse(1000), ellipse(1000, width=1.2))
    for count in (64, 100):
        for changed in ({"start": 1.1}, {"uneven": 0.4}):
            x, y = ellipse(count, **changed), ellipse(count + 17, width=1.2)
            np.testing.assert_allclose(match.squared_distance(x, y), truth, rtol=0.01)
            assert match.squared_distance(x, ellipse(count)) < 0.01 * truth


def test_precision_of_curves_is_the_curvature_where_they_meet(key):
    """By Gauss and Newton: the Hessian itself at the datum, and nowhere negative."""
    x = jnp.asarray(nb.datasets.ellipses(8).points[0])
    for match in (nb.VarifoldMatch(0.1, **SCALES), nb.CurrentMatch(0.1, 0.4)):
        hessian = jax.hessian(lambda y, m=match: m.log_density(BROWNIAN, y.reshape(x.shape), x))(
            x.reshape(-1)
        )
        close(match.precision(BROWNIAN, x, x), -hessian, 1e-9)
        away = x + 0.1 * jr.normal(key, x.shape)
        assert np.min(np.linalg.eigvalsh(match.precision(BROWNIAN, away, x))) > -1e-9


def test_outlines_without_correspondence():
    """Of a flow, led to a curve of other points: as paths that nothing leads have it."""
    wings = nb.datasets.ellipses(6, aspects=(1.0, 1.3)).points
    finer = nb.datasets.ellipses(9, aspects=(1.0, 1.3)).points
    flow = nb.KunitaFlow(nb.Landmarks(6, 2), nb.GaussianKernel(0.1, 0.8))
    condition = nb.VarifoldMatch(0.02, 1.0).at(finer[1])
    bridge = nb.GuidedBridge(flow, condition, x0=wings[0], t1=1.0, num_steps=4)
    found = nb.estimate_evidence(bridge, jr.key(0), 4000)
    free = nb.estimate_evidence(bridge.with_guide(nb.Unguided()), jr.key(1), 20_000)
    assert found.standard_error < 0.08 and free.standard_error < 0.05
    assert abs(found.log_evidence - free.log_evidence) < 4 * np.hypot(
        found.standard_error, free.standard_error
    )
    assert nb.weights.pareto_k(found.log_weights) < 0.7


# The door of a user.


def test_parameters_of_a_density_have_priors():
    """In a model under jit, of an endpoint: density and slope those of the inexact match, in both
    precisions.
    """

    def model(match, v):
        sd = numpyro.sample("sd", dist.LogNormal(-1.0, 0.5))
        rate = numpyro.sample("rate", dist.LogNormal(0.0, 0.5))
        law = nb.DiffusionEndpoint(
            nb.LinearSDE(-rate, 0.7), VECTOR, match(sd**2), t1=1.0, num_steps=3
        )
        nb.sample("v", law, obs=v)

    def log_joint(match, sd, rate, z):
        values = {"sd": sd, "rate": rate, "v_noise": z}
        return numpyro.infer.util.log_density(model, (match, VECTOR + 0.5), {}, values)[0]

    z = np.random.default_rng(0).normal(size=(3, 2, 1))

    def of(match):
        return jax.jit(jax.value_and_grad(lambda sd, rate: log_joint(match, sd, rate, z), (0, 1)))

    truth = of(nb.InexactMatch)(0.4, 0.9)
    by_density = of(lambda variance: nb.DensityMatch(normal, variance))
    jax.tree.map(lambda a, b: close(a, b, 1e-9), by_density(0.4, 0.9), truth)
    z = z.astype(np.float32)
    with jax.enable_x64(False):
        single = of(lambda variance: nb.DensityMatch(normal, variance))(
            np.float32(0.4), np.float32(0.9)
        )
    jax.tree.map(lambda a, b: close(a, b, 2e-3), single, truth)


def test_a_function_is_held_as_it_is():
    """What it reads is frozen when a bridge or a law is made, and seen anew by the next."""
    setting = {"center": 0.5}

    def log_density(x, observed, args):
        return -jnp.sum((x - observed - setting["center"]) ** 2)

    def made():
        match = nb.DensityMatch(log_density)
        bridge = nb.GuidedBridge(BROWNIAN, match.at(VECTOR), x0=VECTOR, t1=1.0, num_steps=2)
        law = nb.DiffusionEndpoint(BROWNIAN, VECTOR, match, t1=1.0, num_steps=2)
        return bridge, law.given(np.zeros((2, 2, 1)))

    def values(bridge, law):
        return float(bridge.log_weight(np.zeros((2, 2, 1)))), float(law.log_prob(VECTOR))

    first = made()
    before = values(*first)
    setting["center"] = 1.5
    assert values(*first) == before
    after = values(*made())
    # two columns of (1 + 2 · 0.5)^{-1/2} exp(−c²/2)
    truth = [-(c**2) - np.log(2.0) for c in (0.5, 1.5)]
    close(np.array([before, after]), np.repeat(truth, 2).reshape(2, 2), 1e-9)


def test_slope_of_the_positive_part(key):
    """Where eigenvalues coincide, are of both signs, and are 0."""
    rotation, _ = np.linalg.qr(np.asarray(jr.normal(key, (5, 5))))
    S = (rotation * [2.0, 2.0, 0.7, -1.0, -1.0]) @ rotation.T
    close(positive_part(jnp.asarray(S)), (rotation * [2.0, 2.0, 0.7, 0.0, 0.0]) @ rotation.T, 1e-12)
    change = np.asarray(jr.normal(jr.fold_in(key, 1), (5, 5)))
    change = change + change.T
    _, slope = jax.jvp(positive_part, (jnp.asarray(S),), (jnp.asarray(change),))
    difference = (positive_part(S + 1e-6 * change) - positive_part(S - 1e-6 * change)) / 2e-6
    close(slope, difference, 1e-7)


SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


def bridge_to(match, v=VECTOR, x0=VECTOR):
    return nb.GuidedBridge(BROWNIAN, match.at(v), x0=x0, t1=1.0, num_steps=2)


ERRORS = {
    "`log_density` must return one number; got shape \\(2,\\)": lambda: bridge_to(
        nb.DensityMatch(lambda x, v, a: x)
    ),
    "`log_density` must be finite and smooth; the log density is nan": lambda: bridge_to(
        nb.DensityMatch(lambda x, v, a: jnp.log(-1.0 - jnp.sum(x**2)))
    ),
    "`log_density` must be finite and smooth; the slope": lambda: bridge_to(
        nb.DensityMatch(lambda x, v, a: -jnp.sum(jnp.sqrt(jnp.abs(x - VECTOR))))
    ),
    "`observed` must hold the points of a curve": lambda: nb.VarifoldMatch(0.1, 0.5).at(VECTOR),
    "points \\[2\\] are repeated by the next one": lambda: nb.CurrentMatch(0.1, 0.5).at(
        SQUARE[[0, 1, 2, 2]]
    ),
    "points \\[4\\] are repeated": lambda: nb.VarifoldMatch(0.1, 0.5).at(SQUARE[[0, 1, 2, 3, 0]]),
    "`observed` must be shaped like a state": lambda: bridge_to(
        nb.StudentMatch(0.1, 3.0), np.ones(3)
    ),
    "`x0` must hold points in the plane or in space": lambda: bridge_to(nb.ProcrustesMatch(0.1)),
    "got a state \\(5, 2\\) of FourierBasis": lambda: nb.ProcrustesMatch(0.1).log_density(
        nb.LinearSDE(0.0, 1.0, space=nb.FourierBasis(2, 2)), jnp.ones((5, 2)), jnp.ones((5, 2))
    ),
    "weighs the end state and is no law": lambda: nb.DiffusionEndpoint(
        BROWNIAN, SQUARE, nb.VarifoldMatch(0.1, 0.5), t1=1.0, num_steps=1
    ).sample(jr.key(0)),
    "`match` must have a Gaussian error where nodes have several rows": lambda: nb.DiffusionTree(
        LINEAR, VECTOR, nb.StudentMatch(0.1, 3.0), tree=TREE.observing(["a", "a", "b"])
    ),
    "cannot be learned": lambda: nb.scores.fit(
        BROWNIAN,
        nb.VarifoldMatch(0.1, 0.5).at(SQUARE),
        x0=SQUARE,
        t1=1.0,
        num_steps=2,
        key=jr.key(0),
    ),
    "`guided_terms` are of the bridge `flat`": lambda: bridge_to(
        nb.VarifoldMatch(0.1, 0.5), SQUARE, SQUARE
    ).guided_terms(np.zeros((2, 4, 2))),
}


@pytest.mark.parametrize("message", ERRORS)
def test_errors(message):
    with pytest.raises(ValueError, match=message):
        ERRORS[message]()
