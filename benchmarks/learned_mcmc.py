"""Does a guide that is learned for all parameters pay inside MCMC, its training included?

    python benchmarks/learned_mcmc.py            # half an hour
    python benchmarks/learned_mcmc.py --quick

Six particles in a double well, dX = −4 h X (X² − 1) dt + σ dW from 1, seen with SD 0.1 after one
unit of time: half of them have crossed. h and σ are unknown, and the plain guides have an ESS of a
few percent. One JSON line for each kernel and guide:

- `particles` that a pseudo-marginal kernel has chosen for each datum.
- `mean`, `sd` of log h and log σ; `errors_off`, by how many Monte Carlo errors their means differ
  from the referee's, and `sd_ratio`, their SDs relative to the referee's: a grid of 41 × 41
  parameters, the density of the same Euler chain by quadrature at each.
- `guide_ess_percent`: of 1024 paths to each datum at the posterior mean, the least.
- `ess`, the lesser of the two; `seconds` of draws, without warm-up and compilation;
  `ess_per_second`.
- `training` in seconds, and `paid_after`: the effective draws from which training has paid beside
  the best of the same kernel without it; null where it never does.
"""

import argparse
import json
import os
from functools import partial

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import numpyro
import numpyro.distributions as dist
from mcmc import seconds_of_a_draw
from numpyro.diagnostics import effective_sample_size
from numpyro.infer import MCMC
from scipy.special import logsumexp
from scipy.stats import norm

import numpyro_bridges as nb

PRIORS = {"log_h": dist.Normal(np.log(3.0), 0.3), "log_sigma": dist.Normal(0.0, 0.2)}
KERNELS = "FunctionSpaceHMC", "CorrelatedPseudoMarginalMALA"
DATA = np.array([[-1.1], [-0.97], [-0.85], [0.88], [1.0], [1.12]])
SD, NUM_STEPS = 0.1, 100
SEEN, START = nb.InexactMatch(SD**2), np.ones(1)


def well(log_h, log_sigma):
    return nb.SDE(
        lambda t, x, args: -4 * args["h"] * x * (x * x - 1),
        lambda t, x, args: args["sigma"],
        args={"h": jnp.exp(log_h), "sigma": jnp.exp(log_sigma)},
    )


def model(guide, observed):
    parameters = {name: numpyro.sample(name, prior) for name, prior in PRIORS.items()}
    law = nb.DiffusionEndpoint(
        well(**parameters), START, SEEN, t1=1.0, num_steps=NUM_STEPS, guide=guide
    )
    with numpyro.plate("particle", len(DATA)):
        nb.sample("end", law, obs=observed)


def referee(num=41):
    """Mean and SD of each parameter: densities of the Euler chain on a grid of states."""
    x = np.linspace(-3.0, 3.0, 601)
    spacing = x[1] - x[0]
    dt = 1.0 / NUM_STEPS
    axes = [prior.loc + prior.scale * np.linspace(-4, 4, num) for prior in PRIORS.values()]

    def log_likelihood(log_h, log_sigma):
        scale = np.exp(log_sigma) * np.sqrt(dt)
        ahead = x - dt * 4 * np.exp(log_h) * x * (x * x - 1)
        step = norm.pdf(x[:, None], ahead, scale)
        density = norm.pdf(x, START, scale)
        for _ in range(NUM_STEPS - 1):
            density = spacing * step @ density
        return np.sum(np.log(spacing * norm.pdf(DATA, x, SD) @ density))

    grid = np.meshgrid(*axes, indexing="ij")
    log_posterior = np.vectorize(log_likelihood)(*grid)
    for values, prior in zip(grid, PRIORS.values(), strict=True):
        log_posterior += np.asarray(prior.log_prob(values))
    mass = np.exp(log_posterior - logsumexp(log_posterior))
    means = [float(np.sum(mass * values)) for values in grid]
    sds = [
        float(np.sqrt(np.sum(mass * (values - mean) ** 2)))
        for values, mean in zip(grid, means, strict=True)
    ]
    return np.array(means), np.array(sds)


def learned(num_updates, key):
    """One guide for all parameters and data: `matching` on draws of both."""

    def draw(key):
        key_parameters, key_side, key_datum = jr.split(key, 3)
        keys = jr.split(key_parameters, len(PRIORS))
        parameters = [prior.sample(k) for prior, k in zip(PRIORS.values(), keys, strict=True)]
        side = jnp.where(jr.bernoulli(key_side), 1.0, -1.0)
        datum = side + 0.12 * jr.normal(key_datum, (1,))
        return well(*parameters), SEEN.at(datum), START

    return nb.scores.fit(
        well(np.log(3.0), 0.0),
        SEEN.at(DATA[0]),
        x0=START,
        t1=1.0,
        num_steps=NUM_STEPS,
        key=key,
        method="matching",
        guide=plain_guide(),
        draw=draw,
        context=lambda sde: jnp.log(jnp.stack([sde.args["h"], sde.args["sigma"]])),
        training=nb.scores.Training(num_updates=num_updates),
        progress=False,
    )


def plain_guide():
    return nb.FrozenGuide(nb.BrownianMotion(1.0))


def guide_ess(guide, parameters, key):
    """In percent, the least over data."""

    def of_datum(datum):
        bridge = nb.GuidedBridge(
            well(*parameters), SEEN.at(datum), x0=START, t1=1.0, num_steps=NUM_STEPS, guide=guide
        )
        noise = jr.normal(key, (1024, *bridge.noise_shape))
        return nb.weights.effective_sample_size(jax.vmap(bridge.log_weight)(noise))

    return float(jnp.min(jax.jit(jax.vmap(of_datum))(DATA))) / 10.24


def run(make_kernel, guide, num_warmup, num_samples, key):
    """Draws `(parameters, chains, draws)`, their seconds, and how many particles."""
    kernel = make_kernel(partial(model, guide))
    mcmc = MCMC(
        kernel,
        num_warmup=num_warmup,
        num_samples=num_samples,
        num_chains=4,
        chain_method="vectorized",
        progress_bar=False,
    )
    mcmc.run(key, DATA)

    seconds = seconds_of_a_draw(kernel, mcmc.last_state, DATA) * num_samples
    draws = mcmc.get_samples(group_by_chain=True)
    particles = getattr(kernel, "num_particles", None)
    return np.stack([np.asarray(draws[name]) for name in PRIORS]), seconds, particles


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--kernels", nargs="+", choices=KERNELS, default=list(KERNELS))
    parser.add_argument("--updates", type=int, default=5000)
    parser.add_argument("--warmup", type=int, default=300)
    parser.add_argument("--samples", type=int, default=1500)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.updates, arguments.warmup, arguments.samples = 20, 20, 20
    key_train, key_run, key_ess = jr.split(jr.key(arguments.seed), 3)
    means, sds = referee(11 if arguments.quick else 41)
    print(json.dumps({"referee": {"mean": means.tolist(), "sd": sds.tolist()}}), flush=True)
    trained = learned(arguments.updates, key_train)
    training = float(trained.history["seconds"][-1])
    guides = {"at the end": nb.FrozenGuide(), "brownian": plain_guide(), "learned": trained}
    for name in arguments.kernels:
        kernel = getattr(nb.infer, name)
        best = 0.0
        for label, guide in guides.items():
            draws, seconds, particles = run(
                kernel, guide, arguments.warmup, arguments.samples, key_run
            )
            effective = np.array([float(effective_sample_size(values)) for values in draws])
            error = sds / np.sqrt(effective)
            rate = float(effective.min()) / seconds
            row = {
                "kernel": name,
                "guide": label,
                "particles": particles,
                "guide_ess_percent": guide_ess(guide, means, key_ess),
                "mean": draws.mean((1, 2)).tolist(),
                "errors_off": ((draws.mean((1, 2)) - means) / error).tolist(),
                "sd": draws.std((1, 2)).tolist(),
                "sd_ratio": (draws.std((1, 2)) / sds).tolist(),
                "ess": float(effective.min()),
                "seconds": seconds,
                "ess_per_second": rate,
            }
            if label == "learned":
                row["training"] = training
                row["paid_after"] = training / (1 / best - 1 / rate) if rate > best else None
            best = max(best, rate)
            print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
