"""Fields at any resolution: what is added by more modes and more steps, and what they cost.

    python benchmarks/semilinear.py [--quick] [--cases heat allen_cahn]

- **heat**: the stochastic heat equation on the circle, λ_n = 0.5 + 0.1 n², with noise spectra q_n =
  (1 + n²)^-s, s = 1 and 2, from one curve to another, inexact with variance 0.01 and the kernel of
  the H-norm: log evidence at 16 to 4096 modes less its limit, to be of the size of what is left of
  the trace; by 1 and by 20 steps.
- **allen_cahn**: dX = (0.1 Δ X + X − X³) dt + dW, q_n = 0.04 (1 + n²)⁻², variance 0.01: log
  evidence and SD of the log weight by functions and by steps; at 4 modes and variance 0.1 beside
  paths that nothing guides.

One JSON line for each row: `seconds` of one run of all paths, without compilation. All in double
precision.
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

import numpyro_bridges as nb


def curves(space):
    """A start and an end, of the three lowest frequencies."""
    s = space.grid
    return space.from_points(0.5 * np.cos(s)), space.from_points(
        0.3 + 0.8 * np.sin(s) + 0.1 * np.cos(3 * s)
    )


def allen_cahn(
    num_modes: int, num_steps: int, scheme: str = "euler", variance: float = 0.01, **settings
) -> nb.GuidedBridge:
    space = nb.FourierBasis(num_modes, 1)
    spectrum = 0.04 * (1 - space.laplacian) ** -2.0

    def reaction(t, x, args):
        u = space.to_points(x)
        return space.from_points(u - u**3)

    sde = nb.SemilinearSDE(
        0.1 * space.laplacian, reaction, jnp.sqrt(spectrum), space=space, scheme=scheme
    )
    x0, v = curves(space)
    condition = nb.InexactMatch(variance, normalised=False).at(v)
    return nb.GuidedBridge(sde, condition, x0=x0, t1=1.0, num_steps=num_steps, **settings)


def heat(num_modes: int, num_steps: int, decay: float) -> nb.GuidedBridge:
    frequencies = (np.arange(2 * num_modes + 1) + 1) // 2
    coarse = nb.FourierBasis(8, 1)
    x0, v = (jnp.zeros(2 * num_modes + 1).at[:17].set(curve) for curve in curves(coarse))
    spectrum = (1.0 + frequencies**2.0) ** -decay
    sde = nb.LinearSDE(-(0.5 + 0.1 * frequencies**2), np.sqrt(spectrum))
    return nb.GuidedBridge(
        sde, nb.InexactMatch(0.01, normalised=False).at(v), x0=x0, t1=1.0, num_steps=num_steps
    )


def seconds_of(f, z) -> tuple[float, np.ndarray]:
    program = jax.jit(lambda z: jax.lax.map(f, z, batch_size=25)).lower(z).compile()
    program(z)
    began = time.perf_counter()
    result = np.asarray(program(z))
    return time.perf_counter() - began, result


def show_heat(quick: bool) -> None:
    sizes = (16, 64) if quick else (16, 32, 64, 128, 256, 512, 1024, 4096)
    for decay in (1.0, 2.0):
        finest = heat(max(sizes), 1, decay)
        limit = float(finest.log_weight(still(finest)[0]))
        for num_modes in sizes:
            rows = {}
            for num_steps in (1, 20):
                bridge = heat(num_modes, num_steps, decay)
                seconds, found = seconds_of(bridge.log_weight, still(bridge))
                rows[num_steps] = seconds, float(found[0])
            n = np.arange(num_modes + 1, max(sizes) + 1)
            left = np.sum((1.0 + n**2.0) ** -decay / (0.5 + 0.1 * n**2) / 0.01)
            row = {"case": "heat", "decay": decay, "modes": num_modes, "log_evidence": rows[1][1]}
            row |= {"less_limit": rows[1][1] - limit, "left_of_trace": float(left)}
            row |= {
                "one_step_less_20": rows[1][1] - rows[20][1],
                "seconds_20_steps": round(rows[20][0], 4),
            }
            print(json.dumps(row), flush=True)


def still(bridge):
    return jnp.zeros((1, *bridge.noise_shape))


def show_allen_cahn(quick: bool) -> None:
    resolutions = [(4, 100), (16, 100), (64, 100), (256, 100), (64, 50), (64, 200), (64, 400)]
    rows = [(*row, "euler") for row in resolutions]
    rows += [(64, num_steps, "midpoint") for num_steps in (25, 50, 100, 400)]
    num_particles = 100 if quick else 8000
    for num_modes, num_steps, scheme in rows[:2] if quick else rows:
        bridge = allen_cahn(num_modes, num_steps, scheme)
        z = jr.normal(jr.key(0), (num_particles, *bridge.noise_shape))
        seconds, log_weights = seconds_of(bridge.log_weight, z)
        row = {
            "case": "allen_cahn",
            "functions": 2 * num_modes + 1,
            "steps": num_steps,
            "scheme": scheme,
        }
        print(json.dumps(row | quality(log_weights) | {"seconds": round(seconds, 2)}), flush=True)
    for guide, num_particles in ((nb.FrozenGuide(rounds=2), 4000), (nb.Unguided(), 1_000_000)):
        bridge = allen_cahn(4, 100, variance=0.1, guide=guide)
        estimate = nb.estimate_evidence(bridge, jr.key(1), 2000 if quick else num_particles)
        row = {
            "case": "allen_cahn, variance 0.1",
            "functions": 9,
            "steps": 100,
            "guide": type(guide).__name__,
        }
        print(json.dumps(row | quality(estimate.log_weights)), flush=True)


def quality(log_weights) -> dict:
    weights = jnp.asarray(log_weights)
    row = {
        "log_evidence": nb.weights.log_mean_exp(weights),
        "standard_error": nb.weights.standard_error(weights),
    }
    row |= {"ess_percent": 100 * nb.weights.effective_sample_size(weights) / len(weights)}
    row |= {"pareto_k": nb.weights.pareto_k(weights), "sd": jnp.std(weights)}
    return {name: round(float(value), 4) for name, value in row.items()}


CASES = {"heat": show_heat, "allen_cahn": show_allen_cahn}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--cases", nargs="*", choices=CASES, default=list(CASES))
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    for name in arguments.cases:
        CASES[name](arguments.quick)
