# %% [markdown]
# # Comparing models by their evidence: does a trait wander, or is it pulled back?
#
# A trait of 16 species on a tree. Three models: it wanders (Brownian motion); it is pulled back to
# an optimum, the more the farther it is (Ornstein–Uhlenbeck); or it is pulled back as hard near the
# optimum as far from it, dX = −θ tanh(5 X) dt + σ dW, whose likelihood no formula gives. The
# evidence of a model is the probability of the data, with parameters integrated over their priors;
# ratios of evidences are Bayes factors. Where it is linear, the likelihood is exact and the
# integral over two parameters can be done on a grid: the referee of the estimates.
#
#     python examples/comparing_models.py            # some five minutes
#     python examples/comparing_models.py --quick    # fewer steps and particles, no bridge sampling

# %%
import argparse
import os
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
from jax.scipy.special import logsumexp

import numpyro_bridges as nb

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

parser = argparse.ArgumentParser(description="Comparing models by their evidence.")
parser.add_argument("--quick", action="store_true", help="fewer steps and particles")
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--output", type=Path, default=Path("output"))
arguments = parser.parse_known_args()[0]
quick = arguments.quick
num_steps = 5 if quick else 10  # on each branch; the linear models need one
settings = {"num_particles": 32, "num_islands": 4} if quick else {"num_particles": 128}
methods = ["smc"] if quick else ["smc", "bridge"]
START, ERROR = np.zeros(1), 0.05
key_data, key_run = jr.split(jr.key(arguments.seed))


# %% [markdown]
# ## The models
# All of one form: an SDE made of parameters, and priors of these. A tree of 16 tips, four splits
# one after the other, is one unit high; tips are seen with an error of 0.05.


# %%
def wanders(sigma):
    return nb.BrownianMotion(sigma**2)


def returns(sigma, theta):
    return nb.LinearSDE(-theta, sigma)


def returns_evenly(sigma, theta):
    return nb.SDE(
        drift=lambda t, x, args: -args["theta"] * jnp.tanh(5.0 * x),
        diffusion=lambda t, x, args: args["sigma"],
        args={"sigma": sigma, "theta": theta},
    )


MODELS = {"wanders": wanders, "returns": returns, "returns evenly": returns_evenly}
PRIORS = {"sigma": dist.LogNormal(0.0, 0.7), "theta": dist.LogNormal(1.0, 0.7)}

parents = [-1, *(node // 2 for node in range(30))]  # nodes 2 i + 1 and 2 i + 2 come from node i
names = [None] * 15 + [f"species {i}" for i in range(1, 17)]
tree = nb.Tree.from_parents(parents, np.full(31, 0.25), names)


def law_of(process):
    linear = isinstance(process, (nb.BrownianMotion, nb.LinearSDE))
    steps = 1 if linear else num_steps
    seen = nb.InexactMatch(ERROR**2)
    return nb.DiffusionTree(process, START, seen, tree=tree, num_steps=steps)


def model(name, observed):
    used = ["sigma"] if name == "wanders" else ["sigma", "theta"]
    parameters = [numpyro.sample(parameter, PRIORS[parameter]) for parameter in used]
    nb.sample("trait", law_of(MODELS[name](*parameters)), obs=observed)


# %% [markdown]
# ## The data
# Simulated, with an even pull. The truth is known, and so is what a good answer is; how clear it
# can be from 16 numbers is what the evidence says.

# %%
observed = law_of(returns_evenly(1.0, 4.0)).sample(key_data)
print("traits: " + " ".join(f"{value:.2f}" for value in np.ravel(observed)))


# %% [markdown]
# ## The evidence
# Two estimates, in opposite directions: particles go from the prior to the posterior ("smc"),
# chains from the posterior to the prior ("bridge"). Each has a standard error, and says whether it
# is to be trusted.

# %%
estimates = {}
for name in MODELS:
    for method in methods:
        estimates[name, method] = nb.estimate_model_evidence(
            model, key_run, name, observed, method=method, progress=False, **settings
        )
        print(f"{name}: {estimates[name, method]}")


# %% [markdown]
# The referee, where the likelihood is exact: `log_prob` of a linear model does not depend on the
# noise, and the mean over the prior is a sum over a grid of quantiles.


# %%
def log_evidence_on_a_grid(name, num=60):
    quantiles = (np.arange(num) + 0.5) / num
    axes = [PRIORS["sigma"].icdf(quantiles)]
    if name != "wanders":
        axes.append(PRIORS["theta"].icdf(quantiles))
    grid = [jnp.ravel(axis) for axis in jnp.meshgrid(*axes)]

    def log_likelihood(parameters):
        law = law_of(MODELS[name](*parameters))
        any_noise = jnp.zeros(law.noise_prior().shape())
        return law.given(any_noise).log_prob(observed)

    values = jax.jit(lambda points: jax.lax.map(log_likelihood, points))(grid)
    return float(logsumexp(values) - np.log(len(values)))


for name in ("wanders", "returns"):
    exact = log_evidence_on_a_grid(name)
    for method in methods:
        found = estimates[name, method]
        away = abs(float(found.log_evidence) - exact) / float(found.standard_error)
        print(f"{name}, by quadrature: {exact:.2f}; {method} is {away:.1f} standard errors away")

# %% [markdown]
# ## What it says
# With equal odds before, the probability of each model. Brownian motion has to explain why so many
# species are near the optimum; which of the two pulls it was, 16 numbers hardly say.
#
# ![Log evidence of each model with two standard errors](comparing_models.png)

# %%
first = np.array([float(estimates[name, "smc"].log_evidence) for name in MODELS])
probabilities = np.exp(first - logsumexp(first))
for name, probability in zip(MODELS, probabilities, strict=True):
    print(f"probability of “{name}”: {probability:.2f}")

arguments.output.mkdir(parents=True, exist_ok=True)
figure, ax = plt.subplots(figsize=(6, 2.6), constrained_layout=True)
for place, method in enumerate(methods):
    found = [estimates[name, method] for name in MODELS]
    ax.errorbar(
        [float(estimate.log_evidence) for estimate in found],
        np.arange(len(MODELS)) + 0.15 * place,
        xerr=[2 * float(estimate.standard_error) for estimate in found],
        fmt="o",
        capsize=3,
        label={"smc": "particles", "bridge": "bridge sampling"}[method],
    )
ax.set_yticks(range(len(MODELS)), labels=list(MODELS))
ax.set(xlabel="log evidence, ± 2 standard errors", ylim=(len(MODELS) - 0.5, -0.5))
ax.legend(frameon=False)
file = arguments.output / "comparing_models.png"
figure.savefig(file, dpi=150)
plt.close(figure)
print(f"written: {file}")
