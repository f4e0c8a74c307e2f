# %% [markdown]
# # Does a learned guide earn its training?
#
# The wing that is farthest from the mean of all mosquito wings, as the end of a Kunita flow from
# that mean. A guided bridge needs no training; a learned guide corrects it. Part 1 trains the
# correction in three ways at fixed parameters and compares evidence, effective sample size and
# cost. Part 2 trains one correction for all amplitudes and length scales, and uses it in MCMC over
# them: the posterior must be the same, since the weights are exact either way.
#
#     python examples/learned_vs_guided.py            # some minutes on 2 cores
#     python examples/learned_vs_guided.py --quick    # some two minutes, to see that all runs

# %%
import argparse
import json
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
from numpyro.diagnostics import effective_sample_size
from numpyro.infer import MCMC

import numpyro_bridges as nb

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

numpyro.set_host_device_count(2)  # two of the four chains on each core

parser = argparse.ArgumentParser()
parser.add_argument(
    "--quick", action="store_true", help="16 points, 30 steps, two trainings, few updates and draws"
)
parser.add_argument("--updates", type=int, default=150, help="of each training")
parser.add_argument("--draws", type=int, default=200, help="of each of 4 chains")
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--output", type=Path, default=Path("output"))
arguments, _ = parser.parse_known_args()
quick = arguments.quick
num_points, num_steps = (16, 30) if quick else (32, 50)
num_particles = 128 if quick else 2048
num_warmup, num_draws = (10, 20) if quick else (60, arguments.draws)
if quick:
    training = nb.scores.Training(10, 4, interval=5, held_out=32)
else:
    training = nb.scores.Training(
        arguments.updates, 16, interval=max(arguments.updates // 10, 1), held_out=256
    )
arguments.output.mkdir(parents=True, exist_ok=True)
key_fit, key_compare, key_amortised, key_mcmc = jr.split(jr.key(arguments.seed), 4)

# %% [markdown]
# ## The bridge
# Real outlines at unit RMS radius. The parameters are fixed in part 1.

# %%
wings = nb.datasets.mosquito_wings(num_points=num_points)
distance = np.sqrt(np.mean(np.sum((wings.points - wings.mean) ** 2, axis=-1), axis=-1))
chosen = int(np.argmax(distance))
wing = jnp.asarray(wings.points[chosen])
space = nb.Landmarks(num_points=num_points, dim=2)
seen = nb.InexactMatch.from_point_sd(0.005, space)
AMPLITUDE, LENGTH_SCALE = 0.1, 0.4


def flow(amplitude, length_scale):
    return nb.KunitaFlow(space, nb.GaussianKernel(amplitude, length_scale))


bridge = nb.GuidedBridge(
    flow(AMPLITUDE, LENGTH_SCALE), seen.at(wing), x0=wings.mean, t1=1.0, num_steps=num_steps
)
print(
    f"wing {wings.names[chosen]}, {num_points} points, RMS distance to the mean "
    f"{distance[chosen]:.3f};",
    end=" ",
)
print(f"observation SD 0.005, ratio {0.005 / distance[chosen]:.2f}")

# %% [markdown]
# ## Part 1: three ways to train
# A network of a few thousand weights, started at zero: before training the learned guide is the
# guided one.


# %%
def small_network(size, key):
    return nb.scores.PointNetwork(2, size, width=16, depth=1, key=key)


def learn(method):
    network = small_network(0, jr.fold_in(key_fit, 1))
    settings = {
        "x0": wings.mean,
        "t1": 1.0,
        "num_steps": num_steps,
        "training": training,
        "progress": False,
    }
    return nb.scores.fit(
        bridge.sde, seen.at(wing), key=key_fit, method=method, network=network, **settings
    )


methods = ("residual", "adjoint") if quick else ("residual", "adjoint", "reversal")
guides = {method: learn(method) for method in methods}
bridges = {"guided": bridge} | {
    method: bridge.with_guide(guide) for method, guide in guides.items()
}
comparison = nb.compare(bridges, key_compare, num_particles=num_particles)
print(comparison)

# %% [markdown]
# Every estimate is of the same number. The bound E log w, which `"residual"` maximises, lies below
# it; the ESS is what importance sampling and MCMC profit from. The two need not rise together: the
# ESS hangs on the largest weights.


# %%
def plot_training(histories):
    _, axes = plt.subplots(1, 2, figsize=(8.0, 3.0), layout="constrained")
    log_evidence = comparison.rows["guided"]["log_evidence"]
    for (method, history), color in zip(
        histories.items(), ("#003f5c", "#d55e00", "#0072b2"), strict=False
    ):
        style = {"color": color, "marker": "o", "markersize": 3, "linewidth": 1.2, "label": method}
        axes[0].plot(history["seconds"], history["bound"], **style)
        axes[1].plot(history["seconds"], 100 * history["ess"], **style)
    axes[0].axhline(log_evidence, color="#8a8a8a", linestyle=(0, (4, 2)), linewidth=1.0)
    axes[0].annotate(
        "log evidence (guided)", (1.0, log_evidence), (-2, -3), xycoords=("axes fraction", "data"),
        textcoords="offset points", ha="right", va="top", fontsize=8, color="#555555",
    )  # fmt: skip
    axes[0].set(xlabel="seconds of training", ylabel="bound E log w, held out")
    axes[1].set(xlabel="seconds of training", ylabel="ESS, % of held-out paths")
    axes[1].set_ylim(
        0, 1.1 * max(100 * float(np.max(history["ess"])) for history in histories.values())
    )
    axes[1].legend(frameon=False, fontsize=9, loc="lower right")
    for ax in axes:
        ax.spines[["top", "right"]].set_visible(False)
    plt.savefig(arguments.output / "training.png", dpi=150)
    plt.close()


def rows(history):
    return {name: np.asarray(values).tolist() for name, values in history.items()}


comparison.plot(arguments.output / "comparison.png")
plot_training({method: guide.history for method, guide in guides.items()})

# %% [markdown]
# ## Part 2: one guide for all parameters, inside MCMC
# Training draws the parameters from their prior; the network is told their logarithms.


# %%
def log_parameters(sde):
    return jnp.log(jnp.stack([sde.kernel.amplitude, sde.kernel.length_scale]))


prior = {"amplitude": dist.LogNormal(-2.5, 0.5), "length_scale": dist.LogNormal(-1.0, 0.4)}


def draw(key):
    key_amplitude, key_length = jr.split(key)
    sde = flow(prior["amplitude"].sample(key_amplitude), prior["length_scale"].sample(key_length))
    return sde, seen.at(wing), jnp.asarray(wings.mean)


amortised = nb.scores.fit(
    bridge.sde,
    seen.at(wing),
    x0=wings.mean,
    t1=1.0,
    num_steps=num_steps,
    key=key_amortised,
    method="residual",
    network=small_network(2, jr.fold_in(key_amortised, 1)),
    training=training,
    draw=draw,
    context=log_parameters,
    progress=False,
)
before, after = (float(amortised.history["ess"][i]) for i in (0, -1))
print(f"amortised guide: {float(amortised.history['seconds'][-1]):.0f} s of training;", end=" ")
print(f"ESS over the prior {100 * before:.0f} % before, {100 * after:.0f} % after")


# %%
def model(guide, observed):
    parameters = {name: numpyro.sample(name, law) for name, law in prior.items()}
    law = nb.DiffusionEndpoint(
        flow(**parameters), wings.mean, seen, t1=1.0, num_steps=num_steps, guide=guide
    )
    nb.sample("wing", law, obs=observed)


def run(guide, key):
    """Draws, and their seconds without compilation, from the time of ten more."""
    kernel = nb.infer.FunctionSpaceHMC(
        lambda observed: model(guide, observed), max_num_steps=4 if quick else 16
    )
    mcmc = MCMC(
        kernel,
        num_warmup=num_warmup,
        num_samples=num_draws,
        num_chains=4,
        chain_method="vectorized",
        progress_bar=False,
    )
    mcmc.run(key, wing)

    @jax.jit
    def more(state):
        return jax.lax.fori_loop(0, 10, lambda _, state: kernel.sample(state, (wing,), {}), state)

    state = jax.block_until_ready(more(more(mcmc.last_state)))
    start = time.perf_counter()
    jax.block_until_ready(more(state))
    seconds = (time.perf_counter() - start) / 10 * num_draws
    draws = mcmc.get_samples(group_by_chain=True)
    return {name: np.asarray(draws[name]) for name in prior}, seconds


def summary(draws, seconds):
    """Mean, SD, and the Monte Carlo errors of both; the ESS, and the ESS a second."""
    found = {}
    for name, values in draws.items():
        values = np.log(values)
        ess, sd = float(effective_sample_size(values)), float(values.std())
        found[name] = {
            "mean": float(values.mean()),
            "sd": sd,
            "ess": ess,
            "ess_per_second": ess / seconds,
        }
        found[name] |= {"mean_error": sd / ess**0.5, "sd_error": sd / (2 * ess) ** 0.5}
    return found


key_guided, key_learned = jr.split(key_mcmc)
runs = {"guided": run(None, key_guided), "learned": run(amortised, key_learned)}
found = {name: summary(*result) for name, result in runs.items()}
for name, (_, seconds) in runs.items():
    print(
        f"{name}: {seconds:.1f} s for {num_draws} draws of 4 chains, without compilation and "
        "warm-up"
    )

# %% [markdown]
# The same posterior? Differences in units of their joint Monte Carlo error (for the SDs, that of a
# normal posterior).


# %%
def difference(parameter, what):
    one, other = (found[name][parameter] for name in ("guided", "learned"))
    return (other[what] - one[what]) / np.hypot(one[f"{what}_error"], other[f"{what}_error"])


differences = {
    parameter: {what: float(difference(parameter, what)) for what in ("mean", "sd")}
    for parameter in prior
}
print(f"{'':24}{'mean':>8}{'SD':>8}{'ESS':>8}{'ESS/s':>8}")
for parameter in prior:
    for name in found:
        row = found[name][parameter]
        print(f"log {parameter:13}{name:7}{row['mean']:8.3f}{row['sd']:8.3f}", end="")
        print(f"{row['ess']:8.0f}{row['ess_per_second']:8.2f}")
worst = max(abs(z) for row in differences.values() for z in row.values())
least = min(row[parameter]["ess"] for row in found.values() for parameter in prior)
verdict = "agree" if worst < 3 else "do not agree"
if least < 100:
    verdict = f"have too few draws to compare (an ESS of {least:.0f}, and 100 are needed)"
print(
    f"The posteriors {verdict}: means and SDs differ by at most {worst:.1f} joint Monte Carlo "
    "errors."
)

# %%
nb.plot.posterior({k: v.ravel() for k, v in runs["guided"][0].items()})
axes = plt.gcf().axes
for ax, values in zip(axes, runs["learned"][0].values(), strict=True):
    ordered = np.sort(values.ravel())
    grid = np.linspace(*ax.get_xlim(), 200)
    width = 1.06 * ordered.std() * len(ordered) ** -0.2
    density = np.exp(-0.5 * ((grid[:, None] - ordered) / width) ** 2).mean(axis=1) / (
        width * np.sqrt(2 * np.pi)
    )
    ax.plot(grid, density, color="#d55e00", linewidth=1.4, linestyle=(0, (4, 2)))
plt.gcf().suptitle(
    "posterior with the guide alone (filled) and with the learned one (dashed)", fontsize="medium"
)
plt.savefig(arguments.output / "posteriors.png", dpi=150)
plt.close()

numbers = {
    "points": num_points,
    "steps": num_steps,
    "comparison": comparison.rows,
    "history": {
        method: rows(guide.history) for method, guide in (guides | {"amortised": amortised}).items()
    },
    "posterior": found,
    "seconds": {name: seconds for name, (_, seconds) in runs.items()},
    "difference_in_errors": differences,
}
(arguments.output / "learned_vs_guided.json").write_text(json.dumps(numbers, indent=1))
print(
    f"written: {arguments.output}/ training.png, comparison.png, posteriors.png, "
    "learned_vs_guided.json"
)
