"""Models: `sample` and `NoiseReparam` under NumPyro's handlers and samplers."""

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from numpyro import handlers
from numpyro.diagnostics import effective_sample_size
from numpyro.infer import MCMC, NUTS, SVI, Predictive, Trace_ELBO, log_likelihood
from numpyro.infer.autoguide import AutoDelta, AutoNormal
from numpyro.infer.util import log_density

import numpyro_bridges as nb

pytestmark = [pytest.mark.numpyro, pytest.mark.usefixtures("compile_quickly")]

N, STEPS = 5, 3
RATE, SIGMA, SPREAD = 0.8, 0.6, 0.05
GUIDE = nb.FrozenGuide(nb.BrownianMotion(0.5))  # not the process's own: the weight depends on the noise
SEEN = nb.InexactMatch(SPREAD)
DATA = np.random.default_rng(0).normal(0.5, 0.5, (N, 2))
NOISE = np.random.default_rng(1).standard_normal((N, STEPS, 2, 1))


def law(mean, **kwargs):
    sde = nb.LinearSDE(-RATE, SIGMA, RATE * mean)
    return nb.DiffusionEndpoint(sde, np.zeros(2), SEEN, t1=1.0, num_steps=STEPS, guide=GUIDE, **kwargs)


def model(data=None, n=N):
    mean = numpyro.sample("mean", dist.Normal(0.0, 2.0))
    with numpyro.plate("specimens", n):
        return nb.sample("wing", law(mean), obs=data)


def plain(data=None, n=N):
    mean = numpyro.sample("mean", dist.Normal(0.0, 2.0))
    with numpyro.plate("specimens", n):
        return numpyro.sample("wing", law(mean), obs=data)


def loop(data=None):
    mean = numpyro.sample("mean", dist.Normal(0.0, 2.0))
    for i in range(N):
        nb.sample(f"wing{i}", law(mean), obs=None if data is None else data[i])


reparametrised = handlers.reparam(plain, config={"wing": nb.NoiseReparam()})
PARAMS = {"mean": 0.3, "wing_noise": NOISE}


def trace_of(model, *args, **kwargs):
    return handlers.trace(handlers.seed(model, 0)).get_trace(*args, **kwargs)


@pytest.fixture(scope="module")
def weights():
    """log_weight of each datum's bridge at PARAMS, from the bridge itself."""

    def log_weight(v, z):
        sde = nb.LinearSDE(-RATE, SIGMA, RATE * 0.3)
        bridge = nb.GuidedBridge(sde, SEEN.at(v), x0=np.zeros(2), t1=1.0, num_steps=STEPS, guide=GUIDE)
        return bridge.log_weight(z)

    return np.array([log_weight(v, z) for v, z in zip(DATA, NOISE, strict=True)])


def priors():
    return dist.Normal(0.0, 2.0).log_prob(0.3), dist.Normal().log_prob(NOISE).sum((1, 2, 3))


# The density of a model


@pytest.mark.parametrize("model", [model, reparametrised], ids=["sample", "NoiseReparam"])
def test_density_is_prior_times_noise_times_weight(model, weights):
    prior, noise = priors()
    found, trace = log_density(model, (DATA,), {}, PARAMS)
    assert float(found) == pytest.approx(float(prior + noise.sum() + weights.sum()), abs=1e-10)
    assert trace["wing_noise"]["infer"] == {"driving_noise": True} and not trace["wing_noise"]["is_observed"]
    assert trace["wing"]["is_observed"] and [f.name for f in trace["wing"]["cond_indep_stack"]] == ["specimens"]


def test_a_plate_is_a_loop(weights):
    singles = {"mean": 0.3} | {f"wing{i}_noise": z for i, z in enumerate(NOISE)}
    in_loop, _ = log_density(loop, (DATA,), {}, singles)
    in_plate, _ = log_density(model, (DATA,), {}, PARAMS)
    assert float(in_plate) == pytest.approx(float(in_loop), abs=1e-10)


def test_nested_plates():
    def nested(data):
        with numpyro.plate("sides", 2, dim=-1), numpyro.plate("specimens", N, dim=-2):
            nb.sample("wing", law(0.3), obs=data)

    data, noise = np.stack([DATA, DATA + 0.1], 1), np.stack([NOISE, -NOISE], 1)
    found, trace = log_density(nested, (data,), {}, {"wing_noise": noise})
    expected = dist.Normal().log_prob(noise).sum() + sum(
        law(0.3).expand((N,)).given(noise[:, j]).log_prob(data[:, j]).sum() for j in range(2)
    )
    assert trace["wing"]["fn"].batch_shape == (N, 2)
    assert float(found) == pytest.approx(float(expected), abs=1e-10)


@pytest.mark.parametrize("base", [model, plain], ids=["sample", "NoiseReparam"])
@pytest.mark.parametrize("outside", [True, False], ids=["mask around the plate", "mask in the plate"])
def test_mask_leaves_the_noise_its_prior(base, outside, weights):
    """Not masked, the noise of a masked datum keeps a proper posterior: its prior."""
    keep = np.array([True, False, True, True, False])

    def inside(data):
        with numpyro.plate("specimens", N), handlers.mask(mask=keep):
            (nb.sample if base is model else numpyro.sample)("wing", law(0.3), obs=data)

    masked = handlers.mask(base, mask=keep) if outside else inside
    masked = masked if base is model else handlers.reparam(masked, config={"wing": nb.NoiseReparam()})
    data = np.where(keep[:, None], DATA, np.nan)
    prior, noise = priors()
    trace = handlers.trace(handlers.substitute(masked, PARAMS)).get_trace(data)
    np.testing.assert_allclose(trace["wing"]["fn"].log_prob(data), np.where(keep, weights, 0), atol=1e-10)
    np.testing.assert_allclose(trace["wing_noise"]["fn"].log_prob(NOISE), noise, rtol=1e-12)
    gradient = jax.grad(lambda m: log_density(masked, (data,), {}, PARAMS | {"mean": m})[0])(0.3)
    assert np.isfinite(gradient)


def test_scale_and_subsampling(weights):
    prior, noise = priors()
    found, _ = log_density(handlers.scale(model, scale=2.0), (DATA,), {}, PARAMS)
    assert float(found) == pytest.approx(float(2 * (prior + noise.sum() + weights.sum())), abs=1e-9)

    def minibatch(data):
        mean = numpyro.sample("mean", dist.Normal(0.0, 2.0))
        with numpyro.plate("specimens", N, subsample_size=2) as rows:
            nb.sample("wing", law(mean), obs=data[rows])

    rows = np.array([3, 1])
    params = {"mean": 0.3, "specimens": jnp.asarray(rows), "wing_noise": NOISE[rows]}
    found, _ = log_density(minibatch, (jnp.asarray(DATA),), {}, params)
    expected = prior + N / 2 * (noise + weights)[rows].sum()
    assert float(found) == pytest.approx(float(expected), abs=1e-10)


def test_condition_do_substitute_and_block():
    trace = trace_of(handlers.condition(model, {"wing": DATA}))
    assert trace["wing"]["is_observed"] and np.array_equal(trace["wing"]["value"], DATA)
    found, _ = log_density(handlers.condition(model, {"wing": DATA}), (), {}, PARAMS)
    assert float(found) == pytest.approx(float(log_density(model, (DATA,), {}, PARAMS)[0]), abs=1e-10)
    fixed = {"mean": 100.0, "wing_noise": NOISE}
    trace = trace_of(handlers.substitute(model, fixed))
    assert np.array_equal(trace["wing"]["fn"].noise, NOISE) and np.all(trace["wing"]["value"] > 20)
    assert np.all(trace_of(handlers.do(model, {"mean": 100.0}))["wing"]["value"] > 20)
    assert set(trace_of(handlers.block(model, hide=["wing_noise"]), DATA)) == {"mean", "specimens", "wing"}


def test_own_parameters_of_each_specimen():
    """A parameter inside the plate: one SDE per specimen, declared."""

    def per_specimen(data):
        with numpyro.plate("specimens", N):
            mean = numpyro.sample("mean", dist.Normal(0.0, 2.0))
            sde = jax.vmap(lambda m: nb.LinearSDE(-RATE, SIGMA, RATE * m))(mean)
            one = nb.DiffusionEndpoint(
                sde, np.zeros(2), SEEN, t1=1.0, num_steps=STEPS, guide=GUIDE, batch_shape=(N,), batched=("sde",)
            )
            nb.sample("wing", one, obs=data)

    means = np.linspace(-1, 1, N)
    trace = handlers.trace(handlers.substitute(per_specimen, {"mean": means, "wing_noise": NOISE})).get_trace(DATA)
    expected = np.array([law(m).given(z).log_prob(v) for m, z, v in zip(means, NOISE, DATA, strict=True)])
    np.testing.assert_allclose(trace["wing"]["fn"].log_prob(DATA), expected, atol=1e-10)

    @jax.jit
    def joint(means):
        return log_density(per_specimen, (DATA,), {}, {"mean": means, "wing_noise": NOISE})[0]

    joint_expected = dist.Normal(0, 2).log_prob(means).sum() + priors()[1].sum() + expected.sum()
    assert float(joint(means)) == pytest.approx(float(joint_expected), abs=1e-10)


# What is refused


def test_errors_name_the_site():
    with pytest.raises(ValueError, match=r"site `wing`: `obs` must have shape \(5, 2\).*got \(4, 2\)"):
        trace_of(model, DATA[:4])
    with pytest.raises(ValueError, match=r"`obs` must have shape \(5, 2\).*got \(2,\).*plate"):
        trace_of(reparametrised, DATA[0])
    with pytest.raises(ValueError, match=r"`obs` must have shape \(2,\).*got \(5, 2\).*plate"):
        trace_of(lambda: nb.sample("wing", law(0.3), obs=DATA))
    for wrapped in (dist.Normal(), dist.ExpandedDistribution(law(0.3), (N,))):
        with pytest.raises(ValueError, match="site `wing`: the law must be driven by noise"):
            trace_of(lambda wrapped=wrapped: nb.sample("wing", wrapped))


def test_a_site_without_its_noise():
    with pytest.raises(ValueError, match="the noise site is missing"):
        log_density(plain, (DATA,), {}, {"mean": 0.3})


def test_noise_outside_the_plate():
    def shared(data):
        noise = numpyro.sample("noise", law(0.3).noise_prior())
        with numpyro.plate("specimens", N):
            numpyro.sample("wing", law(0.3).given(noise), obs=data)

    with pytest.raises(ValueError, match="One noise shared by several data"):
        trace_of(shared, DATA)


def test_a_parameter_inside_the_plate():
    def hidden(rate_of_sde):
        def model(data=None):
            with numpyro.plate("specimens", 2):
                rate = numpyro.sample("rate", dist.LogNormal())
                one = nb.DiffusionEndpoint(rate_of_sde(rate), np.zeros(2), SEEN, t1=1.0, num_steps=STEPS)
                return nb.sample("wing", one, obs=data)

        return model

    def drift(t, x, rate):
        return -rate * x

    sdes = [lambda r: nb.LinearSDE(-r, SIGMA), lambda r: nb.SDE(drift, lambda t, x, args: 0.5, r)]
    for sde in sdes:
        with pytest.raises(ValueError, match="`sde` holds an array of shape .* inside the plate"):
            trace_of(hidden(sde))
    flow = handlers.seed(
        lambda: nb.KunitaFlow(
            nb.Landmarks(4, 2), nb.GaussianKernel(numpyro.sample("a", dist.LogNormal().expand([2])), 1.0)
        ),
        0,
    )
    with pytest.raises(ValueError, match="`amplitude` must be a scalar"):
        flow()


def test_missing_data_stop_a_run_in_words():
    data = DATA.copy()
    data[3, 1] = np.nan
    mcmc = MCMC(NUTS(model), num_warmup=1, num_samples=1, progress_bar=False)
    with pytest.raises(ValueError, match=r"datum \(3,\).*must be finite"):
        mcmc.run(jr.key(0), data)


# Samplers


def posterior_of_mean():
    """Closed form: the end is N(mean (1 − e^-rate), S + SPREAD) in each coordinate."""
    slope = 1 - np.exp(-RATE)
    variance = SIGMA**2 * (1 - np.exp(-2 * RATE)) / (2 * RATE) + SPREAD
    precision = 1 / 4 + DATA.size * slope**2 / variance
    return slope * DATA.sum() / variance / precision, 1 / np.sqrt(precision)


@pytest.fixture(scope="module")
def mcmc():
    mcmc = MCMC(NUTS(model), num_warmup=200, num_samples=1000, progress_bar=False)
    mcmc.run(jr.key(2), DATA)
    return mcmc


def test_nuts_has_the_closed_form_posterior(mcmc):
    draws = np.asarray(mcmc.get_samples()["mean"])
    mean, sd = posterior_of_mean()
    ess = effective_sample_size(draws[None])
    ess_square = effective_sample_size((draws[None] - mean) ** 2)
    assert min(ess, ess_square) > 200, "standard errors of 0.07 and 0.05 SDs: a posterior 30 % too wide is seen"
    assert abs(draws.mean() - mean) < 4 * sd / np.sqrt(ess)
    assert abs(draws.std() / sd - 1) < 4 / np.sqrt(2 * ess_square)
    assert not np.any(mcmc.get_extra_fields()["diverging"])


def test_predictive(mcmc):
    prior = Predictive(model, num_samples=7)(jr.key(0))
    assert prior["wing"].shape == (7, N, 2) and prior["wing_noise"].shape == (7, *NOISE.shape)
    thinned = {name: draws[::100] for name, draws in mcmc.get_samples().items()}
    assert set(replicates := Predictive(model, thinned)(jr.key(1))) == {"wing"}
    assert replicates["wing"].shape == (10, N, 2)
    new = Predictive(model, {"mean": mcmc.get_samples()["mean"]})(jr.key(1), n=4)["wing"]
    slope, mean = 1 - np.exp(-RATE), posterior_of_mean()[0]
    assert new.shape == (1000, 4, 2)
    assert abs(new.mean() - slope * mean) < 4 * new.std() / np.sqrt(1000)
    pointwise = log_likelihood(model, thinned, DATA)
    assert set(pointwise) == {"wing"} and pointwise["wing"].shape == (10, N)


@pytest.mark.slow
def test_an_unobserved_site_may_be_sampled_by_nuts():
    """N(z) exp(log_prob(v | z)) is a joint density of (z, v), whose margin of v is the law."""
    mcmc = MCMC(NUTS(lambda: nb.sample("wing", law(0.5))), num_warmup=200, num_samples=1000, progress_bar=False)
    mcmc.run(jr.key(0))
    v = np.asarray(mcmc.get_samples()["wing"])
    sd = np.sqrt(SIGMA**2 * (1 - np.exp(-2 * RATE)) / (2 * RATE) + SPREAD)
    for j in range(2):
        ess = effective_sample_size(v[None, :, j])
        assert ess > 200
        assert abs(v[:, j].mean() - 0.5 * (1 - np.exp(-RATE))) < 4 * sd / np.sqrt(ess)
    assert abs(v.std(0) / sd - 1).max() < 0.2


def test_svi():
    svi = SVI(model, AutoNormal(model), numpyro.optim.Adam(0.05), Trace_ELBO())
    result = svi.run(jr.key(0), 150, DATA, progress_bar=False)
    losses = np.asarray(result.losses)
    assert np.all(np.isfinite(losses)) and losses[-20:].mean() < losses[:20].mean()
    mean, sd = posterior_of_mean()
    assert abs(result.params["mean_auto_loc"] - mean) < 3 * sd


def test_a_point_estimate_has_the_density_of_the_model():
    svi = SVI(model, AutoDelta(model), numpyro.optim.Adam(0.05), Trace_ELBO())
    state = svi.init(jr.key(0), DATA)
    point = {name.removesuffix("_auto_loc"): value for name, value in svi.get_params(state).items()}
    expected, _ = log_density(model, (DATA,), {}, point)
    assert float(svi.evaluate(state, DATA)) == pytest.approx(-float(expected), abs=1e-8)


@pytest.mark.slow
def test_kunita_flow_out_of_the_box():
    """In single precision, from NumPyro's own start: uniform on (−2, 2) for the noise is no trouble."""
    with jax.enable_x64(False):
        angles = np.linspace(0, 2 * np.pi, 4, endpoint=False).astype(np.float32)
        circle = np.stack([np.cos(angles), np.sin(angles)], 1)

        def flow_model(data=None):
            amplitude = numpyro.sample("amplitude", dist.LogNormal(-1.0, 1.0))
            flow = nb.KunitaFlow(nb.Landmarks(4, 2), nb.GaussianKernel(amplitude, 0.7))
            one = nb.DiffusionEndpoint(flow, circle, nb.InexactMatch(1e-2), t1=1.0, num_steps=5)
            with numpyro.plate("specimens", 3):
                return nb.sample("wing", one, obs=data)

        data = trace_of(handlers.substitute(flow_model, {"amplitude": 0.3}))["wing"]["value"]
        mcmc = MCMC(NUTS(flow_model), num_warmup=80, num_samples=80, progress_bar=False)
        mcmc.run(jr.key(0), data, extra_fields=("accept_prob",))
        draws, fields = np.asarray(mcmc.get_samples()["amplitude"]), mcmc.get_extra_fields()
        assert draws.dtype == np.float32 and fields["diverging"].sum() == 0 and fields["accept_prob"].mean() > 0.7
        assert abs(np.log(draws / 0.3).mean()) < 4 * np.log(draws).std()
