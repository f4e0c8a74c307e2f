"""The MCMC kernels at their edges: settings, starts, models that draw, new data for an old chain."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from jax.example_libraries import stax
from numpyro.contrib.control_flow import cond, scan
from numpyro.contrib.module import random_eqx_module
from numpyro.diagnostics import effective_sample_size
from numpyro.infer import MCMC, NUTS, Gibbs, init_to_median
from numpyro.infer.gibbs import GIBBS_SITES_KWARG
from numpyro.infer.util import potential_energy

import numpyro_bridges as nb
from numpyro_bridges.infer import (
    PCN,
    PCNL,
    CorrelatedPseudoMarginal,
    CorrelatedPseudoMarginalMALA,
    FunctionSpaceHMC,
    _kernel,
    _reference,
    noise_sites,
    run_checkpointed,
)
from numpyro_bridges.infer._posterior import is_latent, misfit, sites_of
from numpyro_bridges.infer._seal import of_arguments, with_key

pytestmark = pytest.mark.usefixtures("compile_quickly")

RNG = np.random.default_rng(0)
DATA = np.array([[0.4], [0.9]])


def law_of(mean):
    return nb.DiffusionEndpoint(
        nb.LinearSDE(-1.0, 0.6, mean), [0.0], nb.InexactMatch(0.1), t1=1.0, num_steps=1
    )


def model(data):
    mean = numpyro.sample("mean", dist.Normal(0.0, 2.0))
    with numpyro.plate("specimen", len(data)):
        nb.sample("wing", law_of(mean), obs=data)


# For each setting: what is accepted, and what is out of range.
POSITIVE = [1e-9, 0.5, 50, np.int64(3)], [0, -1.0, 1e-400]
PROPORTION = [0.01, 0.99], [0.0, 1.0, -0.5, 2]
PROPORTION_OR_0 = [0, 0.0, 0.99], [1.0, -1e-9, 2]
NUMBERS = [
    (FunctionSpaceHMC, "step_size", *POSITIVE),
    (FunctionSpaceHMC, "trajectory_length", *POSITIVE),
    (FunctionSpaceHMC, "target_accept_prob", *PROPORTION),
    (FunctionSpaceHMC, "jitter", *PROPORTION_OR_0),
    (PCN, "angle", [1e-9, np.pi / 2, np.float32(np.pi / 2)], [0.0, -1.0, 1.5709]),
    (PCNL, "target_accept_prob", *PROPORTION),
    (CorrelatedPseudoMarginal, "correlation", *PROPORTION_OR_0),
    (CorrelatedPseudoMarginalMALA, "step_size", *POSITIVE),
]
NO_NUMBERS = [
    "0.5",
    True,
    np.True_,
    0.5 + 0j,
    np.nan,
    np.inf,
    [0.5],
    np.array([0.5]),
    b"1",
    np.datetime64("2020"),
    {},
]


def name_of(x):
    return x if isinstance(x, str) else getattr(x, "__name__", None)


@pytest.mark.parametrize("kernel, name, inside, outside", NUMBERS, ids=name_of)
def test_numbers(kernel, name, inside, outside):
    """Of any real type and in range, anything else refused by name."""
    for value in inside:
        kernel(model, **{name: value})
    for value in (np.float32(0.5), np.float64(0.5), np.array(0.5), jnp.asarray(0.5)):
        kernel(model, **{name: value})
    for value in outside + NO_NUMBERS:
        with pytest.raises(ValueError, match=f"`{name}` must be"):
            kernel(model, **{name: value})


COUNT = [1, np.int64(3)], [0, -3, 2.0, "a", True, np.inf], "a positive integer"
SWITCH = [True, np.False_], ["no", 1, 0.0, None], "True or False"
STRATEGY = [init_to_median, init_to_median(num_samples=3)], ["median", 3, None], "a strategy"
OTHERS = [
    (FunctionSpaceHMC, "max_num_steps", *COUNT),
    (PCN, "num_moves", *COUNT),
    (PCNL, "num_blocks", *COUNT),
    (CorrelatedPseudoMarginal, "num_particles", *COUNT),
    (CorrelatedPseudoMarginalMALA, "max_particles", *COUNT),
    (FunctionSpaceHMC, "adapt_step_size", *SWITCH),
    (PCNL, "adapt_angle", *SWITCH),
    (FunctionSpaceHMC, "init_strategy", *STRATEGY),
    (PCN, "init_strategy", *STRATEGY),
    (CorrelatedPseudoMarginal, "init_strategy", *STRATEGY),
]


@pytest.mark.parametrize("kernel, name, good, bad, rule", OTHERS, ids=name_of)
def test_counts_switches_and_strategies(kernel, name, good, bad, rule):
    for value in good:
        kernel(model, **{name: value})
    for value in bad:
        with pytest.raises(ValueError, match=f"`{name}` must be {rule}"):
            kernel(model, **{name: value})


@pytest.fixture(scope="module", autouse=True)
def no_laplace():
    """Chains start at the reference that knows nothing, as the tests here ask for."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_reference, "_MAX_EVALUATIONS", 1)
        yield


@pytest.mark.parametrize(
    "settings, num_warmup, expected, least",
    [
        # one long step by a reference that knows nothing: mostly refused
        ({"max_num_steps": 1}, 5, {1}, 0.0),
        ({"max_num_steps": 3, "step_size": 1e-9, "adapt_step_size": False}, 0, {3}, 0.1),
    ],
)
def test_number_of_steps(settings, num_warmup, expected, least):
    """Within its bound, adapted or not; the step is the one that was made."""
    kernel = FunctionSpaceHMC(model, trajectory_length=2.1, **settings)
    mcmc = MCMC(kernel, num_warmup=num_warmup, num_samples=4, thinning=2, progress_bar=False)
    mcmc.run(jr.key(0), DATA, extra_fields=("num_steps", "adapt_state.step_size", "accept_prob"))
    found = mcmc.get_extra_fields()
    assert set(found["num_steps"].tolist()) == expected
    np.testing.assert_allclose(found["num_steps"] * found["adapt_state.step_size"], 2.1)
    assert np.all(found["accept_prob"] > least)


def subset(data):
    mean = numpyro.sample("mean", dist.Normal(0.0, 2.0))
    with numpyro.plate("specimen", len(data), subsample_size=1) as index:
        nb.sample("wing", law_of(mean), obs=jnp.asarray(data)[index])


def with_factor(draw):
    """The model with a factor that is drawn."""

    def model_with_factor(data):
        model(data)
        numpyro.factor("more", draw())

    return model_with_factor


def in_scan(draw):
    def drawn():
        return scan(lambda total, _: (total + draw(), None), 0.0, None, length=3)[0]

    return with_factor(drawn)


def draw_from_key():
    return jr.normal(numpyro.prng_key())


def draw_hidden():
    with numpyro.handlers.block():
        return numpyro.sample("hidden", dist.Normal())


def draw_network():
    network = numpyro.module("network", stax.Dense(1), (1,))
    return network(jnp.ones(1))[0]


def draw_subset():
    with numpyro.plate("part", 5, subsample_size=2) as index:
        return jnp.sum(index) * 1.0


def draw_deterministic():
    numpyro.deterministic("predicted", draw_from_key())
    return 0.0


def fixed(model):
    return numpyro.handlers.condition(model, {"mean": 0.3})


RANDOM = {
    "subset": (subset, "plate `specimen` draws 1 of its 2 data at random"),
    "subset, seeded": (numpyro.handlers.seed(subset, 1), "plate `specimen` draws 1 of its 2 data"),
    "subset in a factor": (with_factor(draw_subset), "plate `part` draws 2 of its 5 data"),
    "subset in scan": (in_scan(draw_subset), "the model needs a random key"),
    "key": (with_factor(draw_from_key), "the model needs a random key"),
    "key, seeded": (
        numpyro.handlers.seed(with_factor(draw_from_key), 1),
        "the model needs a random key",
    ),
    "key in scan": (in_scan(draw_from_key), "the model needs a random key"),
    "key, of no weight": (with_factor(draw_deterministic), "the model needs a random key"),
    "hidden site": (with_factor(draw_hidden), "the model needs a random key"),
    "network": (with_factor(draw_network), "the model needs a random key"),
}


@pytest.mark.parametrize("name", RANDOM)
def test_hidden_randomness_is_refused(name):
    model, message = RANDOM[name]
    with pytest.raises(ValueError, match=message):
        FunctionSpaceHMC(model).init(jr.key(0), 0, None, (DATA,), {})


@pytest.mark.parametrize(
    "kernel",
    [
        lambda model: PCN(fixed(model)),
        lambda model: PCNL(fixed(model)),
        lambda model: CorrelatedPseudoMarginal(model),
        lambda model: CorrelatedPseudoMarginalMALA(model, 2),
        lambda model: Gibbs([(PCN(model), noise_sites), (NUTS(model), None)]),
    ],
    ids=["PCN", "PCNL", "pilot", "MALA", "Gibbs"],
)
def test_every_kernel_refuses_it(kernel, tmp_path):
    mcmc = MCMC(kernel(with_factor(draw_from_key)), num_warmup=1, num_samples=1, progress_bar=False)
    with pytest.raises(ValueError, match="the model needs a random key"):
        run_checkpointed(mcmc, tmp_path / "run", jr.key(0), DATA)
    assert not (tmp_path / "run").exists()


def test_sites_must_stay():
    """What another argument of the model adds, no chain has."""

    def growing(data, more=False):
        model(data)
        if more:
            numpyro.sample("new", dist.Normal())

    kernel = FunctionSpaceHMC(growing)
    state = jax.eval_shape(lambda key: kernel.init(key, 0, None, (DATA,), {}), jr.key(0))
    with pytest.raises(ValueError, match="site `new` would be drawn at random"):
        jax.eval_shape(lambda state: kernel.sample(state, (DATA,), {"more": True}), state)


def without_randomness(data):
    """Plates that take all, deterministic sites, control flow, a network with a prior, supports."""
    with numpyro.plate("specimen", len(data), subsample_size=len(data)):
        data = numpyro.subsample(jnp.asarray(data), event_dim=1)
        width = numpyro.sample("width", dist.LogNormal(0.0, 0.1))
    numpyro.deterministic("widths", 2 * width)
    numpyro.sample("inside", dist.Uniform(0.0, jnp.sum(width)))

    def step(total, _):
        total, _ = scan(lambda x, _: (x + 1.0, None), total, None, length=2)
        total = cond(total > 0, lambda x: 2 * x, lambda x: x, total)
        return total + numpyro.sample("step", dist.Normal()), None

    total, _ = scan(step, 0.0, None, length=3)
    network = random_eqx_module("network", eqx.nn.Linear(1, 1, key=jr.key(0)), prior=dist.Normal())
    numpyro.factor("more", total + network(jnp.ones(1))[0])
    model(data)


def test_what_is_not_random_goes_on():
    """With the posterior that NumPyro gives the same model under a seed, which plays no part."""
    seeded = numpyro.handlers.seed(without_randomness, 3)
    latent = {
        name: site
        for name, site in sites_of(without_randomness, (DATA,), {}).items()
        if is_latent(site)
    }
    z = {name: 0.1 * jnp.ones(jnp.shape(site["value"])) for name, site in latent.items()}
    prior = np.sum(z["wing_noise"] ** 2 + np.log(2 * np.pi)) / 2
    expected = potential_energy(seeded, (DATA,), {}, z) - prior
    np.testing.assert_allclose(misfit(without_randomness, (DATA,), {}, z), expected, rtol=1e-12)
    values = FunctionSpaceHMC(without_randomness).postprocess_fn((DATA,), {})(z)
    assert set(values) == set(z) | {"widths"}
    np.testing.assert_allclose(values["widths"], 2 * np.exp(0.1))
    own_seed = numpyro.handlers.seed(model, 0)
    assert misfit(own_seed, (DATA,), {}, z) == misfit(model, (DATA,), {}, z)


def nested(data, bound=None):
    top = numpyro.sample("top", dist.LogNormal(0.0, 1.0))
    own = numpyro.sample("own", dist.LogNormal(jnp.log(top), 1.0))
    numpyro.sample("inner", dist.Uniform(0.0, own if bound is None else bound * top))
    model(data)


def test_supports_across_blocks():
    """`Gibbs` asks for the values of a block before it knows those of the others."""
    kernel = Gibbs(
        [
            (FunctionSpaceHMC(nested), ["own", "inner", "mean", "wing_noise"]),
            (NUTS(nested), ["top"]),
        ]
    )
    with pytest.raises(
        ValueError, match=r"supports of the sites \['inner'\] depend on sites of other blocks"
    ):
        kernel.init(jr.key(0), 0, None, (DATA, 2.0), {})
    jax.eval_shape(lambda key: kernel.init(key, 0, None, (DATA,), {}), jr.key(0))


@jax.custom_jvp
def without_slope(x):
    return x


@without_slope.defjvp
def _(x, dx):
    return x[0], jnp.where(x[0] > 0, jnp.nan, 1.0) * dx[0]


def no_slope(data):
    model(data)
    scale = numpyro.sample("scale", dist.LogNormal(jnp.zeros(3), 0.1).to_event(1))
    numpyro.factor("more", 0.01 * without_slope(scale[:2]))


def no_density(data):
    model(data)
    numpyro.factor("more", jnp.array([0.0, -jnp.inf]))


STARTS = {
    "gradient": (
        FunctionSpaceHMC,
        no_slope,
        None,
        "gradient is not finite.*gradient of `scale`, nan in 2 of 3",
    ),
    "MALA": (
        CorrelatedPseudoMarginalMALA,
        no_slope,
        None,
        "gradient is not finite.*gradient of `scale`, nan in 2",
    ),
    "density": (
        FunctionSpaceHMC,
        no_density,
        None,
        "energy is inf at.*log density of `more`, -inf in 1 of 2 entries",
    ),
    "name": (
        FunctionSpaceHMC,
        model,
        {"meen": 0.1},
        r"values for \['meen'\]; the latent sites are \['mean', 'wing_n",
    ),
    "shape": (
        FunctionSpaceHMC,
        model,
        {"mean": jnp.zeros(2)},
        r"must have shape \(\), unconstrained; got \(2,\)",
    ),
    "kind": (FunctionSpaceHMC, model, {"mean": "0.1"}, r"`init_params\['mean'\]` must be a number"),
    "no dictionary": (
        FunctionSpaceHMC,
        model,
        [0.1],
        "`init_params` must be a dictionary by sites",
    ),
}


@pytest.mark.parametrize("name", STARTS)
def test_starts(name):
    kernel, model, init_params, message = STARTS[name]
    kernel = kernel(model, 2) if kernel is CorrelatedPseudoMarginalMALA else kernel(model)
    with pytest.raises(ValueError, match=message):
        kernel.init(jr.key(0), 0, init_params, (DATA,), {})


def test_start_of_one_of_several_chains():
    keys = jr.split(jr.key(0), 3)
    kernel = FunctionSpaceHMC(model)
    with pytest.raises(
        ValueError, match="at the start of chain 1: .*the value of `mean`, inf in 1 of 1"
    ):
        kernel.init(keys, 0, {"mean": jnp.array([0.0, jnp.inf, jnp.nan])}, (DATA,), {})
    with pytest.raises(
        ValueError, match=r"shape \(3,\), unconstrained, chains in front; got \(2,\)"
    ):
        kernel.init(keys, 0, {"mean": jnp.zeros(2)}, (DATA,), {})


def test_seal():
    """The same traced or not; another for each change of arguments, of their kind, or of the key."""
    data, key = RNG.normal(size=(3, 2)), jr.key(0)
    base = (
        (data, {"n": 3, "how": "left", "mask": np.array([True, False])}, np.float32(0.5), key),
        {},
    )

    def of(arguments):
        return int(with_key(of_arguments(arguments), key))

    def changed(place, value):
        return (*base[0][:place], value, *base[0][place + 1 :]), {}

    others = [
        changed(0, -data),
        changed(0, data[::-1]),
        changed(0, np.nextafter(data, 9.0)),
        changed(0, data.reshape(2, 3)),
        changed(0, data.astype(np.float32)),
        changed(1, {**base[0][1], "how": "right"}),
        changed(1, {**base[0][1], "n": 4}),
        changed(1, {**base[0][1], "mask": np.array([False, True])}),
        changed(2, np.float32(-0.5)),
        changed(3, jr.key(1)),
        (base[0], {"more": None}),
    ]
    seals = [of(base), *map(of, others), int(with_key(of_arguments(base), jr.key(2)))]
    assert len(set(seals)) == len(seals)
    assert of(((jnp.asarray(data), *base[0][1:]), {})) == seals[0]
    # the values of other blocks of `Gibbs` are no arguments: it tells itself when they change
    others = {GIBBS_SITES_KWARG: {"mean": 0.3}}
    assert _kernel._seal_of((data,), others) == _kernel._seal_of((data,), {})
    traced = jax.jit(lambda data, mask, x, key: of_arguments((data, mask, x, key)))
    parts = data, np.array([True, False]), np.float32(0.5), key
    np.testing.assert_array_equal(traced(*parts), of_arguments(parts))


WARM = {
    "FunctionSpaceHMC": lambda: FunctionSpaceHMC(model),
    "PCN": lambda: PCN(fixed(model), num_moves=2, num_blocks=1),
    "PCNL": lambda: PCNL(fixed(model), num_moves=2),
    "MALA": lambda: CorrelatedPseudoMarginalMALA(model, 3),
}


@pytest.mark.parametrize("name", WARM)
def test_energies_are_those_of_the_data(name):
    """From the first draw on, accepted or not; on the same data a chain goes on bit for bit."""
    kernel, other = WARM[name](), DATA + 4.0
    start = kernel.init(jr.key(0), 0, None, (DATA,), {})

    @jax.jit
    def draws(state, data, number):
        return jax.lax.fori_loop(
            0, number, lambda _, state: kernel.sample(state, (data,), {}), state
        )

    def once(state, data):
        return draws(state, data, 1)

    state = once(once(start, DATA), DATA)
    for data in (other, DATA, other):
        new = once(state, data)
        again = kernel.refresh(new, (data,), {})
        for field in kernel._energies:
            found, expected = getattr(new, field), getattr(again, field)
            jax.tree.map(
                lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9), found, expected
            )
        assert new.seal == again.seal and new.i == state.i + 1
        state = new
    whole, parts = draws(start, DATA, 2), once(once(start, DATA), DATA)
    jax.tree.map(
        np.testing.assert_array_equal, whole._replace(rng_key=0), parts._replace(rng_key=0)
    )


def test_warm_chains_on_new_data():
    """Passed by name to a program that is there already; their posterior is normal."""
    mcmc = MCMC(
        FunctionSpaceHMC(model),
        num_warmup=200,
        num_samples=1000,
        num_chains=2,
        chain_method="vectorized",
        progress_bar=False,
        jit_model_args=True,
    )
    mcmc.run(jr.key(0), data=DATA)
    mcmc.post_warmup_state = mcmc.last_state
    data = DATA + 2.0
    mcmc.run(jr.key(1), data=data)
    slope, variance = 1 - np.exp(-1.0), 0.36 * (1 - np.exp(-2.0)) / 2 + 0.1
    precision = 1 / 4 + data.size * slope**2 / variance
    mean, sd = data.sum() * slope / variance / precision, precision**-0.5
    draws = mcmc.get_samples(group_by_chain=True)["mean"][:, 200:]
    error = 1 / np.sqrt(effective_sample_size(np.asarray(draws)))
    assert error < 0.06
    assert abs(draws.mean() - mean) < 4 * error * sd
    assert draws.std() == pytest.approx(sd, rel=0.15)


@pytest.fixture
def optimized():
    """The compiler as users have it, in a module that goes without most optimisations."""
    jax.config.update("jax_disable_most_optimizations", False)
    yield
    jax.config.update("jax_disable_most_optimizations", True)


@pytest.mark.usefixtures("optimized")
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_chains_start_within_another_program(dtype):
    """Whose compiler's options are not to be changed; the key may be known, and the data not."""

    def model(observed):
        sd = numpyro.sample("sd", dist.LogNormal(jnp.zeros((), dtype), 0.3))
        law = nb.DiffusionEndpoint(
            nb.BrownianMotion(sd**2), np.zeros(1), nb.InexactMatch(0.1), t1=1.0, num_steps=2
        )
        nb.sample("x", law, obs=observed)

    def start(observed, key):
        state = FunctionSpaceHMC(model).init(key, 10, None, (observed,), {})
        return state.potential_energy

    observed = jnp.array([0.7], dtype)
    key = jr.key(0)
    plain = start(observed, key)
    for traced in (
        jax.jit(lambda: start(observed, key))(),
        jax.jit(lambda observed: start(observed, key))(observed),
        jax.jit(start)(observed, key),
        jax.vmap(start)(observed[None], key[None])[0],
    ):
        np.testing.assert_allclose(traced, plain, rtol=2e-3)
