# %% [markdown]
# # A growth series as a chain: how fast do animals become adult in shape, how do they differ?
#
# Each animal is measured at several ages. Its shape and size go towards an adult one, at a rate,
# and are pushed off by noise on the way, points close together being pushed together over a length
# scale: an Ornstein–Uhlenbeck process on a chain of ages, whose likelihood is exact. What is seen
# has an error. An age at which an animal was not measured is masked; its shape there is among the
# results.
#
#     python examples/growth.py            # simulated animals, and the truth beside
#     python examples/growth.py --quick    # under a minute
#     python examples/growth.py --shapes rats.csv --names rat --age age_days

# %%
import time

import arviz as az
import jax
import jax.numpy as jnp
import jax.random as jr
import matplotlib.pyplot as plt
import numpy as np
import numpyro
import numpyro.distributions as dist
from numpyro.infer import MCMC, NUTS, Predictive
from phylogeny import column_of, files, options, read_shapes, settings

import numpyro_bridges as nb

parser = options("Growth series as chains.")
files(parser, required=False)
parser.add_argument("--names", default="id", help="the column that says which animal was measured")
parser.add_argument("--age", default="age", help="the column with its age, a number")
arguments = settings(parser.parse_known_args()[0])
TRUTH = {"rate": 3.0, "amplitude": 0.15, "length_scale": 0.5, "error": 0.01}


# %% [markdown]
# ## The data
# Shapes are aligned but keep their size, in units of the mean size at the first age. Times run from
# the first age on, in units of the span of ages. Each chain starts at what was seen at the first
# age; animals not seen then are left out.


# %%
def series(shapes, animals, ages):
    """Shapes `(animals, ages, n, dim)`, NaN where there is none, and the ages."""
    distinct, names = np.unique(ages), list(dict.fromkeys(animals))
    rows = np.full((len(names), len(distinct), *shapes.shape[1:]), np.nan)
    for shape, animal, age in zip(shapes, animals, ages, strict=True):
        place = names.index(animal), int(np.searchsorted(distinct, age))
        if np.isfinite(rows[place]).all():
            raise ValueError(
                f"each animal must have one shape at an age; {animal} has several at {age:g}."
            )
        rows[place] = shape
    started = np.isfinite(rows[:, 0]).all(axis=(1, 2))
    if not started.all():
        print(f"animals not seen at the first age, left out: {int(np.sum(~started))}")
    if not started.any() or len(distinct) < 2:
        raise ValueError("at least one animal must be seen at the first of at least two ages.")
    return rows[started], distinct


def read():
    shapes, rows = read_shapes(arguments)
    ages = [float(age) for age in column_of(rows, arguments.age, "--age")]
    aligned = nb.shapes.procrustes_align(shapes, scale=False).shapes
    rows, ages = series(aligned, column_of(rows, arguments.names, "--names"), ages)
    return rows / nb.shapes.rms_radius(rows[:, 0].mean(axis=0)), ages


def simulated():
    """Twelve animals that are born round and grow long, seen at six ages; the last one misses two
    of them.
    """
    ages = np.array([0.0, 1.0, 2.0, 4.0, 7.0, 10.0])
    young, adult = nb.datasets.ellipses(num_points=12, aspects=(1.0, 1.8)).points
    start = young + 0.05 * np.random.default_rng(0).normal(size=(12, 1, 1)) * young
    law = law_of(start, nb.Tree.chain(ages[1:] / 10), young, 2 * adult, mask=None, **TRUTH)
    rows = np.concatenate([start[:, None], law.sample(jr.key(2))], axis=1)
    rows[-1, [2, 4]] = np.nan
    return rows, ages


# %% [markdown]
# ## The model
# The noise is that of a Kunita flow, frozen at the mean shape of the first age. The data say more
# of the shape at the last age than of the adult one, which lies beyond; so the former is the
# parameter, and the latter follows from it. Its prior is as wide as the animals differ at that age.
#
# The SDE is linear, so that the density of what is seen does not depend on the noise that drives
# the paths: it is given some, and only parameters are sampled, by NUTS.


# %%
def law_of(start, tree, mean, adult, mask, rate, amplitude, length_scale, error):
    flow = nb.KunitaFlow(nb.Landmarks(*mean.shape), nb.GaussianKernel(amplitude, length_scale))
    factor, _ = flow.noise(0.0, mean)
    growth = nb.LinearSDE(-rate, factor, rate * adult)
    match, own = nb.InexactMatch(error**2), ()
    if mask is not None:
        match, own = (
            jax.vmap(jax.vmap(lambda seen: nb.InexactMatch(error**2, mask=seen)))(mask),
            ("match",),
        )
    batch = {"batch_shape": start.shape[:1], "batched": ("x0", *own)}
    return nb.DiffusionTree(growth, start, match, tree=tree, per_row=own, **batch)


try:
    rows, ages = simulated() if arguments.shapes is None else read()
except (OSError, ValueError) as fault:
    parser.error(str(fault))
span = float(ages[-1] - ages[0])
tree = nb.Tree.chain((ages[1:] - ages[0]) / span, names=[f"{age:g}" for age in ages[1:]])
start, later = rows[:, 0], np.nan_to_num(rows[:, 1:])
mask = np.isfinite(rows[:, 1:]).all(axis=-1)
mean, centre = start.mean(axis=0), np.nanmean(rows[:, -1], axis=0)
spread = np.sqrt(np.nanmean((rows[:, -1] - centre) ** 2))
print(
    f"{len(rows)} animals, {len(ages)} ages from {ages[0]:g} to {ages[-1]:g}, {len(mean)} points;",
    end=" ",
)
print(f"not seen: {int(np.sum(~mask.all(axis=-1)))} of {mask[..., 0].size}")


def parameters():
    rate = numpyro.sample("rate", dist.LogNormal(1.0, 1.0))
    amplitude = numpyro.sample("amplitude", dist.LogNormal(-2.0, 1.0))
    length_scale = numpyro.sample("length_scale", dist.LogNormal(-1.0, 0.5))
    error = numpyro.sample("error", dist.LogNormal(-4.0, 1.0))
    return {"rate": rate, "amplitude": amplitude, "length_scale": length_scale, "error": error}


def model(later=None):
    drawn = parameters()
    last = centre + spread * numpyro.sample(
        "offset", dist.Normal(jnp.zeros(mean.shape), 1.0).to_event(2)
    )
    adult = numpyro.deterministic("adult", mean + (last - mean) / -jnp.expm1(-drawn["rate"]))
    with numpyro.plate("animal", len(start)):
        numpyro.sample("series", given(law_of(start, tree, mean, adult, mask, **drawn)), obs=later)


def given(law, key=None):
    """The law with noise of a key, or of zeros."""
    prior = law.noise_prior()
    shape = (*prior.batch_shape, *prior.event_shape)
    return law.given(jnp.zeros(shape) if key is None else jr.normal(key, shape))


# %% [markdown]
# ## Inference

# %%
kernel = NUTS(model)
run = {
    "num_warmup": arguments.warmup,
    "num_samples": arguments.samples,
    "num_chains": arguments.chains,
}
mcmc = MCMC(kernel, chain_method="vectorized", **run)
began, key, fields = time.perf_counter(), jr.key(arguments.seed), ("diverging",)
if arguments.run is None:
    mcmc.run(key, later, extra_fields=fields)
else:
    nb.infer.run_checkpointed(mcmc, arguments.run, key, later, extra_fields=fields)
posterior = jax.block_until_ready(mcmc.get_samples())
print(f"{time.perf_counter() - began:.0f} s for {arguments.chains} chains; ", end="")
print(f"divergences: {int(np.sum(mcmc.get_extra_fields()['diverging']))}")

prior = Predictive(parameters, num_samples=2000)(jr.key(1))
results = nb.to_arviz(mcmc, prior=prior)
print(az.summary(results, var_names=[*prior, "adult"]).iloc[: len(prior) + 2].to_string())
halved = np.log(2) / posterior["rate"] * span
print(
    f"half of the way to the adult shape takes {np.mean(halved):.3g} ± {np.std(halved):.2g} units "
    "of age"
)
if arguments.shapes is None:
    print("the truth: " + ", ".join(f"{name} {value:g}" for name, value in TRUTH.items()))


# %% [markdown]
# ## What is left behind: a NetCDF file and two figures
# The animal with the fewest ages, and draws of its shapes, those that were not seen among them:
# here the noise counts.


# %%
def shapes_of(draw, key):
    law = law_of(start, tree, mean, draw["adult"], mask, **{name: draw[name] for name in prior})
    return given(law, key).nodes(later)[fewest]


fewest = int(np.argmin(mask.all(axis=-1).sum(axis=1)))
chosen = np.linspace(0, len(posterior["rate"]) - 1, 40).astype(int)
draws = {name: value[chosen] for name, value in posterior.items()}
found = np.asarray(
    jax.lax.map(lambda pair: shapes_of(*pair), (draws, jr.split(jr.key(2), len(chosen))))
)
arguments.output.mkdir(parents=True, exist_ok=True)
written = [
    arguments.output / file for file in ("growth.nc", "growth_series.png", "growth_posterior.png")
]
results.to_netcdf(str(written[0]), engine="h5netcdf")

bands = {node: found[:, node, :, :2] for node in tree.observed}
nb.plot.tree(
    tree, shapes={0: start[fewest, :, :2]}, draws=bands, closed=not arguments.open, size=0.8
)
plt.gca().set_xlabel(f"time since the first age, in units of {span:g}")
plt.gcf().suptitle("one animal: its first shape, and draws of the later ones", fontsize="medium")
plt.savefig(written[1], dpi=150)
plt.close()

nb.plot.posterior(
    {name: posterior[name] for name in prior}, prior, truth=None if arguments.shapes else TRUTH
)
plt.gcf().suptitle("posterior, and prior (dashed)", fontsize="medium")
plt.savefig(written[2], dpi=150)
plt.close()
print("written: " + ", ".join(str(path) for path in written))
