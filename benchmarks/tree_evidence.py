"""Do two ways to the evidence of a tree agree, and what do they cost?

Nine simulated tips of a strongly nonlinear flow, 16 landmarks, 12 branches of 100 steps, parameters
fixed at the truth: tempering from the prior up by particles, and bridge sampling by chains from the
posterior down. JSON lines: estimate, standard error, temperatures, seconds with compilation; then
the difference in units of the joint standard error.

    python benchmarks/tree_evidence.py                    # hours on a busy machine
    python benchmarks/tree_evidence.py --quick            # a minute: 4 steps a branch
    python benchmarks/tree_evidence.py --methods smc --repeats 4
"""

import argparse
import os
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import jax.random as jr
import numpy as np
from trees import show

import numpyro_bridges as nb

jax.config.update("jax_enable_x64", True)


def simulated(num_steps: int, guide: nb.AbstractGuide | None = None):
    """The law and its data, or `None` where they are not."""
    folder = Path(
        os.environ.get("NUMPYRO_BRIDGES_DATA", Path(__file__).parents[2] / "shared" / "data")
    )
    file = folder / "kunita_cases" / "kunita_cases.npz"
    if not file.is_file():
        return None
    data = np.load(file)
    space = nb.Landmarks(16, 2, weights=1.0)
    flow = nb.KunitaFlow(
        space, covariance=nb.MaternKernel(0.1, 0.25, order=4), noise=nb.LandmarkNoise(jitter=1e-5)
    )
    tree = nb.Tree.from_newick("((a:1,b:1,c:1):1,(d:1,e:1,f:1):1,(g:1,h:1,i:1):1);")
    law = nb.DiffusionTree(
        flow, data["root"], nb.InexactMatch(1e-3), tree=tree, num_steps=num_steps, guide=guide
    )
    return law, data["tree_leaves"]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--methods", nargs="+", default=["smc", "bridge"])
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument(
        "--particles", type=int, default=48, help="of an island; half as many draws of a chain"
    )
    parser.add_argument("--islands", type=int, default=8)
    parser.add_argument("--moves", type=int, default=3)
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--progress", action="store_true")
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.steps, arguments.particles, arguments.islands = 4, 16, 2
    case = simulated(arguments.steps)
    if case is None:
        show({"skipped": "no kunita_cases/kunita_cases.npz: set NUMPYRO_BRIDGES_DATA"})
        return
    law, data = case
    last = {}
    for repeat in range(arguments.repeats):
        for method in arguments.methods:
            start = time.perf_counter()
            particles = arguments.particles if method == "smc" else arguments.particles // 2
            found = nb.estimate_tree_evidence(
                law,
                data,
                jr.key(arguments.seed + repeat),
                method=method,
                num_particles=particles,
                num_islands=arguments.islands,
                num_moves=arguments.moves,
                progress=arguments.progress,
            )
            line = {"method": method, "steps": arguments.steps, "seed": arguments.seed + repeat}
            line |= {
                "log_evidence": float(found.log_evidence),
                "standard_error": float(found.standard_error),
            }
            line |= {"trusted": found.trusted, "temperatures": len(found.inverse_temperatures) - 1}
            line |= {
                "least_acceptance": float(found.accept_prob.min()),
                "seconds": time.perf_counter() - start,
            }
            show(line | {"words": str(found), "jax": jax.__version__})
            last[method] = found
        if len(last) == 2:
            one, two = last.values()
            joint = np.hypot(float(one.standard_error), float(two.standard_error))
            difference = float(one.log_evidence - two.log_evidence)
            show(
                {
                    "difference": difference,
                    "joint_standard_error": float(joint),
                    "ratio": difference / float(joint),
                }
            )


if __name__ == "__main__":
    main()
