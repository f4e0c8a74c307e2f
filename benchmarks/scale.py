"""What does a guided weight cost as the number of landmarks grows, beside noise of all landmarks?

    python benchmarks/scale.py [--sizes 32 128 1000] [--length-scales 0.4 0.1]
                               [--guides GeodesicGuide]

One path of 100 steps between two outlines of diameter 2.5, controls by a tolerance of 1e-3, one
core: value, and gradient with respect to the noise, the amplitude and the length scale. A JSON line
for each size: seconds of the core (the minimum over repeats), of landmark noise too up to 256
points, the ratios, seconds of compilation, and the exponent of the time from the size before.
`--memory`: of one size, the peak memory of the process after each program.
"""

import argparse
import functools
import os
import resource
import sys
import time

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from trees import compiled, show

import numpyro_bridges as nb

NUM_STEPS, MOST_LANDMARK = 100, 256


def outlines(n: int):
    """Of diameter 2.5: an egg and a bent one."""
    s = np.linspace(0, 2 * np.pi, n, endpoint=False)
    x = np.stack([1.25 * np.cos(s), 0.8 * np.sin(s) * (1 + 0.15 * np.cos(s))], 1)
    return x, x * np.array([1.05, 0.95]) + 0.08 * np.stack([np.sin(2 * s), np.cos(s)], 1)


def weight(n: int, length_scale: float, noise, guide: str):
    x0, v = outlines(n)

    def log_weight(parameters, z):
        flow = nb.KunitaFlow(
            nb.Landmarks(n, 2), covariance=nb.GaussianKernel(*parameters), noise=noise
        )
        match = nb.InexactMatch.from_point_sd(0.01, flow.space)
        bridge = nb.GuidedBridge(
            flow, match.at(v), x0=x0, t1=1.0, num_steps=NUM_STEPS, guide=getattr(nb, guide)()
        )
        return bridge.log_weight(z)

    parameters = jnp.asarray(0.04), jnp.asarray(length_scale)
    flow = nb.KunitaFlow(nb.Landmarks(n, 2), covariance=nb.GaussianKernel(*parameters), noise=noise)
    z = jr.normal(jr.key(0), (NUM_STEPS, flow.noise_size(jnp.asarray(x0)), 2))
    return log_weight, (parameters, z)


def seconds(f) -> float:
    """Of the core, which other programs may use besides."""
    start = time.process_time()
    jax.block_until_ready(f())
    return time.process_time() - start


def measure(n: int, length_scale: float, guide: str, repeats: int, memory: bool) -> dict:
    x0, _ = outlines(n)
    control = nb.ControlNoise.within(1e-3, x0, covariance=nb.GaussianKernel(0.04, length_scale))
    row = {"n": n, "length_scale": length_scale, "guide": guide, "controls": len(control.points)}
    noises = {"control": control}
    if n <= MOST_LANDMARK and not memory:
        noises["landmark"] = nb.LandmarkNoise()
    weights = {name: weight(n, length_scale, noise, guide) for name, noise in noises.items()}
    for kind in ("value", "gradient"):
        programs = {}
        for name, (f, arguments) in weights.items():
            f = f if kind == "value" else jax.grad(f, argnums=(0, 1))
            program, row[f"{kind}_{name}_compile_s"] = compiled(f, *arguments)
            programs[name] = functools.partial(program, *arguments)
            seconds(programs[name])  # the first run is not counted
            row[f"{kind}_{name}_s"] = np.inf
        for _ in range(repeats):  # in turn
            for name, program in programs.items():
                row[f"{kind}_{name}_s"] = min(row[f"{kind}_{name}_s"], seconds(program))
        if "landmark" in weights:
            row[f"{kind}_ratio"] = row[f"{kind}_landmark_s"] / row[f"{kind}_control_s"]
        if memory:
            row[f"{kind}_peak_gib"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return row


def main(arguments):
    for guide in arguments.guides:
        for length_scale in arguments.length_scales:
            before = None
            for n in arguments.sizes:
                row = measure(n, length_scale, guide, arguments.repeats, arguments.memory)
                if before is not None:
                    for kind in ("value", "gradient"):
                        growth = row[f"{kind}_control_s"] / before[f"{kind}_control_s"]
                        row[f"{kind}_exponent"] = np.log(growth) / np.log(n / before["n"])
                show(row)
                before = row


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--sizes", type=int, nargs="+", default=[32, 64, 128, 256, 1000, 10_000])
    parser.add_argument("--length-scales", type=float, nargs="+", default=[0.4])
    parser.add_argument("--guides", nargs="+", default=["GeodesicGuide", "RecedingGuide"])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument(
        "--memory", action="store_true", help="no landmark noise: peak memory after each program"
    )
    arguments = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # one core
    jax.config.update("jax_enable_x64", True)
    sys.exit(main(arguments))
