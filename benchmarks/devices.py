"""Batches over devices: how much of the work is left to each of them, and is the result the same?

    python benchmarks/devices.py [--devices 1 2 4 8] [--paths 1024] [--chains 16]

One JSON line for each task and number of devices:

- **evidence**: log weights of paths of a Kunita flow between two ellipses of 16 landmarks.
- **chains**: 20 draws of FunctionSpaceHMC, of 4 steps each, its amplitude unknown.
- **gradient**: of the mean log weight of the paths, in the amplitude.

`items` of the batch on each device; `gflop`, as XLA counts those of the program of one device, a
loop's body once for each of its steps where their number is fixed; `seconds` of a run,
`seconds_compiling`; `difference`, the largest one to the run on one device. On a CPU the devices
share its cores: the work of each falls, and the time down to what the cores allow.
"""

import argparse
import json
import os
import time

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import numpyro
import numpyro.distributions as dist
from jax.sharding import Mesh

import numpyro_bridges as nb
from numpyro_bridges.infer import FunctionSpaceHMC

POINTS, STEPS = 16, 20


def ellipse(aspect):
    s = 2 * np.pi * np.arange(POINTS) / POINTS
    return np.stack([aspect * np.cos(s), np.sin(s)], axis=1)


START, END = ellipse(1.0), ellipse(1.3)


def flow(amplitude):
    return nb.KunitaFlow(nb.Landmarks(POINTS, 2), nb.GaussianKernel(amplitude, 0.5))


def log_weight(amplitude, key):
    seen = nb.InexactMatch(1e-4).at(END)
    bridge = nb.GuidedBridge(flow(amplitude), seen, x0=START, t1=1.0, num_steps=STEPS)
    return bridge.log_weight(jr.normal(key, bridge.noise_shape, bridge.x0.dtype))


def model(observed):
    amplitude = numpyro.sample("amplitude", dist.LogNormal(-1.0, 0.5))
    match = nb.InexactMatch(1e-4)
    law = nb.DiffusionEndpoint(flow(amplitude), START, match, t1=1.0, num_steps=STEPS)
    nb.sample("shape", law, obs=observed)


def tasks(mesh, num_paths, num_chains):
    """Programs and their arguments, by name, with the size of the batch."""
    keys = jr.split(jr.key(0), num_paths)
    kernel = FunctionSpaceHMC(model, step_size=0.525, adapt_step_size=False, mesh=mesh)
    state = kernel.init(jr.split(jr.key(1), num_chains), 0, None, (END,), {})

    def draws(state):
        def draw(state, _):
            state = kernel.sample(state, (END,), {})
            return state, state.z["amplitude"]

        return jax.lax.scan(draw, state, None, length=20)[1]

    def mean(amplitude):
        return jnp.mean(nb.spread(lambda key: log_weight(amplitude, key), mesh)(keys))

    return {
        "evidence": (nb.spread(lambda key: log_weight(0.3, key), mesh), keys, num_paths),
        "chains": (draws, state, num_chains),
        "gradient": (jax.grad(mean), jnp.asarray(0.3), num_paths),
    }


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--devices", type=int, nargs="+", default=[1, 2, 4, 8])
    parser.add_argument("--paths", type=int, default=1024)
    parser.add_argument("--chains", type=int, default=16)
    arguments = parser.parse_args()
    numpyro.set_host_device_count(max(arguments.devices))
    jax.config.update("jax_enable_x64", True)
    of_one = {}
    for number in sorted(arguments.devices):
        mesh = Mesh(np.array(jax.devices()[:number]), "devices")
        assert mesh.size == number
        for name, (fn, argument, size) in tasks(mesh, arguments.paths, arguments.chains).items():
            begin = time.perf_counter()
            compiled = jax.jit(fn).lower(argument).compile()
            compiling = time.perf_counter() - begin
            found = np.asarray(jax.block_until_ready(compiled(argument)))
            begin = time.perf_counter()
            jax.block_until_ready(compiled(argument))
            seconds = time.perf_counter() - begin
            row = {
                "task": name,
                "devices": number,
                "items": size // number,
                "gflop": compiled.cost_analysis()["flops"] / 1e9,
                "seconds": seconds,
                "seconds_compiling": compiling,
                "difference": float(np.max(np.abs(found - of_one.setdefault(name, found)))),
                "device": jax.devices()[0].device_kind,
                "jax": jax.__version__,
            }
            print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
