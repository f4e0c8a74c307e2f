# %% [markdown]
# # Outlines without correspondence
#
# Landmarks say which point of one shape is which of another. Outlines often do not: each was
# digitised at points of its own. `VarifoldMatch` compares outlines as sets of edges, whatever
# points these were made from. Does it find the same amplitude α and length scale ℓ of a Kunita flow
# as landmarks on the same wings do?
#
# Three ways to see the end of the flow:
#
# - **landmarks** that correspond, `InexactMatch`;
# - **sliding** landmarks, of which only the displacement across the outline counts, as for
#   semilandmarks: along it there is nothing to be seen in an outline;
# - **varifolds** of outlines with uneven points of their own.
#
# Chords lie inside a curve: outlines of few points differ by more than their curves do. See how the
# answer of the varifolds moves with `--points` and `--curve-points`; with `--same-points` outlines
# have the landmarks for their points, and nothing is left but what the matches see.
#
#     python examples/outlines.py
#     python examples/outlines.py --quick    # some minutes, most of which is compilation

# %%
import argparse
import os
import time
from pathlib import Path

# threads of its own slow small matrices down, many times over
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import arviz as az
import jax
import jax.numpy as jnp
import jax.random as jr
import matplotlib
import numpy as np
import numpyro
import numpyro.distributions as dist
from numpyro.infer import MCMC, Predictive
from scipy.optimize import brentq

import numpyro_bridges as nb

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

jax.config.update("jax_enable_x64", True)
numpyro.set_host_device_count(2)  # half of the chains on each core

parser = argparse.ArgumentParser(
    description="Amplitude and length scale from outlines that do not correspond."
)
parser.add_argument(
    "--quick", action="store_true", help="2 wings, few points, steps and draws, 2 chains"
)
parser.add_argument("--specimens", type=int, default=6)
parser.add_argument("--points", type=int, default=32, help="of a state of the flow")
parser.add_argument(
    "--curve-points", type=int, default=40, help="of an outline, each at places of its own"
)
parser.add_argument(
    "--same-points", action="store_true", help="the landmarks are the points of outlines too"
)
parser.add_argument("--steps", type=int, default=10)
parser.add_argument("--warmup", type=int, default=100)
parser.add_argument("--samples", type=int, default=300)
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--output", type=Path, default=Path("output"))
arguments = parser.parse_known_args()[0]
if arguments.quick:
    arguments.specimens, arguments.points, arguments.curve_points, arguments.steps = 2, 12, 16, 4
    arguments.warmup, arguments.samples = 30, 50
NAMES, POINT_SD, HARMONICS = ("amplitude", "length_scale"), 0.01, 8

# %% [markdown]
# ## The outlines
# 25 wings, smoothed, since a chord across a corner errs by more than the wings vary. Points are
# dense where an outline bends, and, of outlines that do not correspond, anywhere else besides.

# %%
wings = nb.datasets.mosquito_wings(num_points=480, genus="CX")


def smoothed(outline):
    coefficients = np.fft.fft(outline @ [1, 1j])
    coefficients[HARMONICS + 1 : -HARMONICS] = 0
    smooth = np.fft.ifft(coefficients)
    return np.stack([smooth.real, smooth.imag], axis=1)


def places(outline, number, rng=None):
    """Indices of points, a half of them by how sharply the outline bends; uneven where there is
    `rng`.
    """
    tangent = (np.roll(outline, -1, axis=0) - np.roll(outline, 1, axis=0)) @ [1, 1j]
    density = np.sqrt(np.abs(np.angle(np.roll(tangent, -1) / np.roll(tangent, 1))))
    density = density / density.mean() + 0.5
    within = 0.5 if rng is None else rng.uniform(0.0, 0.8, number)
    return np.searchsorted(
        np.cumsum(density / density.sum()), (np.arange(number) + within) / number
    )


rng = np.random.default_rng(arguments.seed)
mean = smoothed(wings.mean)
outlines = np.stack([smoothed(outline) for outline in wings.points[: arguments.specimens]])
own = places(mean, arguments.points)
start, landmarks = mean[own], outlines[:, own]
if arguments.same_points:
    curves = landmarks
else:
    curves = np.stack(
        [outline[places(outline, arguments.curve_points, rng)] for outline in outlines]
    )
space = nb.Landmarks(arguments.points, 2)
print(
    f"{len(outlines)} wings: spread of a coordinate {np.std(landmarks - start):.4f}, error of a "
    f"landmark {POINT_SD}"
)


# %% [markdown]
# ## Three matches, and one model
# A displacement of a landmark across the outline is seen with the error of a landmark, one along it
# not at all.


# %%
def normals(points):
    along = jnp.roll(points, -1, axis=0) - jnp.roll(points, 1, axis=0)
    across = along[:, ::-1] * jnp.array([[1.0, -1.0]])
    return across / jnp.linalg.norm(across, axis=1, keepdims=True)


def across(x, observed, args):
    """The log density of sliding landmarks."""
    error = jnp.sum((x - observed) * normals(observed), axis=1) / POINT_SD
    return -0.5 * jnp.sum(error**2)


def varifold(variance):
    """Edges within some 0.6 of each other are one place, and 60° one direction.

    What is told of a wing then is, direction by direction, nearest to what sliding landmarks tell;
    from 0.4 to 1.2 nearly as much. At 0.2, the distance of neighbours, it is something else.
    """
    return nb.VarifoldMatch(variance, 0.6, num_points=curves.shape[1])


def flow_of(amplitude, length_scale):
    return nb.KunitaFlow(space, nb.GaussianKernel(amplitude, length_scale))


def parameters():
    amplitude = numpyro.sample("amplitude", dist.LogNormal(-3.0, 1.0))
    length_scale = numpyro.sample("length_scale", dist.LogNormal(-1.0, 0.5))
    return {"amplitude": amplitude, "length_scale": length_scale}


def run(match, observed):
    def model(observed=None):
        flow = flow_of(**parameters())
        law = nb.DiffusionEndpoint(
            flow, start, match, t1=1.0, num_steps=arguments.steps, batched=()
        )
        with numpyro.plate("specimen", arguments.specimens):
            nb.sample("wing", law, obs=observed)

    kernel = nb.infer.FunctionSpaceHMC(model)
    num_chains = 2 if arguments.quick else 4
    settings = {
        "num_warmup": arguments.warmup,
        "num_samples": arguments.samples,
        "num_chains": num_chains,
    }
    mcmc = MCMC(kernel, chain_method="vectorized", progress_bar=False, **settings)
    began = time.perf_counter()
    mcmc.run(jr.key(arguments.seed), observed, extra_fields=nb.infer.fields(kernel))
    jax.block_until_ready(mcmc.get_samples())
    print(f"{time.perf_counter() - began:.0f} s")
    return mcmc


runs = {}
runs["landmarks"] = run(nb.InexactMatch.from_point_sd(POINT_SD, space), landmarks)
runs["sliding"] = run(nb.DensityMatch(across), landmarks)

# %% [markdown]
# ## Comparable errors
# An observation of precision W tells ½ log|I + C W| nats of a state whose covariance is C. The
# variance of the varifold is the one that tells as much as sliding landmarks do, of a flow with the
# parameters that landmarks have found.

# %%
typical = {name: jnp.mean(runs["landmarks"].get_samples()[name]) for name in NAMES}
flow = flow_of(**typical)
root = np.kron(np.linalg.cholesky(flow.covariance(0.0, jnp.asarray(start))), np.eye(2))


def told(precision):
    return 0.5 * np.linalg.slogdet(np.eye(len(root)) + root.T @ precision @ root)[1]


def precisions(match):
    return np.stack([match.precision(flow, jnp.asarray(v), jnp.asarray(v)) for v in landmarks])


by_landmarks = np.mean([told(W) for W in precisions(nb.DensityMatch(across))])
unit = precisions(varifold(1.0))
log_variance = brentq(
    lambda x: np.mean([told(W) for W in unit / np.exp(x)]) - by_landmarks, -30.0, 5.0
)
variance = float(np.exp(log_variance))
print(
    f"sliding landmarks tell {by_landmarks:.1f} nats of a wing, varifolds of variance "
    f"{variance:.2e} as many"
)

runs["varifolds"] = run(varifold(variance), curves)

# %% [markdown]
# ## One answer?

# %%
posteriors = {
    kind: {name: mcmc.get_samples()[name] for name in NAMES} for kind, mcmc in runs.items()
}
prior = Predictive(parameters, num_samples=2000)(jr.key(1))
for kind, mcmc in runs.items():
    results = nb.to_arviz(mcmc, prior=prior)
    print(kind, az.summary(results, var_names=list(NAMES)).to_string(), sep="\n")
for kind in ("landmarks", "sliding"):
    apart = []
    for name in NAMES:
        found, other = (np.log(posteriors[which][name]) for which in ("varifolds", kind))
        apart.append(f"{name} {(found.mean() - other.mean()) / other.std():+.2f}")
    print(f"varifolds less {kind}, logarithms in posterior SDs: {', '.join(apart)}")

# %% [markdown]
# ## What is left behind: a NetCDF file and two figures
# The file is of the varifolds, the last of the three.

# %%
arguments.output.mkdir(parents=True, exist_ok=True)
written = [
    arguments.output / name for name in ("outlines.nc", "outlines.png", "outlines_posterior.png")
]
results.to_netcdf(str(written[0]), engine="h5netcdf")

figure, axes = plt.subplots(1, 2, figsize=(10, 2.4), sharey=True, constrained_layout=True)
for ax, outline, points, corresponding in zip(axes, outlines, curves, landmarks, strict=False):
    ax.plot(*mean[np.arange(len(mean) + 1) % len(mean)].T, color="0.8")
    ax.plot(*outline.T, color="0.4", linewidth=0.8)
    ax.plot(*corresponding.T, "o", markersize=3, fillstyle="none", label="landmarks")
    ax.plot(*points.T, ".", markersize=5, label="points of an outline")
    ax.set_aspect("equal")
axes[0].legend(fontsize="x-small")
figure.savefig(written[1], dpi=150)
plt.close()

figure, axes = plt.subplots(1, 2, figsize=(7, 2.6), constrained_layout=True)
for name, ax in zip(NAMES, axes, strict=True):
    for kind, draws in posteriors.items():
        ax.hist(draws[name], bins=30, density=True, histtype="step", label=kind)
    ax.set(xlabel=name.replace("_", " "), yticks=[])
axes[0].legend(fontsize="small")
figure.savefig(written[2], dpi=150)
plt.close()
print("written: " + ", ".join(str(path) for path in written))
