"""Inference on trees: moves by branch and clade, ancestors for ArviZ, evidence. The referee is the
dense normal.

One law throughout, Brownian motion as a user's SDE, led by a guide of another covariance, so that
its weight depends on the noise.
"""

import warnings

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro.infer import MCMC
from scipy import stats

import numpyro_bridges as nb
from numpyro_bridges.infer import PCN, PCNL, FunctionSpaceHMC, _evidence

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # ArviZ 0.x announces 1.x when it is imported
    import arviz

pytestmark = [pytest.mark.numpyro, pytest.mark.usefixtures("compile_quickly")]

TREE = nb.Tree.from_newick("((a:1,b:1.5)x:.5,(c:3,d:.5):0.1,u:1)r:.3;").observing(
    ["a", "b", "c", "d", "x"]
)
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
    return (
        gain @ DATA[:, 0],
        C - gain @ C[seen],
        stats.multivariate_normal(None, total).logpdf(DATA[:, 0]),
    )


def model(data=None):
    nb.sample("tips", LAW, obs=data)


def test_terms_of_branches(key):
    """They add up to the log probability, and know the noise of their own branch and of those
    before it alone.
    """
    z = jr.normal(key, LAW.noise_prior().shape())
    terms, slopes = jax.jit(
        lambda z: (LAW.given(z)._log_prob_by_block(DATA), jax.jacfwd(by_block)(z))
    )(z)
    np.testing.assert_allclose(jnp.sum(terms), LAW.given(z).log_prob(DATA), rtol=1e-12)
    depends = np.abs(slopes).reshape(len(terms), len(terms), -1).max(-1) > 1e-12
    above = [[other in TREE._lineage(node) for other in BRANCHES] for node in BRANCHES]
    np.testing.assert_array_equal(depends, above)
    assert LAW.noise_blocks == ((STEPS,) * len(BRANCHES), (-1, 0, 1, 1, 0, 4, 4))


def by_block(z):
    return LAW.given(z)._log_prob_by_block(DATA)


def chains(kernel):
    """Four of them, with one move for each of three levels in every draw."""
    settings = {
        "num_warmup": 300,
        "num_samples": 2000,
        "num_chains": 4,
        "chain_method": "vectorized",
    }
    mcmc = MCMC(kernel, progress_bar=False, **settings)
    mcmc.run(jr.key(0), DATA)
    return mcmc


@pytest.fixture(scope="module")
def run():
    mcmc = chains(PCN(model, num_moves=3, blocks="branch"))
    return mcmc, nb.to_arviz(mcmc, paths=2)


def check_ancestors(draws):
    """Of draws `(S, ancestors)`: means within 0.1 SD, SDs within 10 %."""
    mean, C, _ = posterior()
    sd = np.sqrt(np.diag(C))[INNER]
    assert len(sd) == 3
    np.testing.assert_array_less(np.abs(draws.mean(0) - mean[INNER]), 0.1 * sd)
    np.testing.assert_allclose(draws.std(0), sd, rtol=0.1)


def test_moves_by_clade():
    z = chains(PCNL(model, num_moves=3, blocks="clade")).get_samples()["tips_noise"]
    paths = jax.jit(lambda z: jax.lax.map(lambda z: LAW.given(z).path(DATA), z, batch_size=100))(z)
    check_ancestors(paths[:, np.array(INNER) - 1, -1, 0])


def test_moves_by_branch(run):
    mcmc, data = run
    nodes = data["posterior_nodes"]["tips"]
    assert nodes.dims == ("chain", "draw", "node", "coordinate") and nodes.shape == (
        4,
        2000,
        len(BRANCHES),
        1,
    )
    names = [TREE.names[node] or f"node {node}" for node in BRANCHES]
    assert list(nodes["node"]) == names and names[INNER[-1] - 1] == "node 5"
    check_ancestors(
        nodes.sel(node=[names[node - 1] for node in INNER]).values.reshape(-1, len(INNER))
    )
    angles = mcmc.last_state.angles[0]
    assert angles.shape == (4, len(BRANCHES)) and np.all(angles > 0.1)


def test_diagnostics_of_ancestors(run):
    table = arviz.summary(run[1], group="posterior_nodes")
    assert len(table) == len(BRANCHES) and "tips[node 5, 0]" in table.index
    assert np.all(table["r_hat"].astype(float) < 1.05) and np.all(
        table["ess_bulk"].astype(float) > 200
    )


def test_leaving_out_one_node(run):
    """The harmonic mean of each node's term, against the dense normal of one datum given the
    others.
    """
    values = run[1].log_likelihood["tips"]
    assert values.dims == ("chain", "draw", "node") and list(values["node"]) == list(
        TREE.observed_names
    )
    found = -np.log(np.mean(np.exp(-values), axis=(0, 1)))
    seen = list(TREE.observed)
    total = covariance()[np.ix_(seen, seen)] + VARIANCE * np.eye(len(seen))
    precision = np.linalg.inv(total)
    variance = 1 / np.diag(precision)
    truth = stats.norm(DATA[:, 0] - variance * (precision @ DATA[:, 0]), np.sqrt(variance)).logpdf(
        DATA[:, 0]
    )
    np.testing.assert_allclose(found, truth, atol=0.1)
    assert np.std(truth) > 0.2 and np.all(np.std(values, axis=(0, 1)) > 0.05)


def test_paths_along_branches(run):
    data = run[1]
    paths, times = data["posterior_paths"]["tips"], data["posterior_paths"]["tips_times"]
    assert paths.dims == ("chain", "draw", "branch", "step", "coordinate")
    assert paths.shape == (4, 2, len(BRANCHES), STEPS + 1, 1)
    np.testing.assert_allclose(times.sel(branch="b")[0, 0], [0.8, 1.55, 2.3])
    np.testing.assert_allclose(
        paths.isel(step=-1), data["posterior_nodes"]["tips"].sel(draw=paths["draw"])
    )


def test_hamiltonian_moves_without_parameters():
    """They are traced in double precision, in which an empty vector of parameters is of another
    type.
    """
    kernel = FunctionSpaceHMC(model)

    def two_draws(key):
        return kernel.sample(kernel.init(key, 5, None, (DATA,), {}), (DATA,), {})

    assert jax.eval_shape(two_draws, jr.key(0)).potential_energy.dtype == jnp.float64


# Evidence.

SHARP = 0.01  # variance of the error, beside which the guide of another covariance leads badly


def sharp_law():
    guide = nb.FrozenGuide(nb.BrownianMotion(20.0))
    settings = {"tree": TREE, "num_steps": STEPS, "guide": guide}
    return nb.DiffusionTree(
        nb.BrownianMotion(RATE), np.zeros(1), nb.InexactMatch(SHARP), **settings
    )


@pytest.mark.parametrize("method", ["smc", "bridge"])
def test_evidence(method):
    """The dense normal within 4 standard errors, one of which is below 0.1; importance weights have
    an SD of 5.
    """
    found = nb.estimate_tree_evidence(
        sharp_law(),
        DATA,
        jr.key(1),
        method=method,
        num_particles=64,
        batch_size=64,
        num_moves=1,
        progress=False,
    )
    seen = list(TREE.observed)
    total = covariance()[np.ix_(seen, seen)] + SHARP * np.eye(len(seen))
    truth = stats.multivariate_normal(None, total).logpdf(DATA[:, 0])
    print(found, truth)
    assert found.trusted and 0 < found.standard_error < 0.1 and len(found.inverse_temperatures) > 2
    assert abs(found.log_evidence - truth) < 4 * found.standard_error


THREE = nb.Tree.from_newick("((a:.5,b:.7):.4,c:.6);")
SEEN = np.array([[0.3], [1.1], [-0.2]])


def nonlinear(data):
    strength = numpyro.sample("strength", dist.LogNormal(0.0, 0.5))
    sde = nb.SDE(lambda t, x, a: a * jnp.sin(x), lambda t, x, a: 0.6 + 0.1 * jnp.cos(x), strength)
    law = nb.DiffusionTree(sde, np.array([0.4]), nb.InexactMatch(0.05), tree=THREE, num_steps=STEPS)
    nb.sample("tips", law, obs=data)
    numpyro.sample("other", dist.Normal(strength, 1.0), obs=0.7)


def test_evidence_of_a_model(monkeypatch):
    """A nonlinear tree and another datum, a parameter integrated over its prior, against simulation
    in NumPy.

    By more temperatures than are needed, so that moves of the parameter matter.
    """
    monkeypatch.setattr(_evidence, "_ESS", 0.95)
    rng, count = np.random.default_rng(0), 400_000
    strength = np.exp(0.5 * rng.normal(size=count))
    states, log_density = {0: np.full(count, 0.4)}, stats.norm(strength, 1.0).logpdf(0.7)
    for node in range(1, THREE.num_nodes):
        x, dt = states[THREE.parents[node]], float(THREE.lengths[node - 1]) / STEPS
        for _ in range(STEPS):
            x = (
                x
                + dt * strength * np.sin(x)
                + np.sqrt(dt) * (0.6 + 0.1 * np.cos(x)) * rng.normal(size=count)
            )
        states[node] = x
    for node, v in zip(THREE.observed, SEEN[:, 0], strict=True):
        log_density = log_density + stats.norm(states[node], np.sqrt(0.05)).logpdf(v)
    w = np.exp(log_density)
    truth, error = np.log(w.mean()), w.std() / np.sqrt(count) / w.mean()
    found = nb.estimate_model_evidence(
        nonlinear, jr.key(2), SEEN, batch_size=64, num_moves=1, progress=False
    )
    print(found, truth, error)
    assert error < 0.02 and found.standard_error < 0.05 and len(found.inverse_temperatures) > 3
    assert abs(found.log_evidence - truth) < 4 * np.hypot(found.standard_error, error)


def scaled(data):
    with numpyro.handlers.scale(scale=2.0):
        nb.sample("tips", LAW, obs=data)


def improper(data):
    numpyro.sample("level", dist.ImproperUniform(dist.constraints.real, (), ()))
    nb.sample("tips", LAW, obs=data)


REFUSED = {
    "noise": (
        lambda data: numpyro.sample("x", dist.Normal(), obs=0.0),
        "`model` must have driving noise",
    ),
    "prior": (improper, r"`model` must have proper priors, .* \['level'\] are improper"),
    "scale": (scaled, "is scaled, by `handlers.scale` or a plate that is subsampled"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_models_without_an_evidence(name):
    build, message = REFUSED[name]
    with pytest.raises(ValueError, match=message):
        nb.estimate_model_evidence(build, jr.key(0), DATA, progress=False)


def test_failures_are_no_numbers():
    """NaN in a weight makes the estimate NaN, and says so."""
    estimates = jnp.array([1.0, jnp.nan, 2.0])
    found = nb.TemperedEvidence(
        jnp.nan, jnp.nan, estimates, np.array([0.0, 1.0]), np.array([0.9]), 4, "smc"
    )
    assert not found.trusted and "nan" in str(found)
    apart = nb.TemperedEvidence(
        jnp.array(1.0),
        jnp.array(0.5),
        jnp.array([-3.0, 1.0, 3.0]),
        np.array([0.0, 1.0]),
        np.array([0.9]),
        4,
        "smc",
    )
    assert "islands differ by 3.1 nats" in str(apart)
