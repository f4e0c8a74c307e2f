"""Inference on trees beside hyperiax 3.0, on the two trees of its notebooks.

    pip install ".[benchmarks]"
    python benchmarks/trees_against_hyperiax.py [--quick] [--parts gaussian weight kunita]
                                                [--iterations 2000]

`gaussian`: a binary tree of 16 leaves, Brownian motion, two variances with priors: NUTS by both,
beside a grid. `weight`: a Kunita flow of 16 landmarks on a ternary tree of 9 leaves, 100 steps a
branch: one guided log weight. `kunita`: on that tree amplitude and length scale with priors; by
hyperiax random walks of the parameters and pCN of the noise, with the settings of its notebook, by
this package function-space HMC. Data are the same, simulated here.

One JSON line each. ESS is that of ArviZ, in bulk, the smallest where several numbers are meant;
seconds of a run are those of all draws, warmup included; compiling is left out of `gaussian`, and
is in `kunita`.
"""

import argparse
import time
from collections import namedtuple

import arviz
import hyperiax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import numpyro
import numpyro.distributions as dist
from hyperiax.prebuilt import bffg
from numpyro.infer import MCMC, NUTS
from numpyro.infer.mcmc import MCMCKernel
from numpyro.infer.util import initialize_model
from trees import seconds, show

import numpyro_bridges as nb

numpyro.set_host_device_count(3)  # before any array


def ran(mcmc, key, *args, **settings) -> float:
    """Seconds of a run that is compiled."""
    mcmc.run(key, *args, **settings)  # compiles; NumPyro keeps the program
    start = time.perf_counter()
    mcmc.run(key, *args, **settings)
    jax.block_until_ready(mcmc.last_state)
    return time.perf_counter() - start


def summary(draws):
    """Smallest bulk ESS and largest R̂ over all numbers of draws `(chain, draw, ...)`."""
    draws = np.asarray(draws, float).reshape(*draws.shape[:2], -1)
    columns = [draws[..., i] for i in range(draws.shape[2])]
    columns = [column for column in columns if column.std() > 0]
    ess = min(float(arviz.ess(column)) for column in columns)
    return ess, max(float(arviz.rhat(column)) for column in columns)


# The Gaussian tree.


def binary(depth: int) -> nb.Tree:
    """With all lengths 1, nodes numbered by level as hyperiax does."""
    count = 2 ** (depth + 1) - 1
    return nb.Tree.from_parents([-1] + [(i - 1) // 2 for i in range(1, count)], np.ones(count))


def log_density_on_grid(tree, data):
    """log σ², log τ² and the posterior's weight of each, by the dense normal law of the leaves."""
    lineages = [set(tree._lineage(tip)) for tip in tree.tips]
    shared = np.array([[len(a & b) - 1.0 for b in lineages] for a in lineages])
    values, vectors = np.linalg.eigh(shared)
    log_sigma, log_tau = np.meshgrid(
        np.linspace(-7, 5, 600), np.linspace(-12, 5, 600), indexing="ij"
    )
    variance = np.exp(log_sigma)[..., None] * values + np.exp(log_tau)[..., None]
    quadratic = np.sum((vectors.T @ data[:, 0]) ** 2 / variance, axis=-1)
    log_density = (
        -0.5 * (quadratic + np.sum(np.log(variance), axis=-1)) - (log_sigma**2 + log_tau**2) / 8
    )
    weight = np.exp(log_density - log_density.max())
    return log_sigma, log_tau, weight / weight.sum()


def gaussian(arguments):
    tree = binary(4)
    law = nb.DiffusionTree(nb.BrownianMotion(0.5), jnp.zeros(1), nb.InexactMatch(0.1), tree=tree)
    data = np.asarray(law.sample(jr.key(202605)))
    *logs, weight = log_density_on_grid(tree, data)
    truth = [np.sum(weight * log) for log in logs]
    spread = [
        np.sqrt(np.sum(weight * (log - mean) ** 2)) for log, mean in zip(logs, truth, strict=True)
    ]

    def ours():
        log_theta = numpyro.sample("log_theta", dist.Normal(jnp.zeros(2), 2.0).to_event(1))
        sigma, tau = jnp.exp(log_theta)
        law = nb.DiffusionTree(
            nb.BrownianMotion(sigma), jnp.zeros(1), nb.InexactMatch(tau), tree=tree
        )
        noise = jnp.zeros(law.noise_prior().shape())  # of which the density does not depend
        numpyro.sample("tips", law.given(noise), obs=data)

    topology = hyperiax.symmetric_topology(depth=4, degree=2)
    empty = hyperiax.Tree.empty(topology, bffg.discrete_schema(d=1))
    scale, shift = lambda anchor, p: jnp.eye(1), lambda anchor, p: jnp.zeros(1)
    mean, covariance = lambda x, p: x, lambda x, p: p * jnp.eye(1)
    filter_back = bffg.discrete_bf_sweep(scale, shift, covariance)
    guide = bffg.discrete_fg_sweep(mean, covariance, scale, shift, covariance)

    def theirs():
        log_theta = numpyro.sample("log_theta", dist.Normal(jnp.zeros(2), 2.0).to_event(1))
        z = numpyro.sample("z", dist.Normal(jnp.zeros(topology.size), 1.0).to_event(1))
        sigma, tau = jnp.exp(log_theta)
        found = bffg.init_discrete_tree(
            empty, jnp.asarray(data), obs_var=tau, d=1, root_val=jnp.zeros(1)
        )
        found = guide(filter_back(found, params=sigma).set(z=z[:, None]), params=sigma)
        # the message at a root of 0
        numpyro.factor("bffg", found.log_norm[0] + found.log_corr.sum())

    draws = 500 if arguments.quick else 4000
    for name, model in (("numpyro_bridges", ours), ("hyperiax", theirs)):
        run = {
            "num_warmup": draws // 4,
            "num_samples": draws,
            "num_chains": 4,
            "chain_method": "vectorized",
        }
        mcmc = MCMC(NUTS(model), progress_bar=False, **run)
        elapsed = ran(mcmc, jr.key(7))
        found = np.asarray(mcmc.get_samples(group_by_chain=True)["log_theta"])
        ess, rhat = summary(found)
        line = {
            "part": "gaussian",
            "package": name,
            "seconds": elapsed,
            "ess": ess,
            "ess_per_s": ess / elapsed,
        }
        line |= {"rhat": rhat}
        for i, parameter in enumerate(("log_sigma2", "log_tau2")):
            # in posterior SDs
            line[f"{parameter}_off"] = (found[..., i].mean() - truth[i]) / spread[i]
            line[f"{parameter}_sd_ratio"] = found[..., i].std() / spread[i]
        show(line)


# The Kunita tree.

POINTS, DIM = 16, 2
SIZE = POINTS * DIM
VARIANCE = 1e-3
ANGLES = 2 * np.pi * np.arange(POINTS) / POINTS
CIRCLE = np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)
TERNARY = nb.Tree.from_parents([-1, 0, 0, 0] + [1 + i // 3 for i in range(9)], np.ones(13))
AMPLITUDE, LENGTH_SCALE = 0.1, 0.25


def law_of(amplitude, length_scale, num_steps, guide=None):
    space = nb.Landmarks(POINTS, DIM, weights=1.0)
    flow = nb.KunitaFlow(space, covariance=nb.MaternKernel(amplitude, length_scale))
    return nb.DiffusionTree(
        flow, CIRCLE, nb.InexactMatch(VARIANCE), tree=TERNARY, num_steps=num_steps, guide=guide
    )


class Theirs:
    """hyperiax's guided log weight, put together as in its notebook."""

    def __init__(self, data, num_steps: int, num_refinements: int = 3):
        self.topology = hyperiax.symmetric_topology(depth=2, degree=3)
        size = self.topology.size
        empty = hyperiax.Tree.empty(
            self.topology, bffg.continuous_schema(d=SIZE, n_steps=num_steps)
        )
        self.root = jnp.asarray(CIRCLE.ravel(), jnp.result_type(float))
        path = jnp.broadcast_to(self.root, (num_steps + 1, SIZE))
        self.empty = empty.set(edge_len=jnp.ones(size)).at[self.topology.is_root].set(vals=path)
        self.data, self.num_steps = jnp.asarray(data).reshape(-1, SIZE), num_steps
        self.num_refinements = num_refinements
        self.filter_back = bffg.continuous_bf_sweep(num_steps, None, None, self.diffusion)
        self.refine = bffg.continuous_refine_anchor()
        still = lambda t, x, p: jnp.zeros(SIZE)  # noqa: E731
        self.guide = bffg.continuous_fg_sweep(
            num_steps, still, self.diffusion, None, None, self.diffusion
        )
        self.num_noises = size * num_steps * SIZE

    @staticmethod
    def diffusion(t, x, params):
        points = x.reshape(POINTS, DIM)
        between = (points[:, None] - points[None]) / params["length_scale"]
        r = jnp.sqrt(jnp.sum(between**2, axis=-1) + 1e-8)
        profile = 1.0 + r + (45 / 105) * r**2 + (10 / 105) * r**3 + (1 / 105) * r**4
        covariance = params["amplitude"] * profile * jnp.exp(-r)
        jitter = 1e-6 * jnp.maximum(1.0, jnp.max(jnp.diag(covariance)))
        factor = jnp.linalg.cholesky(covariance + jitter * jnp.eye(POINTS))
        return jnp.kron(factor, jnp.eye(DIM))

    def __call__(self, noise, amplitude, length_scale):
        """The log weight, and the states of the three inner nodes."""
        params = {"amplitude": amplitude, "length_scale": length_scale}
        settings = {"obs_var": VARIANCE, "d": SIZE, "n_steps": self.num_steps}
        tree = bffg.init_continuous_tree(
            self.empty, self.data, root_val=self.root, anchor_init=self.root, **settings
        )
        for _ in range(self.num_refinements):
            tree = self.refine(self.filter_back(tree, params=params), params=params)
        tree = tree.set(zs=noise.reshape(self.topology.size, self.num_steps, SIZE))
        tree = self.guide(tree, params=params)
        quadratic = self.root @ tree.prec_v[0] @ self.root
        message = tree.log_norm[0] + tree.ptnl_v[0] @ self.root - 0.5 * quadratic
        return message + tree.log_corr.sum(), tree.vals[1:4, -1]


def weight(arguments):
    num_steps = 20 if arguments.quick else 100
    data = np.asarray(law_of(AMPLITUDE, LENGTH_SCALE, num_steps).sample(jr.key(1)))
    theirs = Theirs(data, num_steps)
    shape = law_of(AMPLITUDE, LENGTH_SCALE, num_steps).noise_prior().shape()

    def by(guide):
        def ours(z, amplitude, length_scale):
            return law_of(amplitude, length_scale, num_steps, guide).given(z).log_prob(data)

        return ours, jr.normal(jr.key(0), (64, *shape))

    programs = {
        "numpyro_bridges, geodesic guide": by(nb.GeodesicGuide()),
        "numpyro_bridges, receding guide": by(nb.RecedingGuide()),
        "numpyro_bridges, frozen guide": by(nb.FrozenGuide()),
        "hyperiax": (lambda *args: theirs(*args)[0], jr.normal(jr.key(0), (64, theirs.num_noises))),
    }
    for name, (value, z) in programs.items():
        run = jax.jit(value)
        gradient = jax.jit(jax.value_and_grad(value, argnums=(0, 1, 2)))
        found = np.array([run(one, AMPLITUDE, LENGTH_SCALE) for one in z])
        line = {
            "part": "weight",
            "package": name,
            "steps": num_steps,
            "mean": found.mean(),
            "sd": found.std(),
        }
        line["value_ms"] = 1e3 * seconds(
            lambda run=run, z=z: run(z[0], AMPLITUDE, LENGTH_SCALE), 10
        )
        jax.block_until_ready(gradient(z[0], AMPLITUDE, LENGTH_SCALE))
        line["gradient_ms"] = 1e3 * seconds(
            lambda run=gradient, z=z: run(z[0], AMPLITUDE, LENGTH_SCALE), 5
        )
        show(line)


WalkState = namedtuple("WalkState", ["u", "potential_energy", "accepted", "rng_key"])


class WalkAndPCN(MCMCKernel):
    """What its notebook samples with: pCN of the noise, then a random walk of the logs of the
    parameters.
    """

    sample_field = "u"
    scales = {"amplitude": 0.05, "length_scale": 0.04}
    beta = 0.1

    def __init__(self, potential, postprocess):
        self.potential, self.postprocess = potential, postprocess

    def init(self, rng_key, num_warmup, init_params, model_args, model_kwargs):
        return WalkState(init_params, self.potential(init_params), jnp.zeros(2), rng_key)

    def postprocess_fn(self, model_args, model_kwargs):
        return self.postprocess

    def sample(self, state, model_args, model_kwargs):
        u, energy = dict(state.u), state.potential_energy
        key, key_z, key_accept, key_walk, key_end = jr.split(state.rng_key, 5)
        z = u["z"]
        proposed = jnp.sqrt(1 - self.beta**2) * z + self.beta * jr.normal(key_z, z.shape)
        there = self.potential(u | {"z": proposed})
        # of the likelihood alone
        log_ratio = energy - there + 0.5 * (jnp.sum(proposed**2) - jnp.sum(z**2))
        taken = jnp.log(jr.uniform(key_accept)) < log_ratio
        u["z"], energy = jnp.where(taken, proposed, z), jnp.where(taken, there, energy)

        keys = jr.split(key_walk, len(self.scales))
        walked = {
            n: u[n] + s * jr.normal(k) for (n, s), k in zip(self.scales.items(), keys, strict=True)
        }
        there = self.potential(u | walked)
        moved = jnp.log(jr.uniform(key_end)) < energy - there
        u |= {name: jnp.where(moved, value, u[name]) for name, value in walked.items()}
        return WalkState(
            u, jnp.where(moved, there, energy), jnp.stack([taken, moved]).astype(float), key
        )


def parameters():
    amplitude = numpyro.sample("amplitude", dist.InverseGamma(2.0, 0.5))
    return amplitude, numpyro.sample("length_scale", dist.InverseGamma(3.0, 2.0))


def report(name, elapsed, samples, ancestors, quantities):
    line = {"part": "kunita", "package": name, "seconds": elapsed} | quantities
    for parameter in ("amplitude", "length_scale"):
        draws = np.log(np.asarray(samples[parameter]))
        ess, rhat = summary(draws)
        line |= {
            f"{parameter}_ess": ess,
            f"{parameter}_ess_per_s": ess / elapsed,
            f"{parameter}_rhat": rhat,
        }
        line |= {f"{parameter}_log_mean": draws.mean(), f"{parameter}_log_sd": draws.std()}
    line["ancestors_ess"], line["ancestors_rhat"] = summary(ancestors)
    show(line)


def kunita(arguments):
    num_steps = 20 if arguments.quick else 100
    data = np.asarray(law_of(AMPLITUDE, LENGTH_SCALE, num_steps).sample(jr.key(1)))

    def ours(rows):
        nb.sample("tips", law_of(*parameters(), num_steps), obs=rows)

    draws = 50 if arguments.quick else arguments.draws
    kernel = nb.infer.FunctionSpaceHMC(ours)
    mcmc = MCMC(
        kernel, num_warmup=draws // 2, num_samples=draws, num_chains=4, chain_method="vectorized",
        progress_bar=arguments.progress,
    )  # fmt: skip
    start = time.perf_counter()
    mcmc.run(jr.key(7), data)
    samples = jax.block_until_ready(mcmc.get_samples(group_by_chain=True))
    elapsed = time.perf_counter() - start
    nodes = nb.to_arviz(mcmc)["posterior_nodes"]["tips"].to_numpy()
    inner = sorted(set(range(1, TERNARY.num_nodes)) - set(TERNARY.tips))
    quantities = {"draws": draws, "steps": num_steps, "compiling_included": True}
    report("numpyro_bridges", elapsed, samples, nodes[:, :, np.array(inner)], quantities)

    theirs = Theirs(data, num_steps)
    iterations = 100 if arguments.quick else arguments.iterations

    def model():
        amplitude, length_scale = parameters()
        z = numpyro.sample("z", dist.Normal(jnp.zeros(theirs.num_noises), 1.0).to_event(1))
        log_weight, nodes = theirs(z, amplitude, length_scale)
        numpyro.factor("bffg", log_weight)
        numpyro.deterministic("inner", nodes)

    found = initialize_model(jr.key(0), model, validate_grad=False)
    starts = {
        "amplitude": jnp.log(jnp.array([0.05, 0.1, 0.3])),
        "length_scale": jnp.log(jnp.array([0.15, 0.25, 0.5])),
        "z": jr.normal(jr.key(2024), (3, theirs.num_noises)),
    }
    walk = WalkAndPCN(found.potential_fn, found.postprocess_fn)
    thinning = 10  # its noise would fill the memory
    mcmc = MCMC(
        walk,
        num_warmup=0,
        num_samples=iterations,
        num_chains=3,
        chain_method="parallel",
        thinning=thinning,
        progress_bar=False,
    )
    start = time.perf_counter()
    mcmc.run(jr.key(404), init_params=starts)
    samples = jax.block_until_ready(mcmc.get_samples(group_by_chain=True))
    elapsed = time.perf_counter() - start
    kept = {name: value[:, iterations // (2 * thinning) :] for name, value in samples.items()}
    quantities = {"draws": iterations, "steps": num_steps, "compiling_included": True}
    report("hyperiax", elapsed, kept, kept["inner"], quantities)


PARTS = {"gaussian": gaussian, "weight": weight, "kunita": kunita}


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true", help="few steps and draws: that all runs")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument(
        "--draws", type=int, default=150, help="of each of 4 chains of function-space HMC"
    )
    parser.add_argument(
        "--iterations", type=int, default=10_000, help="of each of 3 chains of hyperiax's notebook"
    )
    parser.add_argument(
        "--double", action="store_true", help="double precision; hyperiax's notebooks use single"
    )
    parser.add_argument("--progress", action="store_true")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", arguments.double)
    for part in arguments.parts:
        PARTS[part](arguments)


if __name__ == "__main__":
    main()
