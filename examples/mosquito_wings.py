# %% [markdown]
# # How variable are wing shapes within a genus, and on what length scale?
#
# Each wing outline is the end of a Kunita flow that started at the genus mean: points close together move together,
# over a length scale ℓ, by amounts set by an amplitude α. The outlines are seen with a small observation error. MCMC
# draws from the posterior of (α, ℓ) and of the paths themselves, for all specimens of the genus.
#
#     python examples/mosquito_wings.py            # 4 chains, some minutes on 2 cores
#     python examples/mosquito_wings.py --quick    # under a minute, to see that all runs

# %%
import argparse
import os
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # threads of its own slow small matrices down, many times over

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import numpyro
import numpyro.distributions as dist
from numpyro.infer import MCMC, Predictive

import numpyro_bridges as nb

numpyro.set_host_device_count(2)  # two of the four chains on each core

parser = argparse.ArgumentParser()
parser.add_argument("--quick", action="store_true", help="4 specimens, 16 points, few steps and draws")
parser.add_argument("--genus", default="CX", help="a genus of the data set; CX is Culex")
parser.add_argument("--specimens", type=int, help="the first so many; by default all")
parser.add_argument("--warmup", type=int, default=150)
parser.add_argument("--samples", type=int, default=300)
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--output", type=Path, default=Path("output"))
arguments, _ = parser.parse_known_args()
quick = arguments.quick
num_points, num_steps = (16, 10) if quick else (32, 50)
num_warmup, num_samples = (30, 50) if quick else (arguments.warmup, arguments.samples)

# %% [markdown]
# ## The data
# Real outlines, resampled by arc length, aligned, at unit RMS radius; the observation error is small beside their
# spread.

# %%
wings = nb.datasets.mosquito_wings(num_points=num_points, genus=arguments.genus)
points = wings.points[: 4 if quick else arguments.specimens]
space = nb.Landmarks(num_points=num_points, dim=2)
seen = nb.InexactMatch.from_point_sd(0.005, space)
spread = float(np.std(points - wings.mean))
print(f"{len(points)} wings of {arguments.genus}, {num_points} points: spread of a coordinate {spread:.4f},", end=" ")
print(f"observation SD 0.005, ratio {0.005 / spread:.2f}")


# %% [markdown]
# ## The model


# %%
def model(observed=None, num_specimens=None):
    amplitude = numpyro.sample("amplitude", dist.LogNormal(-2.0, 1.0))
    length_scale = numpyro.sample("length_scale", dist.LogNormal(-1.0, 0.5))
    flow = nb.KunitaFlow(space, nb.GaussianKernel(amplitude, length_scale))
    law = nb.DiffusionEndpoint(flow, wings.mean, seen, t1=1.0, num_steps=num_steps)
    with numpyro.plate("specimen", num_specimens or len(points)):
        nb.sample("wing", law, obs=observed)


# %% [markdown]
# ## Inference
# A kernel that knows that the noise is nearly standard normal: 2 or 3 gradients a draw where NUTS needs some 30.

# %%
kernel = nb.infer.FunctionSpaceHMC(model)
mcmc = MCMC(kernel, num_warmup=num_warmup, num_samples=num_samples, num_chains=4, chain_method="vectorized")
start = time.perf_counter()
mcmc.run(jr.key(arguments.seed), points, extra_fields=nb.infer.fields(kernel))
posterior = jax.block_until_ready(mcmc.get_samples())
print(f"{time.perf_counter() - start:.0f} s for 4 chains of {num_warmup} + {num_samples} draws")

prior = Predictive(model, num_samples=2000, parallel=True)(jr.key(1), num_specimens=1)
results = nb.to_arviz(mcmc, prior={name: prior[name] for name in ("amplitude", "length_scale")})

# %%
import arviz as az  # noqa: E402

print(az.summary(results, var_names=["amplitude", "length_scale"]).to_string())
for name in ("amplitude", "length_scale"):
    before, after = np.std(prior[name]), np.std(posterior[name])
    print(f"{name}: prior SD {before:.4f}, posterior SD {after:.4f}, ratio {after / before:.2f}")
print(f"divergences: {int(np.sum(mcmc.get_extra_fields()['diverging']))}")

# %% [markdown]
# How well is a wing predicted from the others? The log likelihoods have the noise integrated out, by 16 bridges at each
# of 200 draws.

# %%
print(az.loo(results))

# %% [markdown]
# ## Posterior bridges
# A draw of (α, ℓ, noise) is a draw of the path: nothing is to be simulated again.


# %%
@jax.jit
def bridge_path(amplitude, length_scale, noise, observed):
    flow = nb.KunitaFlow(space, nb.GaussianKernel(amplitude, length_scale))
    bridge = nb.GuidedBridge(flow, seen.at(observed), x0=wings.mean, t1=1.0, num_steps=num_steps)
    pull = flow.covariance(0.0, bridge.x0) @ bridge.score(0.0, bridge.x0)  # a ∇log h̃, what is added to the drift
    return bridge.path(noise), pull


specimen = int(np.argmax(np.std(points - wings.mean, axis=(1, 2))))  # the wing farthest from the mean
chosen = np.linspace(0, len(posterior["amplitude"]) - 1, 40).astype(int)
paths, pulls = jax.vmap(bridge_path, (0, 0, 0, None))(
    posterior["amplitude"][chosen],
    posterior["length_scale"][chosen],
    posterior["wing_noise"][chosen, specimen],
    jnp.asarray(points[specimen]),
)

# %% [markdown]
# ## What is left behind: a NetCDF file and three figures

# %%
import matplotlib  # noqa: E402

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

arguments.output.mkdir(parents=True, exist_ok=True)
written = [arguments.output / "wings.nc"]
results.to_netcdf(str(written[0]), engine="h5netcdf")


def save(name, title):
    written.append(arguments.output / name)
    plt.gcf().suptitle(title, fontsize="medium")
    plt.savefig(written[-1], dpi=150)
    plt.close()


def magnified(shapes, times=4):
    return wings.mean + times * (np.asarray(shapes) - wings.mean)


nb.plot.bridge_fan(magnified(paths), wings.mean, magnified(points[specimen]), direction="column")
save("bridges.png", "posterior bridges, deviations × 4")

nb.plot.posterior({k: posterior[k] for k in ("amplitude", "length_scale")}, prior)
save("posterior.png", "posterior, and prior (broken)")

nb.plot.score_field(wings.mean, np.asarray(pulls).mean(0))
save("score.png", "guiding term at the start, a ∇log h")

print("written: " + ", ".join(str(path) for path in written))
