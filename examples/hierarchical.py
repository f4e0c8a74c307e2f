# %% [markdown]
# # Ten cells: what they share, and what each has of its own
#
# A nerve cell follows the FitzHugh–Nagumo equations, of a voltage v and of a recovery w, which a
# constant input and noise move:
#
#     dv = (v − w − v³) / 0.3 dt,   dw = (1.5 v − w + β) dt + σ dB
#
# Ten cells are each seen once, after one unit of time. The noise σ is that of all; the input β
# is each cell's own, and varies about a mean μ with a spread τ. What do ten pairs of numbers say of
# μ, τ and σ, how well is one cell predicted from the nine others, and are they different at all?
#
#     python examples/hierarchical.py            # up to ten minutes
#     python examples/hierarchical.py --quick    # fewer draws and particles

# %%
import argparse
import os
from pathlib import Path

# threads of its own slow small matrices down, many times over
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# half the time of compiling, which is much of so short a run
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=1")

import arviz as az
import jax
import jax.numpy as jnp
import jax.random as jr
import matplotlib
import numpy as np
import numpyro
import numpyro.distributions as dist
from numpyro.infer import MCMC, Predictive
from scipy.interpolate import CubicSpline
from scipy.special import logsumexp

import numpyro_bridges as nb

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

parser = argparse.ArgumentParser(description="Ten cells, with parameters of all and of each.")
parser.add_argument("--quick", action="store_true", help="fewer draws and particles")
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--output", type=Path, default=Path("output"))
arguments = parser.parse_known_args()[0]
quick = arguments.quick
num_warmup, num_samples = (50, 50) if quick else (500, 2000)
num_particles = 16 if quick else 64
START, ERROR_SD = np.array([-0.5, -0.6]), 0.1
key_run, key_same, key_new, key_grid = jr.split(jr.key(arguments.seed), 4)

# the ends of ten cells, (v, w), simulated
observed = np.array(
    [[-0.79, -0.07], [-0.34, -0.11], [-1.11, 0.2], [0.87, 0.27], [0.91, 0.18]]
    + [[-0.97, -0.08], [1.1, 0.26], [-0.9, -0.18], [-0.95, 0.01], [-0.83, 0.07]]
)


# %% [markdown]
# ## The model
# Shared is what is drawn outside the plate. Each cell has an SDE of its own, made by `jax.vmap`,
# and `batch_shape=` says that there is one for each datum. The deviations are standard normal
# numbers (the non-centred form), so that the sampler meets no funnel where cells hardly differ.


# %%
def drift(t, x, args):
    v, w = x
    beta, _ = args
    return jnp.stack([(v - w - v**3) / 0.3, 1.5 * v - w + beta])


def diffusion(t, x, args):
    _, sigma = args
    return jnp.stack([0.0, sigma])[:, None]


def cell(beta, sigma):
    return nb.SDE(drift, diffusion, args=(beta, sigma))


seen = nb.InexactMatch(ERROR_SD**2)
steps = {"t1": 1.0, "num_steps": 25}
PRIORS = {
    "mu": dist.Normal(0.8, 0.5),
    "tau": dist.HalfNormal(0.5),
    "sigma": dist.LogNormal(-1.0, 0.5),
}


def law_of(betas, sigma):
    """Of the ends of cells, each with its input."""
    cells = jax.vmap(cell, in_axes=(0, None))(betas, sigma)
    return nb.DiffusionEndpoint(
        cells, START, seen, batch_shape=(len(betas),), batched=("sde",), **steps
    )


def model(observed=None, num_cells=10):
    mu, tau, sigma = [numpyro.sample(name, prior) for name, prior in PRIORS.items()]
    with numpyro.plate("cell", num_cells):
        deviation = numpyro.sample("deviation", dist.Normal(0.0, 1.0))
        beta = numpyro.deterministic("beta", mu + tau * deviation)
        nb.sample("end", law_of(beta, sigma), obs=observed)


def model_of_equals(observed=None, num_cells=10):
    mu, sigma = [numpyro.sample(name, PRIORS[name]) for name in ("mu", "sigma")]
    law = nb.DiffusionEndpoint(cell(mu, sigma), START, seen, **steps)
    with numpyro.plate("cell", num_cells):
        nb.sample("end", law, obs=observed)


# %% [markdown]
# ## Inference


# %%
def fitted(model):
    kernel = nb.infer.FunctionSpaceHMC(model)
    mcmc = MCMC(
        kernel,
        num_warmup=num_warmup,
        num_samples=num_samples,
        num_chains=4,
        chain_method="vectorized",
        progress_bar=False,
    )
    mcmc.run(key_run, observed, extra_fields=nb.infer.fields(kernel))
    return mcmc


runs = {"each its own": fitted(model), "all alike": fitted(model_of_equals)}
mcmc = runs["each its own"]
draws = mcmc.get_samples()

# %% [markdown]
# ## How well is a cell predicted from the others?
# Leave-one-out needs the probability of a cell's end given what all share. Its noise and its own
# input are integrated out, by new bridges: `nb.log_likelihood` does it, and says how well.
#
# Given its noise and its input, each cell would look well predicted, since both have been fitted
# to it: that is the second line, and no answer to the question.

# %%
found = {
    name: nb.log_likelihood(run, num_particles=num_particles, draws=200)
    for name, run in runs.items()
}
results = {name: nb.to_arviz(run, log_likelihood=found[name]) for name, run in runs.items()}
print(az.summary(results["each its own"], var_names=list(PRIORS)).to_string())


def leave_one_out(log_likelihood):
    """Sum over cells of log p(a cell | the others), from values `(chains, draws, cells)`."""
    flat = log_likelihood.reshape(-1, log_likelihood.shape[-1])
    return float(np.sum(np.log(len(flat)) - logsumexp(-flat, axis=0)))


def given_noise(sites):
    """The log likelihood of each cell given its noise and its input, at one draw."""
    law = law_of(sites["beta"], sites["sigma"])
    return law.given(sites["end_noise"]).log_prob(observed)


conditional = np.asarray(jax.jit(jax.vmap(given_noise))(draws))
print(f"\nelpd of new cells: {leave_one_out(found['each its own'].values['end']):.2f}")
print(f"given noise and input, which nobody knows beforehand: {leave_one_out(conditional):.2f}")
print(found["each its own"])


# %% [markdown]
# ## The referee
# Three parameters are few enough for a grid. The probability of each cell's end by 200 bridges at
# each of 48 inputs and 24 values of σ; its average over the inputs, given μ and τ; and the
# posterior without each cell, as a sum.


# %%
def elpd_on_a_grid(num_bridges=200):
    betas = np.linspace(-2.0, 3.6, 48)
    sigmas = np.exp(np.linspace(-2.5, 0.7, 24))

    def log_density(beta, sigma, key):
        law = nb.DiffusionEndpoint(cell(beta, sigma), START, seen, **steps)
        noise = jr.normal(key, (num_bridges, 10, *law.noise_prior().shape()))
        log_weights = jax.vmap(lambda one: law.given(one).log_prob(observed))(noise)
        return jax.nn.logsumexp(log_weights, axis=0) - np.log(num_bridges)

    grid = [axis.ravel() for axis in np.meshgrid(betas, sigmas, indexing="ij")]
    keys = jr.split(key_grid, grid[0].size)
    at_points = jax.jit(lambda *points: jax.lax.map(lambda point: log_density(*point), points))
    log_densities = np.asarray(at_points(*grid, keys)).reshape(48, 24, 10)

    # between inputs the logarithm is smooth
    fine = np.linspace(betas[0], betas[-1], 951)
    densities = np.exp(CubicSpline(betas, log_densities)(fine)).reshape(951, -1)
    mus, taus = np.meshgrid(np.linspace(-0.7, 2.3, 61), np.linspace(0.02, 2.0, 50))
    mus, taus = mus.reshape(-1, 1), taus.reshape(-1, 1)
    of_beta = np.exp(dist.Normal(mus, taus).log_prob(fine))
    of_beta /= np.sum(of_beta, axis=1, keepdims=True)
    # (μ and τ, σ, cell)
    log_likelihood = np.log(of_beta @ densities).reshape(-1, 24, 10)

    log_prior = PRIORS["mu"].log_prob(mus) + PRIORS["tau"].log_prob(taus)
    # the grid is even in log σ
    log_prior += PRIORS["sigma"].log_prob(sigmas) + np.log(sigmas)
    joint = np.asarray(log_prior) + np.sum(log_likelihood, axis=-1)
    without = joint[..., None] - log_likelihood
    return float(np.sum(logsumexp(joint) - logsumexp(without, axis=(0, 1))))


referee = elpd_on_a_grid()
print(f"elpd by quadrature: {referee:.2f}")

# %% [markdown]
# ## Are the cells different?
# `arviz.compare` ranks the two models by how well they predict a cell. Its standard error is that
# of ten differences.

# %%
print(az.compare(results).to_string())

# %% [markdown]
# ## Does the model make what was seen?
# `Predictive` draws anew what it is not given. With all draws: the same cells once more, other
# noise. With the shared parameters alone: cells that nobody has seen, and the stricter check.

# %%
shared = {name: draws[name] for name in PRIORS}
same = Predictive(model, draws)(key_same)["end"]
new = Predictive(model, shared)(key_new, num_cells=30)["end"]
for name, cells in {"the same cells": same, "new cells": new}.items():
    spreads = np.std(cells[:, :10, 0], axis=1)
    share = np.mean(spreads > np.std(observed[:, 0]))
    print(f"{name}: the voltages spread more than what was seen in {100 * share:.0f} % of draws")

# %% [markdown]
# ## What is left behind: a NetCDF file and a figure
# Most cells have stayed at rest and three have fired: what the input of a cell was is known up to
# which of the two it favours, and inputs are drawn together by their common mean. Intervals hold
# 50 and 90 %.
#
# ![Ends of ten cells over those predicted of new ones; the input of each](hierarchical.png)

# %%
arguments.output.mkdir(parents=True, exist_ok=True)
file = arguments.output / "hierarchical.nc"
results["each its own"].to_netcdf(str(file), engine="h5netcdf")

figure, (left, right) = plt.subplots(1, 2, figsize=(8.5, 3.6), constrained_layout=True)
cloud = np.asarray(new).reshape(-1, 2)
cloud = cloud[:: -(-len(cloud) // 1500)]
left.plot(*cloud.T, ".", color="0.75", markersize=2, label="new cells, by the model")
left.plot(*observed.T, "o", color="tab:blue", markersize=5, label="what was seen")
left.set(xlabel="voltage v at the end", ylabel="recovery w at the end")
left.set(xlim=(-2.0, 2.0), ylim=(-1.2, 1.2))
left.legend(frameon=False, loc="upper left", fontsize="small")

order = np.argsort(observed[:, 0])
places = np.arange(10)
for level, width in ((0.9, 1.2), (0.5, 3.5)):
    low, high = np.quantile(draws["beta"][:, order], [0.5 - level / 2, 0.5 + level / 2], axis=0)
    right.hlines(places, low, high, color="tab:blue", linewidth=width)
right.plot(np.median(draws["beta"][:, order], axis=0), places, "o", color="white", markersize=3)
right.axvline(np.mean(draws["mu"]), color="0.5", linestyle="--", label="mean of μ")
right.set_yticks(places, labels=[f"cell {i + 1}, v = {observed[i, 0]:.2f}" for i in order])
right.set(xlabel="input β")
right.legend(frameon=False, loc="upper right", fontsize="small")
picture = arguments.output / "hierarchical.png"
figure.savefig(picture, dpi=150)
plt.close(figure)
print(f"written: {file}, {picture}")
