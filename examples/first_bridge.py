# %% [markdown]
# # A bridge in one dimension
#
# A trait x wanders, and is drawn towards 0 by a pull that does not grow with the distance:
#
#     dX = −θ tanh(X) dt + σ dW
#
# It starts at 1, and after one unit of time it is seen at −1, which few paths reach. What
# happened on the way, how probable was it, and what do several such observations say of θ and σ?
# One dimension has the advantage that everything can be checked: the density of the end is an
# integral over a grid.
#
#     python examples/first_bridge.py            # half a minute
#     python examples/first_bridge.py --quick    # fewer paths and draws

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

import numpyro_bridges as nb

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

parser = argparse.ArgumentParser(description="A bridge in one dimension.")
parser.add_argument("--quick", action="store_true", help="fewer paths and draws")
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--output", type=Path, default=Path("output"))
arguments = parser.parse_known_args()[0]
num_paths = 2048 if arguments.quick else 4096
num_warmup, num_samples = (100, 200) if arguments.quick else (300, 1000)
TRUTH = {"theta": 2.0, "sigma": 1.0}
START, END = np.array([1.0]), np.array([-1.0])
NUM_STEPS = 50
key_paths, key_bridges, key_data, key_run = jr.split(jr.key(arguments.seed), 4)


# %% [markdown]
# ## The process
# Two functions of time, state and parameters. A state is a vector, here of one number; its paths
# are found by `simulate`, and hardly one of them comes near −1.


# %%
def process(theta, sigma):
    return nb.SDE(
        drift=lambda t, x, args: -args["theta"] * jnp.tanh(x),
        diffusion=lambda t, x, args: args["sigma"],
        args={"theta": theta, "sigma": sigma},
    )


sde = process(**TRUTH)
ts = np.linspace(0.0, 1.0, NUM_STEPS + 1)
free_noise = jr.normal(key_paths, (num_paths, NUM_STEPS, 1))
free = jax.vmap(lambda noise: nb.simulate(sde, START, ts, noise))(free_noise)
near = np.mean(np.abs(free[:, -1, 0] - END[0]) < 0.1)
print(f"of {num_paths} free paths {100 * near:.1f} % end within 0.1 of {END[0]}")

# %% [markdown]
# ## The bridge
# `ExactMatch` says that the end is seen without error; `GuidedBridge` leads paths there. A path is
# a function of standard normal noise, and so is its weight. All guided paths end at −1, but not
# each is as probable as the conditioned process has it: weights say by how much.

# %%
bridge = nb.GuidedBridge(sde, nb.ExactMatch().at(END), x0=START, t1=1.0, num_steps=NUM_STEPS)
noise = jr.normal(key_bridges, (num_paths, *bridge.noise_shape))
paths = jax.vmap(bridge.path)(noise)
log_weights = jax.vmap(bridge.log_weight)(noise)
print(f"guided paths end at {np.min(paths[:, -1]):.4f} to {np.max(paths[:, -1]):.4f}")
print(f"SD of their log weights: {np.std(log_weights):.2f}")

# %% [markdown]
# ## How probable was it?
# The mean weight is the density p(−1 | 1) of the end, without bias. The estimate comes with its
# error, the effective number of paths, and Pareto k̂, which is below 0.7 where the error is to be
# believed.

# %%
estimate = nb.estimate_evidence(bridge, key_bridges, num_particles=num_paths)
print(f"log density of the end: {estimate.log_evidence:.3f} ± {estimate.standard_error:.3f}")
print(f"effective paths: {estimate.ess:.0f} of {num_paths}, k̂ {estimate.pareto_k:.2f}")

# %% [markdown]
# The referee: the density after each step is the one before, moved by the drift and blurred by the
# noise of a step, here on a grid of 2001 places.


# %%
def log_density_by_quadrature(theta, sigma):
    places = np.linspace(-6.0, 6.0, 2001)
    dt = 1.0 / NUM_STEPS
    sd = sigma * np.sqrt(dt)

    def step_density(to, start):
        mean = start - theta * np.tanh(start) * dt
        return np.exp(-0.5 * ((to - mean) / sd) ** 2) / (sd * np.sqrt(2 * np.pi))

    blur = step_density(places[:, None], places[None, :]) * (places[1] - places[0])
    density = step_density(places, START[0])
    for _ in range(NUM_STEPS - 2):
        density = blur @ density
    return np.log(step_density(END[0], places) @ density * (places[1] - places[0]))


referee = log_density_by_quadrature(**TRUTH)
errors = (float(estimate.log_evidence) - referee) / float(estimate.standard_error)
print(f"by quadrature: {referee:.3f}, {abs(errors):.1f} standard errors away")

# %% [markdown]
# ## Unknown parameters
# Forty such traits, seen with an error of 0.1, after one unit of time. In a NumPyro model the law
# of their ends is an observed site; `nb.sample` adds the noise that drives each path. The kernel
# `FunctionSpaceHMC` knows that this noise is nearly standard normal.

# %%
error = nb.InexactMatch(0.1**2)


def model(observed=None):
    theta = numpyro.sample("theta", dist.LogNormal(0.0, 1.0))
    sigma = numpyro.sample("sigma", dist.LogNormal(0.0, 1.0))
    law = nb.DiffusionEndpoint(process(theta, sigma), START, error, t1=1.0, num_steps=NUM_STEPS)
    with numpyro.plate("trait", 40):
        nb.sample("end", law, obs=observed)


at_truth = Predictive(numpyro.handlers.substitute(model, TRUTH), num_samples=1)
observed = at_truth(key_data)["end"][0]  # (40, 1)

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
posterior = mcmc.get_samples()
prior = Predictive(model, num_samples=2000)(key_data)
results = nb.to_arviz(mcmc, prior={name: prior[name] for name in TRUTH})
print(az.summary(results, var_names=list(TRUTH)).to_string())
print("the truth: " + ", ".join(f"{name} {value:g}" for name, value in TRUTH.items()))

# %% [markdown]
# ## What is left behind: a NetCDF file and two figures
# Paths of the conditioned process, drawn from the guided ones by their weights, beside free ones.
# At first both are pulled to 0; those that end at −1 go on from there, against the pull.
#
# ![Free paths, grey, and bridges to −1, coloured](first_bridge.png)
#
# ![Posterior of θ and σ, prior (dashed), and truth](first_bridge_posterior.png)

# %%
arguments.output.mkdir(parents=True, exist_ok=True)
names = ("first_bridge.nc", "first_bridge.png", "first_bridge_posterior.png")
written = [arguments.output / name for name in names]
results.to_netcdf(str(written[0]), engine="h5netcdf")

chosen = jr.categorical(key_paths, log_weights, shape=(30,))
figure, ax = plt.subplots(figsize=(7, 4), constrained_layout=True)
ax.plot(ts, free[:60, :, 0].T, color="0.8", linewidth=0.7)
ax.plot(ts, paths[chosen, :, 0].T, color="tab:blue", linewidth=0.8)
ax.plot([], [], color="0.8", label="free paths")
ax.plot([], [], color="tab:blue", label="paths that end at −1")
ax.plot([0, 1], [START[0], END[0]], "ko", label="what is known")
ax.set(xlabel="time", ylabel="trait")
ax.legend(frameon=False, loc="lower left")
figure.savefig(written[1], dpi=150)
plt.close(figure)

nb.plot.posterior({name: posterior[name] for name in TRUTH}, prior, truth=TRUTH)
plt.gcf().suptitle("posterior, prior (dashed), truth", fontsize="medium")
plt.savefig(written[2], dpi=150)
plt.close()
print("written: " + ", ".join(str(path) for path in written))
