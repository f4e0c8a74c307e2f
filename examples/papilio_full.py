# %% [markdown]
# # A butterfly at 1000 landmarks: the answer and the cost as the mesh is refined
#
# One outline becomes another by a Kunita flow, whose amplitude α and length scale ℓ are asked for.
# The observation error is given in the norm of the curve, ‖x − v‖² = ∫ |x(s) − v(s)|² ds, not for
# each landmark: ten times as many landmarks are ten times as many numbers, each ten times less
# certain, and say the same. What drives the flow is the noise of 64 of them, the controls, which
# carries the others: a draw costs in proportion to the landmarks, where the noise of all would cost
# the cube.
#
#     python examples/papilio_full.py                   # two mosquito wings, 100 landmarks
#     python examples/papilio_full.py --data papilio    # two butterflies, 1000 landmarks
#     python examples/papilio_full.py --data papilio --points 50 100 200 400 1000
#                                                       # and how answer and cost change
#     python examples/papilio_full.py --quick           # under a minute
#
# `--data` is a folder with a file `papilio.npz` of the arrays `aligned` (N, 1000, 2), `species`,
# the names, and `species_index` (N,): the outlines of swallowtails of Baker et al. (2024).

# %%
import argparse
import os
import time
from pathlib import Path

# threads of its own slow small matrices down, many times over
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import jax.numpy as jnp
import jax.random as jr
import matplotlib
import numpy as np
import numpyro
import numpyro.distributions as dist
from numpyro.diagnostics import summary
from numpyro.infer import MCMC, Predictive
from scipy.interpolate import CubicSpline

import numpyro_bridges as nb

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

jax.config.update("jax_enable_x64", True)  # landmarks are close together beside the length scale
numpyro.set_host_device_count(2)  # two of the four chains on each core

parser = argparse.ArgumentParser(
    description="Bridges between two outlines, at any number of landmarks."
)
parser.add_argument("--quick", action="store_true", help="80 landmarks, few steps and draws")
parser.add_argument(
    "--data", type=Path, help="the folder of papilio.npz; without it, two mosquito wings"
)
parser.add_argument(
    "--pair", nargs=2, help="species, or genera of mosquitoes: the first specimen of each"
)
parser.add_argument(
    "--points", type=int, nargs="+", help="numbers of landmarks, up to 1000; one after the other"
)
parser.add_argument("--steps", type=int, default=20)
parser.add_argument("--warmup", type=int, default=150)
parser.add_argument("--samples", type=int, default=500)
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--output", type=Path, default=Path("output"))
arguments, _ = parser.parse_known_args()
if arguments.quick:
    arguments.steps, arguments.warmup, arguments.samples = 5, 30, 50
numbers = arguments.points or [80 if arguments.quick else 1000 if arguments.data else 100]
# of the error, in the norm of the curve: an SD of 0.02 of each of 100 landmarks, 0.063 of 1000
VARIANCE = 4e-6

# %% [markdown]
# ## The pair
# Two outlines of unit size, aligned. A landmark stands for a stretch of the outline, and lies in
# the middle of it. One point of the stretch would bring along all that is finer than the landmarks,
# and which point it is then moves the posterior: of 50 landmarks by up to a standard deviation. So
# it is found from the average over the stretch, less 1/24 of how averages bend, which makes a point
# of the curve of an average to fourth order.


# %%
def outlines() -> tuple[np.ndarray, list[str], bool]:
    """Two outlines of 1000 points, their names, and whether they are closed."""
    if arguments.data is None:
        wings = nb.datasets.mosquito_wings(num_points=1000)
        shapes, names, closed = wings.points, np.array(wings.labels), True
    else:
        file = np.load(arguments.data / "papilio.npz")
        names = np.array([name.removeprefix("Papilio_") for name in file["species"]])[
            file["species_index"]
        ]
        shapes, closed = nb.shapes.unit_size(nb.shapes.center(file["aligned"])), False
    pair = arguments.pair or (["CX", "AN"] if arguments.data is None else ["ambrax", "polytes"])
    unknown = sorted(set(pair) - set(names))
    if unknown:
        parser.error(f"--pair must be two of {sorted(set(names))}; got {unknown}.")
    return shapes[[np.flatnonzero(names == name)[0] for name in pair]], pair, closed


shapes, names, closed = outlines()


def landmarks(num_points: int) -> np.ndarray:
    """Both outlines at some landmarks, `(2, num_points, 2)`."""
    total = np.concatenate([np.zeros((2, 1, 2)), np.cumsum(shapes, axis=1)], axis=1)
    ends = np.linspace(0, shapes.shape[1], num_points + 1)
    integral = CubicSpline(np.arange(total.shape[1]), total, axis=1)
    averages = np.diff(integral(ends), axis=1) / np.diff(ends)[:, None]
    bend = np.roll(averages, 1, axis=1) - 2 * averages + np.roll(averages, -1, axis=1)
    if not closed:
        bend[:, [0, -1]] = 0.0
    return averages - bend / 24


print(f"{names[0]} to {names[1]}: RMS of a coordinate's change {np.std(shapes[1] - shapes[0]):.3f}")


# %% [markdown]
# ## The model, at any number of landmarks


# %%
def flow_of(amplitude, length_scale, num_points):
    kernel = nb.GaussianKernel(amplitude, length_scale)
    return nb.KunitaFlow(
        nb.Landmarks(num_points, 2), kernel, noise=nb.ControlNoise(min(num_points, 64))
    )


def law_of(amplitude, length_scale, num_points):
    flow, match = flow_of(amplitude, length_scale, num_points), nb.InexactMatch(VARIANCE)
    return nb.DiffusionEndpoint(
        flow, landmarks(num_points)[0], match, t1=1.0, num_steps=arguments.steps
    )


def parameters():
    amplitude = numpyro.sample("amplitude", dist.LogNormal(-2.0, 1.0))
    length_scale = numpyro.sample("length_scale", dist.LogNormal(-1.0, 0.5))
    return {"amplitude": amplitude, "length_scale": length_scale}


def model(num_points, observed=None):
    nb.sample("outline", law_of(**parameters(), num_points=num_points), obs=observed)


# %% [markdown]
# ## MCMC at each number of landmarks
# Posterior means and SDs, the ESS and R̂ of the worse parameter, the acceptance, and what a draw of
# four chains costs without compilation.

# %%
NAMES = ("amplitude", "length_scale")
compilations = []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, seconds, **_: (
        compilations.append(seconds) if event.endswith("backend_compile_duration") else None
    )
)
table, runs = {}, {}
for num_points in numbers:
    kernel = nb.infer.FunctionSpaceHMC(model)
    settings = {"num_warmup": arguments.warmup, "num_samples": arguments.samples, "num_chains": 4}
    mcmc = MCMC(kernel, chain_method="vectorized", progress_bar=False, **settings)
    key, observed = jr.key(arguments.seed), landmarks(num_points)[1]
    compilations.clear()
    start = time.perf_counter()
    mcmc.run(key, num_points, observed, extra_fields=nb.infer.fields(kernel))
    draws = jax.block_until_ready(mcmc.get_samples(group_by_chain=True))
    in_all = time.perf_counter() - start
    a_draw = (in_all - sum(compilations)) / (arguments.warmup + arguments.samples)
    scalars = summary({name: np.asarray(draws[name]) for name in NAMES}).items()
    row = {f"{name} {what}": value[what] for name, value in scalars for what in ("mean", "std")}
    row |= {
        "ESS": min(value["n_eff"] for _, value in scalars),
        "R̂": max(value["r_hat"] for _, value in scalars),
    }
    row |= {"acceptance": float(np.mean(mcmc.get_extra_fields()["accept_prob"]))}
    row |= {"s a draw": a_draw, "s in all": in_all}
    table[num_points], runs[num_points] = row, mcmc
    print(
        f"{num_points} landmarks: "
        + ", ".join(f"{name} {value:.4g}" for name, value in row.items()),
        flush=True,
    )

finest = max(numbers)
for num_points in sorted(set(numbers) - {finest}):
    row, best = table[num_points], table[finest]
    apart = [
        f"{name} {(row[f'{name} mean'] - best[f'{name} mean']) / best[f'{name} std']:+.2f}"
        for name in NAMES
    ]
    print(f"{num_points} less {finest} landmarks, in posterior SDs: {', '.join(apart)}")

# %% [markdown]
# ## What is left behind, of the finest: a NetCDF file and three figures
# A draw of (α, ℓ, noise) is a draw of the path, and moves any other point too: a grid, here.

# %%
mcmc = runs[finest]
prior = Predictive(parameters, num_samples=2000)(jr.key(2))
results = nb.to_arviz(mcmc, prior=prior, paths=10)
paths = np.asarray(results["posterior_paths"]["outline"])  # (chain, draw, time, point, coordinate)
posterior = {name: mcmc.get_samples()[name] for name in NAMES}
arguments.output.mkdir(parents=True, exist_ok=True)
written = [arguments.output / "papilio.nc"]
results.to_netcdf(str(written[0]), engine="h5netcdf")


def save(name, title):
    written.append(arguments.output / name)
    plt.gcf().suptitle(title, fontsize="medium")
    plt.savefig(written[-1], dpi=150)
    plt.close()


start, target = landmarks(finest)
frames = paths.reshape(-1, *paths.shape[2:])
nb.plot.bridge_fan(frames, start, target, closed=closed)
save("papilio_bridges.png", f"{names[0]} to {names[1]}: posterior bridges at {finest} landmarks")

last = flow_of(*(jnp.asarray(results["posterior"][name])[0, -1] for name in NAMES), finest)
mesh = nb.plot.deformation(last, frames[9], closed=closed)  # of the first chain, the last draw
plt.colorbar(mesh, label="log₂ area")
save("papilio_deformation.png", "what one draw does to the plane")

nb.plot.posterior(posterior, prior)
save("papilio_posterior.png", "posterior, and prior (broken)")
print("written: " + ", ".join(str(path) for path in written))
