"""How well is the score of Brownian motion between shapes learned, and how fast, beside the
published recipe?

    python benchmarks/score_table.py [--quick] [--cells landmarks-8 fourier-32]
                                     [--conditions exact inexact]
                                     [--methods reversal adjoint residual]
                                     [--epochs 10] [--output DIR]
    python benchmarks/score_table.py --freeze FILE [--budget SECONDS]    # the reference's curves

The published table (Baker, Yang, Severinsen, Hipsley and Sommer 2024): the unit circle is start and
target, T = 1, dX = 0.1 dW in every coordinate, 100 steps of one length. N landmarks, or the 2N + 1
real functions of `FourierBasis(N, 2)` (published: N complex numbers a coordinate). The inexact
condition has a point SD of 0.05: its variance is 0.0025 for each coordinate of a landmark, or each
coefficient.

One JSON line per cell, condition, method and setting (rows that DIR already has of others are
kept):

- `published_rmse`: root mean square of trained minus true score at x = x0 = target, over times,
  points and coordinates. The true score is 0 there, so a network that says 0 has none.
- `error`: E|s − s*|²_a / E|s*|²_a, over times and paths from the target run backwards, which are
  the law that score matching is trained on; `error_on_bridges`: the same over bridges. s* = (v −
  x)/(σ² (T − t) + noise variance). Fourier scores are compared on 100 points of the curve.
- `seconds`: updates and looks at held-out paths, without compilation; `cpu_seconds`: of the
  processor, which says more where several programs share it. `steps_per_second`: trajectories ×
  steps used, by `cpu_seconds`.
- `reference`: the published recipe in the same run: its throughput, its seconds for all the epochs
  of the published table, and its error when it has trained for as long as the row's. The mirror
  image of its pass over unconditioned paths from the target is `method="adjoint"`, as Brownian
  motion and its adjoint are one process; so it is that method, with the published network,
  schedule, batches and one-step targets, and no guide. Its input is standardised and its output is
  in units of 1/σ, as for every network here: it learns faster so than from the raw state to the raw
  score, whose error was still 0.99 after 15 epochs at 8 landmarks. `score_table_reference.json` has
  its curves as they were frozen before anything else was tuned: 0.36 after 40 epochs at 8
  landmarks. The published rate is small: with `--rate 1e-3` the same recipe has 0.11 after 20
  epochs and 0.044 after 40.

Settings: `guide` corrects the default guide, which is the true score here, so it shows only that
training spoils nothing; `nothing` learns all of the score with `Unguided()` and a network whose
singular part near the end is `Singular`. "residual" has the first setting only.
"""

import argparse
import json
import operator
import os
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

import numpyro_bridges as nb

SIGMA, NUM_STEPS, POINT_SD = 0.1, 100, 0.05
TIMES = np.linspace(0.0, 1.0, NUM_STEPS + 1)
EPOCHS = {  # as published
    "landmarks-8": 100,
    "landmarks-16": 100,
    "landmarks-32": 100,
    "fourier-8": 100,
    "fourier-16": 150,
    "fourier-32": 300,
}
METHODS = ("reversal", "adjoint", "residual")
UPDATES_PER_EPOCH = 40


class Cell:
    """One bridge, its true score, and how scores are compared."""

    def __init__(self, name: str, condition: str):
        kind, size = name.split("-")
        self.name, self.condition_name, self.num_bases = name, condition, int(size)
        s = np.linspace(0, 2 * np.pi, self.num_bases, endpoint=False)
        if kind == "landmarks":
            space, self.on_curve = nb.Landmarks(self.num_bases, 2, weights=1.0), None
            circle = np.stack([np.cos(s), np.sin(s)], axis=1)
        else:
            space = nb.FourierBasis(self.num_bases, 2)
            self.on_curve = jnp.asarray(space.basis(np.linspace(0, 2 * np.pi, 100, endpoint=False)))
            circle = np.zeros((space.size, 2))
            circle[1, 0] = circle[2, 1] = np.sqrt(0.5)
        match = (
            nb.ExactMatch()
            if condition == "exact"
            else nb.InexactMatch.from_point_sd(POINT_SD, space)
        )
        self.target = jnp.asarray(circle)
        self.variance = jnp.asarray(0.0 if condition == "exact" else POINT_SD**2)
        self.problem = {
            "sde": nb.BrownianMotion(SIGMA**2, space=space),
            "condition": match.at(circle),
            "x0": circle,
            "ts": TIMES,
        }
        problem = dict(self.problem)
        self.bridge = nb.GuidedBridge(problem.pop("sde"), problem.pop("condition"), **problem)
        self.paths = {
            "error": self._backwards(jr.key(11)),
            "error_on_bridges": self._bridges(jr.key(12)),
        }

    def _backwards(self, key, num_paths: int = 64):
        """Unconditioned paths from the datum, at all times but the last, `(num_paths, K, n, 2)`."""
        key_start, key = jr.split(key)
        steps = SIGMA * jnp.sqrt(jnp.diff(TIMES))[:, None, None]
        start = jnp.sqrt(self.variance) * jr.normal(key_start, (num_paths, 1, *self.target.shape))
        moves = steps * jr.normal(key, (num_paths, NUM_STEPS, *self.target.shape))
        return self.target + (start + jnp.cumsum(moves, axis=1))[:, ::-1]

    def _bridges(self, key, num_paths: int = 64):
        return jax.vmap(self.bridge.path)(jr.normal(key, (num_paths, *self.bridge.noise_shape)))[
            :, :-1
        ]

    def errors(self, guide) -> dict[str, float]:
        # its history grows: compiled once without
        guide = nb.ScoreGuide(guide.guide, guide.network, guide.standard)
        found = _errors(guide, self.bridge, self.paths, self.on_curve, self.variance)
        return {name: float(value) for name, value in found.items()}


@eqx.filter_jit
def _errors(guide, bridge, paths, on_curve, variance):
    bridge, times = bridge.with_guide(guide), jnp.asarray(TIMES[:-1])
    target = bridge.x0

    def squares(t, x):
        true = (target - x) / (SIGMA**2 * (1 - t) + variance)
        pair = jnp.stack([bridge.score(t, x) - true, true])
        if on_curve is not None:
            pair = jnp.einsum("qn,pnd->pqd", on_curve, pair)
        return jnp.mean(pair**2, axis=(1, 2))

    found = {}
    for name, x in paths.items():
        wrong, size = jnp.mean(jax.vmap(jax.vmap(squares), (None, 0))(times, x), axis=(0, 1))
        found[name] = wrong / size
    at_target = jax.vmap(lambda t: squares(t, target)[0])(times)
    return found | {"published_rmse": jnp.sqrt(jnp.mean(at_target))}


class Enough(Exception):
    """The time is over."""


class Watch:
    """Errors against training time, the time of the errors' evaluation apart; stops at a number of
    seconds.
    """

    def __init__(self, cell: Cell, name: str, most: float = np.inf):
        self.cell, self.name, self.most = cell, name, most
        self.curve: list[dict] = []
        self.spent, self.updates = np.zeros(2), 0
        self.stamp = np.zeros(2)

    def __call__(self, name, guide):
        now = np.array([time.perf_counter(), time.process_time()])
        update = int(guide.history["update"][-1])
        if update > 0:
            self.spent = self.spent + now - self.stamp
            self.updates += update - int(guide.history["update"][-2])
        if name == self.name:
            row = {
                "updates": self.updates,
                "seconds": float(self.spent[0]),
                "cpu_seconds": float(self.spent[1]),
            }
            self.curve.append(row | self.cell.errors(guide))
        if self.spent[1] > self.most:
            raise Enough
        self.stamp = np.array([time.perf_counter(), time.process_time()])


def reference(cell: Cell, epochs: int, rate: float, budget: float) -> Watch:
    """The published recipe, for at most `budget` seconds of the processor."""
    network = nb.scores.UNet.published(cell.target.shape, cell.num_bases, key=jr.key(0))
    recipe = nb.scores.Training.published(epochs, rate)
    training = nb.scores.Training(
        recipe.num_updates,
        recipe.batch_size,
        optimizer=recipe.optimizer,
        average=recipe.average,
        interval=UPDATES_PER_EPOCH,
        held_out=1,  # it has no use for looks
        patience=recipe.patience,
        one_step=recipe.one_step,
    )
    watch = Watch(cell, "adjoint", budget)
    try:
        nb.scores.fit(
            **cell.problem,
            key=jr.key(1),
            method="adjoint",
            guide=nb.Unguided(),
            network=network,
            training=training,
            progress=False,
            watch=watch,
        )
    except Enough:
        pass
    return watch


def freeze(file: Path, cells, conditions, epochs, rate: float, budget: float):
    """The reference's curves over time, one cell after the other."""
    record: dict[str, Any] = json.loads(file.read_text()) if file.exists() else {"curves": {}}
    record |= {
        "recipe": "UNet.published, Training.published of numpyro_bridges.scores, adjoint, Unguided",
        "jax": jax.__version__,
        "equinox": eqx.__version__,
        "machine": "2 CPU cores, one used; float32",
    }
    for condition in conditions:
        for name in cells:
            cell = Cell(name, condition)
            watch = reference(cell, epochs or EPOCHS[name], rate, budget)
            rows = [{k: float(f"{v:.5g}") for k, v in row.items()} for row in watch.curve]
            columns = {k: [row[k] for row in rows] for k in rows[0]}
            record["curves"][f"{name} {condition}"] = {
                "epochs_of_schedule": epochs or EPOCHS[name]
            } | columns
            file.write_text(json.dumps(record))
            print(json.dumps({"cell": name, "condition": condition, **rows[-1]}), flush=True)


def train(cell: Cell, method: str, setting: str, num_updates: int) -> dict:
    """One of ours."""
    training = nb.scores.Training(num_updates, interval=min(100, num_updates))
    network = None
    if setting == "nothing":
        key_network, key_gain = jr.split(jr.key(2))
        network = nb.scores.Singular(
            nb.scores.MLP((cell.target.shape[0], 2), key=key_network), key=key_gain
        )
    watch = Watch(cell, method)
    begin = time.perf_counter()
    guide = nb.scores.fit(
        **cell.problem,
        key=jr.key(3),
        method=method,
        guide=nb.Unguided() if setting == "nothing" else None,
        network=network,
        training=training,
        progress=False,
        watch=watch,
    )
    total = time.perf_counter() - begin
    seconds, cpu = watch.spent
    found = cell.errors(guide)
    return {
        "cell": cell.name,
        "condition": cell.condition_name,
        "method": method,
        "setting": setting,
        **found,
        "updates": watch.updates,
        "seconds": seconds,
        "cpu_seconds": cpu,
        "with_compilation": total,
        "jax": jax.__version__,
        "device": jax.devices()[0].device_kind,
        "steps_per_second": watch.updates * training.batch_size * NUM_STEPS / cpu,
        "curve": [*watch.curve, {**watch.curve[-1], **found}],
    }


def beside(row: dict, watch: Watch, epochs: int) -> dict:
    """The row, and the reference's time and error."""
    last = watch.curve[-1]
    times = {clock: [r[clock] for r in watch.curve] for clock in ("seconds", "cpu_seconds")}
    whole = {clock: last[clock] / last["updates"] * UPDATES_PER_EPOCH * epochs for clock in times}
    after = {
        name: float(
            np.interp(row["cpu_seconds"], times["cpu_seconds"], [r[name] for r in watch.curve])
        )
        for name in ("error", "error_on_bridges", "published_rmse")
    }
    speed = last["updates"] * 50 * NUM_STEPS / last["cpu_seconds"]
    return row | {
        "reference": {
            "after_the_same_cpu_seconds": after,
            "epochs": epochs,
            "seconds": whole["seconds"],
            "cpu_seconds": whole["cpu_seconds"],
            "steps_per_second": speed,
        },
        "cpu_seconds_over_reference": row["cpu_seconds"] / whole["cpu_seconds"],
        "seconds_over_reference": row["seconds"] / whole["seconds"],
        "throughput_over_reference": row["steps_per_second"] / speed,
    }


def rounded(value):
    if isinstance(value, dict):
        return {k: rounded(v) for k, v in value.items()}
    return float(f"{value:.4g}") if isinstance(value, float) else value


def plot(rows, references, path):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    columns = min(3, len(references))
    lines = -(-len(references) // columns)
    figure, axes = plt.subplots(
        lines, columns, figsize=(3.6 * columns, 2.6 * lines), sharey=True, squeeze=False
    )
    for axis, (name, curve) in zip(axes.flat, references.items(), strict=False):
        axis.plot(
            [r["cpu_seconds"] for r in curve],
            [r["error"] for r in curve],
            "k.-",
            label="published recipe",
        )
        for row in rows:
            if f"{row['cell']} {row['condition']}" == name and row["setting"] == "nothing":
                spent = [r["cpu_seconds"] for r in row["curve"]]
                axis.plot(
                    spent,
                    [r["error"] for r in row["curve"]],
                    ".-",
                    label=f"{row['method']}, from nothing",
                )
        axis.axhline(0.01, color="0.7", lw=0.8)
        axis.set(xscale="log", yscale="log", title=name)
        axis.title.set_fontsize(8)
        axis.tick_params(labelsize=7)
    axes.flat[0].legend(fontsize=6)
    for axis in axes.flat[len(references) :]:
        axis.remove()
    figure.supxlabel("seconds of the processor, training only", fontsize=8)
    figure.supylabel("relative squared error of the score", fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=130)


def main(arguments):
    arguments.output.mkdir(parents=True, exist_ok=True)
    file = arguments.output / "score_table.json"
    record = json.loads(file.read_text()) if file.exists() else {"rows": [], "references": {}}
    key = operator.itemgetter("cell", "condition", "method", "setting")
    for condition in arguments.conditions:
        for name in arguments.cells:
            cell, epochs = Cell(name, condition), arguments.epochs or EPOCHS[name]
            found = [
                train(cell, method, setting, arguments.updates)
                for setting in arguments.settings
                for method in arguments.methods
                if (method, setting) != ("residual", "nothing")
            ]
            if not arguments.without_reference:
                watch = reference(
                    cell, epochs, arguments.rate, max(row["cpu_seconds"] for row in found)
                )
                record["references"][f"{name} {condition}"] = watch.curve
                found = [beside(row, watch, epochs) for row in found]
            for row in found:
                record["rows"] = [r for r in record["rows"] if key(r) != key(row)] + [row]
                print(
                    json.dumps(rounded({k: v for k, v in row.items() if k != "curve"})), flush=True
                )
            file.write_text(json.dumps(record))
            if record["references"]:
                plot(**record, path=arguments.output / "score_table.png")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="one small cell")
    parser.add_argument("--cells", nargs="+", choices=EPOCHS, default=list(EPOCHS))
    parser.add_argument(
        "--conditions", nargs="+", choices=("exact", "inexact"), default=["exact", "inexact"]
    )
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument(
        "--settings", nargs="+", choices=("guide", "nothing"), default=["nothing", "guide"]
    )
    parser.add_argument("--updates", type=int, default=400, help="of ours, at most")
    parser.add_argument(
        "--epochs", type=int, help="of the reference's schedule; as published by default"
    )
    parser.add_argument(
        "--rate", type=float, default=1e-4, help="the reference's largest learning rate"
    )
    parser.add_argument("--without-reference", action="store_true", help="ours alone")
    parser.add_argument(
        "--freeze", type=Path, help="write the reference's curves here, and nothing else"
    )
    parser.add_argument(
        "--budget", type=float, default=np.inf, help="seconds of the reference's training in a cell"
    )
    parser.add_argument("--output", type=Path, default=Path("output"))
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.cells, arguments.conditions, arguments.methods = (
            ["landmarks-2"],
            ["exact"],
            ["adjoint"],
        )
        arguments.settings, arguments.updates, arguments.epochs = ["nothing"], 20, 1
    if arguments.freeze:
        freeze(
            arguments.freeze,
            arguments.cells,
            arguments.conditions,
            arguments.epochs,
            arguments.rate,
            arguments.budget,
        )
    else:
        main(arguments)
