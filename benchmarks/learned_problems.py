"""Where do learned guides help? The problems of the literature, each with unbiased evidence, ESS
and k̂.

    python benchmarks/learned_problems.py                        # all: some hours
    python benchmarks/learned_problems.py --problem double-well --method guided matching
    python benchmarks/learned_problems.py --quick

One JSON line for each problem and method:

- `log_evidence`, `standard_error`, `ess_percent`, `pareto_k`, `trusted`: of `--particles` paths;
  `reference`: the log evidence of the same Euler chain by a referee outside the package, where
  there is one, and `errors_off`, how many joint standard errors lie between them.
- `kl`, `kl_error`: ½ E Σ |b* − b|²_a⁻¹ dt over the steps but the last and paths of the exact
  h-transform, where h is known, as in the literature.
- `seconds` of training (updates and clouds, compilation apart), `updates`, `training_wall`,
  `run_seconds` of the paths, `seconds_per_effective` of these, and `paid_after`, the number of
  effective paths from which training has paid for itself against the best row of the problem
  without training that is to be trusted: null where it never does, 0 where there is no such row.

Referees: quadrature of the Euler chain in one and two dimensions (`chain`), closed forms of linear
processes, and receding guides for landmarks, as given with the cases.
"""

import argparse
import json
import os
import time
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from scipy.ndimage import map_coordinates

import numpyro_bridges as nb
from numpyro_bridges.scores import Training, fit

METHODS = ("guided", "brownian", "residual", "matching", "adjoint", "reversal")
ALL = METHODS[2:]
CASES = Path(os.environ.get("NB_CASES", "data"))


class Truth(NamedTuple):
    """What a referee knows: log p, and paths of the exact h-transform with ∇log h on them, but for
    the last step. `error`: of a referee that is an estimate too.
    """

    log_evidence: float
    paths: np.ndarray | None = None
    scores: np.ndarray | None = None
    error: float = 0.0


class Case(NamedTuple):
    """A bridge, the guide that is corrected, the methods that suit it, and what is known."""

    bridge: nb.GuidedBridge
    truth: Callable[[], Truth] | None = None
    methods: tuple[str, ...] = ALL
    base: Any = None
    batch_size: int = 64
    width: int | None = None  # of an MLP in place of the default network


# Referees.


def chain(drift, sigma, x0, v, ts, low, high, spacing, num_paths=0) -> Truth:
    """h of an Euler chain to an exact end on a grid: h_k(x) = (N(0, σ² dt I) * h_{k+1})(x + b dt),
    in NumPy.

    The convolution is exact to rounding where the spacing is at most half a step's SD; ln h is
    interpolated by cubics.
    """
    axes = [np.arange(a, b + spacing, spacing) for a, b in zip(low, high, strict=True)]
    x = np.stack(np.meshgrid(*axes, indexing="ij"))
    v = np.reshape(v, (-1, *[1] * (x.ndim - 1)))
    dts, b = np.diff(ts), drift(x)
    variance = sigma**2 * dts[-1]
    ahead = x + dts[-1] * b
    log_h = -0.5 * np.sum((v - ahead) ** 2, 0) / variance - 0.5 * len(x) * np.log(
        2 * np.pi * variance
    )
    levels = [log_h]
    assert np.allclose(dts, dts[0])  # one kernel for all steps
    dt = dts[0]
    kernels = [np.exp(-0.5 * (axis[:, None] - axis) ** 2 / (sigma**2 * dt)) for axis in axes]
    kernels = [kernel * spacing / np.sqrt(2 * np.pi * sigma**2 * dt) for kernel in kernels]
    for _ in dts[1:]:
        top = log_h.max()
        smooth = np.exp(np.maximum(log_h - top, -700))
        for i, kernel in enumerate(kernels):
            smooth = np.moveaxis(np.tensordot(kernel, smooth, (1, i)), 0, i)
        smooth = np.log(np.maximum(smooth, 1e-305)) + top
        log_h = interpolate(smooth, x + dt * b, low, spacing)
        if num_paths:
            levels.append(log_h)
    at = np.reshape(np.asarray(x0, float), (-1, 1))
    log_p = float(interpolate(log_h, at, low, spacing)[0])
    if not num_paths:
        return Truth(log_p)
    random, states, paths, scores = np.random.default_rng(0), np.repeat(at, num_paths, 1), [], []
    for dt, level in zip(dts[:-1], levels[:0:-1], strict=True):
        slopes = np.stack([np.gradient(level, spacing, axis=i) for i in range(len(x))])
        score = np.stack([interpolate(slope, states, low, spacing) for slope in slopes])
        paths.append(states.T)
        scores.append(score.T)
        noise = random.standard_normal(states.shape)
        states = states + dt * (drift(states) + sigma**2 * score) + sigma * np.sqrt(dt) * noise
    end = np.broadcast_to(v.reshape(1, -1), states.T.shape)
    return Truth(log_p, np.stack([*paths, states.T, end], 1), np.stack(scores, 1))


def interpolate(values, x, low, spacing):
    """At x `(d, ...)`, by cubic splines, constant beyond the grid."""
    index = (x - np.reshape(low, (-1, *[1] * (x.ndim - 1)))) / spacing
    return map_coordinates(values, index, order=3, mode="nearest")


# Problems.


def double_well(quick) -> Iterator[tuple[str, Case]]:
    """dX = −V'(X) dt + dW, V = 3 (x² − 1)², from 1 to −1; 500 uniform steps."""
    ts = np.linspace(0, 1, 51 if quick else 501)
    sde = nb.SDE(lambda t, x, args: -12 * x * (x * x - 1), lambda t, x, args: 1.0)
    bridge = nb.GuidedBridge(sde, nb.ExactMatch().at([-1.0]), x0=[1.0], ts=ts)

    def truth():
        return chain(
            lambda x: -12 * x * (x * x - 1), 1.0, [1.0], [-1.0], ts, [-2.6], [2.6], 0.004, 1000
        )

    yield "double-well", Case(bridge, truth)


MINIMA = [-0.558223634633, 1.441725841804], [0.623499404931, 0.028037758528]


def mueller_brown_gradient(x, xp):
    """∇V of Müller and Brown (1979), x `(2, ...)`."""
    A, a, b, c = [-200, -100, -170, 15], [-1, -1, -6.5, 0.7], [0, 0, 11, 0.6], [-10, -10, -6.5, 0.7]
    p, q = [1, 0, -0.5, -1], [0, 0.5, 1.5, 1]
    terms = []
    for i in range(4):
        u, w = x[0] - p[i], x[1] - q[i]
        e = A[i] * xp.exp(a[i] * u**2 + b[i] * u * w + c[i] * w**2)
        terms.append(xp.stack([e * (2 * a[i] * u + b[i] * w), e * (b[i] * u + 2 * c[i] * w)]))
    return sum(terms)


def mueller_brown(quick) -> Iterator[tuple[str, Case]]:
    """dX = −∇V dt + 5 dW from one minimum to the other, exact end, time 0.0275, 275 steps.

    The settings of Du et al. (2024), Doob's Lagrangian: kT is 12.5, and the barrier from the start
    106 high.
    """
    sigma, ts = 5.0, np.linspace(0, 0.0275, 276)
    sde = nb.SDE(lambda t, x, args: -mueller_brown_gradient(x, jnp), lambda t, x, args: sigma)
    bridge = nb.GuidedBridge(sde, nb.ExactMatch().at(MINIMA[1]), x0=MINIMA[0], ts=ts)

    def truth():
        low, high = [-2.2, -1.2], [1.8, 2.6]
        return chain(
            lambda x: -mueller_brown_gradient(x, np), sigma, *MINIMA, ts, low, high, 0.02, 500
        )

    yield "mueller-brown", Case(bridge, truth)


def ou(quick) -> Iterator[tuple[str, Case]]:
    """dX = −X dt + dW in d dimensions, guided by Brownian motion; time 1, 100 steps."""
    for d in (1,) if quick else (1, 2, 4, 8, 16, 32):
        exact = nb.GuidedBridge(
            nb.LinearSDE(-1.0, 1.0),
            nb.ExactMatch().at(jnp.full(d, 0.5)),
            x0=jnp.ones(d),
            t1=1.0,
            num_steps=100,
        )

        def truth(exact=exact):
            noise = jr.normal(jr.key(8), (1000, *exact.noise_shape))
            paths = jax.jit(jax.vmap(exact.path))(noise)
            left = 1.0 - np.asarray(exact.ts[:-2])[:, None]
            scores = (
                np.exp(-left)
                * (0.5 - np.exp(-left) * np.asarray(paths)[:, :-2])
                / (-0.5 * np.expm1(-2 * left))
            )
            return Truth(float(exact.log_weight(noise[0])), np.asarray(paths), scores)

        base = nb.FrozenGuide(nb.BrownianMotion(1.0))
        yield f"ou-{d}", Case(exact.with_guide(base), truth, base=base)


def cell(quick) -> Iterator[tuple[str, Case]]:
    """Two genes that excite themselves and inhibit each other, σ = 0.1, time 4, 400 steps; exact
    ends.
    """
    ts = np.linspace(0.0, 4.0, 401)

    def drift(x, xp):
        u = x**4 / (1 / 16 + x**4)
        return xp.stack([u[0] + 1 - u[1] - x[0], u[1] + 1 - u[0] - x[1]])

    sde = nb.SDE(lambda t, x, args: drift(x, jnp), lambda t, x, args: 0.1)
    for name, end in (("cell", [2.0, -0.1]), ("cell-rare", [1.0, -0.1])):
        aux = nb.FrozenGuide(nb.LinearSDE(-1.0, 0.1, jnp.array([end[0], 0.0])))
        bridge = nb.GuidedBridge(sde, nb.ExactMatch().at(end), x0=[0.1, -0.1], ts=ts, guide=aux)

        def truth(end=end):
            return chain(
                lambda x: drift(x, np),
                0.1,
                [0.1, -0.1],
                end,
                ts,
                [-0.5, -0.6],
                [end[0] + 0.9, 1.3],
                0.007,
            )

        yield name, Case(bridge, truth, base=aux)


def sine(quick) -> Iterator[tuple[str, Case]]:
    """dX = (2 − 2 sin 8X) dt + ½ dW from 0 to π/2, guided by Brownian motion; 100 uniform steps."""
    ts, base = np.linspace(0, 1, 101), nb.FrozenGuide(nb.BrownianMotion(0.25))
    sde = nb.SDE(lambda t, x, args: 2 - 2 * jnp.sin(8 * x), lambda t, x, args: 0.5)
    bridge = nb.GuidedBridge(sde, nb.ExactMatch().at([np.pi / 2]), x0=[0.0], ts=ts, guide=base)

    def truth():
        return chain(
            lambda x: 2 - 2 * np.sin(8 * x), 0.5, [0.0], [np.pi / 2], ts, [-2.5], [4.0], 0.01, 1000
        )

    yield "sine", Case(bridge, truth, base=base)


def fitzhugh_nagumo(quick) -> Iterator[tuple[str, Case]]:
    """Its first coordinate, which has no noise of its own, seen with SD 0.1 at −1, and at 1.1,
    which is rare.
    """

    def drift(t, x, args):
        return jnp.stack([(x[0] - x[1] - x[0] ** 3) / 0.1, 1.5 * x[0] - x[1] + 0.8])

    sde = nb.SDE(drift, lambda t, x, args: jnp.array([[0.0], [0.3]]))
    seen = nb.InexactMatch(0.1**2, jnp.array([[1.0, 0.0]]))
    for name, v in (("fitzhugh-nagumo", -1.0), ("fitzhugh-nagumo-rare", 1.1)):
        bridge = nb.GuidedBridge(
            sde, seen.at(jnp.array([v])), x0=[-0.5, -0.6], t1=2.0, num_steps=400
        )
        yield name, Case(bridge, methods=("residual",))


def kunita(quick) -> Iterator[tuple[str, Case]]:
    """A flow from the circle to another closed curve; 50 steps."""
    for n in (8,) if quick else (8, 32, 100):
        s = 2 * np.pi * np.arange(n) / n
        start = np.stack([np.cos(s), np.sin(s)], 1)
        end = np.stack([1.3 * np.cos(s) + 0.1 + 0.05 * np.cos(3 * s), 0.8 * np.sin(s) - 0.2], 1)
        flow = nb.KunitaFlow(nb.Landmarks(n, 2), nb.GaussianKernel(0.3, 0.5))
        bridge = nb.GuidedBridge(
            flow, nb.InexactMatch(0.01 / n).at(end), x0=start, t1=1.0, num_steps=50
        )
        yield (
            f"kunita-{n}",
            Case(bridge, methods=("residual", "matching"), batch_size=16 if n > 8 else 64),
        )


def kunita_hard(quick) -> Iterator[tuple[str, Case]]:
    """Simulated end states of a strongly nonlinear flow: 16 landmarks, observation SD 0.032, 100
    steps.
    """
    file = CASES / "kunita_cases" / "kunita_cases.npz"
    if not file.is_file():
        warnings.warn(f"no {file}: set NB_CASES", stacklevel=1)
        return
    data = np.load(file)
    flow = nb.KunitaFlow(
        nb.Landmarks(16, 2, weights=1.0),
        covariance=nb.MaternKernel(0.1, 0.25, order=4),
        noise=nb.LandmarkNoise(jitter=1e-5),
    )
    # receding guides, as given with the cases
    referees = [(24.75, 0.08), (16.40, 0.09), (9.65, 0.11)]
    for i, (target, (value, error)) in enumerate(zip(data["edge_targets"], referees, strict=True)):
        match = nb.InexactMatch(1e-3).at(target)
        bridge = nb.GuidedBridge(flow, match, x0=data["root"], t1=1.0, num_steps=100)
        yield (
            f"kunita-hard-{i}",
            # of a single bridge: each of 16 landmarks sees all others with an MLP
            Case(
                bridge, partial(Truth, value, error=error), ("residual", "matching"), None, 16, 128
            ),
        )


PROBLEMS = {
    "double-well": double_well,
    "mueller-brown": mueller_brown,
    "ou": ou,
    "cell": cell,
    "sine": sine,
    "fitzhugh-nagumo": fitzhugh_nagumo,
    "kunita": kunita,
    "kunita-hard": kunita_hard,
}


# What is measured.


def network_of(bridge, width):
    """The default network, `None`, or an MLP of this width."""
    if width is None:
        return None
    shape = bridge.x0.reshape(bridge.x0.shape[0], -1).shape
    return nb.scores.MLP(shape, key=jr.key(11), width=width)


def trained(case: Case, method: str, arguments) -> tuple[Any, dict[str, Any]]:
    """The guide after about so many seconds of updates: a short training tells how long an update
    takes.
    """

    def run(training):
        return fit(
            case.bridge.sde,
            case.bridge.condition,
            x0=case.bridge.x0,
            ts=case.bridge.grid,
            guide=case.base,
            key=jr.key(arguments.seed),
            method=method,
            network=network_of(case.bridge, arguments.width or case.width),
            training=training,
            progress=False,
        )

    settings = {"learning_rate": arguments.rate}
    trial = run(Training(40, case.batch_size, interval=20, **settings)).history["seconds"]
    each = float(trial[-1] - trial[-2]) / 20
    passes = 2 if method == "reversal" else 1
    updates = max(int(arguments.seconds / each / passes), 100)
    begin = time.perf_counter()
    interval = max(min(100, updates // 20), 1)
    guide = run(
        Training(
            updates, case.batch_size, interval=interval, patience=10**6, average=0.99, **settings
        )
    )
    history = guide.history
    return guide, {
        "seconds": float(history["seconds"][-1]),
        "updates": updates,
        "training_wall": time.perf_counter() - begin,
        "gain": float(history["gain"]),
        "gain_error": float(history["gain_error"]),
        "kept_guide": type(guide.guide).__name__,
    }


@eqx.filter_jit
def divergences(bridge, paths, scores):
    """½ Σ |b* − b|²_a⁻¹ dt of each path."""
    ts = bridge.shown_ts[:-2]

    def one(path, score):
        gap = bridge.scores(path)[:-1] - score
        a = jax.vmap(bridge.sde.covariance)(ts, path[:-2])
        return 0.5 * jnp.sum(jnp.diff(bridge.shown_ts)[:-1, None] * a.reshape(len(ts), -1) * gap**2)

    return jax.vmap(one)(paths, scores)


def measure(bridge, truth: Truth | None, arguments) -> dict[str, Any]:
    key = jr.key(100 + arguments.seed)
    nb.estimate_evidence(bridge, key, arguments.particles)
    begin = time.perf_counter()
    found = nb.estimate_evidence(bridge, key, arguments.particles)
    run, ess = time.perf_counter() - begin, float(found.ess)
    row = {
        "log_evidence": float(found.log_evidence),
        "standard_error": float(found.standard_error),
        "ess_percent": 100 * ess / arguments.particles,
        "pareto_k": float(found.pareto_k),
        "trusted": found.trusted,
        "run_seconds": run,
        "seconds_per_effective": run / ess,
    }
    if truth is None:
        return row
    joint = np.hypot(row["standard_error"], truth.error)
    off = (row["log_evidence"] - truth.log_evidence) / max(joint, 1e-12)
    row |= {"reference": truth.log_evidence, "errors_off": off if found.trusted else None}
    if truth.paths is None:
        return row
    paths, scores = (jnp.asarray(a, bridge.x0.dtype) for a in (truth.paths, truth.scores))
    kl = np.asarray(divergences(bridge, paths, scores), float)
    return row | {"kl": kl.mean(), "kl_error": kl.std() / np.sqrt(len(kl))}


def show(**row):
    print(
        json.dumps({k: float(f"{v:.5g}") if isinstance(v, float) else v for k, v in row.items()}),
        flush=True,
    )


def main(arguments):
    for problem in arguments.problem:
        for name, case in PROBLEMS[problem](arguments.quick):
            if arguments.case and name not in arguments.case:
                continue
            truth = None if case.truth is None else case.truth()
            cheapest, guides = np.inf, {}
            for method in arguments.method:
                if method in ALL and method not in case.methods:
                    continue
                bridge, extra = case.bridge, {}
                if method == "brownian":
                    if not isinstance(bridge.guide, nb.FrozenGuide):
                        continue
                    bridge = bridge.with_guide(
                        nb.FrozenGuide(nb.BrownianMotion(bridge.sde.covariance(0.0, bridge.x0)))
                    )
                if method in ALL:
                    try:
                        guide, extra = trained(case, method, arguments)
                    except ValueError as error:
                        show(problem=name, method=method, error=str(error))
                        continue
                    guides[method], bridge = guide, bridge.with_guide(guide)
                row = measure(bridge, truth, arguments)
                if method in ALL:
                    saved = cheapest - row["seconds_per_effective"]
                    extra["paid_after"] = extra["seconds"] / saved if saved > 0 else None
                elif row["trusted"]:
                    cheapest = min(cheapest, row["seconds_per_effective"])
                show(problem=name, method=method, **row, **extra)
            if arguments.plot and guides:
                nb.plot.training(guides, arguments.plot / f"{name}.png")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="small problems, a second of training")
    parser.add_argument("--problem", nargs="+", choices=PROBLEMS, default=list(PROBLEMS))
    parser.add_argument(
        "--case", nargs="+", help="of a problem: cell-rare, ou-8 and so on; all by default"
    )
    parser.add_argument(
        "--method", nargs="+", choices=METHODS, default=list(METHODS), help="in this order"
    )
    parser.add_argument("--seconds", type=float, default=60.0, help="of training, for each method")
    parser.add_argument("--rate", type=float, default=5e-3, help="the largest learning rate")
    parser.add_argument(
        "--width", type=int, help="of an MLP of three hidden layers, in place of what a problem has"
    )
    parser.add_argument("--particles", type=int, default=4096)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--plot", type=Path, help="a folder for histories of training")
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.problem, arguments.seconds, arguments.particles = ["double-well"], 1.0, 256
    main(arguments)
