"""Inference on trees: moves by branch and clade, ancestors for ArviZ, evidence. The referee is the dense normal.

One Brownian law throughout, led by a guide of another covariance, so that its weight depends on the noise.
"""

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from numpyro.infer import MCMC
from scipy import stats

import numpyro_bridges as nb
from numpyro_bridges.infer import PCN, PCNL

pytestmark = [pytest.mark.numpyro, pytest.mark.usefixtures("compile_quickly")]

TREE = nb.Tree.from_newick("((a:1,b:1.5)x:2,(c:3,d:.5)y:0.1)r:.3;").observing(["a", "b", "c", "d", "x"])
RATE, VARIANCE, STEPS = 0.4, 0.05, 2
DATA = np.random.default_rng(0).normal(size=(len(TREE.observed), 1))
LAW = nb.DiffusionTree(
    nb.BrownianMotion(RATE),
    np.zeros(1),
    nb.InexactMatch(VARIANCE),
    tree=TREE,
    num_steps=STEPS,
    guide=nb.FrozenGuide(nb.BrownianMotion(1.5)),
)
NAMED = [TREE.names.index(name) for name in "rxy"]


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


@jax.jit
def ancestors(noise):
    """States `(3, ...)` of the nodes r, x and y."""
    walk = [node - 1 for node in NAMED]  # every branch has noise
    return jax.lax.map(lambda z: LAW.given(z).path(DATA)[np.array(walk), -1, 0], noise, batch_size=100)


def test_terms_of_branches(key):
    """They add up to the log probability, and know the noise of their own branch and of those before it alone."""
    z = jr.normal(key, LAW.noise_prior().shape())
    terms, slopes = jax.jit(lambda z: (LAW.given(z).log_prob_by_block(DATA), jax.jacfwd(by_block)(z)))(z)
    np.testing.assert_allclose(jnp.sum(terms), LAW.given(z).log_prob(DATA), rtol=1e-12)
    depends = np.abs(slopes).reshape(len(terms), len(terms), -1).max(-1) > 1e-12
    above = [[other in TREE._lineage(node) for other in range(1, TREE.num_nodes)] for node in range(1, TREE.num_nodes)]
    np.testing.assert_array_equal(depends, above)
    assert LAW.noise_blocks.above == tuple(parent - 1 if parent else -1 for parent in TREE.parents[1:])


def by_block(z):
    return LAW.given(z).log_prob_by_block(DATA)


@pytest.mark.parametrize("kernel, blocks", [(PCN, "branch"), (PCNL, "clade")])
def test_moves_by_branch_and_clade(kernel, blocks):
    """Posterior of three ancestors: means within 0.1 SD, SDs within 10 %; three levels, one move each."""
    mcmc = MCMC(
        kernel(model, num_moves=3, blocks=blocks), num_warmup=300, num_samples=2000, num_chains=4,
        chain_method="vectorized", progress_bar=False,
    )  # fmt: skip
    mcmc.run(jr.key(0), DATA)
    mean, C, _ = posterior()
    draws = np.asarray(ancestors(mcmc.get_samples()["tips_noise"]))
    sd = np.sqrt(np.diag(C))[NAMED]
    np.testing.assert_array_less(np.abs(draws.mean(0) - mean[NAMED]), 0.1 * sd)
    np.testing.assert_allclose(draws.std(0), sd, rtol=0.1)
    angles = mcmc.last_state.angles[0]
    assert angles.shape == (4, TREE.num_nodes - 1) and np.all(angles > 0.1)
