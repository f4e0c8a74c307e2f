"""Laws on trees: the dense joint normal of linear processes, brute force for nonlinear ones, the
way back to noise.
"""

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro.infer import MCMC, NUTS, Predictive
from numpyro.infer.util import log_density
from scipy import stats
from scipy.linalg import block_diag

import numpyro_bridges as nb
from numpyro_bridges.distributions._tree import _divided, _problem, _simulated
from numpyro_bridges.guiding._score import Standard
from numpyro_bridges.infer import FunctionSpaceHMC
from numpyro_bridges.trees._schedule import schedule

pytestmark = [pytest.mark.numpyro, pytest.mark.usefixtures("compile_quickly")]

Q = np.array([[0.5, 0.1, 0.05], [0.1, 0.4, -0.1], [0.05, -0.1, 0.3]])
X0 = np.array([[0.3, -0.2], [0.9, 0.4], [-0.6, 0.1]])
TEXT = "((a:1,b:1.5)x:2,(c:3,d:.5,(e:1,f:0):.2):0.1,g:2,(u:1):1):.3;"
SEEN = ["a", "b", "c", "d", "e", "f", "g", "x"]  # u is missing, x is an inner node
TREE = nb.Tree.from_newick(TEXT).observing(SEEN)
DATA = np.random.default_rng(0).normal(size=(len(SEEN), 3, 2))


def random_tree(seed, count, zeros=True):
    """Nodes in any order, polytomies, unifurcations, lengths of 0, some inner nodes seen and some
    tips not.
    """
    rng = np.random.default_rng(seed)
    parents = [-1] + [int(rng.integers(max(0, i - 6), i)) for i in range(1, count)]
    lengths = rng.exponential(size=count)
    if zeros:
        lengths = np.where(rng.random(count) < 0.15, 0.0, lengths)
    tips = [i for i in range(1, count) if i not in parents]
    inner = [i for i in range(1, count) if i in parents]
    seen = [i for i in tips if rng.random() < 0.8] + [i for i in inner if rng.random() < 0.2]
    return nb.Tree.from_parents(parents, lengths, [f"n{i}" for i in range(count)], seen or tips)


def shared_times(tree):
    """For each pair of seen nodes the time that their lineages share, by walking up."""

    def lineage(node):
        return [node] if node == 0 else [node, *lineage(tree.parents[node])]

    above = [set(lineage(node)) for node in tree.observed]
    shared = np.zeros((len(above), len(above), tree.num_nodes))
    for i, first in enumerate(above):
        for j, second in enumerate(above):
            shared[i, j, sorted(first & second)] = 1.0
    lengths = jnp.concatenate([jnp.zeros(1), tree.lengths])
    return jnp.asarray(shared) @ lengths


def joint(tree, x0, data, a, noise, rate=None, shift=0.0, root=0.0):
    """Log density of all rows of data by one dense normal: dX = (shift − rate X) dt + √a dW, errors
    of each row.

    `root`: the covariance of the state at the root.
    """
    shared = shared_times(tree)
    depth = jnp.diagonal(shared)
    if rate is None:
        C, decay, drift = shared, jnp.ones_like(depth), shift * depth
    else:
        C = (
            jnp.exp(-rate * (depth[:, None] + depth[None]))
            * jnp.expm1(2 * rate * shared)
            / (2 * rate)
        )
        decay = jnp.exp(-rate * depth)
        drift = shift * -jnp.expm1(-rate * depth) / rate
    mean = decay[:, None, None] * x0 + drift[:, None, None]
    m, n = data.shape[:2]
    covariance = jnp.kron(C, a) + jnp.kron(jnp.outer(decay, decay), root * jnp.ones((n, n)))
    covariance = covariance + jnp.diag(jnp.repeat(jnp.broadcast_to(noise, (m,)), n))
    r = (data - mean).reshape(m * n, -1)
    L = jnp.linalg.cholesky(covariance)
    y = jax.scipy.linalg.solve_triangular(L, r, lower=True)
    return -0.5 * jnp.sum(y * y) - r.shape[1] * (
        jnp.sum(jnp.log(jnp.diagonal(L))) + 0.5 * m * n * jnp.log(2 * jnp.pi)
    )


def brownian(p, tree, **settings):
    match = jax.vmap(nb.InexactMatch)(p["noise"])
    return nb.DiffusionTree(
        nb.BrownianMotion(p["a"]),
        p["x0"],
        match,
        tree=tree.with_lengths(p["lengths"]),
        per_row=("match",),
        **settings,
    )


def ornstein_uhlenbeck(p, tree, **settings):
    match = jax.vmap(nb.InexactMatch)(p["noise"])
    sde = nb.LinearSDE(-p["rate"], jnp.linalg.cholesky(p["a"]), p["shift"])
    return nb.DiffusionTree(
        sde, p["x0"], match, tree=tree.with_lengths(p["lengths"]), per_row=("match",), **settings
    )


LINEAR = {
    "Brownian": (brownian, {}),
    "Ornstein-Uhlenbeck": (ornstein_uhlenbeck, {"rate": 0.7, "shift": 0.4}),
}


def parameters(tree, n, seed, **more):
    rng = np.random.default_rng(seed)
    m = len(tree.observed)
    root = rng.normal(size=(n, n))
    p = {
        "a": root @ root.T + np.eye(n),
        "x0": rng.normal(size=(n, 2)),
        "noise": rng.uniform(0.02, 0.3, m),
    }
    p |= {"lengths": tree.lengths, **more}
    return {name: jnp.asarray(x) for name, x in p.items()}, rng.normal(size=(m, n, 2))


@pytest.mark.parametrize("name", LINEAR)
@pytest.mark.parametrize("count", [2, 6, 60])
def test_linear_processes_have_the_dense_normal(name, count):
    """Value to 1e-8, gradients in every parameter and length to 1e-6, whatever the noise."""
    make, more = LINEAR[name]
    tree = random_tree(count, count)
    p, data = parameters(tree, 2, count, **more)

    def ours(p):
        law = make(p, tree)
        return law.given(jnp.ones(law.noise_prior().shape())).log_prob(data)

    def truth(p):
        own = {key: p[key] for key in more}
        return joint(tree.with_lengths(p["lengths"]), p["x0"], data, p["a"], p["noise"], **own)

    found, slopes = jax.jit(jax.value_and_grad(ours))(p)
    expected, true_slopes = jax.jit(jax.value_and_grad(truth))(p)
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-8)
    symmetric = lambda slopes: slopes | {"a": slopes["a"] + slopes["a"].T}  # noqa: E731
    slopes, true_slopes = symmetric(slopes), symmetric(true_slopes)
    for key in p:
        size = 1 + np.max(np.abs(true_slopes[key]))
        np.testing.assert_allclose(
            slopes[key], true_slopes[key], rtol=1e-6, atol=1e-6 * size, err_msg=key
        )


class Still(nb.KunitaFlow):
    """A flow whose field does not move with its landmarks, unknown to the library: its covariance
    is that at X0.
    """

    def noise(self, t, x):
        return super().noise(t, jnp.asarray(X0) + 0 * x)


@pytest.mark.parametrize(
    "guide", [nb.RecedingGuide(), nb.GeodesicGuide()], ids=["receding", "geodesic"]
)
@pytest.mark.parametrize("seen", ["all", "some", "exact"])
def test_what_follows_is_the_message_of_a_constant_covariance(seen, guide):
    """Every log weight is the dense normal's; to 1e-8, or 1e-5 where points are missing, for
    rounding's sake.
    """
    tree = random_tree(5, 14, zeros=seen != "exact")
    tips = [tree.names[tip] for tip in tree.tips]
    tree = tree.observing(tips if seen == "exact" else ["n13", "n12", "n11", "n10", "n9", "n4"])
    m = len(tree.observed)
    rng = np.random.default_rng(1)
    data, errors, mask = (
        rng.normal(size=(m, 3, 2)),
        rng.uniform(0.02, 0.3, m),
        rng.random((m, 3)) < 0.7,
    )
    flow = Still(nb.Landmarks(3, 2, weights=1.0), nb.GaussianKernel(0.7, 0.6))
    a = flow.covariance(0.0, X0)
    match, rows = jax.vmap(nb.InexactMatch)(errors), np.ones((m, 3), bool)
    if seen == "some":
        match, rows = (
            jax.vmap(lambda error, mask: nb.InexactMatch(error, mask=mask))(errors, mask),
            mask,
        )
    if seen == "exact":
        law = nb.DiffusionTree(flow, X0, nb.ExactMatch(), tree=tree, num_steps=3, guide=guide)
        errors = np.zeros(m)
    else:
        law = nb.DiffusionTree(
            flow, X0, match, tree=tree, num_steps=3, guide=guide, per_row=("match",)
        )
    z = jr.normal(jr.key(0), (3, *law.noise_prior().shape()))
    found = jax.jit(jax.vmap(lambda z: law.given(z).log_prob(data)))(z)

    covariance = np.kron(shared_times(tree), a) + np.diag(np.repeat(errors, 3))
    kept = rows.ravel()
    normal = stats.multivariate_normal(None, covariance[np.ix_(kept, kept)])
    truth = sum(normal.logpdf((data - X0)[..., j].ravel()[kept]) for j in range(2))
    tolerance = 1e-5 if seen == "some" else 1e-8
    np.testing.assert_allclose(found, truth, rtol=tolerance, atol=tolerance)


def test_a_thousand_tips():
    """Beside a pruning that is written here for one number per tip."""
    tree = random_tree(3, 2600, zeros=False)
    p, data = parameters(tree, 1, 3)
    law = brownian(p, tree)
    found = jax.jit(lambda law: law.given(jnp.zeros(law.noise_prior().shape())).log_prob(data))(law)

    lengths, a = np.concatenate([[0.0], tree.lengths]), float(p["a"][0, 0])
    precision, pull, log_scale = np.zeros(tree.num_nodes), np.zeros((tree.num_nodes, 2)), 0.0
    row = {node: i for i, node in enumerate(tree.observed)}
    for node in reversed(range(1, tree.num_nodes)):
        h, f = precision[node], pull[node]
        if node in row:
            s = float(p["noise"][row[node]])
            h, f = h + 1 / s, f + data[row[node], 0] / s
            log_scale -= np.log(2 * np.pi * s) + 0.5 * np.sum(data[row[node], 0] ** 2) / s
        if h == 0:
            continue
        t = lengths[node] * a
        log_scale += 0.5 * np.sum(f**2) * t / (1 + h * t) - np.log(1 + h * t)
        precision[tree.parents[node]] += h / (1 + h * t)
        pull[tree.parents[node]] += f / (1 + h * t)
    x0 = np.asarray(p["x0"])[0]
    truth = log_scale + pull[0] @ x0 - 0.5 * precision[0] * np.sum(x0**2)
    assert len(tree.observed) > 1000
    np.testing.assert_allclose(found, truth, rtol=1e-9)


@pytest.mark.parametrize(
    "guide", [nb.FrozenGuide(nb.LinearSDE(-0.7, np.linalg.cholesky(Q), 0.4)), nb.RecedingGuide()]
)
def test_paths_of_a_linear_process_have_one_weight(guide, key):
    """With every step taken, the weight is the likelihood for each noise: no constant is lost on
    the way down.
    """
    sde = nb.LinearSDE(-0.7, np.linalg.cholesky(Q), 0.4)
    law = nb.DiffusionTree(sde, X0, nb.InexactMatch(0.1), tree=TREE, num_steps=3, guide=guide)
    truth = joint(TREE, X0, DATA, Q, 0.1, 0.7, 0.4)
    z = jr.normal(key, (4, *law.noise_prior().shape()))
    found = jax.jit(
        lambda z: law.expand((4,)).given(z).log_prob(jnp.broadcast_to(DATA, (4, *DATA.shape)))
    )(z)
    np.testing.assert_allclose(found, np.full(4, truth), rtol=1e-9)


def test_a_star_is_a_product_and_the_order_of_children_makes_no_difference():
    sde, match = nb.LinearSDE(-0.7, 0.6, 0.4), nb.InexactMatch(0.1)

    def density(law, data):
        return law.given(jnp.zeros(law.noise_prior().shape())).log_prob(data)

    star = nb.Tree.star([0.5, 1.0, 2.0], ["a", "b", "c"])
    one_by_one = [
        density(nb.DiffusionEndpoint(sde, X0, match, t1=t, num_steps=1), v)
        for t, v in zip([0.5, 1.0, 2.0], DATA[:3], strict=True)
    ]
    found = density(nb.DiffusionTree(sde, X0, match, tree=star), DATA[:3])
    np.testing.assert_allclose(found, sum(one_by_one), rtol=1e-11)

    turned = nb.Tree.from_newick(
        "((u:1):1,g:2,((f:0,e:1):.2,d:.5,c:3):0.1,(b:1.5,a:1)x:2):.3;"
    ).observing(SEEN)
    rows = dict(zip(TREE.observed_names, DATA, strict=True))
    laws = [nb.DiffusionTree(sde, X0, match, tree=tree) for tree in (TREE, turned)]
    values = [density(law, law.tree.rows(rows)) for law in laws]
    np.testing.assert_allclose(values[1], values[0], rtol=1e-11)


def test_masks_of_their_own():
    """Landmarks that are missing in some tips say nothing: the dense normal of what is there."""
    seen = np.random.default_rng(1).random((len(SEEN), 3)) < 0.7
    match = jax.vmap(lambda mask: nb.InexactMatch(0.1, mask=mask))(jnp.asarray(seen))
    law = nb.DiffusionTree(nb.BrownianMotion(Q), X0, match, tree=TREE, per_row=("match",))
    found = law.given(jnp.zeros(law.noise_prior().shape())).log_prob(DATA)
    rows = seen.ravel()
    C = np.kron(shared_times(TREE), Q) + 0.1 * np.eye(rows.size)
    r = (DATA - X0).reshape(rows.size, 2)
    truth = sum(
        stats.multivariate_normal(None, C[rows][:, rows]).logpdf(r[rows, c]) for c in (0, 1)
    )
    np.testing.assert_allclose(found, truth, rtol=1e-8)


# Several specimens.

TIMES = [3, 1, 4, 1, 2, 1, 1, 2]  # rows of each node of SEEN, an inner one among them
MANY = TREE.observing([name for name, count in zip(SEEN, TIMES, strict=True) for _ in range(count)])
ROWS = np.random.default_rng(7).normal(size=(len(MANY.observed), 3, 2))
OWN = np.random.default_rng(8).uniform(0.02, 0.3, len(ROWS))
THERE = np.random.default_rng(9).random((len(ROWS), 3)) < 0.6
THERE[:3, 0] = False  # of one species nobody has seen the first landmark
ERROR = np.array([[0.1, 0.03, 0.0], [0.03, 0.2, -0.05], [0.0, -0.05, 0.15]])
SOME = np.array([[0.0, 0.0, 1.0], [1.0, 0.5, 0.0]])


@pytest.mark.parametrize("own", [True, False], ids=["errors of their own", "one error"])
def test_several_specimens_have_the_dense_normal(own):
    """Value to 1e-8 and gradients to 1e-6: species share their past, specimens the state of their
    node.
    """
    p = {"a": jnp.asarray(Q), "x0": jnp.asarray(X0), "lengths": MANY.lengths}
    p |= {
        "noise": jnp.asarray(OWN if own else 0.1),
        "rate": jnp.asarray(0.7),
        "shift": jnp.asarray(0.4),
    }

    def ours(p, data):
        sde = nb.LinearSDE(-p["rate"], jnp.linalg.cholesky(p["a"]), p["shift"])
        match = jax.vmap(nb.InexactMatch)(p["noise"]) if own else nb.InexactMatch(p["noise"])
        settings = {"per_row": ("match",)} if own else {}
        law = nb.DiffusionTree(
            sde, p["x0"], match, tree=MANY.with_lengths(p["lengths"]), **settings
        )
        return law.given(jnp.zeros(law.noise_prior().shape())).log_prob(data)

    def truth(p, data):
        tree = MANY.with_lengths(p["lengths"])
        return joint(tree, p["x0"], data, p["a"], p["noise"], p["rate"], p["shift"])

    found, slopes = jax.jit(jax.value_and_grad(ours, (0, 1)))(p, ROWS)
    expected, true_slopes = jax.jit(jax.value_and_grad(truth, (0, 1)))(p, ROWS)
    np.testing.assert_allclose(found, expected, rtol=1e-8)
    np.testing.assert_allclose(slopes[1], true_slopes[1], rtol=1e-6, atol=1e-6)
    for key in p:
        slope, true_slope = (
            s[key] + s[key].T if key == "a" else s[key] for s in (slopes[0], true_slopes[0])
        )
        size = 1 + np.max(np.abs(true_slope))
        np.testing.assert_allclose(slope, true_slope, rtol=1e-6, atol=1e-6 * size, err_msg=key)


def matches(**arrays):
    """A match for each row."""
    return jax.vmap(lambda arrays: nb.InexactMatch(**arrays))(jax.tree.map(jnp.asarray, arrays))


EACH = OWN[:, None, None]
FUSED = {
    "masks and errors": (
        matches(variance=OWN, mask=THERE),
        [np.eye(3)[there] for there in THERE],
        [error * np.eye(there.sum()) for error, there in zip(OWN, THERE, strict=True)],
    ),
    "one mask": (
        nb.InexactMatch(0.1, mask=[True, False, True]),
        np.eye(3)[[0, 2]],
        0.1 * np.eye(2),
    ),
    "correlated": (nb.InexactMatch(ERROR), np.eye(3), ERROR),
    "correlated, their own": (matches(variance=EACH * ERROR), np.eye(3), EACH * ERROR),
    "one operator": (nb.InexactMatch(0.1, SOME), SOME, 0.1 * np.eye(2)),
    "operators": (
        jax.vmap(lambda s: nb.InexactMatch(s, SOME))(jnp.asarray(OWN)),
        SOME,
        EACH * np.eye(2),
    ),
}


@pytest.mark.parametrize("name", FUSED)
def test_specimens_of_every_kind(name):
    """The dense normal of what is seen of them."""
    match, operators, errors = FUSED[name]
    if not isinstance(operators, list):
        operators = [operators] * len(ROWS)
        errors = np.broadcast_to(errors, (len(ROWS), *errors.shape[-2:]))
    per_row = ("match",) if match.variance.shape[:1] == (len(ROWS),) else ()
    law = nb.DiffusionTree(nb.BrownianMotion(Q), X0, match, tree=MANY, per_row=per_row)
    seen = [operator @ v for operator, v in zip(operators, ROWS, strict=True)]
    data = ROWS if "mask" in name else np.stack(seen)
    found = law.given(jnp.zeros(law.noise_prior().shape())).log_prob(data)
    L = block_diag(*operators)
    C = L @ np.kron(shared_times(MANY), Q) @ L.T + block_diag(*errors)
    r = np.concatenate(seen) - L @ np.tile(X0, (len(ROWS), 1))
    truth = sum(stats.multivariate_normal(None, C).logpdf(r[:, c]) for c in (0, 1))
    np.testing.assert_allclose(found, truth, rtol=1e-8)


def test_specimens_of_nonlinear_processes(key):
    """The weight of the mean, of variance σ/r, for the same noise, and a constant in closed form."""
    few = nb.Tree.from_newick("((a:1,b:1.5)x:.5,c:2);").observing(["x", "a", "c"])
    names, sizes = list("xxaaac"), np.array([2, 3, 1])
    many = few.observing(names)
    data = many.rows(ROWS[:6], names=names)
    owner = np.repeat(np.arange(3), sizes)
    means = np.stack([data[owner == i].mean(0) for i in range(3)])
    match = jax.vmap(nb.InexactMatch)(jnp.asarray(0.1 / sizes))
    one = nb.DiffusionTree(FLOW, X0, match, tree=few, num_steps=3, per_row=("match",))
    law = nb.DiffusionTree(FLOW, X0, nb.InexactMatch(0.1), tree=many, num_steps=3)
    z = jr.normal(key, law.noise_prior().shape())
    errors = 0.1 / np.asarray(FLOW.space.weights)[:, None]
    constant = stats.norm(means[owner], np.sqrt(errors)).logpdf(data).sum()
    constant -= (
        stats.norm(0, np.sqrt(errors / sizes[:, None, None])).logpdf(np.zeros_like(means)).sum()
    )
    expected = one.given(z).log_prob(means) + constant
    np.testing.assert_allclose(law.given(z).log_prob(data), expected, rtol=1e-10)
    np.testing.assert_allclose(law.given(z).path(data), one.given(z).path(means), atol=1e-10)


# The root.

# seen twice itself
ROOTED = nb.Tree(MANY.parents, MANY.lengths, MANY.names, [0, 0, *MANY.observed])
ROOTED_ROWS = np.concatenate([ROWS, ROWS[:2] + 0.5])
PRIOR = np.array([[2.0, 0.3, 0.1], [0.3, 1.0, 0.2], [0.1, 0.2, 0.5]])
OU = nb.LinearSDE(-0.7, np.linalg.cholesky(Q), 0.4)


def test_a_root_with_a_prior_has_the_dense_normal():
    """Value to 1e-8, gradients to 1e-6."""
    p = {"x0": jnp.asarray(X0), "root": jnp.asarray(PRIOR), "noise": jnp.asarray(0.1)}

    def ours(p):
        match = nb.InexactMatch(p["noise"])
        law = nb.DiffusionTree(OU, p["x0"], match, tree=ROOTED, root_covariance=p["root"])
        return law.given(jnp.zeros(law.noise_prior().shape())).log_prob(ROOTED_ROWS)

    def truth(p):
        return joint(
            ROOTED, p["x0"], ROOTED_ROWS, Q, p["noise"], 0.7, 0.4, 0.5 * (p["root"] + p["root"].T)
        )

    found, slopes = jax.jit(jax.value_and_grad(ours))(p)
    expected, true_slopes = jax.jit(jax.value_and_grad(truth))(p)
    np.testing.assert_allclose(found, expected, rtol=1e-8)
    for key in p:
        size = 1 + np.max(np.abs(true_slopes[key]))
        np.testing.assert_allclose(
            slopes[key], true_slopes[key], rtol=1e-6, atol=1e-6 * size, err_msg=key
        )


@pytest.mark.parametrize("prior", [np.array([2.0, 0.5, 0.1]), PRIOR], ids=["diagonal", "matrix"])
def test_the_posterior_of_the_root(prior, key):
    """Every noise weighs the same; the root is drawn from its dense posterior, of which 0 is the
    mean.
    """
    law = nb.DiffusionTree(
        OU,
        X0,
        nb.InexactMatch(0.1),
        tree=ROOTED,
        num_steps=2,
        guide=nb.RecedingGuide(),
        root_covariance=prior,
    )
    matrix = np.diag(prior) if prior.ndim == 1 else prior
    truth = joint(ROOTED, X0, ROOTED_ROWS, Q, 0.1, 0.7, 0.4, matrix)
    laws = law.expand((8,))
    z = jr.normal(key, laws.noise_prior().shape())
    # the mean, columns of a factor, any
    z = z.at[:7, 1:].set(0).at[:4, 0].set(0).at[1:4, 0, :, 0].set(np.eye(3))
    data = np.broadcast_to(ROOTED_ROWS, (8, *ROOTED_ROWS.shape))
    np.testing.assert_allclose(laws.given(z).log_prob(data), np.full(8, truth), rtol=1e-9)
    roots = laws.given(z).nodes(data)[:, 0]

    shared = np.asarray(shared_times(ROOTED))
    depth = np.diag(shared)
    C = np.exp(-0.7 * (depth[:, None] + depth)) * np.expm1(1.4 * shared) / 1.4
    errors = np.kron(C, Q) + 0.1 * np.eye(3 * len(depth))
    decay = np.kron(np.exp(-0.7 * depth)[:, None], np.eye(3))
    residual = ROOTED_ROWS - (-np.expm1(-0.7 * depth) * 0.4 / 0.7)[:, None, None]
    precision = decay.T @ np.linalg.solve(errors, decay) + np.linalg.inv(matrix)
    pull = decay.T @ np.linalg.solve(errors, residual.reshape(-1, 2)) + np.linalg.solve(matrix, X0)
    np.testing.assert_allclose(roots[0], np.linalg.solve(precision, pull), atol=1e-9)
    factor = (roots[1:4, :, 0] - roots[0, :, 0]).T
    np.testing.assert_allclose(factor @ factor.T, np.linalg.inv(precision), atol=1e-9)


def test_samples_with_a_root_that_varies():
    """Tips and root have the covariance of the tree and of the root."""
    tree = nb.Tree(SMALL.parents, SMALL.lengths, SMALL.names, [0, *SMALL.observed])
    law = nb.DiffusionTree(
        nb.BrownianMotion(0.8),
        np.ones(2),
        nb.InexactMatch(0.05),
        tree=tree,
        root_covariance=np.array([0.5, 2.0]),
    )
    draws = np.asarray(law.sample(jr.key(2), (8000,)))
    for i, variance in enumerate((0.5, 2.0)):
        values = draws[..., i] - 1
        truth = variance + 0.8 * np.asarray(shared_times(tree)) + 0.05 * np.eye(4)
        error = np.sqrt((np.outer(np.diag(truth), np.diag(truth)) + truth**2) / len(values))
        assert np.all(np.abs(values.T @ values / len(values) - truth) < 4.5 * error)
        assert np.all(error < 0.05 * np.diag(truth).max())


# Regimes.


def test_rates_are_lengths():
    """A Brownian motion of its own on each branch, value and gradient in the rates."""
    rates = jnp.linspace(0.5, 2.0, TREE.num_nodes - 1)

    def by_regime(rates):
        sdes = jax.vmap(lambda rate: nb.BrownianMotion(rate * Q))(rates)
        law = nb.DiffusionTree(sdes, X0, nb.InexactMatch(0.1), tree=TREE, per_edge=("sde",))
        return law.given(jnp.zeros(law.noise_prior().shape())).log_prob(DATA)

    def by_length(rates):
        law = nb.DiffusionTree(
            nb.BrownianMotion(Q), X0, nb.InexactMatch(0.1), tree=TREE.scaled(rates)
        )
        return law.given(jnp.zeros(law.noise_prior().shape())).log_prob(DATA)

    found, slopes = jax.jit(jax.value_and_grad(by_regime))(rates)
    expected, true_slopes = jax.jit(jax.value_and_grad(by_length))(rates)
    np.testing.assert_allclose(found, expected, rtol=1e-10)
    np.testing.assert_allclose(slopes, true_slopes, rtol=1e-8, atol=1e-10)


def test_regimes_have_the_dense_normal():
    """Ornstein–Uhlenbeck processes of two kinds, from a root that varies."""
    kind = TREE.clade("c", "d", "e").astype(int)
    rate, shift, scale = (
        np.array([0.4, 1.5])[kind],
        np.array([0.4, -0.6])[kind],
        np.array([1.0, 0.3])[kind],
    )
    lengths, size = np.asarray(TREE.lengths), TREE.num_nodes
    sdes = jax.vmap(lambda r, b, s: nb.LinearSDE(-r, jnp.sqrt(s) * np.linalg.cholesky(Q), b))(
        rate, shift, scale
    )
    law = nb.DiffusionTree(
        sdes, X0, nb.InexactMatch(0.1), tree=TREE, per_edge=("sde",), root_covariance=0.7 * Q
    )
    found = law.given(jnp.zeros(law.noise_prior().shape())).log_prob(DATA)

    decay, weight, C = np.exp(-rate * lengths), np.ones(size), 0.7 * np.eye(size)
    push = np.zeros(size)
    for node in range(1, size):
        parent, e = TREE.parents[node], node - 1
        weight[node] = decay[e] * weight[parent]
        push[node] = decay[e] * push[parent] + shift[e] * (1 - decay[e]) / rate[e]
        C[node, :node] = C[:node, node] = decay[e] * C[parent, :node]
        C[node, node] = decay[e] ** 2 * C[parent, parent] + scale[e] * (1 - decay[e] ** 2) / (
            2 * rate[e]
        )
    seen = np.array(TREE.observed)
    covariance = np.kron(C[np.ix_(seen, seen)], Q) + 0.1 * np.eye(3 * len(seen))
    r = (DATA - weight[seen, None, None] * X0 - push[seen, None, None]).reshape(-1, 2)
    truth = sum(stats.multivariate_normal(None, covariance).logpdf(r[:, c]) for c in (0, 1))
    np.testing.assert_allclose(found, truth, rtol=1e-8)


def test_regimes_of_nonlinear_processes(key):
    """Coefficients r b and √r σ for a time t are b and σ for r t: the same weight; and the way
    back.
    """
    rates = jnp.linspace(0.5, 2.0, TREE.num_nodes - 1)

    def sde(r):
        return nb.SDE(lambda t, x, r: r * jnp.sin(x), lambda t, x, r: 0.6 * jnp.sqrt(r), r)

    settings = {"num_steps": 3, "root_covariance": 0.3}
    law = nb.DiffusionTree(
        jax.vmap(sde)(rates), X0, nb.InexactMatch(0.1), tree=TREE, per_edge=("sde",), **settings
    )
    scaled = nb.DiffusionTree(
        sde(1.0), X0, nb.InexactMatch(0.1), tree=TREE.scaled(rates), **settings
    )
    z = jr.normal(key, law.noise_prior().shape())
    np.testing.assert_allclose(
        law.given(z).log_prob(DATA), scaled.given(z).log_prob(DATA), rtol=1e-10
    )

    @jax.jit
    def there_and_back(key):
        seen, paths = _simulated(law.parts, key)
        problem = _problem(law.parts, seen)
        return paths, problem.paths(problem.noise_from_paths(paths, key))

    paths, again = there_and_back(key)
    np.testing.assert_allclose(again, paths, atol=1e-10)


# Nonlinear processes.


def sine(p):
    return nb.SDE(
        lambda t, x, a: a * jnp.sin(x) + 0.2 * t, lambda t, x, a: 0.6 + 0.1 * jnp.cos(x), p
    )


SMALL = nb.Tree.from_newick("((a:.5,b:.7):.4,c:.6);")
TEXT_LARGE = "(((a:.3,b:.4)x:.2,c:0):.3,(d:.2,(e:.1,f:.3):.2):.1);"
LARGE = nb.Tree.from_newick(TEXT_LARGE)


SEVEN = LARGE.observing(list("abcdef") + ["x"])
SEEN_ROOT = nb.Tree(SMALL.parents, SMALL.lengths, SMALL.names, [0, *SMALL.observed])
FORCED = {
    "three tips, 4 steps": (SMALL, 4, None),
    "three tips, 10 steps": (SMALL, 10, None),
    "six tips, 4 steps": (SEVEN, 4, None),
    "six tips, 10 steps": (SEVEN, 10, None),
    "three tips, steps of their own": (SMALL, (2, 4, 6, 4), None),
    "a root that varies": (SMALL, 4, 1.5),
    "a root that varies and is seen": (SEEN_ROOT, 3, 1.5),
}


@pytest.mark.parametrize("name", FORCED)
def test_evidence_by_brute_force(name):
    """The mean weight, against forward simulation in NumPy weighed by the density of the data."""
    tree, num_steps, root = FORCED[name]
    counts = np.broadcast_to(num_steps, tree.num_nodes - 1)
    rng = np.random.default_rng(counts[-1])
    variance, x0, count = 0.3, 0.4, 400_000
    data = rng.normal(0.5, 0.4, (len(tree.observed), 1))
    depths, lengths = np.asarray(tree.depths), np.asarray(tree.lengths)
    state, log_density = {0: x0 + np.sqrt(root or 0.0) * rng.normal(size=count)}, np.zeros(count)
    if 0 in tree.observed:
        log_density += stats.norm(state[0], np.sqrt(variance)).logpdf(data[0, 0])
    for node in range(1, tree.num_nodes):
        x, t = state[tree.parents[node]], depths[tree.parents[node]]
        dt = lengths[node - 1] / counts[node - 1]
        for _ in range(counts[node - 1]):
            spread = 0.6 + 0.1 * np.cos(x)
            x = x + dt * (np.sin(x) + 0.2 * t) + np.sqrt(dt) * spread * rng.normal(size=count)
            t = t + dt
        state[node] = x
        if node in tree.observed:
            v = data[tree.observed.index(node), 0]
            log_density += stats.norm(x, np.sqrt(variance)).logpdf(v)
    weights = np.exp(log_density)
    truth, error = weights.mean(), weights.std() / np.sqrt(count)
    assert error < 0.01 * truth

    law = nb.DiffusionTree(
        sine(1.0),
        np.array([x0]),
        nb.InexactMatch(variance),
        tree=tree,
        num_steps=num_steps,
        root_covariance=root,
    )
    z = jr.normal(jr.key(counts[-1]), (6000, *law.noise_prior().shape()))
    log_weights = jax.jit(jax.vmap(lambda z: law.given(z).log_prob(data)))(z)
    own = np.exp(log_weights)
    own_error = own.std() / np.sqrt(len(own))
    assert own_error < 0.01 * truth
    assert abs(own.mean() - truth) < 4 * np.hypot(error, own_error)


FLOW = nb.KunitaFlow(nb.Landmarks(3, 2), nb.GaussianKernel(0.4, 0.7))
WIGGLY = nb.ScoreGuide(
    nb.GeodesicGuide(),
    lambda t, x, v, theta: jnp.sin(2 * x + t) + 0.3 * v,
    Standard(*map(jnp.asarray, (1.0, 0.8, 0.0, 1.0, np.zeros(0), np.zeros(0)))),
)
KINDS = {
    "inexact, inner node seen": (nb.InexactMatch(0.1), TREE, None),
    "learned": (nb.InexactMatch(0.1), TREE, WIGGLY),
    "exact": (nb.ExactMatch(), nb.Tree.from_newick("((a:1,b:1.5):2,(c:3,d:.5):.3,g:2):.3;"), None),
    "some points": (nb.InexactMatch(0.1, PICK := np.eye(3)[[2, 0]]), TREE, nb.FrozenGuide()),
    "chain": (nb.InexactMatch(0.1), nb.Tree.chain([0.5, 0.7, 2.0]), None),
    "one branch": (nb.ExactMatch(), nb.Tree.star([1.2]), None),
    "a root that varies": (nb.InexactMatch(0.1), ROOTED, None),
    "fewer noises than states": (nb.InexactMatch(0.1), ROOTED, None),
    "steps of their own": (nb.ExactMatch(), nb.Tree.from_newick("((a:1,b:1.5):2,g:2):.3;"), None),
}
OTHERS = {"a root that varies": {"root_covariance": 0.2 * PRIOR}}
OTHERS["fewer noises than states"] = {"root_covariance": np.array([0.4, 0.2, 0.3])}
OTHERS["steps of their own"] = {"num_steps": (2, 4, 2, 6, 4)}
NARROW = nb.SDE(lambda t, x, a: -x, lambda t, x, a: jnp.stack([jnp.cos(x[:, 0]), jnp.ones(3)], 1))


SEVERAL_WAYS = [
    pytest.param(
        name, marks=pytest.mark.slow if name in ("some points", "chain", "one branch") else ()
    )
    for name in KINDS
]


@pytest.mark.parametrize("name", SEVERAL_WAYS)
def test_the_way_back_to_the_noise(name, key):
    """Simulated paths are those of their noise; paths meet at the nodes, and end in what is seen
    exactly.
    """
    match, tree, guide = KINDS[name]
    sde = NARROW if name.startswith("fewer") else FLOW
    law = nb.DiffusionTree(
        sde, X0, match, tree=tree, guide=guide, **({"num_steps": 3} | OTHERS.get(name, {}))
    )

    @jax.jit
    def there_and_back(key):
        seen, paths = _simulated(law.parts, key)
        problem = _problem(law.parts, seen)
        noise = problem.noise_from_paths(paths, key)
        return seen, paths, problem.paths(noise), problem.log_weight(noise)

    seen, paths, again, log_weight = there_and_back(key)
    np.testing.assert_allclose(again, paths, atol=1e-10)
    assert ("root_covariance" in OTHERS.get(name, {})) == (np.max(np.abs(paths[0, 0] - X0)) > 0)
    assert np.isfinite(log_weight)
    tree = _divided(law.parts)
    walk = schedule(tree.parents, tree.observed)
    for i, node in enumerate(walk.active):
        parent = tree.parents[node]
        start = paths[0, 0] if parent == 0 else paths[walk.active.index(parent), -1]
        np.testing.assert_allclose(paths[i, 0], start, atol=1e-12)
    if isinstance(match, nb.ExactMatch):
        ends = [paths[walk.active.index(node), -1] for node in tree.observed]
        np.testing.assert_allclose(ends, seen, atol=1e-12)


def test_a_network_of_zeros_changes_nothing(key):
    """Path by path: what is told of a node, and how long until it is seen, reaches the guide that
    is corrected.
    """
    silent = nb.ScoreGuide(WIGGLY.guide, lambda t, x, v, theta: 0 * x, WIGGLY.standard)

    @jax.jit
    def log_weights(key):
        found = []
        for guide in (WIGGLY.guide, silent, nb.DriftGuide(WIGGLY.guide), nb.DriftGuide(silent)):
            law = nb.DiffusionTree(
                FLOW, X0, nb.InexactMatch(0.1), tree=TREE, num_steps=3, guide=guide
            )
            z = jr.normal(key, law.noise_prior().shape())
            found.append(law.given(z).log_prob(DATA))
        return found

    plain, same, drift, same_drift = log_weights(key)
    np.testing.assert_allclose([same, same_drift], [plain, drift], rtol=1e-10)


def test_steps_of_their_own(key):
    """Those of a tree whose branches are divided; by branch and by node, whatever the pieces."""
    sde = nb.SDE(lambda t, x, a: jnp.sin(x) - t, lambda t, x, a: 0.6 + 0.1 * jnp.cos(x[:, 0]))
    counts = SMALL.num_steps(0.15)
    assert counts == (4, 4, 6, 4)
    settings = {"guide": nb.RecedingGuide(), "root_covariance": 0.3, "t0": 0.5}
    law = nb.DiffusionTree(sde, X0, nb.InexactMatch(0.1), tree=SMALL, num_steps=counts, **settings)
    divided = SMALL.divided((2, 2, 3, 2))
    pieces = nb.DiffusionTree(sde, X0, nb.InexactMatch(0.1), tree=divided, num_steps=2, **settings)
    z = jr.normal(key, law.noise_prior().shape())
    assert law.noise_blocks.sizes == (1, 4, 4, 6, 4)

    @jax.jit
    def found(law, z):
        law = law.given(z)
        return law._log_prob_by_block(DATA[:3]), law.log_prob_by_node(DATA[:3]), law.path(DATA[:3])

    blocks, by_node, paths = zip(found(law, z), found(pieces, z), strict=True)
    np.testing.assert_allclose(
        jax.jit(lambda z: law.given(z).log_prob(DATA[:3]))(z), np.sum(blocks[1]), rtol=1e-12
    )
    branch = [0, 1, 1, 2, 2, 3, 3, 3, 4, 4]
    np.testing.assert_allclose(blocks[0], np.bincount(branch, blocks[1]), rtol=1e-12)
    # a tip's own is its branch
    np.testing.assert_allclose(by_node[0], blocks[0][np.array([2, 3, 4])], rtol=1e-12)
    np.testing.assert_allclose(by_node[1], by_node[0], rtol=1e-12)
    nodes = jax.jit(lambda z: law.given(z).nodes(DATA[:3]))(z)
    np.testing.assert_allclose(nodes[1:], paths[1][np.array([1, 3, 6, 8]), -1], rtol=1e-12)
    np.testing.assert_allclose(
        paths[0][2, :7], np.concatenate([paths[1][4], *paths[1][5:7, 1:]]), rtol=1e-12
    )
    assert np.all(np.isnan(paths[0][0, 5:])) and np.all(np.isfinite(paths[0][0, :5]))
    np.testing.assert_allclose(law.times[2], 0.9 + 0.7 * np.arange(7) / 6)


@pytest.mark.parametrize("columns", [(), (2,)], ids=["vectors", "columns"])
def test_states_of_all_nodes(columns, key):
    """Ends of the branches in the tree's order; NaN where a node leads to nothing seen, and where
    the law is masked.
    """
    law = nb.DiffusionTree(
        nb.BrownianMotion(Q), X0[(..., *(0,) * (1 - len(columns)))], nb.InexactMatch(0.1), tree=TREE
    )
    data = DATA[(..., *(0,) * (1 - len(columns)))]
    law = law.expand((2,)).given(jr.normal(key, law.expand((2,)).noise_prior().shape()))
    data = np.stack([data, data + 1])
    states, paths = law.nodes(data), law.path(data)
    assert states.shape == (2, TREE.num_nodes, 3, *columns)
    active = schedule(TREE.parents, TREE.observed).active
    np.testing.assert_array_equal(states[:, np.array(active)], paths[:, :, -1])
    np.testing.assert_array_equal(states[0, 0], law.parts["x0"])
    unseen = sorted(set(range(TREE.num_nodes)) - {0, *active})
    assert [TREE.names[node] for node in unseen] == [None, "u"] and np.all(
        np.isnan(states[:, np.array(unseen)])
    )
    masked = law.mask(np.array([True, False])).nodes(data)
    assert np.all(np.isnan(masked[1])) and np.array_equal(masked[0], states[0], equal_nan=True)


def test_one_branch_is_an_endpoint(key):
    """The same weight and path for the same noise."""
    endpoint = nb.DiffusionEndpoint(FLOW, X0, nb.InexactMatch(0.1), t1=1.2, num_steps=3)
    branch = nb.DiffusionTree(FLOW, X0, nb.InexactMatch(0.1), tree=nb.Tree.star([1.2]), num_steps=3)
    z = jr.normal(key, endpoint.noise_prior().shape())
    assert branch.noise_prior().shape() == z.shape
    np.testing.assert_allclose(
        branch.given(z).log_prob(DATA[:1]), endpoint.given(z).log_prob(DATA[0]), rtol=1e-8
    )
    np.testing.assert_allclose(
        branch.given(z).path(DATA[:1])[0], endpoint.given(z).path(DATA[0]), atol=1e-6
    )


# In NumPyro.


def model(data=None, tree=SMALL):
    rate = numpyro.sample("rate", dist.LogNormal(0.0, 0.5))
    sde = nb.BrownianMotion(rate)
    nb.sample(
        "tips", nb.DiffusionTree(sde, np.zeros((4, 2)), nb.InexactMatch(0.05), tree=tree), obs=data
    )


def test_posterior_of_a_rate():
    """By two kernels against quadrature; its width is that of all tips together."""
    data = np.random.default_rng(2).normal(size=(3, 4, 2))
    log_rates = np.linspace(-3, 3, 400)
    log_density = [
        stats.norm(0, 0.5).logpdf(r)
        + joint(SMALL, np.zeros((4, 2)), data, np.exp(r) * np.eye(4), 0.05)
        for r in log_rates
    ]
    w = np.exp(log_density - np.max(log_density))
    mean = np.sum(w * log_rates) / w.sum()
    sd = np.sqrt(np.sum(w * (log_rates - mean) ** 2) / w.sum())
    for kernel in (FunctionSpaceHMC(model), NUTS(model)):
        mcmc = MCMC(kernel, num_warmup=200, num_samples=1500, progress_bar=False)
        mcmc.run(jr.key(0), data, extra_fields=("~z.tips_noise",))
        draws = np.log(mcmc.get_samples()["rate"])
        assert abs(draws.mean() - mean) < 0.2 * sd and draws.std() == pytest.approx(sd, rel=0.15)


def test_prior_predictive():
    """Tips have the covariance of the tree."""
    fixed = numpyro.handlers.condition(model, {"rate": 0.8})
    draws = np.asarray(Predictive(fixed, num_samples=4000)(jr.key(1))["tips"])
    assert draws.shape == (4000, 3, 4, 2)
    values = draws.transpose(0, 2, 3, 1).reshape(-1, 3)
    truth = 0.8 * np.asarray(shared_times(SMALL)) + 0.05 * np.eye(3)
    error = np.sqrt((np.outer(np.diag(truth), np.diag(truth)) + truth**2) / len(values))
    assert np.all(np.abs(values.T @ values / len(values) - truth) < 4.5 * error)


def test_specimens_share_the_state_of_their_node():
    law = nb.DiffusionTree(nb.BrownianMotion(Q), X0, nb.InexactMatch(1e-8), tree=MANY)
    draws = law.sample(jr.key(0), (200,))
    between = draws - draws[:, [MANY.observed.index(node) for node in MANY.observed]]
    repeats = between[:, np.array(MANY.observed) == np.roll(MANY.observed, 1)]
    assert repeats.std() == pytest.approx(np.sqrt(2e-8), rel=0.05) and draws.std() > 0.5


def test_branch_lengths_have_priors():
    def clock(data):
        rates = numpyro.sample(
            "rates", dist.LogNormal(0.0, 0.5).expand([SMALL.num_nodes - 1]).to_event(1)
        )
        law = nb.DiffusionTree(
            nb.BrownianMotion(1.0), np.zeros(2), nb.InexactMatch(0.05), tree=SMALL.scaled(rates)
        )
        nb.sample("tips", law, obs=data)

    data = np.random.default_rng(2).normal(size=(3, 2))
    mcmc = MCMC(FunctionSpaceHMC(clock), num_warmup=50, num_samples=50, progress_bar=False)
    mcmc.run(jr.key(0), data)
    assert np.all(np.isfinite(mcmc.get_samples()["rates"]))


@pytest.mark.parametrize("learned", [False, True], ids=["geodesic", "learned"])
def test_priors_on_everything_in_both_precisions(learned):
    """Kernel, errors of each tip, lengths, root and guide, inside a model under jit, branches with
    steps of their own.

    float32 within 0.02 of float64.
    """
    angles = 2 * np.pi * np.arange(6) / 6
    circle = np.stack([np.cos(angles), np.sin(angles)], 1)
    size, counts = LARGE.num_nodes - 1, LARGE.num_steps(0.1)
    data = np.stack([(1 + 0.05 * i) * circle + 0.02 * i for i in range(7)])

    def everything(data):
        tree = nb.Tree.from_newick(TEXT_LARGE).observing(list("abcdef") + ["x"])
        space = nb.Landmarks(6, 2)
        amplitude = numpyro.sample("amplitude", dist.LogNormal(-1.0, 0.3))
        length_scale = numpyro.sample("length_scale", dist.LogNormal(-0.3, 0.3))
        sd = numpyro.sample("sd", dist.LogNormal(-3.0, 0.3).expand([7]).to_event(1))
        rates = numpyro.sample("rates", dist.LogNormal(0.0, 0.3).expand([size]).to_event(1))
        start = numpyro.sample("start", dist.Normal(circle, 0.1).to_event(2))
        correction = numpyro.sample("correction", dist.Uniform(0.0, 1.0))
        guide = nb.GeodesicGuide(correction, numpyro.sample("end_weight", dist.Uniform(0.0, 0.5)))
        if learned:
            guide = nb.ScoreGuide(guide, WIGGLY.network, WIGGLY.standard)
        flow = nb.KunitaFlow(
            space, nb.GaussianKernel(amplitude, length_scale), noise=nb.LandmarkNoise(1e-5)
        )
        match = jax.vmap(lambda sd: nb.InexactMatch(sd**2, space=space))(sd)
        tree_law = nb.DiffusionTree(
            flow,
            start,
            match,
            tree=tree.scaled(rates),
            num_steps=counts,
            guide=guide,
            per_row=("match",),
        )
        nb.sample("tips", tree_law, obs=data)

    values = {
        "amplitude": 0.4,
        "length_scale": 0.7,
        "sd": np.full(7, 0.05),
        "start": circle,
        "end_weight": 0.1,
    }
    values |= {"rates": np.linspace(0.8, 1.2, size), "correction": 0.6}
    values |= {"tips_noise": np.random.default_rng(0).normal(size=(sum(counts), 6, 2))}

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


WRONG = {
    "tree": (lambda: law(tree="(a:1);"), "`tree` must be a `Tree`"),
    "match": (lambda: law(match=nb.FrozenGuide()), "`match` must be a model of observation"),
    "root": (
        lambda: law(tree=nb.Tree([-1, 0], [1.0], None, [0, 1])),
        "`tree` must not have its root among",
    ),
    "root alone": (
        lambda: law(tree=nb.Tree([-1, 0], [1.0], None, [0]), root_covariance=1.0),
        "`tree` must have a seen node besides its root",
    ),
    "prior": (
        lambda: law(root_covariance=np.ones(2)),
        r"`root_covariance` must be a number, \(3,\) or \(3, 3\)",
    ),
    "no prior": (lambda: law(root_covariance=-1.0), "`root_covariance` must be positive definite"),
    "steps": (lambda: law(sde=sine(1.0)), "`num_steps` must be given"),
    "no steps": (lambda: law(num_steps=0), "`num_steps` must be a positive integer; got 0"),
    "steps of other branches": (
        lambda: law(num_steps=(2, 3)),
        "`num_steps` must be positive integers, one for each",
    ),
    "no steps somewhere": (
        lambda: law(num_steps=[2, 2, 0, 2]),
        "`num_steps` must be positive integers",
    ),
    "inner exact": (lambda: law(match=nb.ExactMatch()), "1 of the seen nodes are no tips"),
    "several exact": (
        lambda: law(match=nb.ExactMatch(), tree=TREE.observing(list("aabcc"))),
        "and 2 rows are of nodes that have one",
    ),
    "bins": (
        lambda: law(match=nb.IntervalCensored([0.0])),
        "`match` must see a value at each node",
    ),
    "per_edge": (lambda: law(per_edge=("match",)), "`per_edge` may hold 'sde'"),
    "one SDE": (
        lambda: law(sde=nb.BrownianMotion(Q), per_edge=("sde",)),
        "`sde` is in `per_edge`, so every array of it must have 13 rows, one for each branch",
    ),
    "no arrays": (
        lambda: law(
            sde=nb.SDE(lambda t, x, a: -x, lambda t, x, a: 1.0), per_edge=("sde",), num_steps=2
        ),
        "`sde` is in `per_edge`, and has no array to have one for each branch",
    ),
    "spaces": (
        lambda: law(
            sde=jax.vmap(lambda w: nb.BrownianMotion(w, space=nb.Landmarks(3, 2, weights=w)))(
                jnp.arange(1.0, 14.0)
            ),
            per_edge=("sde",),
        ),
        "`sde` must have one space on all branches",
    ),
    "per_row": (lambda: law(per_row=("sde",)), "`per_row` may hold 'match'"),
    "rows of matches": (
        lambda: law(match=jax.vmap(nb.InexactMatch)(jnp.ones(3)), per_row=("match",)),
        "`match` is in `per_row`, so every array of it must have 8 rows",
    ),
    "data": (lambda: density(DATA[:3]), r"`value`, an observation, must have shape \(8, 3, 2\)"),
    "several trees": (
        lambda: density(np.stack([DATA, DATA])),
        "holds 2 observations.*One noise shared",
    ),
    "NaN": (lambda: density(np.where(DATA > 1, np.nan, DATA)), "finite"),
    "start": (lambda: law(x0=np.zeros((2, 3, 2))), r"`x0` must be one state"),
}


def law(sde=None, x0=X0, match=None, tree=TREE, **settings):
    sde = nb.BrownianMotion(Q) if sde is None else sde
    return nb.DiffusionTree(
        sde, x0, nb.InexactMatch(0.1) if match is None else match, tree=tree, **settings
    )


def density(data):
    return law().given(np.zeros(law().noise_prior().shape())).log_prob(data)


@pytest.mark.parametrize("name", WRONG)
def test_what_is_refused(name):
    make, message = WRONG[name]
    with pytest.raises(ValueError, match=message):
        make()
