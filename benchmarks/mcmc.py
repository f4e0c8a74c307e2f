"""How many effective draws of the parameters does each kernel make, a second and a gradient?

Real wings (32 points) that evolved from their mean, amplitude and length scale unknown: one
specimen, and eight, on 50 to 400 time steps. JSON lines: bulk ESS of the worse parameter, and its
ratio to NUTS in the same run; compile and run time apart. Where R-hat is not below 1.01 in time,
`converged` is false, and the figures are not to be trusted.

    python benchmarks/mcmc.py                     # hours
    python benchmarks/mcmc.py --quick             # a minute, to see that all runs
    python benchmarks/mcmc.py --steps 100 --specimens 1 --kernels nuts function-space-hmc
    python benchmarks/mcmc.py --chains-cost       # four vectorised chains against one
    python benchmarks/mcmc.py --mesh mesh.png     # acceptance at a fixed step, on finer grids
"""

import argparse
import json
import os
import time

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import jax.random as jr
import numpy as np
import numpyro
import numpyro.distributions as dist
from numpyro.diagnostics import effective_sample_size, split_gelman_rubin
from numpyro.infer import HMC, NUTS, Gibbs, init_to_median

import numpyro_bridges as nb
from numpyro_bridges.infer import PCN, CorrelatedPseudoMarginal, FunctionSpaceHMC, noise_sites

PARAMETERS = ("amplitude", "length_scale")


def wing_model(num_points, num_steps, num_specimens):
    wings = nb.datasets.mosquito_wings(num_points=num_points, genus="CX")
    space = nb.Landmarks(num_points, 2)
    # of the H-norm, one likelihood on every mesh; 0.005 a point at 32 points
    seen = nb.InexactMatch(0.005**2 / 32)

    def model(observed):
        amplitude = numpyro.sample("amplitude", dist.LogNormal(-2.0, 1.0))
        length_scale = numpyro.sample("length_scale", dist.LogNormal(-1.0, 0.5))
        flow = nb.KunitaFlow(space, nb.GaussianKernel(amplitude, length_scale))
        law = nb.DiffusionEndpoint(flow, wings.mean, seen, t1=1.0, num_steps=num_steps)
        with numpyro.plate("specimen", num_specimens):
            nb.sample("wing", law, obs=observed)

    return model, wings.points[:num_specimens]


def kernels(model):
    dense = [PARAMETERS]
    return {
        "nuts": lambda: NUTS(model, init_strategy=init_to_median, dense_mass=dense),
        "nuts-0.65": lambda: NUTS(
            model, init_strategy=init_to_median, dense_mass=dense, target_accept_prob=0.65
        ),
        "gibbs-pcn-nuts": lambda: Gibbs(
            [
                (PCN(model), noise_sites),
                (NUTS(model, init_strategy=init_to_median, dense_mass=dense), None),
            ]
        ),
        "function-space-hmc": lambda: FunctionSpaceHMC(model),
        "pseudo-marginal": lambda: CorrelatedPseudoMarginal(model),
    }


def gradients(state):
    """Gradients of the model in the last draw."""
    if hasattr(state, "block_states"):
        return state.block_states[1].num_steps + 1  # and one to renew the parameters' block
    return getattr(state, "num_steps", np.zeros((), int))


def measure(name, kernel, data, arguments):
    """Two chains, one after the other, until R-hat is below 1.01 or time is up."""
    chains, start = [], time.perf_counter()
    for c in range(2):
        state = kernel.init(jr.key(c), arguments.warmup, None, (data,), {})

        def step(state, _, kernel=kernel):
            state = kernel.sample(state, (data,), {})
            return state, ({k: state.z[k] for k in PARAMETERS}, gradients(state))

        advance = (
            jax.jit(lambda state, step=step: jax.lax.scan(step, state, length=25))
            .lower(state)
            .compile()
        )
        chains.append(
            {"advance": advance, "state": state, "draws": [], "gradients": 0, "seconds": 0.0}
        )
    compile_s = (time.perf_counter() - start) / 2

    def run(chain):
        begin = time.perf_counter()
        chain["state"], (draws, count) = jax.block_until_ready(chain["advance"](chain["state"]))
        return time.perf_counter() - begin, draws, int(np.sum(count))

    warmup = [[run(chain) for _ in range(arguments.warmup // 25)] for chain in chains]
    while True:
        for chain in chains:
            seconds, draws, count = run(chain)
            chain["seconds"] += seconds
            chain["gradients"] += count
            chain["draws"].append(draws)
        x = {
            p: np.stack([np.concatenate([d[p] for d in c["draws"]]) for c in chains])
            for p in PARAMETERS
        }
        seconds = sum(c["seconds"] for c in chains)
        r_hat = (
            max(float(split_gelman_rubin(v)) for v in x.values())
            if x[PARAMETERS[0]].shape[1] > 3
            else np.inf
        )
        ess = min(bulk_ess(v) for v in x.values())
        enough = r_hat < 1.01 and ess > 400 and len(x[PARAMETERS[0]][0]) >= arguments.least_draws
        if enough or seconds > 60 * arguments.minutes:
            break
    count = sum(c["gradients"] for c in chains)
    return {
        "kernel": name,
        "draws": int(x[PARAMETERS[0]].size),
        "r_hat": round(r_hat, 4),
        "converged": r_hat < 1.01,
        "bulk_ess": round(ess),
        "ess_of_squares": round(min(bulk_ess((v - v.mean()) ** 2) for v in x.values())),
        "ess_per_s": ess / seconds,
        "ess_per_gradient": ess / count if count else None,
        "gradients_per_draw": count / x[PARAMETERS[0]].size,
        "run_s": round(seconds, 1),
        "warmup_s": round(sum(s for chain in warmup for s, _, _ in chain), 1),
        "compile_s": round(compile_s, 1),
        "means": {p: float(np.exp(v).mean()) for p, v in x.items()},
    }


def bulk_ess(x):
    """Of rank-normalised draws, chains split in halves (Vehtari and others, 2021)."""
    from scipy.stats import norm, rankdata

    z = norm.ppf((rankdata(x) - 0.375) / (x.size + 0.25)).reshape(x.shape)
    half = z.shape[1] // 2
    split = np.concatenate([z[:, :half], z[:, -half:]])
    return float(effective_sample_size(split)) if half > 3 else 0.0


def seconds_of_a_draw(kernel, state, *data):
    """Of all chains, without compilation, which `MCMC.run` repeats in every call."""

    @jax.jit
    def advance(state):
        return jax.lax.fori_loop(0, 50, lambda _, state: kernel.sample(state, data, {}), state)

    # twice: what it returns may be laid out otherwise
    state = jax.block_until_ready(advance(advance(state)))
    begin = time.perf_counter()
    jax.block_until_ready(advance(state))
    return (time.perf_counter() - begin) / 50


def chains_cost(arguments):
    """Seconds of 50 draws of four vectorised chains, shared by the devices, over those of one."""
    numpyro.set_host_device_count(arguments.devices)
    model, data = wing_model(32, arguments.steps[0], arguments.specimens[0])
    seconds = {}
    for n in (1, 4):
        kernel = FunctionSpaceHMC(model, adapt_step_size=False)
        state = kernel.init(jr.key(0) if n == 1 else jr.split(jr.key(0), n), 0, None, (data,), {})
        seconds[n] = 50 * seconds_of_a_draw(kernel, state, data)
    row = {
        "devices": jax.local_device_count(),
        "seconds": seconds,
        "ratio": seconds[4] / seconds[1],
    }
    print(json.dumps(row | {"jax": jax.__version__}))


def mesh(arguments):
    """Acceptance at a fixed step: of FunctionSpaceHMC and PCN, and of plain HMC with as long a
    trajectory.
    """
    rows = []
    for num_points, num_steps in [(32, k) for k in arguments.mesh_steps] + [
        (n, 50) for n in arguments.mesh_points
    ]:
        model, data = wing_model(num_points, num_steps, 1)
        fixed = {"amplitude": 0.036, "length_scale": 0.44}
        noise_only = numpyro.handlers.condition(model, fixed)
        step = {"adapt_step_size": False}
        for name, kernel in {
            "FunctionSpaceHMC": FunctionSpaceHMC(model, step_size=1.0, **step),
            "PCN": PCN(noise_only, angle=0.8, adapt_angle=False),
            "HMC": HMC(
                noise_only, step_size=0.25, trajectory_length=2.0, adapt_mass_matrix=False, **step
            ),
        }.items():
            state = kernel.init(jr.key(0), 100, None, (data,), {})

            @jax.jit
            def run(state, kernel=kernel, data=data):
                def one(state, _):
                    state = kernel.sample(state, (data,), {})
                    return state, state.accept_prob

                return jax.lax.scan(one, state, length=100 + arguments.draws)[1]

            rate = np.asarray(run(state))[100:]
            error = rate.std() / np.sqrt(max(float(effective_sample_size(rate[None])), 2.0))
            rows.append(
                {
                    "points": num_points,
                    "steps": num_steps,
                    "kernel": name,
                    "acceptance": float(rate.mean()),
                }
            )
            print(json.dumps(rows[-1] | {"standard_error": float(error)}), flush=True)
    plot_mesh(rows, arguments.mesh)


def plot_mesh(rows, path):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(8, 3.2), sharey=True)
    for axis, varies, other, fixed in (
        (axes[0], "steps", "points", 32),
        (axes[1], "points", "steps", 50),
    ):
        for name in dict.fromkeys(row["kernel"] for row in rows):
            chosen = sorted(
                (r[varies], r["acceptance"])
                for r in rows
                if r["kernel"] == name and r[other] == fixed
            )
            axis.plot(*zip(*chosen, strict=True), marker="o", label=name)
        axis.set(
            xscale="log",
            xlabel={"steps": "time steps", "points": "landmarks"}[varies],
            ylim=(0, 1.02),
        )
        ticks = sorted({row[varies] for row in rows if row[other] == fixed})
        axis.set_xticks(ticks, map(str, ticks))
        axis.minorticks_off()
    axes[0].set_ylabel("acceptance at a fixed step")
    axes[0].legend(frameon=False)
    figure.tight_layout()
    figure.savefig(path, dpi=150)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--steps", type=int, nargs="+", default=[50, 100, 200, 400])
    parser.add_argument("--specimens", type=int, nargs="+", default=[1, 8])
    parser.add_argument("--kernels", nargs="+")
    parser.add_argument("--warmup", type=int, default=200)
    parser.add_argument(
        "--minutes", type=float, default=30.0, help="for each kernel, after its warm-up"
    )
    parser.add_argument("--least-draws", type=int, default=200, help="of each chain")
    parser.add_argument("--chains-cost", action="store_true")
    parser.add_argument("--devices", type=int, default=2, help="of --chains-cost")
    parser.add_argument("--mesh", metavar="PNG")
    parser.add_argument("--mesh-steps", type=int, nargs="+", default=[50, 100, 200, 400, 800])
    parser.add_argument("--mesh-points", type=int, nargs="+", default=[8, 16, 64])
    parser.add_argument("--draws", type=int, default=400, help="of --mesh")
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.steps, arguments.specimens, arguments.warmup, arguments.minutes = (
            [10],
            [1],
            25,
            0.1,
        )
        arguments.kernels = arguments.kernels or ["gibbs-pcn-nuts", "function-space-hmc"]
    if arguments.chains_cost:
        chains_cost(arguments)
    elif arguments.mesh:
        mesh(arguments)
    else:
        for num_specimens in arguments.specimens:
            for num_steps in arguments.steps:
                model, data = wing_model(16 if arguments.quick else 32, num_steps, num_specimens)
                available, reference = kernels(model), None
                for name in arguments.kernels or available:
                    row = measure(name, available[name](), data, arguments)
                    reference = row["ess_per_s"] if name == "nuts" else reference
                    row["over_nuts"] = row["ess_per_s"] / reference if reference else None
                    row |= {"specimens": num_specimens, "steps": num_steps, "jax": jax.__version__}
                    print(json.dumps(row), flush=True)
