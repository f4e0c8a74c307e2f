"""Log likelihoods with noise and effects of a unit integrated out, and models without noise."""

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
import scipy.stats as stats
from numpyro import handlers
from numpyro.contrib.control_flow import scan
from numpyro.infer import MCMC, NUTS, Predictive
from numpyro.infer.util import log_density

import numpyro_bridges as nb
from numpyro_bridges.infer._draws import model_of
from numpyro_bridges.infer._log_likelihood import _parts, _rows_of_tips
from numpyro_bridges.infer._posterior import sites_of

pytestmark = [pytest.mark.numpyro, pytest.mark.usefixtures("compile_quickly")]

RATE, SIGMA, ERROR = 1.0, 0.6, 0.1
SLOPE, VARIANCE = 1 - np.exp(-RATE), SIGMA**2 * (1 - np.exp(-2 * RATE)) / (2 * RATE) + ERROR


def made_up_run(model, samples, *args):
    """A run with these draws, chains in front."""
    chains, draws = next(iter(samples.values())).shape[:2]
    mcmc = MCMC(
        NUTS(model), num_warmup=0, num_samples=draws, num_chains=chains, chain_method="sequential"
    )
    mcmc._states, mcmc._args, mcmc._kwargs = {"z": samples}, args, {}
    return mcmc


def law_of(mean, guide=None, dim=1, error=ERROR, num_steps=2, **batch):
    sdes = nb.LinearSDE(-RATE, SIGMA, mean)
    if jnp.ndim(mean):
        sdes = jax.vmap(lambda mean: nb.LinearSDE(-RATE, SIGMA, mean))(mean)
    x0, seen = np.zeros(dim), nb.InexactMatch(error)
    return nb.DiffusionEndpoint(sdes, x0, seen, t1=1.0, num_steps=num_steps, guide=guide, **batch)


def check_mean_is_1(ratios, visible):
    """Within 4 standard errors, which are small enough to see an error of `visible`."""
    error = np.std(ratios) / np.sqrt(np.size(ratios))
    print(f"{np.mean(ratios):.4f} ± {error:.4f}")
    assert 4 * error < visible
    assert abs(np.mean(ratios) - 1) < 4 * error


# Noise


def unguided_law(mean):
    """Weights that vary much: all but the last step is free."""
    return law_of(mean, nb.Unguided(), error=0.02, num_steps=8)


UNGUIDED_SD = np.sqrt(VARIANCE - ERROR + 0.02)


def unguided(data):
    mean = numpyro.sample("mean", dist.Normal(0.0, 1.0))
    with numpyro.plate("specimens", len(data)):
        nb.sample("wing", unguided_law(mean), obs=data)


def test_one_point_is_that_of_the_chain():
    """Each noise is a draw given its datum, by `sample_with_noise`: 1 / p̂ has mean 1 / p.

    With new points alone p̂ has mean p, and 1 / p̂ is too large by the relative variance of p̂.
    """
    mean, size = 0.7, 4000
    data, noise = unguided_law(mean).expand([size]).sample_with_noise(jr.key(0))
    truth = stats.norm(SLOPE * mean, UNGUIDED_SD).logpdf(np.asarray(data)[:, 0])
    draws = {"mean": np.full((1, 1), mean), "wing_noise": np.asarray(noise)[None, None]}
    found = nb.log_likelihood(made_up_run(unguided, draws, data), num_particles=8)
    check_mean_is_1(np.exp(truth - found.values["wing"][0, 0]), 0.05)
    new = nb.log_likelihood(made_up_run(unguided, {"mean": draws["mean"]}, data), num_particles=8)
    ratios = np.exp(new.values["wing"][0, 0] - truth)
    check_mean_is_1(ratios, 0.05)
    assert np.mean(1 / ratios) > 1.1


# Effects


def model_of_units(data=None, units=6):
    """An effect of each unit on both of its coordinates."""
    mean = numpyro.sample("mean", dist.Normal(0.0, 1.0))
    spread = numpyro.sample("spread", dist.LogNormal(-1.0, 0.5))
    with numpyro.plate("unit", units):
        shift = numpyro.sample("shift", dist.Normal(mean, spread))
        numpyro.deterministic("twice", 2 * shift)
        nb.sample("wing", law_of(shift, dim=2, batch_shape=(units,)), obs=data)


UNITS = np.random.default_rng(0).normal(0.4, 0.8, (6, 2))


def log_density_of_units(mean, spread):
    """Both coordinates of a unit share its effect: a dense normal, by sum and difference."""
    mean, variance = (
        SLOPE * np.asarray(mean)[..., None],
        VARIANCE + 2 * (SLOPE * np.asarray(spread)[..., None]) ** 2,
    )
    sums = (UNITS.sum(1) - 2 * mean) ** 2 / (2 * variance) + np.log(2 * np.pi * variance)
    differences = (UNITS[:, 0] - UNITS[:, 1]) ** 2 / (2 * VARIANCE) + np.log(2 * np.pi * VARIANCE)
    return -0.5 * (sums + differences)


@pytest.fixture(scope="module")
def units():
    """Exact draws of parameters, from a grid, and of effects; an exact guide leaves N(0, I)."""
    means, spreads = np.linspace(-2.5, 3.5, 121), np.exp(np.linspace(-3.5, 1.5, 101))
    pointwise = log_density_of_units(*np.meshgrid(means, spreads, indexing="ij"))
    prior = stats.norm.logpdf(means)[:, None] + stats.norm(-1, 0.5).logpdf(np.log(spreads))
    weights = np.exp(prior + pointwise.sum(-1))
    rest = np.exp(prior[..., None] + pointwise.sum(-1)[..., None] - pointwise)
    elpd = np.log(np.sum(rest * np.exp(pointwise), (0, 1)) / np.sum(rest, (0, 1)))
    rng = np.random.default_rng(1)
    places = rng.choice(weights.size, (2, 400), p=(weights / weights.sum()).ravel())
    m, s = means[places // len(spreads)], spreads[places % len(spreads)]
    precision = (2 * SLOPE**2 / VARIANCE + 1 / s**2)[..., None]
    centre = (SLOPE * UNITS.sum(1) / VARIANCE + (m / s**2)[..., None]) / precision
    shift = centre + rng.normal(size=centre.shape) / np.sqrt(precision)
    noise = rng.normal(size=(2, 400, len(UNITS), 2, 2, 1))
    samples = {"mean": m, "spread": s, "shift": shift, "wing_noise": noise, "twice": 2 * shift}
    return made_up_run(model_of_units, samples, UNITS), elpd


def test_effects_are_integrated_out(units):
    """Against the dense normal of both coordinates of a unit."""
    mcmc, _ = units
    found, samples = nb.log_likelihood(mcmc, num_particles=8, draws=800), mcmc.get_samples()
    truth = log_density_of_units(samples["mean"], samples["spread"])
    values = found.values["wing"].reshape(-1, len(UNITS))
    check_mean_is_1(np.exp(truth - values), 0.03)
    error = np.sqrt(np.mean((values - truth) ** 2))
    assert (
        error == pytest.approx(np.sqrt(np.mean(found.standard_error["wing"] ** 2)), rel=0.3)
        and error < 0.3
    )
    assert np.all(found.pareto_k["wing"] < 0.7) and "6 data" in str(found)


def harmonic(values):
    """Leave-one-out without smoothing: the harmonic mean over the draws."""
    return np.sum(-np.log(np.mean(np.exp(-values.reshape(-1, values.shape[-1])), 0)))


def test_leave_one_out_of_units(units):
    """Against the predictive density of each unit given the others, on a grid of the parameters."""
    mcmc, elpd = units
    values = nb.log_likelihood(mcmc, draws=200).values["wing"]
    assert values.shape == (2, 100, 6)
    print(f"{harmonic(values):.3f}, exactly {elpd.sum():.3f}")
    assert harmonic(values) == pytest.approx(elpd.sum(), abs=0.25)


def test_predictive_checks(units):
    """The same units keep their effects, new ones have others; noise plays no part."""
    draws = {name: value[::2] for name, value in units[0].get_samples().items()}
    same = Predictive(model_of_units, draws)(jr.key(0))["wing"]
    assert same.shape == (400, 6, 2)
    check_normal((same - SLOPE * draws["shift"][..., None]) / np.sqrt(VARIANCE))
    shared = {name: draws[name] for name in ("mean", "spread")}
    new = Predictive(model_of_units, shared)(jr.key(1), units=5)["wing"].sum(
        -1
    )  # both coordinates have the effect
    assert new.shape == (400, 5)
    variance = 2 * VARIANCE + (2 * SLOPE * draws["spread"]) ** 2
    check_normal((new - 2 * SLOPE * draws["mean"][:, None]) / np.sqrt(variance)[:, None])
    with pytest.raises(ValueError, match="one noise for each datum"):
        Predictive(model_of_units, {"wing_noise": draws["wing_noise"]})(jr.key(1), units=5)


def check_normal(values):
    """Independent standard normal numbers, by the test of Kolmogorov and Smirnov."""
    found = stats.kstest(np.ravel(values), "norm")
    assert found.pvalue > 1e-4 and np.size(values) >= 2000


def positive(data):
    mean = numpyro.sample("mean", dist.Normal(0.0, 1.0))
    with numpyro.plate("unit", len(data)):
        size = numpyro.sample("size", dist.LogNormal(mean, 0.5))
        shift = numpyro.sample("also", dist.Normal(0.3 * size, 0.2))
        nb.sample("wing", law_of(size + shift, batch_shape=(len(data),)), obs=data)


def test_any_proposal_gives_the_integral():
    """New points alone, of effects whose draws are not of the posterior; against quadrature."""
    data, rng = np.array([[0.2], [2.0], [1.0]]), np.random.default_rng(2)
    samples = {"mean": rng.normal(0.3, 0.4, (1, 150)), "also": rng.normal(0.5, 0.4, (1, 150, 3))}
    samples["size"] = np.exp(rng.normal(0.4, 0.2, (1, 150, 3)))
    found = nb.log_likelihood(made_up_run(positive, samples, data), num_particles=64).values[
        "wing"
    ][0]
    log_size, step = np.linspace(-5, 5, 2001, retstep=True)
    truth = []
    for mean in samples["mean"][0]:
        prior = stats.norm(mean, 0.5).pdf(log_size)
        seen = stats.norm(
            SLOPE * 1.3 * np.exp(log_size), np.sqrt(VARIANCE + (SLOPE * 0.2) ** 2)
        ).pdf(data)
        truth.append(np.sum(prior * seen, 1) * step)
    check_mean_is_1(np.exp(found) / np.array(truth), 0.05)


# Which sites are integrated out


def parts_of(model):
    """By observed sites: the noise, the effects and what must be known."""
    mcmc = made_up_run(model, {"mean": np.zeros((1, 1))})
    _, replay = model_of(mcmc)
    return {
        part.name: (part.noise, part.effects, part.needs)
        for part in _parts(sites_of(model, (), {}), replay)
    }


def test_effects_are_those_of_the_plates_of_a_datum():
    def nested():
        mean = numpyro.sample("mean", dist.Normal())
        with numpyro.plate("groups", 3):  # as many as specimens
            group = numpyro.sample("group", dist.Normal(mean))
        with numpyro.plate("specimens", 3, dim=-1):
            effect = numpyro.sample("effect", dist.Normal(group[np.array([0, 0, 1])]))
            unused = numpyro.sample("unused", dist.Normal())
            kind = numpyro.sample("kind", dist.Bernoulli(0.5))
            nb.sample("wing", law_of(effect + kind, batch_shape=(3,)), obs=np.zeros((3, 1)))
            individual = numpyro.sample("individual", dist.Normal())
            with numpyro.plate("years", 4, dim=-2):
                numpyro.sample("size", dist.Normal(individual), obs=np.zeros((4, 3)))
        numpyro.sample("alone", dist.Normal(mean), obs=0.0)
        assert unused.shape == (3,)

    assert parts_of(nested) == {
        "wing": (("wing_noise",), ("effect",), {"group", "kind"}),
        "size": ((), (), {"individual"}),
        "alone": ((), (), {"mean"}),
    }


def test_sites_that_share_an_effect_are_left_out_together():
    def joint():
        with numpyro.plate("specimens", 3):
            base = numpyro.sample("base", dist.Normal())
            effect = numpyro.sample("effect", dist.Normal(base))
            nb.sample("wing", law_of(effect, batch_shape=(3,)), obs=np.zeros((3, 1)))
            numpyro.sample("size", dist.Normal(base), obs=np.zeros(3))
            numpyro.sample("other", dist.Normal(), obs=np.zeros(3))

    assert parts_of(joint) == {
        "wing+size": (("wing_noise",), ("base", "effect"), frozenset()),
        "other": ((), (), frozenset()),
    }
    samples = {
        "base": np.zeros((1, 9, 3)),
        "effect": np.zeros((1, 9, 3)),
        "wing_noise": np.zeros((1, 9, 3, 2, 1, 1)),
    }
    found = nb.to_arviz(made_up_run(joint, samples)).log_likelihood
    assert found["wing+size"].dims == ("chain", "draw", "specimens") and set(found.data_vars) == {
        "wing+size",
        "other",
    }
    np.testing.assert_allclose(found["other"], stats.norm.logpdf(0.0))


def in_a_scan():
    def step(x, y):
        nb.sample("wing", law_of(jnp.zeros(())), obs=y)
        return x, None

    scan(step, jnp.zeros(()), jnp.zeros((3, 1)))


def test_data_in_a_scan():
    with pytest.warns(UserWarning, match=r"\['wing'\] are data in a `scan`"):
        assert parts_of(in_a_scan) == {}
    with pytest.raises(ValueError, match="`wing.*is in a `scan`.*write the loop out"):
        log_density(handlers.seed(nb.infer.integrate_noise(in_a_scan), 0), (), {}, {})


# Trees


def waves(t, x, args):
    return jnp.sin(2 * x)


def test_noise_of_tips_is_drawn_anew():
    """A root with two tips is two bridges."""
    tree = nb.Tree.from_newick("((a:0.5,b:0.5)c:0.3,d:1.0);")
    root = nb.DiffusionTree(
        nb.BrownianMotion(0.5), np.zeros(1), nb.InexactMatch(0.1), tree=tree, num_steps=2
    )
    blocks = root.noise_blocks
    tips = [
        node for node in tree.active if node not in {tree.parents[other] for other in tree.active}
    ]
    assert [tree.names[node] for node in tips] == ["a", "b", "d"]
    np.testing.assert_array_equal(
        _rows_of_tips(blocks), [False, False, True, True, True, True, True, True]
    )
    sde, seen, data = (
        nb.SDE(waves, lambda t, x, args: 0.7),
        nb.InexactMatch(0.05),
        np.array([[0.9], [0.3]]),
    )
    star = nb.Tree.from_newick("(a:0.5,b:0.8);")

    def model():
        numpyro.sample("mean", dist.Normal())
        nb.sample(
            "tips", nb.DiffusionTree(sde, np.array([0.2]), seen, tree=star, num_steps=4), obs=data
        )

    samples = {"mean": np.zeros((1, 2)), "tips_noise": np.zeros((1, 2, 8, 1, 1))}
    found = nb.log_likelihood(made_up_run(model, samples), num_particles=4000)
    for i, t1 in enumerate((0.5, 0.8)):
        bridge = nb.GuidedBridge(sde, seen.at(data[i]), x0=np.array([0.2]), t1=t1, num_steps=4)
        truth = nb.estimate_evidence(bridge, jr.key(1), num_particles=4000)
        errors = np.hypot(found.standard_error["tips"][i], truth.standard_error)
        assert (
            0.001 < errors < 0.05
            and abs(found.values["tips"][0, 1, i] - truth.log_evidence) < 4 * errors
        )


# Models without their noise


def test_a_model_without_its_noise_has_the_likelihood_on_average():
    parameters, data, mean = nb.infer.integrate_noise(unguided, 16), np.array([[0.3], [1.2]]), 0.7

    @jax.jit
    def log_densities(keys):
        def one(key):
            return log_density(handlers.seed(parameters, key), (data,), {}, {"mean": mean})[0]

        return jax.lax.map(one, keys, batch_size=500)

    truth = stats.norm.logpdf(mean) + stats.norm(SLOPE * mean, UNGUIDED_SD).logpdf(data).sum()
    check_mean_is_1(np.exp(log_densities(jr.split(jr.key(0), 4000)) - truth), 0.05)
    trace = handlers.trace(handlers.seed(parameters, 0)).get_trace(data)
    assert [name for name, site in trace.items() if site["type"] == "sample"] == ["mean", "wing"]


def test_noise_that_is_not_of_one_law():
    def classes():
        laws = [law_of(mean) for mean in (0.0, 1.0)]
        noise = numpyro.sample("noise", laws[0].noise_prior(), infer={"driving_noise": True})
        mixed = dist.MixtureGeneral(
            dist.CategoricalProbs(jnp.ones(2) / 2), [law.given(noise) for law in laws]
        )
        numpyro.sample("wing", mixed, obs=np.zeros(1))

    with pytest.raises(
        ValueError, match=r"each noise must drive one observed law.*\['noise'\].*\[\]"
    ):
        handlers.seed(nb.infer.integrate_noise(classes), 0)()
    assert parts_of(classes) == {"wing": (("noise",), (), frozenset())}


def test_arguments():
    mcmc = made_up_run(unguided, {"mean": np.zeros((1, 1))}, np.zeros((1, 1)))
    with pytest.raises(ValueError, match="`num_particles` must be an integer, at least 8; got 7"):
        nb.log_likelihood(mcmc, num_particles=7)
    with pytest.raises(ValueError, match="must run a NumPyro model"):
        nb.log_likelihood(MCMC(NUTS(potential_fn=lambda z: z**2), num_warmup=1, num_samples=1))
    with pytest.raises(ValueError, match="`model` must be a NumPyro model"):
        nb.infer.integrate_noise(3)
