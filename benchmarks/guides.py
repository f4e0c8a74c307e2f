"""How good is a guide? Spread of the log weight, evidence and time, for each guide on simulated,
real and small cases.

    python benchmarks/guides.py [--quick] [--particles 2000]
                                [--cases kunita wing butterflies cell gbm rounds]

One JSON line per case and guide: mean and SD of the log weight, log evidence and its standard
error, ESS in percent, k̂ and whether the evidence is to be trusted, seconds of a run without
compilation, and seconds per effective particle. A standard error is infinite where it is not;
`spread` is that of the weights drawn alone, sd(w)/(mean(w) √S). `reference` is a log evidence from
elsewhere: a closed form, or a long run. All in double precision.

The simulated Kunita cases and the butterflies are read from the folder of data sets,
`NUMPYRO_BRIDGES_DATA` or `../shared/data`.
"""

import argparse
import json
import os
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from semilinear import allen_cahn

import numpyro_bridges as nb

GUIDES = {
    "FrozenGuide()": (nb.FrozenGuide(), None),
    "RecedingGuide()": (nb.RecedingGuide(), None),
    "RecedingGuide(0.1)": (nb.RecedingGuide(0.1), None),
    "GeodesicGuide()": (nb.GeodesicGuide(), None),
    "GeodesicGuide(end_weight=0)": (nb.GeodesicGuide(end_weight=0.0), None),
    "GeodesicGuide(end_weight=0.1)": (nb.GeodesicGuide(end_weight=0.1), None),
    "DriftGuide(RecedingGuide())": (nb.DriftGuide(nb.RecedingGuide()), None),
    "FrozenGuide(), continuous Euler weight": (nb.FrozenGuide(), diffrax.Euler()),
}
CONSTANT = {
    "FrozenGuide()": (nb.FrozenGuide(), None),
    "FrozenGuide(BrownianMotion)": (nb.FrozenGuide(nb.BrownianMotion(0.01)), None),
    "DriftGuide(FrozenGuide())": (nb.DriftGuide(nb.FrozenGuide()), None),
    "FrozenGuide(), continuous Euler weight": (nb.FrozenGuide(), diffrax.Euler()),
}


FROZEN = {f"FrozenGuide(rounds={r})": (nb.FrozenGuide(rounds=r), None) for r in range(4)}
RECEDING = {f"RecedingGuide(rounds={r})": (nb.RecedingGuide(rounds=r), None) for r in range(3)}


FOLDER = Path(os.environ.get("NUMPYRO_BRIDGES_DATA", Path(__file__).parents[2] / "shared" / "data"))


def found(case: str, file: Path) -> bool:
    """Whether a file is there; says what to do where it is not."""
    if not file.is_file():
        print(json.dumps({"case": case, "skipped": f"no {file}: set NUMPYRO_BRIDGES_DATA"}))
    return file.is_file()


def kunita():
    """Three simulated ends of a strongly nonlinear flow: 16 landmarks, observation SD 0.032."""
    file = FOLDER / "kunita_cases" / "kunita_cases.npz"
    if not found("kunita", file):
        return
    data = np.load(file)
    space = nb.Landmarks(16, 2, weights=1.0)
    flow = nb.KunitaFlow(
        space, covariance=nb.MaternKernel(0.1, 0.25, order=4), noise=nb.LandmarkNoise(jitter=1e-5)
    )
    match = nb.InexactMatch(1e-3)
    for i, (target, reference) in enumerate(
        zip(data["edge_targets"], (24.75, 16.40, 9.65), strict=True)
    ):
        setting = {"x0": data["root"], "t1": 1.0, "num_steps": 100}
        yield f"kunita {i}", flow, match.at(target), setting, reference, GUIDES


def wing():
    """From one wing of a genus to another: 32 points, observation SD 0.005 per point coordinate."""
    wings = nb.datasets.mosquito_wings(32, "CX")
    space = nb.Landmarks(32, 2)
    flow = nb.KunitaFlow(space, nb.GaussianKernel(0.1, 0.4))
    match = nb.InexactMatch.from_point_sd(0.005, space)
    setting = {"x0": wings.points[0], "t1": 1.0, "num_steps": 50}
    yield "wing", flow, match.at(wings.points[1]), setting, None, GUIDES


def butterflies():
    """From the outline of one species to another's, 64 points, at two amplitudes."""
    shapes = []
    for species in ("honrathi", "polytes"):
        file = FOLDER / "papilio" / f"outline_{species}_anchored.csv"
        if not found("butterflies", file):
            return
        outline = np.loadtxt(file, delimiter=",", skiprows=1, usecols=(3, 4))
        shapes.append(outline[np.round(np.arange(64) * len(outline) / 64).astype(int)])
    x0, v = nb.shapes.procrustes_align(np.stack(shapes)).shapes
    space = nb.Landmarks(64, 2)
    match = nb.InexactMatch(0.02**2 / 32)
    setting = {"x0": x0, "t1": 1.0, "num_steps": 40}
    for amplitude in (0.1, 0.2):
        flow = nb.KunitaFlow(space, nb.GaussianKernel(amplitude, 0.3))
        yield f"butterflies {amplitude}", flow, match.at(v), setting, None, GUIDES


def cell():
    """A bistable drift, constant noise, exact end; the reference is for 400 uniform Euler steps."""

    def u(y):
        return y**4 / (1 / 16 + y**4)

    def drift(t, x, args):
        a, b = u(x)
        return jnp.stack([a + 1 - b, b + 1 - a]) - x

    sde = nb.SDE(drift, lambda t, x, args: 0.1)
    setting = {"x0": [0.1, -0.1], "ts": np.linspace(0.0, 4.0, 401)}
    yield "cell", sde, nb.ExactMatch().at([2.0, -0.1]), setting, 1.4258, CONSTANT


def gbm():
    """Geometric Brownian motion, exact end; the reference is the closed form of the SDE."""
    sde = nb.SDE(lambda t, x, args: 0.1 * x, lambda t, x, args: 0.4 * x)
    setting = {"x0": [1.0], "t1": 1.0, "num_steps": 50}
    yield "gbm", sde, nb.ExactMatch().at([1.5]), setting, -0.872436, GUIDES


def rounds():
    """Drifts that are not linear, linearised at the end or along a path."""
    field = allen_cahn(16, 50)
    setting = {"x0": field.x0, "t1": 1.0, "num_steps": 50}
    yield "Allen–Cahn", field.sde, field.condition, setting, None, FROZEN
    for _, sde, condition, setting, reference, _ in cell():
        yield "cell", sde, condition, setting, reference, FROZEN
    well = nb.SDE(lambda t, x, args: -12 * x * (x * x - 1), lambda t, x, args: 1.0)
    setting = {"x0": [-1.0], "ts": np.linspace(0, 1, 501)}
    yield "double well", well, nb.ExactMatch().at([1.0]), setting, -4.590, FROZEN
    sine = nb.SDE(lambda t, x, args: 2 - 2 * jnp.sin(8 * x), lambda t, x, args: 0.5)
    setting = {"x0": [0.0], "ts": np.linspace(0, 1, 201)}
    yield "sine", sine, nb.ExactMatch().at([np.pi / 2]), setting, None, FROZEN

    def predation(t, x, args):
        prey, predators = x
        return jnp.stack([prey * (1 - predators), predators * (prey - 1)])

    volterra = nb.SDE(predation, lambda t, x, args: 0.3 * x)
    setting = {"x0": [0.5, 0.5], "t1": 5.0, "num_steps": 200}
    yield (
        "predator and prey",
        volterra,
        nb.InexactMatch(0.01).at([2.0, 1.0]),
        setting,
        None,
        RECEDING,
    )
    logistic = nb.SDE(lambda t, x, args: 2 * x * (1 - x / 2), lambda t, x, args: 0.4 * x)
    setting = {"x0": [0.3], "t1": 2.0, "num_steps": 100}
    yield "logistic growth", logistic, nb.ExactMatch().at([2.5]), setting, None, RECEDING


CASES = {
    "kunita": kunita,
    "wing": wing,
    "butterflies": butterflies,
    "cell": cell,
    "gbm": gbm,
    "rounds": rounds,
}


def measure(bridge, num_particles: int) -> dict:
    seconds = []
    for _ in range(3):
        start = time.perf_counter()
        estimate = nb.estimate_evidence(bridge, jr.key(0), num_particles)
        seconds.append(time.perf_counter() - start)
    run = min(seconds[1:])
    log_weights, ess = estimate.log_weights, float(estimate.ess)
    return {
        "mean": round(float(log_weights.mean()), 3),
        "sd": round(float(log_weights.std()), 3),
        "log_evidence": round(float(estimate.log_evidence), 4),
        "standard_error": round(float(estimate.standard_error), 4),
        "spread": round(float(np.sqrt(max(num_particles / ess - 1, 0.0) / (num_particles - 1))), 4),
        "ess_percent": round(100 * ess / num_particles, 2),
        "pareto_k": round(estimate.pareto_k, 2),
        "trusted": estimate.trusted,
        "seconds": round(run, 2),
        "compile_seconds": round(seconds[0] - run, 2),
        "milliseconds_per_effective_particle": round(1000 * run / ess, 2),
        "num_particles": num_particles,
        "jax": jax.__version__,
        "device": jax.devices()[0].device_kind,
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="50 particles")
    parser.add_argument("--particles", type=int, default=2000)
    parser.add_argument("--cases", nargs="*", choices=CASES, default=list(CASES))
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    particles = 50 if arguments.quick else arguments.particles
    for case in arguments.cases:
        for name, sde, condition, setting, reference, guides in CASES[case]():
            for guide_name, (guide, solver) in guides.items():
                bridge = nb.GuidedBridge(sde, condition, guide=guide, solver=solver, **setting)
                row = {
                    "case": name,
                    "guide": guide_name,
                    "reference": reference,
                    **measure(bridge, particles),
                }
                print(json.dumps(row), flush=True)
