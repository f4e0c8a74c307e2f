"""Inference on trees: moves by branch and clade, ancestors for ArviZ, evidence. The referee is the dense normal.

One law throughout, Brownian motion as a user's SDE, led by a guide of another covariance, so that its weight depends on
the noise.
"""

import warnings

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from numpyro.infer import MCMC
from scipy import stats

import numpyro_bridges as nb
from numpyro_bridges.infer import PCN, PCNL

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # ArviZ 0.x announces 1.x when it is imported
    import arviz

pytestmark = [pytest.mark.numpyro, pytest.mark.usefixtures("compile_quickly")]

TREE = nb.Tree.from_newick("((a:1,b:1.5)x:.5,(c:3,d:.5):0.1,u:1)r:.3;").observing(["a", "b", "c", "d", "x"])
RATE, VARIANCE, STEPS = 0.4, 0.3, 2
DATA = np.random.default_rng(0).normal(size=(len(TREE.observed), 1))
LAW = nb.DiffusionTree(
    nb.SDE(lambda t, x, args: 0.0 * x, lambda t, x, args: RATE**0.5),
    np.zeros(1),
    nb.InexactMatch(VARIANCE),
    tree=TREE,
    num_steps=STEPS,
    guide=nb.FrozenGuide(nb.BrownianMotion(1.5)),
)
BRANCHES = [node for node in range(1, TREE.num_nodes) if TREE.names[node] != "u"]
INNER = [node for node in BRANCHES if node not in TREE.tips]


def covariance():
    """Of the states of all nodes."""
    depths = np.asarray(TREE.depths)
    lineages = [set(TREE._lineage(node)) for node in range(TREE.num_nodes)]
    return RATE * np.array([[depths[max(one & two)] for two in lineages] for one in lineages])


def posterior():
    """Mean and covariance of the states of all nodes, and the log density of the data."""
    C, seen = covariance(), list(TREE.observed)
    total = C[np.ix_(seen, seen)] + VARIANCE * np.eye(len(seen))
    gain = np.linalg.solve(total, C[seen]).T
    return gain @ DATA[:, 0], C - gain @ C[seen], stats.multivariate_normal(None, total).logpdf(DATA[:, 0])


def model(data=None):
    nb.sample("tips", LAW, obs=data)


def test_terms_of_branches(key):
    """They add up to the log probability, and know the noise of their own branch and of those before it alone."""
    z = jr.normal(key, LAW.noise_prior().shape())
    terms, slopes = jax.jit(lambda z: (LAW.given(z)._log_prob_by_block(DATA), jax.jacfwd(by_block)(z)))(z)
    np.testing.assert_allclose(jnp.sum(terms), LAW.given(z).log_prob(DATA), rtol=1e-12)
    depends = np.abs(slopes).reshape(len(terms), len(terms), -1).max(-1) > 1e-12
    above = [[other in TREE._lineage(node) for other in BRANCHES] for node in BRANCHES]
    np.testing.assert_array_equal(depends, above)
    assert LAW.noise_blocks == ((STEPS,) * len(BRANCHES), (-1, 0, 1, 1, 0, 4, 4))


def by_block(z):
    return LAW.given(z)._log_prob_by_block(DATA)


@pytest.fixture(scope="module", params=[(PCN, "branch"), (PCNL, "clade")], ids=["PCN-branch", "PCNL-clade"])
def run(request):
    """Four chains, of three levels and one move each."""
    kernel, blocks = request.param
    mcmc = MCMC(
        kernel(model, num_moves=3, blocks=blocks), num_warmup=300, num_samples=2000, num_chains=4,
        chain_method="vectorized", progress_bar=False,
    )  # fmt: skip
    mcmc.run(jr.key(0), DATA)
    return mcmc, nb.to_arviz(mcmc, paths=2)


def test_moves_by_branch_and_clade(run):
    """Posterior of the ancestors: means within 0.1 SD, SDs within 10 %."""
    mcmc, data = run
    mean, C, _ = posterior()
    nodes = data["posterior_nodes"]["tips"]
    assert nodes.dims == ("chain", "draw", "node", "coordinate") and nodes.shape == (4, 2000, len(BRANCHES), 1)
    names = [TREE.names[node] or f"node {node}" for node in BRANCHES]
    assert list(nodes["node"]) == names and names[INNER[-1] - 1] == "node 5"
    for node in INNER:
        draws, sd = nodes.sel(node=names[node - 1]), np.sqrt(C[node, node])
        assert abs(float(draws.mean()) - mean[node]) < 0.1 * sd
        assert float(draws.std()) == pytest.approx(sd, rel=0.1)
    angles = mcmc.last_state.angles[0]
    assert angles.shape == (4, len(BRANCHES)) and np.all(angles > 0.1)


def test_diagnostics_of_ancestors(run):
    table = arviz.summary(run[1], group="posterior_nodes")
    assert len(table) == len(BRANCHES) and "tips[node 5, 0]" in table.index
    assert np.all(table["r_hat"].astype(float) < 1.05) and np.all(table["ess_bulk"].astype(float) > 200)


def test_leaving_out_one_node(run):
    """The harmonic mean of each node's term, against the dense normal of one datum given the others."""
    values = run[1].log_likelihood["tips"]
    assert values.dims == ("chain", "draw", "node") and list(values["node"]) == list(TREE.observed_names)
    found = -np.log(np.mean(np.exp(-values), axis=(0, 1)))
    seen = list(TREE.observed)
    total = covariance()[np.ix_(seen, seen)] + VARIANCE * np.eye(len(seen))
    precision = np.linalg.inv(total)
    variance = 1 / np.diag(precision)
    truth = stats.norm(DATA[:, 0] - variance * (precision @ DATA[:, 0]), np.sqrt(variance)).logpdf(DATA[:, 0])
    np.testing.assert_allclose(found, truth, atol=0.1)
    assert np.std(truth) > 0.2 and np.all(np.std(values, axis=(0, 1)) > 0.05)


def test_paths_along_branches(run):
    data = run[1]
    paths, times = data["posterior_paths"]["tips"], data["posterior_paths"]["tips_times"]
    assert paths.dims == ("chain", "draw", "branch", "step", "coordinate")
    assert paths.shape == (4, 2, len(BRANCHES), STEPS + 1, 1)
    np.testing.assert_allclose(times.sel(branch="b")[0, 0], [0.8, 1.55, 2.3])
    np.testing.assert_allclose(paths.isel(step=-1), data["posterior_nodes"]["tips"].sel(draw=paths["draw"]))


@pytest.mark.parametrize("method", ["smc", "bridge"])
def test_evidence(method):
    """The dense normal within 4 standard errors, of which one is below 0.1: importance weights have an SD of 2."""
    found = nb.estimate_tree_evidence(
        LAW, DATA, jr.key(1), method=method, num_particles=48, batch_size=48, num_moves=1, progress=False
    )
    truth = posterior()[2]
    print(found, truth)
    assert found.trusted and 0 < found.standard_error < 0.1
    assert abs(found.log_evidence - truth) < 4 * found.standard_error
