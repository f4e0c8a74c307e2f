"""Is the posterior of each kernel calibrated? Simulation-based calibration (Talts and others,
2018).

Parameters are drawn from the prior, data simulated forward, and posterior draws ranked against the
truth: each parameter, a functional of the path (its middle, on average over points) and the log
joint density of all; on a tree a coordinate of an ancestor and the log likelihood, which shows data
that are thrown away. Ranks of an exact sampler are uniform; their ECDF stays within a simultaneous
95 % band (Säilynoja, Bürkner and Vehtari, 2022). Of four statistics one leaves its band by chance
in one run of six, so each has a p-value too, `uniformity`.

Three models: a nonlinear scalar SDE, a Kunita flow of two landmarks, and one of four on a tree of
four tips. JSON lines, and a plot of the ECDF differences.

    python benchmarks/calibration.py --output output          # all kernels, 256 replicates each
    python benchmarks/calibration.py --quick --kernels FunctionSpaceHMC
"""

import argparse
import json
import math
import os
import time
import zlib
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import numpyro
import numpyro.distributions as dist
import scipy.stats
from numpyro.infer import NUTS, Gibbs

import numpyro_bridges as nb
from numpyro_bridges.infer import (
    PCN,
    PCNL,
    CorrelatedPseudoMarginal,
    CorrelatedPseudoMarginalMALA,
    FunctionSpaceHMC,
    noise_sites,
)


def sine(v=None):
    force = numpyro.sample("force", dist.Normal(1.0, 0.5))
    spread = numpyro.sample("spread", dist.LogNormal(-0.5, 0.3))
    sde = nb.SDE(
        lambda t, x, a: a[0] * jnp.sin(2 * x),
        lambda t, x, a: a[1] * (1 + 0.3 * jnp.cos(x)),
        (force, spread),
    )
    law = nb.DiffusionEndpoint(sde, np.zeros(1), nb.InexactMatch(0.05), t1=1.0, num_steps=10)
    nb.sample("v", law, obs=v)


def landmarks(v=None):
    amplitude = numpyro.sample("amplitude", dist.LogNormal(-1.5, 0.4))
    length_scale = numpyro.sample("length_scale", dist.LogNormal(-0.3, 0.3))
    flow = nb.KunitaFlow(nb.Landmarks(2, 2), nb.GaussianKernel(amplitude, length_scale))
    x0 = np.array([[-0.4, 0.0], [0.4, 0.0]])
    law = nb.DiffusionEndpoint(flow, x0, nb.InexactMatch(0.002), t1=1.0, num_steps=10)
    nb.sample("v", law, obs=v)


TREE = nb.Tree.from_newick("((a:.4,b:.5):.5,(c:.6,d:.2):.3);")


def tree(v=None):
    amplitude = numpyro.sample("amplitude", dist.LogNormal(-1.2, 0.4))
    length_scale = numpyro.sample("length_scale", dist.LogNormal(-0.3, 0.3))
    flow = nb.KunitaFlow(nb.Landmarks(4, 2), nb.GaussianKernel(amplitude, length_scale))
    x0 = np.array([[0.5, 0.0], [0.0, 0.5], [-0.5, 0.0], [0.0, -0.5]])
    law = nb.DiffusionTree(
        flow, x0, nb.InexactMatch(0.002), tree=TREE, num_steps=TREE.num_steps(0.1)
    )
    nb.sample("v", law, obs=v)


def with_nuts(kernel, **settings):
    return lambda model: Gibbs([(kernel(model, **settings), noise_sites), (NUTS(model), None)])


MODELS = {"sine": sine, "landmarks": landmarks, "tree": tree}
# Kernel, draws of the warm-up, draws, draws between those that are ranked. Ranks are uniform among
# independent draws only: a quick run keeps every draw's distance and ranks fewer of them.
KERNELS = {
    "FunctionSpaceHMC": (FunctionSpaceHMC, 100, 200, 2),
    "PCN": (with_nuts(PCN, num_moves=2), 100, 400, 4),
    "PCNL": (with_nuts(PCNL), 100, 400, 4),
    "CorrelatedPseudoMarginal": (lambda model: CorrelatedPseudoMarginal(model, 4), 200, 3000, 30),
    "CorrelatedPseudoMarginalMALA": (
        lambda model: CorrelatedPseudoMarginalMALA(model, 2),
        200,
        2000,
        20,
    ),
}


def statistics(model, z, v):
    """What is ranked: parameters, a functional of the path, log joint density of (θ, z, v)."""
    trace = numpyro.handlers.trace(
        numpyro.handlers.substitute(numpyro.handlers.seed(model, 0), z)
    ).get_trace(v)
    sites = [site for site in trace.values() if site["type"] == "sample"]
    log_joint = sum(jnp.sum(site["fn"].log_prob(site["value"])) for site in sites)
    law = trace["v"]["fn"]
    scalars = {name: value for name, value in z.items() if name != "v_noise"}
    if isinstance(law, nb.DiffusionTree):
        scalars |= {
            "coordinate of an ancestor": law.nodes(v)[1, 0, 0],
            "log likelihood": law.log_prob(v),
        }
    else:
        path = law.path(v)
        scalars["middle of the path"] = jnp.mean(path[len(path) // 2])
    return scalars | {"log joint density": log_joint}


def ranks(name, kernel, model, num_replicates, num_warmup, num_draws, thin, seed=0):
    """Ranks `{statistic: (num_replicates,)}` of the truth among the thinned draws."""

    def replicate(key):
        key_prior, key_law, key_chain = jr.split(key, 3)
        prior = numpyro.handlers.trace(numpyro.handlers.seed(model, key_prior)).get_trace()
        v, noise = prior["v"]["fn"].sample_with_noise(key_law)
        latent = {
            k: s["value"]
            for k, s in prior.items()
            if s["type"] == "sample" and k not in ("v", "v_noise")
        }
        truth = statistics(model, latent | {"v_noise": noise}, v)
        state = kernel.init(key_chain, num_warmup, None, (v,), {})

        def one(state, _):
            return kernel.sample(state, (v,), {}), None

        def kept(state, _):
            state, _ = jax.lax.scan(one, state, length=thin)
            return state, statistics(model, kernel.postprocess_fn((v,), {})(state.z), v)

        state, _ = jax.lax.scan(one, state, length=num_warmup)
        _, draws = jax.lax.scan(kept, state, length=num_draws // thin)
        return {k: jnp.sum(draws[k] < truth[k]) for k in truth}

    key = jr.key(seed + zlib.crc32(name.encode()))  # each kernel meets truths of its own
    batches = jr.split(key, num_replicates).reshape(-1, math.gcd(num_replicates, 256))
    replicates = jax.jit(jax.vmap(replicate))  # compiled once for all batches
    found = [jax.device_get(replicates(keys)) for keys in batches]
    return {k: np.concatenate([batch[k] for batch in found]) for k in found[0]}


def band(num_replicates, num_ranks, level=0.95, simulations=4000):
    """Half-widths of the ECDF of uniform ranks, at every rank, that hold at once; in the pointwise
    SD by simulation.
    """
    grid = np.arange(1, num_ranks) / num_ranks
    rng = np.random.default_rng(0)
    uniform = rng.integers(0, num_ranks, size=(simulations, num_replicates))
    ecdf = np.stack([np.mean(uniform < k, axis=1) for k in range(1, num_ranks)], axis=1)
    sd = np.sqrt(grid * (1 - grid) / num_replicates)
    return np.quantile(np.max(np.abs(ecdf - grid) / sd, axis=1), level) * sd


def difference(found, num_ranks):
    """ECDF minus uniform."""
    grid = np.arange(1, num_ranks) / num_ranks
    return np.array([np.mean(found < k) for k in range(1, num_ranks)]) - grid


def uniformity(found, num_ranks):
    """A p-value of uniform ranks, against a posterior at the wrong place or of the wrong width.

    With U uniform, z = Φ⁻¹((rank + U) / num_ranks) is exactly standard normal. Its mean is N(0,
    1/R) and its sum of squares χ²_R; twice the smaller of their two-sided p-values is at most p
    with probability p. Below 2.5e-5, which one of four statistics reaches by chance in one run of
    10 000, it finds with probability 0.9, from 256 ranks among 25 draws, a posterior that is
    shifted by 0.38 of its SD, or whose SD is wrong by a factor of 0.71 or 1.39.
    """
    count = len(found)
    uniform = (found + np.random.default_rng(0).uniform(size=count)) / num_ranks
    z = scipy.stats.norm.ppf(uniform)
    place = 2 * scipy.stats.norm.sf(abs(np.sum(z)) / np.sqrt(count))
    squares = scipy.stats.chi2(count)
    width = 2 * min(squares.cdf(np.sum(z**2)), squares.sf(np.sum(z**2)))
    return float(min(1.0, 2 * min(place, width)))


def plot(rows, path):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    columns = max(len(row["ranks"]) for row in rows)
    figure, axes = plt.subplots(
        len(rows), columns, figsize=(11, 1.7 * len(rows)), sharex=True, sharey=True, squeeze=False
    )
    for line, row in zip(axes, rows, strict=True):
        width = band(row["replicates"], row["num_ranks"])
        x = np.arange(1, row["num_ranks"]) / row["num_ranks"]
        drawn, empty = np.split(line, [len(row["ranks"])])
        for axis in empty:
            axis.set_axis_off()
        for axis, (statistic, found) in zip(drawn, row["ranks"].items(), strict=True):
            axis.fill_between(x, -width, width, color="0.85")
            axis.plot(x, difference(np.array(found), row["num_ranks"]), drawstyle="steps-post")
            axis.set_title(f"{row['kernel']}, {row['model']}\n{statistic}", fontsize=6)
            axis.tick_params(labelsize=6)
    figure.supxlabel("rank of the truth", fontsize=8)
    figure.supylabel("ECDF − uniform", fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=130)


def main(arguments):
    rows = []
    for model in arguments.models:
        for name in arguments.kernels:
            build, num_warmup, num_draws, thin = KERNELS[name]
            thin *= 4 if arguments.quick else 1
            begin = time.perf_counter()
            settings = arguments.replicates, num_warmup, num_draws, thin, arguments.seed
            found = ranks(name, build(MODELS[model]), MODELS[model], *settings)
            num_ranks = num_draws // thin + 1
            width = band(arguments.replicates, num_ranks)
            excess = {
                k: float(np.max(np.abs(difference(r, num_ranks)) / width)) for k, r in found.items()
            }
            row = {
                "kernel": name,
                "model": model,
                "replicates": arguments.replicates,
                "num_ranks": num_ranks,
                "uniformity": {k: uniformity(r, num_ranks) for k, r in found.items()},
                "largest_over_band": excess,
                "inside": all(e <= 1 for e in excess.values()),
                "seconds": round(time.perf_counter() - begin, 1),
            }
            print(json.dumps(row), flush=True)
            rows.append(row | {"ranks": {k: r.tolist() for k, r in found.items()}})
    arguments.output.mkdir(parents=True, exist_ok=True)
    (arguments.output / "calibration.json").write_text(json.dumps(rows))
    plot(rows, arguments.output / "calibration.png")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true", help="a quarter of the draws is ranked")
    parser.add_argument("--models", nargs="+", choices=MODELS, default=list(MODELS))
    parser.add_argument("--kernels", nargs="+", choices=KERNELS, default=list(KERNELS))
    parser.add_argument("--replicates", type=int, default=256, help="a multiple of 64")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=Path("output"))
    arguments = parser.parse_args()
    main(arguments)
