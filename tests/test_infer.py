"""The MCMC kernels: exact, in NumPyro's contract, and with an acceptance that does not depend on
the grid.
"""

import pickle

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro.diagnostics import effective_sample_size, gelman_rubin
from numpyro.infer import MCMC, NUTS, Gibbs
from scipy import stats

import numpyro_bridges as nb
from numpyro_bridges.infer import (
    PCN,
    PCNL,
    CorrelatedPseudoMarginal,
    CorrelatedPseudoMarginalMALA,
    FunctionSpaceHMC,
    noise_sites,
)
from numpyro_bridges.infer._pseudo_marginal import _choose

pytestmark = pytest.mark.usefixtures("compile_quickly")

DATA = np.random.default_rng(0).normal(0.5, 0.5, (3, 2))


def conjugate(data=None, n=3):
    """Ornstein-Uhlenbeck processes with a common mean, guided by another process: the weights
    depend on the noise.
    """
    mean = numpyro.sample("mean", dist.Normal(0.0, 2.0))
    sde, guide = nb.LinearSDE(-1.0, 0.6, mean), nb.FrozenGuide(nb.LinearSDE(0.0, 0.75, 0.3))
    law = nb.DiffusionEndpoint(
        sde, np.zeros(2), nb.InexactMatch(0.1), t1=1.0, num_steps=4, guide=guide
    )
    with numpyro.plate("specimen", n):
        nb.sample("wing", law, obs=data)


def conjugate_posterior():
    """Mean and standard deviation of the mean, by hand."""
    slope, variance = 1 - np.exp(-1.0), 0.36 * (1 - np.exp(-2.0)) / 2 + 0.1
    precision = 1 / 4 + DATA.size * slope**2 / variance
    return DATA.sum() * slope / variance / precision, precision**-0.5


def sine(data=None, n=None):
    """A nonlinear process in which every parameter matters, and a crude guide."""
    force = numpyro.sample("force", dist.Normal(1.0, 0.5))
    spread = numpyro.sample("spread", dist.LogNormal(-0.5, 0.4))
    sde = nb.SDE(
        lambda t, x, a: a[0] * jnp.sin(2 * x),
        lambda t, x, a: a[1] * (1 + 0.3 * jnp.cos(x)),
        (force, spread),
    )
    law = nb.DiffusionEndpoint(
        sde, np.zeros(1), nb.InexactMatch(0.05), t1=1.0, num_steps=4, guide=nb.FrozenGuide()
    )
    nb.sample("v", law, obs=data)


def with_nuts(kernel, **settings):
    return lambda model: Gibbs(
        [(kernel(model, **settings), noise_sites), (NUTS(model, step_size=0.3), None)]
    )


KERNELS = {
    "FunctionSpaceHMC": FunctionSpaceHMC,
    "PCN": with_nuts(PCN, num_moves=2),
    "PCN-blocks": with_nuts(PCN, num_moves=2, num_blocks=2),
    "PCNL": with_nuts(PCNL),
    "pseudo-marginal-2": lambda model: CorrelatedPseudoMarginal(model, 2),
    "pseudo-marginal-5": lambda model: CorrelatedPseudoMarginal(model, 5),
    "pseudo-marginal-20": lambda model: CorrelatedPseudoMarginal(model, 20),
    "MALA-2": lambda model: CorrelatedPseudoMarginalMALA(model, 2),
}


def run(kernel, *args, num_warmup=300, num_samples=1000, num_chains=4, **settings):
    chain_method = jax.vmap if isinstance(kernel, Gibbs) else "vectorized"
    mcmc = MCMC(
        kernel,
        num_warmup=num_warmup,
        num_samples=num_samples,
        num_chains=num_chains,
        chain_method=chain_method,
        progress_bar=False,
    )
    mcmc.run(jr.key(0), *args, **settings)
    return mcmc


SOME = [
    pytest.param(name, marks=pytest.mark.slow if name in ("PCN", "pseudo-marginal-20") else ())
    for name in KERNELS
]


@pytest.mark.parametrize("name", SOME)
def test_conjugate_posterior(name):
    """Mean within 3 standard errors, which are below 0.02 posterior SD; SD within 3 %."""
    draws = {
        "FunctionSpaceHMC": 4000,
        "PCN": 5000,
        "PCN-blocks": 5000,
        "PCNL": 5000,
        "MALA-2": 8000,
    }.get(name, 16000)
    mcmc = run(KERNELS[name](conjugate), DATA, num_samples=draws, extra_fields=("~z.wing_noise",))
    x = np.asarray(mcmc.get_samples(group_by_chain=True)["mean"])
    mean, sd = conjugate_posterior()
    error = 1 / np.sqrt(effective_sample_size(x))
    assert error < 0.02
    assert abs(x.mean() - mean) < 3 * error * sd
    assert x.std() == pytest.approx(sd, rel=0.03)
    assert gelman_rubin(x) < 1.01


SLOW = pytest.mark.slow
"""For one of several kernels of a kind, the others of which run always."""


@pytest.mark.parametrize(
    "name",
    [
        "FunctionSpaceHMC",
        "PCN-blocks",
        pytest.param("PCNL", marks=SLOW),
        "pseudo-marginal-2",
        "MALA-2",
    ],
)
def test_stays_in_the_joint_law(name):
    """From exact draws of (θ, noise, data), some steps given the data leave (θ, noise, data) as
    they were.

    (θ, v) is simulated forward, and the noise is that of the bridge to v along the simulated path.
    """
    number, steps = 2000, 5
    kernel = KERNELS[name](sine)

    def replicate(key):
        key_prior, key_law, key_chain, key_particles = jr.split(key, 4)
        trace = numpyro.handlers.trace(numpyro.handlers.seed(sine, key_prior)).get_trace()
        law = trace["v"]["fn"]
        v, noise = law.sample_with_noise(key_law)
        start = {
            "force": trace["force"]["value"],
            "spread": jnp.log(trace["spread"]["value"]),
            "v_noise": noise,
        }
        state = kernel.init(key_chain, 0, start, (v,), {})
        if hasattr(state, "particles"):
            fresh = jr.normal(key_particles, state.particles["v_noise"][1:].shape)
            # of the particles, the one that made the path is the one that was picked
            particles = {"v_noise": jnp.concatenate([noise[None], fresh])}
            state = state._replace(particles=particles, z=state.z | {"v_noise": noise})
            state = kernel.refresh(state, (v,), {})
        state, _ = jax.lax.scan(
            lambda state, _: (kernel.sample(state, (v,), {}), None), state, length=steps
        )
        return start, state.z, v

    before, after, v = jax.jit(jax.vmap(replicate))(jr.split(jr.key(1), number))
    moved = np.mean(np.asarray(before["force"]) != np.asarray(after["force"]))
    assert moved > 0.5

    def statistics(z):
        noise = np.asarray(z["v_noise"])[..., 0]
        force, spread, datum = np.asarray(z["force"]), np.asarray(z["spread"]), np.asarray(v)[:, 0]
        return {
            "force": force,
            "spread": spread,
            "noise": noise.sum((1, 2)),
            "noise²": (noise**2).sum((1, 2)),
            "force·v": (force - 1) * datum,
            "spread·v²": spread * datum**2,
            "noise·v": noise[:, 0, 0] * datum,
        }

    old, new = statistics(before), statistics(after)
    assert stats.kstest(old["force"], stats.norm(1.0, 0.5).cdf).pvalue > 1e-4
    for label in old:
        assert stats.ks_2samp(old[label], new[label]).pvalue > 1e-4, label
        z = (new[label] - old[label]).mean() / (new[label] - old[label]).std() * np.sqrt(number)
        assert abs(z) < 4, label


def no_information(data=None):
    numpyro.sample("theta", dist.Gamma(3.0, 2.0))
    law = nb.DiffusionEndpoint(
        nb.LinearSDE(-1.0, 0.6), np.zeros(2), nb.InexactMatch(0.1), t1=1.0, num_steps=4
    )
    with numpyro.plate("specimen", 3):
        nb.sample("wing", law, obs=data)


@pytest.mark.parametrize("name", ["FunctionSpaceHMC", "PCN", "pseudo-marginal-2"])
def test_prior_where_the_weight_is_constant(name):
    draws = 12000 if name.startswith("pseudo") else 3000  # correlated particles forget slowly
    samples = run(KERNELS[name](no_information), DATA, num_samples=draws).get_samples(
        group_by_chain=True
    )
    theta, noise = np.asarray(samples["theta"]), np.asarray(samples["wing_noise"])
    error = np.sqrt(0.75 / effective_sample_size(theta))
    assert abs(theta.mean() - 1.5) < 4 * error < 0.1
    noise = noise.reshape(4, draws, -1)[..., ::5]
    size = effective_sample_size(noise)
    assert np.all(np.abs(noise.mean((0, 1))) < 4.5 / np.sqrt(size)) and np.all(size > 1000)
    assert np.mean(noise**2) == pytest.approx(1.0, rel=0.03)


def flow_model(num_points, num_steps):
    def model(data):
        amplitude = numpyro.sample("amplitude", dist.LogNormal(-1.0, 0.3))
        circle = np.stack([np.cos(ANGLES(num_points)), np.sin(ANGLES(num_points))], 1)
        flow = nb.KunitaFlow(nb.Landmarks(num_points, 2), nb.GaussianKernel(amplitude, 0.6))
        match, guide = nb.InexactMatch(0.01), nb.RecedingGuide()
        law = nb.DiffusionEndpoint(flow, circle, match, t1=1.0, num_steps=num_steps, guide=guide)
        nb.sample("shape", law, obs=data)

    angles = ANGLES(num_points)
    return model, np.stack(
        [1.2 * np.cos(angles), 0.8 * np.sin(angles) + 0.1 * np.cos(2 * angles)], 1
    )


def ANGLES(n):
    return 2 * np.pi * np.arange(n) / n


@pytest.mark.parametrize("kernel", [FunctionSpaceHMC, PCN])
def test_acceptance_does_not_depend_on_the_grid(kernel):
    """At a fixed step, from 10 to 80 time steps and from 4 to 16 landmarks."""
    rates = []
    for num_points, num_steps in [(8, 10), (8, 80), (16, 10)]:
        model, data = flow_model(num_points, num_steps)
        if kernel is PCN:
            model = numpyro.handlers.condition(model, {"amplitude": 0.35})
            chain = PCN(model, angle=0.8, adapt_angle=False)
        else:
            chain = FunctionSpaceHMC(model, step_size=1.0, adapt_step_size=False)
        mcmc = run(
            chain,
            data,
            num_warmup=100,
            num_samples=600,
            extra_fields=("accept_prob", "~z.shape_noise"),
        )
        rates.append(float(np.mean(mcmc.get_extra_fields()["accept_prob"])))
    assert 0.3 < rates[0] < 0.99
    assert np.ptp(rates) < 0.03, rates


def discrete(data):
    numpyro.sample("which", dist.Bernoulli(0.5))
    conjugate(data)


def no_noise(data):
    numpyro.sample("x", dist.Normal(numpyro.sample("mean", dist.Normal()), 1.0), obs=data[0, 0])


NOISE_ONLY = numpyro.handlers.condition(conjugate, {"mean": 0.3})
REFUSED = {
    "model": (lambda: FunctionSpaceHMC(3), "`model` must be a NumPyro model"),
    "discrete": (lambda: FunctionSpaceHMC(discrete), r"cannot draw the discrete sites \['which'\]"),
    "no noise": (
        lambda: FunctionSpaceHMC(no_noise),
        "found no driving noise among the latent sites",
    ),
    "step": (
        lambda: FunctionSpaceHMC(conjugate, step_size=0.0),
        "`step_size` must be positive and finite; got 0.0",
    ),
    "target": (
        lambda: FunctionSpaceHMC(conjugate, target_accept_prob=1.0),
        r"must be in \(0, 1\); got 1.0",
    ),
    "length": (
        lambda: FunctionSpaceHMC(conjugate, trajectory_length=-1.0),
        "`trajectory_length` must be positive",
    ),
    "jitter": (
        lambda: FunctionSpaceHMC(conjugate, jitter=1.0),
        r"`jitter` must be in \[0, 1\); got 1.0",
    ),
    "PCN with parameters": (
        lambda: PCN(conjugate),
        r"moves noise alone, and the model has parameters, \['mean'\]",
    ),
    "angle": (lambda: PCN(NOISE_ONLY, angle=2.0), r"`angle` must be in \(0, π/2\]; got 2.0"),
    "moves": (
        lambda: PCN(NOISE_ONLY, num_moves=0),
        "`num_moves` must be a positive integer; got 0",
    ),
    "blocks": (
        lambda: PCN(NOISE_ONLY, num_blocks=5),
        r"`num_blocks` must be at most the number of time steps",
    ),
    "no tree": (
        lambda: PCN(NOISE_ONLY, blocks="branch"),
        "`blocks` needs the noise of a `DiffusionTree`",
    ),
    "both cuts": (
        lambda: PCN(NOISE_ONLY, num_blocks=2, blocks="clade"),
        "`num_blocks` cuts time steps, and",
    ),
    "no cut": (
        lambda: PCN(NOISE_ONLY, blocks="tip"),
        "`blocks` must be one of 'branch', 'clade'; got 'tip'",
    ),
    "no parameters": (
        lambda: CorrelatedPseudoMarginal(NOISE_ONLY, 2),
        "the model has none but its noise",
    ),
    "particles": (
        lambda: CorrelatedPseudoMarginal(conjugate, 0),
        "`num_particles` must be a positive integer; got 0",
    ),
    "correlation": (
        lambda: CorrelatedPseudoMarginal(conjugate, 2, correlation=1.0),
        r"must be in \[0, 1\); got 1.0",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refusals(case):
    build, message = REFUSED[case]
    with pytest.raises(ValueError, match=message):
        build().init(jr.key(0), 10, None, (DATA,), {})


def test_a_start_of_density_zero_is_refused():
    with pytest.raises(
        ValueError,
        match="potential energy is (nan|inf|-inf) at the start: give other `init_params`",
    ):
        FunctionSpaceHMC(conjugate).init(jr.key(0), 10, {"mean": jnp.array(jnp.nan)}, (DATA,), {})


def test_sample_before_init_is_refused():
    kernel = FunctionSpaceHMC(conjugate)
    state = kernel.init(jr.key(0), 10, None, (DATA,), {})
    with pytest.raises(ValueError, match="`init` must be called before `sample`"):
        pickle.loads(pickle.dumps(kernel)).sample(state, (DATA,), {})


def test_number_of_particles():
    """The smallest by which the log estimate varies by at most 1.7; a warning where it cannot be
    had.
    """
    normal = np.random.default_rng(0).normal(0, 1, (256, 4))
    assert _choose([normal], 64) == 2 and _choose([0.1 * normal], 64) == 1
    assert 8 <= _choose([2.0 * normal], 64) <= 64
    with (
        pytest.warns(
            UserWarning,
            match="of 4 particles has a standard deviation of .*: above 1.7 the chain sticks",
        ),
        pytest.warns(UserWarning, match="too heavy a tail: k̂ is .* on average over the data"),
    ):
        assert _choose([6.0 * normal], 4) == 4
    # of a mean that does not exist, and an SD of 1.6
    tail = 1.6 * np.random.default_rng(1).exponential(size=(256, 1))
    for weights in ([tail], [0.1 * normal, tail]):
        with pytest.warns(
            UserWarning, match=r"too heavy a tail: k̂ is .* at most 1\.\d.*give `num_particles`"
        ):
            assert _choose(weights, 64) <= 2
    kernel = CorrelatedPseudoMarginal(conjugate)
    kernel.init(jr.key(0), 10, None, (DATA,), {})
    assert kernel.num_particles in (1, 2, 3)


def shared_noise(data):
    """Two data driven by one noise, which no single decision about one of them can move."""
    law = nb.DiffusionEndpoint(
        nb.LinearSDE(-1.0, 0.6), np.zeros(2), nb.InexactMatch(0.1), t1=1.0, num_steps=4
    )
    noise = numpyro.sample("noise", law.noise_prior(), infer={"driving_noise": True})
    numpyro.sample("a", law.given(noise), obs=data[0])
    numpyro.sample("b", law.given(noise), obs=data[1])


def used_elsewhere(data):
    law = nb.DiffusionEndpoint(
        nb.LinearSDE(-1.0, 0.6), np.zeros(2), nb.InexactMatch(0.1), t1=1.0, num_steps=4
    )
    noise = numpyro.sample("noise", law.noise_prior(), infer={"driving_noise": True})
    numpyro.sample("a", law.given(noise), obs=data[0])
    numpyro.factor("more", -jnp.sum(noise**2))


def test_which_data_are_decided_on_their_own():
    def owners(model):
        kernel = PCN(model)
        state = kernel.init(jr.key(0), 10, None, (DATA,), {})
        return kernel._owners, [energy.shape for energy in state.energies]

    assert owners(NOISE_ONLY) == ({"wing_noise": "wing"}, [(3,)])
    assert owners(shared_noise) == (None, [()])
    assert owners(used_elsewhere) == (None, [()])


def test_noise_with_another_use_has_its_posterior():
    """A factor exp(-|z|²) on a standard normal noise of constant weight leaves a variance of 1/3."""
    mcmc = run(PCN(used_elsewhere), DATA, num_samples=4000)
    noise = np.asarray(mcmc.get_samples()["noise"])
    assert np.var(noise) == pytest.approx(1 / 3, rel=0.03)


def test_small_turns_are_accepted():
    """The energy error of `PCNL` is of third order in its angle: a kick whose work is left out
    would be of first.
    """
    state = (kernel := PCNL(NOISE_ONLY, angle=0.1, adapt_angle=False)).init(
        jr.key(0), 0, None, (DATA,), {}
    )

    def one(state, _):
        state = kernel.sample(state, (DATA,), {})
        return state, state.accept_prob

    _, rates = jax.jit(lambda state: jax.lax.scan(one, state, length=200))(state)
    assert 1 - np.mean(rates) < 2e-4


def test_chain_methods_and_pickling():
    """One chain of `vectorized` is the chain of `sequential`; a pickled kernel runs the same chain."""
    kernel = FunctionSpaceHMC(conjugate)
    settings = dict(num_warmup=30, num_samples=20, num_chains=2, progress_bar=False)
    draws = []
    for method in ("vectorized", "sequential"):
        mcmc = MCMC(pickle.loads(pickle.dumps(kernel)), chain_method=method, **settings)
        mcmc.run(jr.key(0), DATA)
        draws.append(np.asarray(mcmc.get_samples(group_by_chain=True)["mean"]))
    np.testing.assert_allclose(draws[0], draws[1], rtol=1e-6)
    assert pickle.loads(pickle.dumps(mcmc)).get_samples()["mean"].shape == (40,)


def test_chains_start_near_the_mode():
    """The Laplace approximation of a normal posterior is that posterior: no transient is left to
    the warm-up.
    """
    state = FunctionSpaceHMC(conjugate).init(jr.split(jr.key(0), 200), 0, None, (DATA,), {})
    mean, sd = conjugate_posterior()
    start = np.asarray(state.z["mean"])
    assert abs(start.mean() - mean) < 0.5 * sd and 0.8 < start.std() / sd < 1.25
    assert np.all(np.asarray(state.z["wing_noise"]) == 0)
