"""How should the noise of a tree be moved: as a whole, or branch by branch?

A Kunita flow of 8 landmarks on a tree of 8 tips, 4 steps a branch, parameters fixed; four chains.
JSON lines: ESS a second of the worst and the median ancestral coordinate and of the log density Ψ,
evaluations of the model a second, and means of an ancestral coordinate, which must agree.

    python benchmarks/tree_moves.py [--quick]
"""

import argparse
import os
import time

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from numpyro.diagnostics import effective_sample_size
from trees import show

import numpyro_bridges as nb
from numpyro_bridges.infer import PCN, PCNL, FunctionSpaceHMC

jax.config.update("jax_enable_x64", True)
TREE = nb.Tree.from_newick(
    "(((a:1,b:1):.5,(c:1,d:1):.5):.5,((e:1,f:1):.5,(g:1,h:1):.5):.5);"
).scaled(0.5)
ANGLES = 2 * np.pi * np.arange(8) / 8
CIRCLE = np.stack([np.cos(ANGLES), np.sin(ANGLES)], 1)
LAW = nb.DiffusionTree(
    nb.KunitaFlow(nb.Landmarks(8, 2), nb.GaussianKernel(0.3, 0.5)),
    CIRCLE,
    nb.InexactMatch(0.03**2 / 8),
    tree=TREE,
    num_steps=4,
)
DATA = LAW.sample(jr.key(3))
ANCESTORS = np.array([0, 1, 4, 7, 8, 11])  # branches to inner nodes


def model():
    nb.sample("tips", LAW, obs=DATA)


# moves of a draw: as many for each kernel as levels, so that a draw is one round
KERNELS = {
    "PCN": lambda: PCN(model, num_moves=3),
    "PCN, branches": lambda: PCN(model, num_moves=3, blocks="branch"),
    "PCN, clades": lambda: PCN(model, num_moves=3, blocks="clade"),
    "PCNL": lambda: PCNL(model, num_moves=3),
    "PCNL, branches": lambda: PCNL(model, num_moves=3, blocks="branch"),
    "FunctionSpaceHMC": lambda: FunctionSpaceHMC(model),
}


def ess(x):
    """Of draws `(chains, draws, ...)`, for each of the other axes."""
    x = np.asarray(x).reshape(*x.shape[:2], -1)
    return np.array([effective_sample_size(x[..., i]) for i in range(x.shape[-1])])


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--draws", type=int, default=2000)
    parser.add_argument("--kernels", nargs="+", default=list(KERNELS))
    arguments = parser.parse_args()
    draws = 40 if arguments.quick else arguments.draws

    def watched(noise):
        law = LAW.given(noise)
        return law.path(DATA)[ANCESTORS, -1], law.log_prob(DATA)

    watch = jax.jit(lambda noise: jax.lax.map(watched, noise, batch_size=80))

    for name in arguments.kernels:
        kernel = KERNELS[name]()
        state = kernel.init(jr.split(jr.key(0), 4), 200, None, (), {})

        def step(state, _, kernel=kernel):
            state = kernel.sample(state, (), {})
            return state, (state.z["tips_noise"], getattr(state, "num_steps", jnp.full((4,), 3)))

        advance = (
            jax.jit(lambda state, step=step: jax.lax.scan(step, state, length=20))
            .lower(state)
            .compile()
        )
        for _ in range(10):
            state, _ = advance(state)
        found, count, seconds = [], 0, 0.0
        for _ in range(draws // 20):
            start = time.perf_counter()
            state, (noise, steps) = jax.block_until_ready(advance(state))
            seconds += time.perf_counter() - start
            count += int(np.sum(steps))
            found.append(watch(noise.reshape(-1, *noise.shape[2:])))
        stacked = [
            [np.asarray(x).reshape(20, 4, *x.shape[1:]) for x in part]
            for part in zip(*found, strict=True)
        ]
        states, log_density = (np.concatenate(part).swapaxes(0, 1) for part in stacked)
        own = ess(states)
        line = {
            "kernel": name,
            "draws": 4 * draws,
            "seconds": seconds,
            "evaluations_per_s": count / seconds,
        }
        line |= {"worst_per_s": own.min() / seconds, "median_per_s": np.median(own) / seconds}
        line |= {"log_density_per_s": float(ess(log_density)[0]) / seconds}
        line |= {
            "mean": float(states[:, :, 1, 0, 0].mean()),
            "sd": float(states[:, :, 1, 0, 0].std()),
        }
        line |= {"mean_log_density": float(log_density.mean()), "jax": jax.__version__}
        show(line)


if __name__ == "__main__":
    main()
