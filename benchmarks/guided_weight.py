"""What does a guided weight cost, beside a hand-written scan of the same arithmetic?

    python benchmarks/guided_weight.py [--quick] [--x64] [--sizes 8 32 128] [--memory]

One Kunita flow of n landmarks, 100 steps, 64 paths, the receding guide: value, and gradient with
respect to the noise, the amplitude and the length scale; beside them the library's geodesic guide.
One JSON line per size: run times (minimum over repeats, the programs in turn), their ratios,
compile times, flops by XLA's cost analysis. Last the peak memory of one gradient at 256 landmarks,
in a process of its own.
"""

import argparse
import json
import resource
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jax import lax
from jax.scipy.linalg import solve_triangular

NUM_STEPS, VARIANCE = 100, 1e-4


def shapes(n: int):
    """A circle and an ellipse of n points."""
    s = np.linspace(0, 2 * np.pi, n, endpoint=False)
    return np.stack([np.cos(s), np.sin(s)], 1), np.stack(
        [1.2 * np.cos(s) + 0.1, 0.9 * np.sin(s)], 1
    )


def library_weight(n: int, guide: str = "RecedingGuide"):
    """The weight as a user writes it."""
    import numpyro_bridges as nb

    x0, v = shapes(n)
    space, match, leading = nb.Landmarks(n, 2), nb.InexactMatch(VARIANCE), getattr(nb, guide)()

    def log_weight(parameters, noise):
        flow = nb.KunitaFlow(space, nb.GaussianKernel(*parameters), noise="landmark")
        bridge = nb.GuidedBridge(
            flow, match.at(v), x0=x0, t1=1.0, num_steps=NUM_STEPS, guide=leading
        )
        return bridge.log_weight(noise)

    return log_weight


def plain_weight(n: int):
    """The same arithmetic, written out for this one model."""
    x0, v = (jnp.asarray(x, float) for x in shapes(n))
    eye, dt = jnp.eye(n), 1.0 / NUM_STEPS
    left = jnp.asarray(1.0 - jnp.arange(1, NUM_STEPS) * dt)
    sd = jnp.sqrt(VARIANCE * n)
    nugget = 1e-5 if x0.dtype == jnp.float32 else 1e-10

    def log_weight(parameters, noise):
        amplitude, length_scale = parameters
        scale = amplitude**2 * jnp.pi * length_scale**2

        def covariance(x):
            d2 = sum((c[:, None] - c[None]) ** 2 for c in x.T)
            return scale * (jnp.exp(-d2 / (4 * length_scale**2)) + nugget * eye)

        def kick(x, a, tau, z):
            """The steering of one step: u, the whitened residual, and log|P| − log|N|."""
            A = jnp.sqrt(dt) * lax.linalg.cholesky(a, symmetrize_input=False)
            P = (
                lax.linalg.cholesky(tau * a + sd**2 * eye, symmetrize_input=False)
                if tau is not None
                else sd * eye
            )
            N = lax.linalg.cholesky(
                (dt if tau is None else tau + dt) * a + sd**2 * eye, symmetrize_input=False
            )
            y = solve_triangular(N, v - x, lower=True)
            back = solve_triangular(
                N, y - solve_triangular(N + P, A @ z, lower=True), trans=1, lower=True
            )
            log_det = jnp.sum(jnp.log(jnp.diagonal(P))) - jnp.sum(jnp.log(jnp.diagonal(N)))
            return A, z + A.T @ back, y, N, 2 * log_det

        @jax.checkpoint
        def step(carry, inputs):
            x, total = carry
            z, tau = inputs
            A, u, _, _, log_det = kick(x, covariance(x), tau, z)
            return (x + A @ u, total + 0.5 * (jnp.sum(z * z) - jnp.sum(u * u)) + log_det), None

        (x, total), _ = lax.scan(step, (x0, 0.0), (noise[:-1], left))
        _, _, y, N, _ = kick(x, covariance(x), None, noise[-1])
        return (
            total
            - 0.5 * jnp.sum(y * y)
            - 2 * jnp.sum(jnp.log(jnp.diagonal(N)))
            - n * jnp.log(2 * jnp.pi)
        )

    return log_weight


def programs(log_weight):
    """Batched value and gradient, to be compiled."""

    def value(parameters, noise):
        return jnp.sum(jax.vmap(log_weight, (None, 0))(parameters, noise))

    return {"value": value, "gradient": jax.grad(value, argnums=(0, 1))}


def compiled(f, *args):
    start = time.perf_counter()
    program = jax.jit(f).lower(*args).compile()
    cost = program.cost_analysis()
    cost = cost[0] if isinstance(cost, list) else cost
    return program, time.perf_counter() - start, (cost or {}).get("flops", float("nan"))


def measure(n: int, num_paths: int, repeats: int) -> dict:
    parameters = (jnp.asarray(0.3), jnp.asarray(0.5))
    noise = jr.normal(jr.key(0), (num_paths, NUM_STEPS, n, 2))
    row: dict = {"n": n, "num_paths": num_paths, "num_steps": NUM_STEPS, "dtype": str(noise.dtype)}
    results = {}
    for kind in ("value", "gradient"):
        pair = {}
        weights = {"library": library_weight(n), "plain": plain_weight(n)}
        weights["geodesic"] = library_weight(n, "GeodesicGuide")
        for name, weight in weights.items():
            program, seconds, flops = compiled(programs(weight)[kind], parameters, noise)
            pair[name] = program
            row[f"{kind}_{name}_compile_s"] = round(seconds, 2)
            row[f"{kind}_{name}_gflop"] = round(flops / 1e9, 3)
            results[kind, name] = jax.block_until_ready(program(parameters, noise))
        times: dict = {name: [] for name in pair}
        for _ in range(repeats):
            for name, program in pair.items():
                start = time.perf_counter()
                jax.block_until_ready(program(parameters, noise))
                times[name].append(time.perf_counter() - start)
        for name in pair:
            row[f"{kind}_{name}_s"] = round(min(times[name]), 4)
        row[f"{kind}_ratio"] = round(
            float(np.median(np.divide(times["library"], times["plain"]))), 3
        )
        row[f"{kind}_geodesic_ratio"] = round(
            float(np.median(np.divide(times["geodesic"], times["library"]))), 3
        )
    row["gradient_over_value"] = round(row["gradient_library_s"] / row["value_library_s"], 2)
    row["value_difference"] = float(
        abs(results["value", "library"] / results["value", "plain"] - 1)
    )
    row["jax"], row["device"] = jax.__version__, jax.devices()[0].device_kind
    return row


def peak_memory(n: int = 256) -> dict:
    """MiB that one gradient adds to the process, compilation included."""
    parameters = (jnp.asarray(0.3), jnp.asarray(0.5))
    noise = jr.normal(jr.key(0), (1, NUM_STEPS, n, 2))
    gradient = programs(library_weight(n))["gradient"]
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    jax.block_until_ready(jax.jit(gradient)(parameters, noise))
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {
        "n": n,
        "num_paths": 1,
        "peak_MiB": round((after - before) / 1024, 1),
        "process_MiB": round(after / 1024, 1),
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="8 landmarks, 8 paths")
    parser.add_argument("--x64", action="store_true")
    parser.add_argument("--sizes", type=int, nargs="*", default=[8, 32, 128])
    parser.add_argument("--memory", action="store_true", help="only the peak memory")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", arguments.x64)
    if arguments.memory:
        print(json.dumps(peak_memory()))
        sys.exit()
    for size in [8] if arguments.quick else arguments.sizes:
        print(
            json.dumps(measure(size, 8 if arguments.quick else 64, 3 if arguments.quick else 7)),
            flush=True,
        )
    if not arguments.quick:
        subprocess.run(
            [sys.executable, __file__, "--memory", *(["--x64"] if arguments.x64 else [])],
            check=True,
        )
