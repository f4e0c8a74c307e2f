"""`to_arviz`, on both lines of ArviZ: 0.x with Python 3.11, 1.x with later ones."""

import warnings

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
import xarray
from numpyro import handlers
from numpyro.infer import HMC, MCMC, NUTS, Gibbs, log_likelihood
from numpyro.util import nested_attrgetter

import numpyro_bridges as nb
from numpyro_bridges.infer._statistics import statistics

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # ArviZ 0.x announces 1.x when it is imported
    import arviz

pytestmark = [pytest.mark.numpyro, pytest.mark.usefixtures("compile_quickly")]

N, STEPS, PATHS, DRAWS = 6, 2, 4, 1000
DATA = np.random.default_rng(0).normal(0.5, 0.6, (N, 2))


def model(data=None, n=N):
    mean = numpyro.sample("mean", dist.Normal(0.0, 2.0))
    spread = numpyro.deterministic("twice", 2 * mean)
    numpyro.factor("no_datum", -0.01 * spread**2)
    law = nb.DiffusionEndpoint(
        nb.LinearSDE(-1.0, 0.6, mean), np.zeros(2), nb.InexactMatch(0.1), t1=1.0, num_steps=STEPS
    )
    with numpyro.plate("specimens", n):
        nb.sample("wing", law, obs=data)


def two_sites(data):
    """Bridges on two grids, the end of one a parameter, and a datum that no noise drives."""
    mean = numpyro.sample("mean", dist.Normal(0.0, 2.0))
    end = numpyro.sample("end", dist.LogNormal(0.0, 0.1))
    sde = nb.LinearSDE(-1.0, 0.6, mean)
    wing = nb.DiffusionEndpoint(
        sde, np.zeros((2, 1)), nb.InexactMatch(0.1), t1=1.0, num_steps=STEPS
    )
    with numpyro.plate("specimens", 3):
        nb.sample("wing", wing, obs=data)
    leg = nb.DiffusionEndpoint(sde, np.zeros(2), nb.InexactMatch(0.1), t1=end, num_steps=STEPS + 1)
    nb.sample("leg", leg, obs=np.zeros(2))
    numpyro.sample("size", dist.Normal(mean, 1.0), obs=0.3)


WINGS = np.linspace(-1, 1, 6).reshape(3, 2, 1)


def made_up_run(kernel, samples=None, args=(WINGS,), **fields):
    """A run, of `two_sites` or another model, with draws that nothing had to compile, 2 chains of
    7.
    """
    rng = np.random.default_rng(1)
    if samples is None:
        shapes = {
            "mean": (),
            "end": (),
            "wing_noise": (3, STEPS, 2, 1),
            "leg_noise": (STEPS + 1, 2, 1),
        }
        samples = {name: rng.normal(size=(2, 7, *shape)) for name, shape in shapes.items()}
        samples["end"] = np.exp(0.1 * samples["end"])
    mcmc = MCMC(
        kernel,
        num_warmup=0,
        num_samples=7,
        num_chains=2,
        chain_method="sequential",
        progress_bar=False,
    )
    mcmc._states, mcmc._args, mcmc._kwargs = {"z": samples, **fields}, args, {}
    return mcmc


@pytest.fixture(scope="module")
def mcmc():
    mcmc = MCMC(
        NUTS(model),
        num_warmup=100,
        num_samples=DRAWS,
        num_chains=2,
        chain_method="sequential",
        progress_bar=False,
    )
    mcmc.run(jr.key(0), DATA, extra_fields=nb.infer.fields(mcmc.sampler))
    return mcmc


@pytest.fixture(scope="module")
def data(mcmc):
    """With what `Predictive` returns; made up, which compiles nothing."""
    prior = {
        "mean": np.zeros(7),
        "wing": np.zeros((7, N, 2)),
        "wing_noise": np.zeros((7, N, STEPS, 2, 1)),
    }
    return nb.to_arviz(
        mcmc, prior=prior, posterior_predictive={"wing": np.zeros((2 * DRAWS, N, 2))}, paths=PATHS
    )


def test_posterior_is_without_the_noise(mcmc, data):
    assert set(data.posterior.data_vars) == {"mean", "twice"}
    np.testing.assert_array_equal(
        data.posterior["mean"], mcmc.get_samples(group_by_chain=True)["mean"]
    )
    assert len(arviz.summary(data)) == 2
    kept = nb.to_arviz(mcmc, noise=True, log_likelihood=False).posterior["wing_noise"]
    assert kept.shape == (2, DRAWS, N, STEPS, 2, 1) and kept.dims[2] == "specimens"


def test_log_likelihood_is_pointwise(mcmc, data):
    """The guide of a linear SDE is exact: nothing is left of the noise, and any will do."""
    assert set(data.log_likelihood.data_vars) == {"wing"}
    found = data.log_likelihood["wing"]
    assert found.dims == ("chain", "draw", "specimens") and found.shape == (2, 100, N)
    draws = np.asarray(found["draw"])
    assert draws[0] == 0 and draws[-1] == DRAWS - 1 and np.all(np.diff(draws) >= 10)
    expected = log_likelihood(model, mcmc.get_samples(), DATA)["wing"].reshape(2, DRAWS, N)
    np.testing.assert_allclose(found, expected[:, draws])


def test_leave_one_out(data):
    """Against the closed form: the predictive density of a datum given the others, from a grid over
    the mean.
    """
    grid = np.linspace(-4, 6, 2001)
    end = (1 - np.exp(-1)) * grid
    variance = 0.36 * (1 - np.exp(-2)) / 2 + 0.1
    pointwise = dist.Normal(end, np.sqrt(variance)).log_prob(DATA[..., None]).sum(1)
    prior = dist.Normal(0, 2).log_prob(grid) - 0.04 * grid**2
    rest = prior + pointwise.sum(0) - pointwise
    weights = np.exp(rest - rest.max(1, keepdims=True))
    expected = np.log(np.sum(weights * np.exp(pointwise), 1) / weights.sum(1)).sum()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # on a high Pareto k of so few draws
        loo = arviz.loo(data)
    assert loo.n_data_points == N
    elpd = getattr(loo, "elpd", None) or loo["elpd_loo"]
    print(f"{elpd:.3f}, exactly {expected:.3f}")
    assert elpd == pytest.approx(float(expected), abs=0.3)


def test_sample_statistics(mcmc, data):
    stats = data.sample_stats
    names = {"lp", "energy", "acceptance_rate", "n_steps", "step_size", "diverging", "tree_depth"}
    assert set(stats.data_vars) == names
    fields = mcmc.get_extra_fields(group_by_chain=True)
    np.testing.assert_array_equal(stats["lp"], -fields["potential_energy"])
    assert np.all(2 ** stats["tree_depth"] > stats["n_steps"])


def test_data_and_predictions(data):
    np.testing.assert_array_equal(data.observed_data["wing"], DATA)
    assert data.observed_data["wing"].dims[0] == "specimens"
    assert set(data.observed_data.data_vars) == {"wing"}
    assert data.posterior_predictive["wing"].shape == (2, DRAWS, N, 2)
    assert "mean" in data.prior and "wing_noise" not in data.prior
    assert data.prior_predictive["wing"].shape == (1, 7, N, 2)


def test_paths_are_those_of_the_bridges(mcmc, data):
    paths, samples = data["posterior_paths"]["wing"], mcmc.get_samples(group_by_chain=True)
    assert paths.dims == ("chain", "draw", "specimens", "time", "coordinate")
    assert paths.shape == (2, PATHS, N, STEPS + 1, 2)
    np.testing.assert_array_equal(paths["draw"], [0, 333, 666, 999])
    np.testing.assert_allclose(paths["time"], [0, 0.5, 1])

    @jax.jit
    def path(mean, noise, observed):
        sde = nb.LinearSDE(-1.0, 0.6, mean)
        seen = nb.InexactMatch(0.1).at(observed)
        return nb.GuidedBridge(sde, seen, x0=np.zeros(2), t1=1.0, num_steps=STEPS).path(noise)

    for chain, draw, i in [(0, 0, 0), (1, 333, 3), (0, 999, 5)]:
        expected = path(
            samples["mean"][chain, draw], samples["wing_noise"][chain, draw, i], DATA[i]
        )
        np.testing.assert_allclose(
            paths.sel(chain=chain, draw=draw, specimens=i), expected, rtol=1e-12
        )


def test_netcdf(data, tmp_path):
    data.to_netcdf(str(tmp_path / "run.nc"), engine="h5netcdf")
    with xarray.open_dataset(
        tmp_path / "run.nc", group="posterior_paths", engine="h5netcdf"
    ) as read:
        xarray.testing.assert_equal(read["wing"].load(), data["posterior_paths"]["wing"])


@pytest.fixture(scope="module")
def several():
    coords = {"specimens": ["a", "b", "c"], "draw": np.arange(10, 17)}
    kernel = Gibbs([(nb.infer.PCN(two_sites), nb.infer.noise_sites), (NUTS(two_sites), None)])
    fields = {
        name: np.full((2, 7), name.startswith("block_states.1."))
        for name in nb.infer.fields(kernel)[-1:]
    }
    return nb.to_arviz(made_up_run(kernel, **fields), paths=100, coords=coords)


def test_paths_of_several_sites(several):
    paths = several["posterior_paths"]
    assert paths["wing"].dims == (
        "chain",
        "draw",
        "specimens",
        "wing_time",
        "point",
        "wing_coordinate",
    )
    assert paths["leg"].dims == ("chain", "draw", "leg_time", "leg_coordinate")
    assert list(paths["draw"]) == list(range(10, 17)) and list(paths["specimens"]) == [
        "a",
        "b",
        "c",
    ]
    np.testing.assert_allclose(paths["wing_time"], [0, 0.5, 1])
    np.testing.assert_array_equal(paths["leg_times"][..., -1], several.posterior["end"])
    assert np.all(paths["leg"][:, :, 0] == 0) and np.all(np.abs(paths["leg"][:, :, -1]) < 2)


def test_run_of_gibbs(several):
    assert set(several.posterior.data_vars) == {"mean", "end"}
    assert set(several.log_likelihood.data_vars) == {"wing", "leg", "size"}
    assert set(several.sample_stats.data_vars) == {"nuts_diverging", "diverging"}
    assert several.sample_stats["diverging"].all()


def test_without_noise(several):
    samples = made_up_run(NUTS(two_sites)).get_samples(group_by_chain=True)
    del samples["wing_noise"]
    mcmc = made_up_run(NUTS(two_sites), samples)
    found = nb.to_arviz(mcmc).log_likelihood
    assert set(found.data_vars) == {"wing", "leg", "size"}
    np.testing.assert_allclose(found["size"], dist.Normal(samples["mean"], 1.0).log_prob(0.3))
    for name in ("wing", "leg"):  # of a linear SDE, whose weights do not vary
        np.testing.assert_allclose(found[name], several.log_likelihood[name], rtol=1e-9)
    with pytest.raises(
        ValueError, match=r"has not kept \['wing_noise'\]. Run it without \['~z.wing_noise'\]"
    ):
        nb.to_arviz(mcmc, paths=2, log_likelihood=False)


def test_parameters_that_were_dropped():
    samples = made_up_run(NUTS(two_sites)).get_samples(group_by_chain=True)
    del samples["end"]
    data = nb.to_arviz(made_up_run(NUTS(two_sites), samples))
    assert set(data.log_likelihood.data_vars) == {"wing", "size"}


def test_log_likelihood_on_request(mcmc):
    found = nb.log_likelihood(mcmc, num_particles=8, draws=6)
    data = nb.to_arviz(mcmc, log_likelihood=found)
    assert data.log_likelihood["wing"].shape == (2, 3, N) and list(data.log_likelihood["draw"]) == [
        0,
        499,
        999,
    ]
    assert "log_likelihood" not in str(nb.to_arviz(mcmc, log_likelihood=False))


def test_paths_that_cannot_be():
    def no_bridge(data):
        numpyro.sample(
            "size",
            dist.Normal(numpyro.sample("mean", dist.Normal()), 1.0).expand(data.shape),
            obs=data,
        )

    mcmc = made_up_run(NUTS(no_bridge), {"mean": np.zeros((2, 7))})
    with pytest.raises(
        ValueError, match=r"`paths` needs an observed `DiffusionEndpoint` or .*; .* \['size'\]"
    ):
        nb.to_arviz(mcmc, paths=2)
    with pytest.raises(ValueError, match="`paths` must be a positive integer; got 0"):
        nb.to_arviz(mcmc, paths=0)


def kernels():
    pcn, fields = nb.infer.PCN(two_sites), ("lp", "acceptance_rate", "diverging")
    hmc = (*fields, "energy", "n_steps", "step_size")
    return [
        (HMC(two_sites), hmc),
        (nb.infer.FunctionSpaceHMC(two_sites), hmc),
        (nb.infer.CorrelatedPseudoMarginal(two_sites, 2), (*fields, "step_size")),
        (
            Gibbs([(pcn, nb.infer.noise_sites), (NUTS(two_sites), None)]),
            (
                "diverging",
                *(f"pcn_{f}" for f in fields),
                *(f"nuts_{f}" for f in (*hmc, "tree_depth")),
            ),
        ),
        (
            Gibbs(
                [
                    (pcn, ["wing_noise"]),
                    (pcn, ["leg_noise"]),
                    (nb.infer.FunctionSpaceHMC(two_sites), None),
                ]
            ),
            (
                "diverging",
                *(f"pcn{i}_{f}" for i in (0, 1) for f in fields),
                *(f"functionspacehmc_{f}" for f in hmc),
            ),
        ),
    ]


@pytest.mark.parametrize(
    "kernel, names", kernels(), ids=["hmc", "function_space", "pseudo_marginal", "gibbs", "three"]
)
def test_statistics_of_every_kernel(kernel, names):
    fields = nb.infer.fields(kernel)
    values = {name: np.arange(1.0, 15.0).reshape(2, 7) for name in fields}
    flags = [name for name in fields if name.endswith("diverging")]
    values |= {name: np.arange(14).reshape(2, 7) == i for i, name in enumerate(flags)}
    stats = statistics(values, kernel)
    assert set(stats) == set(names)
    assert np.sum(stats["diverging"]) == len(flags)
    np.testing.assert_array_equal(
        next(stats[name] for name in stats if name.endswith("lp"))[0, 0], -1.0
    )


@pytest.mark.parametrize(
    "kernel", [kernel for kernel, _ in kernels()[:4]], ids=lambda kernel: type(kernel).__name__
)
def test_fields_are_in_the_states(kernel):
    fields = nb.infer.fields(kernel)
    state = jax.eval_shape(lambda key: kernel.init(key, 5, None, (WINGS,), {}), jr.key(0))
    assert all(value.shape == () for value in nested_attrgetter(*fields)(state))


def test_samplers_without_a_model():
    mcmc = MCMC(
        NUTS(potential_fn=lambda z: 0.5 * z**2), num_warmup=2, num_samples=2, progress_bar=False
    )
    with pytest.raises(ValueError, match="must run a NumPyro model"):
        nb.to_arviz(mcmc)


# Masks


KEEP = np.array([[True, True], [True, False], [True, True]])
PAIRS = np.where(KEEP[..., None], np.random.default_rng(2).normal(0.3, 0.6, (3, 2, 2)), np.nan)
SIZES = np.arange(6).reshape(3, 2)


def masked_model():
    """Everything that may carry a mask: a bridge, an ordinary site, one of whole vectors,
    `obs_mask`.
    """
    mean = numpyro.sample("mean", dist.Normal(0.0, 2.0))
    sde = nb.LinearSDE(-1.0, 0.6, mean)
    law = nb.DiffusionEndpoint(sde, np.zeros(2), nb.InexactMatch(0.1), t1=1.0, num_steps=STEPS)
    with numpyro.plate("sides", 2, dim=-1), numpyro.plate("specimens", 3, dim=-2):
        with handlers.mask(mask=KEEP):
            nb.sample("wing", law, obs=PAIRS)
            numpyro.sample("spots", dist.Poisson(jnp.exp(mean)), obs=SIZES)
        with handlers.scale(scale=3.0), handlers.mask(mask=mean > -100):
            numpyro.sample("size", dist.Normal(mean, 1.0), obs=SIZES)
        numpyro.sample("tail", dist.Normal(mean, 1.0), obs=1.0 * SIZES, obs_mask=KEEP)
        with handlers.mask(mask=mean < 0):
            numpyro.sample("sometimes", dist.Normal(mean, 1.0), obs=SIZES)
        with handlers.mask(mask=False):
            numpyro.sample("never", dist.Normal(mean, 1.0), obs=SIZES)
    with numpyro.plate("row", 3):
        fine = (
            dist.Normal(mean, 1.0)
            .expand([3, 2])
            .mask(KEEP & [[True, False], [False, False], [True, True]])
        )
        numpyro.sample("pair", fine.to_event(1), obs=SIZES)


@pytest.fixture(scope="module")
def masked():
    rng = np.random.default_rng(3)
    shapes = {"mean": (), "wing_noise": (3, 2, STEPS, 2, 1), "tail_unobserved": (3, 2)}
    samples = {name: rng.normal(size=(2, 40, *shape)) for name, shape in shapes.items()}
    return samples, nb.to_arviz(
        made_up_run(NUTS(masked_model), samples, ()), coords={"sides": ["left", "right"]}
    )


def test_masked_data_are_no_data(masked):
    samples, data = masked
    mean = samples["mean"][..., None, None]
    assert set(data.log_likelihood.data_vars) == {
        "wing",
        "spots",
        "size",
        "tail_observed",
        "sometimes",
        "pair",
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        counts = {
            name: arviz.loo(data, var_name=name).n_data_points
            for name in data.log_likelihood.data_vars
        }
    assert counts == {
        "wing": 5,
        "spots": 5,
        "size": 6,
        "tail_observed": 5,
        "sometimes": 6,
        "pair": 2,
    }
    normal = dist.Normal(mean, 1.0).log_prob(SIZES)
    expected = {
        "spots": dist.Poisson(np.exp(mean)).log_prob(SIZES)[..., KEEP],
        "tail_observed": normal[..., KEEP],
        "size": normal,
        "sometimes": np.where(mean < 0, normal, 0.0),
        "pair": np.stack([normal[..., 0, 0], normal[..., 2, :].sum(-1)], -1),
    }
    for name, values in expected.items():
        np.testing.assert_allclose(data.log_likelihood[name], values, rtol=1e-6)

    def wing(mean, noise, observed):
        sde = nb.LinearSDE(-1.0, 0.6, mean)
        law = nb.DiffusionEndpoint(sde, np.zeros(2), nb.InexactMatch(0.1), t1=1.0, num_steps=STEPS)
        return law.given(noise).log_prob(observed)

    for place, (i, j) in {0: (0, 0), 2: (1, 0), 4: (2, 1)}.items():
        value = wing(samples["mean"][1, 3], samples["wing_noise"][1, 3, i, j], PAIRS[i, j])
        assert float(data.log_likelihood["wing"][1, 3, place]) == pytest.approx(
            float(value), abs=1e-10
        )
        assert data.log_likelihood["wing_specimens"][place] == i
        assert data.log_likelihood["wing_sides"][place] == ["left", "right"][j]


def test_masked_data_are_not_observed(masked):
    found = masked[1].observed_data
    np.testing.assert_array_equal(found["wing"], PAIRS)
    for name in ("spots", "tail_observed"):
        np.testing.assert_array_equal(found[name], np.where(KEEP, SIZES, np.nan))
    for name in ("size", "sometimes"):
        np.testing.assert_array_equal(found[name], SIZES)
    assert np.all(np.isnan(found["never"]))
    np.testing.assert_array_equal(found["pair"], np.where([[1, 0], [0, 0], [1, 1]], SIZES, np.nan))


# Predictions, and names


def plain_run():
    def plain():
        mean = numpyro.sample("mean", dist.Normal())
        with numpyro.plate("specimens", 3):
            numpyro.sample("size", dist.Normal(mean).expand([3, 2]).to_event(1), obs=SIZES)

    return made_up_run(NUTS(plain), {"mean": np.zeros((2, 7))}, ())


@pytest.mark.parametrize(
    "draws, found",
    [((14,), (2, 7)), ((2, 7), (2, 7)), ((5,), (1, 5)), ((2, 3), (2, 3)), ((1, 7), (1, 7))],
)
def test_predictions_of_some_draws(draws, found):
    made_up = np.arange(np.prod(draws) * 6.0).reshape(*draws, 3, 2)
    warning = (
        warnings.catch_warnings()
        if found == (2, 7)
        else pytest.warns(UserWarning, match="holds draws")
    )
    with warning:
        data = nb.to_arviz(
            plain_run(),
            log_likelihood=False,
            posterior_predictive={"size": made_up, "other": made_up},
        )
    assert data.posterior_predictive["size"].shape == (*found, 3, 2)
    assert data.posterior_predictive["size"].dims[2] == "specimens"
    np.testing.assert_array_equal(np.ravel(data.posterior_predictive["size"]), made_up.ravel())


def test_predictions_that_are_not_of_the_same_draws():
    draws = {"size": np.zeros((14, 3, 2)), "mean": np.zeros(5)}
    with pytest.raises(
        ValueError, match=r"same draws of every site; got leading axes \[\(5,\), \(14,\)\]"
    ):
        nb.to_arviz(plain_run(), posterior_predictive=draws)


def test_names_with_a_slash(tmp_path, several):
    """`handlers.scope` makes them, and neither a `DataTree` nor a NetCDF file takes them."""
    scoped = handlers.scope(two_sites, prefix="moth")
    samples = made_up_run(NUTS(two_sites)).get_samples(group_by_chain=True)
    mcmc = made_up_run(NUTS(scoped), {f"moth/{name}": value for name, value in samples.items()})
    prior = {"moth/mean": np.zeros(4), "moth/wing": np.zeros((4, 3, 2, 1))}
    data = nb.to_arviz(
        mcmc,
        prior=prior,
        posterior_predictive={"moth/wing": np.zeros((14, 3, 2, 1))},
        paths=100,
        coords={"moth/specimens": ["a", "b", "c"], "xy": ["x"]},
        dims={"moth/wing": ["moth/specimens", "moth/point", "xy"]},
    )
    for group in ("observed_data", "posterior_predictive", "prior_predictive"):
        assert data[group]["moth.wing"].dims[-3:] == ("moth.specimens", "moth.point", "xy")
    assert set(data.posterior.data_vars) == {"moth.mean", "moth.end"}
    assert list(data.log_likelihood["moth.specimens"].values) == ["a", "b", "c"]
    assert data["posterior_paths"]["moth.leg"].dims == (
        "chain",
        "draw",
        "moth.leg_time",
        "moth.leg_coordinate",
    )
    np.testing.assert_allclose(
        data.log_likelihood["moth.wing"], several.log_likelihood["wing"], rtol=1e-12
    )
    data.to_netcdf(str(tmp_path / "scoped.nc"), engine="h5netcdf")
    with xarray.open_dataset(tmp_path / "scoped.nc", group="posterior", engine="h5netcdf") as read:
        np.testing.assert_array_equal(read["moth.mean"], samples["mean"])


def test_names_that_only_a_slash_keeps_apart():
    def twins(data):
        mean = numpyro.sample("moth/mean", dist.Normal())
        numpyro.sample("moth.mean", dist.Normal(mean))

    mcmc = made_up_run(NUTS(twins), {name: np.zeros((2, 7)) for name in ("moth/mean", "moth.mean")})
    with pytest.raises(ValueError, match=r"\['moth/mean'\] become names of other sites"):
        nb.to_arviz(mcmc)


SHAPE = nb.datasets.ellipses(12).mean
CONTROLS = np.array([0, 3, 6, 9])


def carried(data):
    """A flow whose controls miss more the shorter the length scale is."""
    length_scale = numpyro.sample("length_scale", dist.LogNormal(1.5, 0.1))
    flow = nb.KunitaFlow(
        nb.Landmarks(12, 2),
        covariance=nb.GaussianKernel(0.1, length_scale),
        noise=nb.ControlNoise(points=CONTROLS),
    )
    law = nb.DiffusionEndpoint(flow, SHAPE, nb.InexactMatch(0.1), t1=1.0, num_steps=STEPS)
    nb.sample("wing", law, obs=data)


def missing_at(length_scale):
    """By NumPy: of the worst landmark, 1 − a(x, c) a(c, c)⁻¹ a(c, x) / a(x, x)."""
    square = np.sum((SHAPE[:, None] - SHAPE[None]) ** 2, axis=-1)
    a = np.exp(-0.5 * square / length_scale**2) + 1e-10 * np.eye(12)
    across = a[:, CONTROLS]
    told = np.sum(across * np.linalg.solve(a[np.ix_(CONTROLS, CONTROLS)], across.T).T, axis=1)
    return np.max(1 - told)


def test_draws_that_need_more_controls():
    """A warning with their share and with what is missing at the worst of them, and none where all
    have enough.
    """
    scales = np.linspace(1.0, 3.0, 14).reshape(2, 7)
    missing = np.array([missing_at(scale) for scale in scales.ravel()])
    share = np.mean(missing > 0.01)
    assert 0.2 < share < 0.8
    noise = np.zeros((2, 7, STEPS, 4, 2))
    run = made_up_run(NUTS(carried), {"length_scale": scales, "wing_noise": noise}, (SHAPE,))
    said = f"`wing` needs more controls than its 4: at {100 * share:.2g} % .* {100 * missing.max():.2g} % at most"
    with pytest.warns(UserWarning, match=said):
        nb.to_arviz(run)
    enough = made_up_run(NUTS(carried), {"length_scale": 4 + scales, "wing_noise": noise}, (SHAPE,))
    assert missing_at(5.0) < 0.01
    nb.to_arviz(enough)  # warnings are errors
