# %% [markdown]
# # A random field seen at a few places and times: its law, and the field itself
#
# A field u(s, t) on [0, 1], with no flux through the ends, goes to +1 or −1, spreads, and is driven
# by noise that is smooth in space, the stochastic Allen–Cahn equation
#
#     du = (ν ∂²u/∂s² + r (u − u³)) dt + dW,      W with coefficients of variance σ² / (1 + n²)²
#
# It is a semilinear equation in the cosines, which diagonalise ∂²/∂s²: what is linear is stepped
# exactly, so that no resolution is too fine for a step. Six places are measured at six times, with
# an error. How fast does the field spread and react, how strong is the noise, and what was the
# field where nobody looked?
#
#     python examples/allen_cahn.py              # on two cores some ten minutes
#     python examples/allen_cahn.py --quick      # two or three, most of which is compilation
#     python examples/allen_cahn.py --modes 60   # the same answer: no more of the field is seen

# %%
import argparse
import time
from pathlib import Path

import arviz as az
import jax
import jax.numpy as jnp
import jax.random as jr
import matplotlib.pyplot as plt
import numpy as np
import numpyro
import numpyro.distributions as dist
from numpyro.infer import MCMC, Predictive

import numpyro_bridges as nb

parser = argparse.ArgumentParser(
    description="A stochastic Allen–Cahn field at a few places and times."
)
parser.add_argument("--quick", action="store_true", help="fewer modes, steps and draws, 2 chains")
parser.add_argument("--modes", type=int, default=15, help="the highest of the cosines")
parser.add_argument("--steps", type=int, default=10, help="between two times")
parser.add_argument("--warmup", type=int, default=300)
parser.add_argument("--samples", type=int, default=500)
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--output", type=Path, default=Path("output"))
arguments = parser.parse_known_args()[0]
if arguments.quick:
    arguments.modes, arguments.steps, arguments.warmup, arguments.samples = 7, 4, 60, 100
TRUTH = {"diffusivity": 0.02, "rate": 4.0, "noise": 0.6}
ERROR = 0.1


# %% [markdown]
# ## The model
# A time series is a chain, a tree without branches. Where measured, a field is a row of the basis
# at that place.

# %%
space = nb.CosineBasis(arguments.modes, 1)
places = np.linspace(0.05, 0.95, 6)
times = np.linspace(0.25, 1.5, 6)
chain = nb.Tree.chain(times)
start = space.from_points(np.tanh(4 * (space.grid - 0.5)))
spectrum = (1.0 + jnp.arange(space.size) ** 2.0) ** -2.0


def reaction(t, x, rate):
    u = space.to_points(x)
    return space.from_points(rate * (u - u**3))


def law_of(diffusivity, rate, noise):
    sde = nb.SemilinearSDE(
        diffusivity * space.laplacian, reaction, noise * jnp.sqrt(spectrum), rate, space=space
    )
    match = nb.InexactMatch(ERROR**2, operator=space.basis(places))
    return nb.DiffusionTree(sde, start, match, tree=chain, num_steps=arguments.steps)


def parameters():
    diffusivity = numpyro.sample("diffusivity", dist.LogNormal(-4.0, 1.0))
    rate = numpyro.sample("rate", dist.LogNormal(1.0, 1.0))
    noise = numpyro.sample("noise", dist.LogNormal(-1.0, 1.0))
    return {"diffusivity": diffusivity, "rate": rate, "noise": noise}


def model(measured=None):
    nb.sample("field", law_of(**parameters()), obs=measured)


# %% [markdown]
# ## Data with a known truth, and inference

# %%
truth = law_of(**TRUTH)
measured, noise = truth.sample_with_noise(jr.key(arguments.seed))
true_field = truth.given(noise).path(measured)

kernel = nb.infer.FunctionSpaceHMC(model)
num_chains = 2 if arguments.quick else 4
run = {"num_warmup": arguments.warmup, "num_samples": arguments.samples, "num_chains": num_chains}
mcmc = MCMC(kernel, chain_method="vectorized", **run)
began = time.perf_counter()
mcmc.run(jr.key(1), measured, extra_fields=nb.infer.fields(kernel))
posterior = jax.block_until_ready(mcmc.get_samples())
print(f"{space.size} functions; {time.perf_counter() - began:.0f} s for {num_chains} chains")

prior = Predictive(parameters, num_samples=2000)(jr.key(2))
results = nb.to_arviz(mcmc, prior=prior)
print(az.summary(results, var_names=list(TRUTH)).to_string())
print("the truth: " + ", ".join(f"{name} {value:g}" for name, value in TRUTH.items()))


# %% [markdown]
# ## What is left behind: a NetCDF file and two figures
# The field along the paths that the noise of the draws drives, mean and SD, beside the true one.

# %%
along = np.linspace(0, 1, 101)


def field(draw):
    """On the times of the grid and the places `along`."""
    law = law_of(**{name: draw[name] for name in TRUTH})
    path = law.given(draw["field_noise"]).path(measured)
    return over_time(path) @ space.basis(along).T


def over_time(path):
    """Branches of a chain one after the other, times that two of them share once."""
    return jnp.concatenate([path[0, :1], path[:, 1:].reshape(-1, space.size)])


fields = np.asarray(
    jax.jit(jax.vmap(field))({name: posterior[name][::5] for name in (*TRUTH, "field_noise")})
)
grid = np.concatenate([[0.0], np.asarray(truth.times)[:, 1:].reshape(-1)])
panels = {"the field": over_time(true_field) @ space.basis(along).T}
panels |= {"posterior mean": fields.mean(axis=0), "posterior SD": fields.std(axis=0)}
covered = np.mean(np.abs(panels["the field"] - fields.mean(axis=0)) < 2 * fields.std(axis=0))
print(f"within 2 SD of the posterior mean: {100 * covered:.0f} % of the true field")

arguments.output.mkdir(parents=True, exist_ok=True)
written = [
    arguments.output / name
    for name in ("allen_cahn.nc", "allen_cahn_field.png", "allen_cahn_posterior.png")
]
results.to_netcdf(str(written[0]), engine="h5netcdf")
figure, axes = plt.subplots(1, 3, figsize=(11, 3.4), sharey=True, constrained_layout=True)
for ax, (title, values) in zip(axes, panels.items(), strict=True):
    limits = (
        {"vmin": -1.5, "vmax": 1.5, "cmap": "RdBu_r"}
        if "SD" not in title
        else {"vmin": 0, "cmap": "viridis"}
    )
    shown = ax.pcolormesh(grid, along, np.asarray(values).T, shading="gouraud", **limits)
    ax.plot(
        *(points.ravel() for points in np.meshgrid(times, places)),
        "k.",
        markersize=4,
        clip_on=False,
    )
    ax.set(title=title, xlabel="time")
    figure.colorbar(shown, ax=ax)
axes[0].set_ylabel("place")
figure.savefig(written[1], dpi=150)
plt.close()

nb.plot.posterior({name: posterior[name] for name in TRUTH}, prior, truth=TRUTH)
plt.gcf().suptitle("posterior, prior (dashed), truth", fontsize="medium")
plt.savefig(written[2], dpi=150)
plt.close()
print("written: " + ", ".join(str(path) for path in written))
