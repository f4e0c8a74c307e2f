# %% [markdown]
# # How variable are wing shapes within a genus, and on what length scale?
#
# Each wing outline is the end of a Kunita flow that started at the genus mean: points close
# together move together, over a length scale ℓ, by amounts set by an amplitude α. The outlines are
# seen with a small observation error. MCMC draws from the posterior of (α, ℓ) and of the paths
# themselves, for all specimens of the genus.
#
#     python examples/mosquito_wings.py                # 4 chains, some minutes on 2 cores
#     python examples/mosquito_wings.py --quick        # under a minute, to see that all runs
#     python examples/mosquito_wings.py --genus Aedes  # or its code, AE
#     python examples/mosquito_wings.py --shapes wings.tps                           # your file
#     python examples/mosquito_wings.py --shapes wings.tps --groups specimens.csv \
#         --by specimen --column species --group "Papilio polytes"
#
# A file of your own holds the shapes of one group, or of several: then a table says which group
# each specimen is of, and the group to be fitted is chosen.

# %%
import argparse
import os
import time
from pathlib import Path

# threads of its own slow small matrices down, many times over
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# half the time of compiling, which is much of so short a run
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=1")

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import numpyro
import numpyro.distributions as dist
from numpyro.infer import MCMC, Predictive
from phylogeny import column_of, read_shapes

import numpyro_bridges as nb

numpyro.set_host_device_count(2)  # two of the four chains on each core

parser = argparse.ArgumentParser()
parser.add_argument(
    "--quick", action="store_true", help="4 specimens, 16 points, few steps and draws"
)
parser.add_argument("--genus", default="Culex", help="of the data set: a name or a code, CX")
parser.add_argument("--shapes", type=Path, help="a file of your own that `io.read` reads")
parser.add_argument("--groups", type=Path, dest="table", help="a table with a row a specimen")
parser.add_argument("--by", help="its column with the ids; without it, row is for row")
parser.add_argument("--column", help="the column with the group, of that table or of the shapes")
parser.add_argument("--group", help="the group to be fitted; without it, all specimens")
parser.add_argument("--points", type=int, help="landmarks, at equal steps of their number")
parser.add_argument("--open", action="store_true", help="curves whose ends do not meet")
parser.add_argument("--specimens", type=int, help="the first so many; by default all")
parser.add_argument("--warmup", type=int, default=150)
parser.add_argument("--samples", type=int, default=300)
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--output", type=Path, default=Path("output"))
arguments, _ = parser.parse_known_args()
quick = arguments.quick
arguments.points = min(arguments.points or 32, 16 if quick else 1000)
num_steps = 10 if quick else 50
num_warmup, num_samples = (30, 50) if quick else (arguments.warmup, arguments.samples)

# %% [markdown]
# ## The data
# Real outlines, resampled by arc length, aligned, at unit RMS radius; the observation error is
# small beside their spread. Shapes of your own are aligned here too, and mirror images are named.


# %%
def own_shapes():
    """Aligned shapes of the chosen group, their mean, and what to call them."""
    shapes, rows = read_shapes(arguments)
    if arguments.group is not None:
        groups = column_of(rows, arguments.column, "--column")
        if arguments.group not in groups:
            known = sorted(set(groups))
            raise ValueError(f"--group must be one of {known}; got {arguments.group!r}.")
        shapes = shapes[[group == arguments.group for group in groups]]
    if np.isnan(shapes).any():
        raise ValueError("--shapes must be complete here: `InexactMatch(mask=)` takes others.")
    alignment = nb.shapes.procrustes_align(shapes)
    return alignment.shapes, alignment.mean, arguments.group or arguments.shapes.name


if arguments.shapes is None:
    wings = nb.datasets.mosquito_wings(num_points=arguments.points, genus=arguments.genus)
    points, mean, label = wings.points, wings.mean, arguments.genus
else:
    try:
        points, mean, label = own_shapes()
    except (OSError, ValueError) as problem:
        parser.error(str(problem))
points = points[: 4 if quick else arguments.specimens]
num_points = len(mean)
space = nb.Landmarks(num_points=num_points, dim=2)
seen = nb.InexactMatch.from_point_sd(0.005, space)
spread = float(np.std(points - mean))
print(
    f"{len(points)} shapes of {label}, {num_points} points: spread of a coordinate {spread:.4f},",
    end=" ",
)
print(f"observation SD 0.005, ratio {0.005 / spread:.2f}")


# %% [markdown]
# ## The model


# %%
def model(observed=None, num_specimens=None):
    amplitude = numpyro.sample("amplitude", dist.LogNormal(-2.0, 1.0))
    length_scale = numpyro.sample("length_scale", dist.LogNormal(-1.0, 0.5))
    flow = nb.KunitaFlow(space, nb.GaussianKernel(amplitude, length_scale))
    law = nb.DiffusionEndpoint(flow, mean, seen, t1=1.0, num_steps=num_steps)
    with numpyro.plate("specimen", num_specimens or len(points)):
        nb.sample("wing", law, obs=observed)


# %% [markdown]
# ## Inference
# A kernel that knows that the noise is nearly standard normal: 2 or 3 gradients a draw where NUTS
# needs some 30.

# %%
kernel = nb.infer.FunctionSpaceHMC(model)
settings = {"num_warmup": num_warmup, "num_samples": num_samples, "num_chains": 4}
# of two devices a bar compiles twice
mcmc = MCMC(kernel, chain_method="vectorized", progress_bar=False, **settings)
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
# How well is a wing predicted from the others? The log likelihoods have the noise integrated out,
# by 16 bridges at each of 200 draws.

# %%
print(az.loo(results))

# %% [markdown]
# ## Posterior bridges
# A draw of (α, ℓ, noise) is a draw of the path: nothing is to be simulated again.


# %%
@jax.jit
def bridge_path(amplitude, length_scale, noise, observed):
    flow = nb.KunitaFlow(space, nb.GaussianKernel(amplitude, length_scale))
    bridge = nb.GuidedBridge(flow, seen.at(observed), x0=mean, t1=1.0, num_steps=num_steps)
    # a ∇log h̃, what is added to the drift
    pull = flow.covariance(0.0, bridge.x0) @ bridge.score(0.0, bridge.x0)
    return bridge.path(noise), pull


# the wing farthest from the mean
specimen = int(np.argmax(np.std(points - mean, axis=(1, 2))))
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
    return mean + times * (np.asarray(shapes) - mean)


nb.plot.bridge_fan(
    magnified(paths),
    mean,
    magnified(points[specimen]),
    direction="column",
    closed=not arguments.open,
)
save("bridges.png", "bridges from the mean (dark) to the shape seen (orange), deviations × 4")

nb.plot.posterior({k: posterior[k] for k in ("amplitude", "length_scale")}, prior)
save("posterior.png", "posterior, and prior (dashed)")

nb.plot.score_field(mean, np.asarray(pulls).mean(0), closed=not arguments.open)
save("score.png", "guiding term at the start, a ∇log h")

print("written: " + ", ".join(str(path) for path in written))
