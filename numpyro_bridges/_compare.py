"""Several bridges on one estimand: the same evidence, by different guides, with what each of them costs."""

import itertools
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import PRNGKeyArray

from . import weights
from ._checks import positive_integer, require, require_instance
from ._closed import close
from ._linalg import apply, full_precision
from ._types import RealScalar, State
from .bridges import GuidedBridge
from .plot._comparison import draw_comparison

_SCORE_PATHS = 64
_JOINT_ERRORS = 3.0


@dataclass(frozen=True, repr=False)
class Comparison:
    """What `compare` found. `str` of it is a table with the verdict beneath.

    `rows[name]` holds, as plain numbers,

    - `log_evidence` and its `standard_error`, in nats; `rounding`, the part of an estimate that rounding may account
      for, in nats.
    - `ess`, the effective number of particles, and `ess_fraction`, of all particles.
    - `pareto_k`, −inf where the weights are equal to rounding; `trusted`, whether it is below
      min(1 − 1/log10(num_particles), 0.7) and the estimate and its standard error are finite.
    - `seconds`, the run without compilation, and `training_seconds`; `seconds_per_effective_sample` of the run and
      `seconds_per_effective_sample_with_training` of both.
    - `score_error`, NaN where no score was given.

    What cannot be computed is NaN, and the estimate then not to be trusted.
    """

    num_particles: int
    rows: dict[str, dict[str, float | bool]]

    def agree(self, first: str, second: str) -> bool:
        """Whether two log evidences lie within 3 joint standard errors, and rounding. Says nothing of trust."""
        gap, joint, rounding = self._gap(first, second)
        return bool(gap <= _JOINT_ERRORS * joint + rounding < math.inf)

    @property
    def verdict(self) -> str:
        """A sentence for every pair, on whether they agree, and on what is not to be trusted in it."""
        pairs = list(itertools.combinations(self.rows, 2))
        if not pairs:
            (name,) = self.rows
            return f"{name}: nothing to compare it with.{self._distrust(name)}"
        return "\n".join(self._sentence(*pair) for pair in pairs)

    def to_pandas(self) -> Any:
        """The rows as a `pandas.DataFrame`, indexed by name. `ImportError` without pandas."""
        try:
            import pandas
        except ImportError as error:
            raise ImportError("`to_pandas` needs pandas: pip install pandas. `rows` holds the same.") from error
        return pandas.DataFrame.from_dict(self.rows, orient="index")

    def plot(self, path: Any) -> Any:
        """Log evidences ± 2 standard errors, ESS in percent and seconds per effective sample, written to a file.

        **Arguments:** `path`: where to; matplotlib knows the format by its ending.

        **Returns:** the `Figure`, closed. Grey is not to be trusted. **Errors:** `ImportError` without matplotlib.
        """
        return draw_comparison(self.rows, path)

    def __str__(self) -> str:
        header = ["", "log evidence", "SE", "ESS", "ESS, %", "k̂", "s / ESS", "with training", "score error"]
        table = [header, *([name, *_cells(row)] for name, row in self.rows.items())]
        if all(math.isnan(row["score_error"]) for row in self.rows.values()):
            table = [line[:-1] for line in table]
        rule = f"k̂ must be below {_threshold(self.num_particles):.2f}" if self.num_particles > 1 else "k̂ needs more"
        return "\n".join([*_aligned(table), f"Particles of each: {self.num_particles}; {rule}.", self.verdict])

    __repr__ = __str__

    def _gap(self, first: str, second: str) -> tuple[float, float, float]:
        """The distance of two log evidences, its standard error, and what rounding may account for."""
        a, b = self.rows[first], self.rows[second]
        joint = math.hypot(a["standard_error"], b["standard_error"])
        return abs(a["log_evidence"] - b["log_evidence"]), joint, a["rounding"] + b["rounding"]

    def _sentence(self, first: str, second: str) -> str:
        gap, joint, rounding = self._gap(first, second)
        if not math.isfinite(gap + joint):
            found = f"cannot be compared: they differ by {gap:.2g} ± {joint:.2g}"
        elif gap <= rounding:
            found = "agree to rounding"
        else:
            found = "agree" if self.agree(first, second) else "do not agree"
            errors = gap / joint if joint > 0 else math.inf
            found += f": they differ by {gap:.2g}, or {errors:.1f} joint standard errors"
        return f"{first} and {second} {found}.{self._distrust(first, second)}"

    def _distrust(self, *names: str) -> str:
        doubts = [f"{name} ({self._doubt(name)})" for name in names if not self.rows[name]["trusted"]]
        return f" Not to be trusted: {', '.join(doubts)}." if doubts else ""

    def _doubt(self, name: str) -> str:
        row = self.rows[name]
        if math.isfinite(row["log_evidence"]) and math.isfinite(row["standard_error"]):
            return f"k̂ = {row['pareto_k']:.2f}"
        return f"{row['log_evidence']:.2f} ± {row['standard_error']:.2g}"


def compare(
    bridges: Mapping[str, GuidedBridge],
    key: PRNGKeyArray,
    *,
    num_particles: int = 1024,
    batch_size: int | None = None,
    training_seconds: Mapping[str, float] | None = None,
    score: Callable[[RealScalar, State], State] | None = None,
) -> Comparison:
    """Estimate one evidence by several bridges, and say whether they agree and what each costs.

    **Arguments:**

    - `bridges`: by name; they differ in nothing but their guides, `{"a": bridge, "b": bridge.with_guide(guide)}`.
    - `key`: split, so that the estimates' errors are independent.
    - `num_particles`: number S of paths of each bridge. Of a single one there is no standard error, and no trust.
    - `batch_size`: how many run at once; memory is bounded by it. At most 256 by default.
    - `training_seconds`: by name, seconds spent on training a guide. By default the last entry of
      `guide.history["seconds"]` where the guide has a history, and 0 where it has none.
    - `score`: (t, x) ↦ ∇ log h(t, x), shaped like x, where it is known. The `score_error` of a guide's score s is then

          E ∫ |s − ∇ log h|²_a dt / E ∫ |∇ log h|²_a dt,    |u|²_a = uᵀ a(t, x) u,

      over 64 of the weighted paths (self-normalised) and the steps of the grid, t and x being those at a step's start.

    **Returns:** a `Comparison`. Run times are measured after compilation, one batch after the other.

    **Errors:** `ValueError` where the bridges differ in their SDE, condition, start, grid or solver (the continuous
    weight of a diffrax solver has another expectation): there is then no one number to agree on.
    """
    _check_bridges(bridges)
    training_seconds = {} if training_seconds is None else training_seconds
    unknown = sorted(set(training_seconds) - set(bridges))
    require(not unknown, f"`training_seconds` must be of the bridges {sorted(bridges)}; got {unknown} too.")
    num_particles = positive_integer(num_particles, "num_particles")
    batch_size = min(256, num_particles) if batch_size is None else positive_integer(batch_size, "batch_size")
    rows = {}
    for (name, bridge), key_bridge in zip(bridges.items(), jr.split(key, len(bridges)), strict=True):
        keys = jr.split(key_bridge, num_particles)
        log_weights, seconds = _timed_log_weights(bridge, keys, batch_size)
        trained = float(training_seconds.get(name, _trained_seconds(bridge)))
        error = math.nan if score is None else _checked_score_error(bridge, score, keys[:_SCORE_PATHS])
        rows[name] = _row(bridge, log_weights, seconds, trained) | {"score_error": error}
    return Comparison(num_particles, rows)


def _check_bridges(bridges) -> None:
    require(
        isinstance(bridges, Mapping) and len(bridges) > 0,
        f'`bridges` must be a dictionary of bridges by name, such as {{"guided": bridge}}; got {bridges!r}.',
    )
    for name, bridge in bridges.items():
        require_instance(bridge, GuidedBridge, f"bridges[{name!r}]", "a `GuidedBridge`")
    (first, reference), *others = bridges.items()
    for name, bridge in others:
        for field in ("sde", "condition", "x0", "ts", "solver"):
            mine, theirs = getattr(bridge, field), getattr(reference, field)
            require(
                eqx.tree_equal(mine, theirs),
                f"`bridges` must have one estimand; {name!r} has another `{field}` than {first!r}"
                f"{_words(mine, theirs)}. Make one from the other: `bridge.with_guide(guide)`.",
            )


def _words(mine, theirs) -> str:
    """How two values differ, in a few words."""
    if type(mine) is not type(theirs):
        return f": {type(mine).__name__}, not {type(theirs).__name__}"
    if eqx.is_array(mine) and mine.shape != theirs.shape:
        return f": shape {mine.shape}, not {theirs.shape}"
    return ""


def _trained_seconds(bridge: GuidedBridge) -> float:
    """What the guide says of its training; 0 for a guide that was not trained."""
    history = getattr(bridge.guide, "history", None)
    return float(np.asarray(history["seconds"])[-1]) if history else 0.0


def _noise(bridge: GuidedBridge, key):
    return jr.normal(key, bridge.noise_shape, bridge.x0.dtype)


@eqx.filter_jit
def _log_weights(bridge: GuidedBridge, keys):
    return jax.vmap(lambda key: bridge.log_weight(_noise(bridge, key)))(keys)


def _timed_log_weights(bridge: GuidedBridge, keys, batch_size: int) -> tuple[np.ndarray, float]:
    """Log weights, and the seconds that they took after compilation."""
    batches = [keys[i : i + batch_size] for i in range(0, len(keys), batch_size)]
    for batch in {len(batch): batch for batch in batches}.values():
        jax.block_until_ready(_log_weights(bridge, batch))
    start = time.perf_counter()
    found = [jax.block_until_ready(_log_weights(bridge, batch)) for batch in batches]
    seconds = time.perf_counter() - start
    return np.concatenate(found), seconds


def _row(bridge: GuidedBridge, log_weights: np.ndarray, seconds: float, trained: float) -> dict[str, float | bool]:
    num_particles = len(log_weights)
    log_evidence = float(weights.log_mean_exp(log_weights))
    standard_error = float(weights.standard_error(log_weights))
    rounding = _rounding(bridge, log_evidence)
    # one particle has an ESS of 1 and a bounded tail, both without meaning
    ess = float(weights.effective_sample_size(log_weights)) if num_particles > 1 else math.nan
    pareto_k = float(weights.pareto_k(log_weights)) if num_particles > 1 else math.nan
    finite = math.isfinite(log_evidence) and math.isfinite(standard_error)
    if finite and np.ptp(log_weights) <= 2 * rounding:  # each of two log weights may be off by it
        pareto_k = -math.inf  # and not the shape of the tail of rounding errors
    return {
        "log_evidence": log_evidence,
        "standard_error": standard_error,
        "rounding": rounding,
        "ess": ess,
        "ess_fraction": ess / num_particles,
        "pareto_k": pareto_k,
        "trusted": finite and pareto_k < _threshold(num_particles),
        "seconds": seconds,
        "training_seconds": trained,
        "seconds_per_effective_sample": seconds / ess if ess else math.inf,
        "seconds_per_effective_sample_with_training": (seconds + trained) / ess if ess else math.inf,
    }


def _rounding(bridge: GuidedBridge, log_evidence: float) -> float:
    """Nats that rounding may cost a log weight: K sums of numbers as large as itself and of all squared noises."""
    size = math.prod(bridge.noise_shape) + bridge.num_steps * abs(log_evidence)
    return float(jnp.finfo(bridge.x0.dtype).eps) * size


def _threshold(num_particles: int) -> float:
    return weights.pareto_k_threshold(num_particles) if num_particles > 1 else math.nan


def _checked_score_error(bridge: GuidedBridge, score, keys) -> float:
    require(callable(score), f"`score` must be a function (t, x) of a time and a state; got {score!r}.")
    score = close(score, bridge.ts[0], bridge.x0)
    require(
        score.shape == bridge.x0.shape,
        f"`score` must return a vector like the state, {bridge.x0.shape}; got {score.shape}.",
    )
    return float(_score_error(bridge, score, keys))


@eqx.filter_jit
@full_precision
def _score_error(bridge: GuidedBridge, score, keys):
    def squares(t, x, s):
        s_exact = score(t, x)
        a = bridge.sde.covariance(t, x)
        return jnp.stack([jnp.sum(u * apply(a, u)) for u in (s - s_exact, s_exact)])

    def integrals(key):
        path, log_weight = bridge.path_and_log_weight(_noise(bridge, key))
        along = jax.vmap(squares)(bridge.ts[:-1], path[:-1], bridge.scores(path))
        return jnp.diff(bridge.grid.elapsed) @ along, log_weight

    found, log_weights = jax.lax.map(integrals, keys)
    error, size = jax.nn.softmax(log_weights) @ found
    return error / size


def _cells(row) -> list[str]:
    return [
        f"{row['log_evidence']:.3f}",
        f"{row['standard_error']:.2g}",
        f"{row['ess']:.1f}",
        f"{100 * row['ess_fraction']:.2f}",
        f"{row['pareto_k']:.2f}",
        f"{row['seconds_per_effective_sample']:.2g}",
        f"{row['seconds_per_effective_sample_with_training']:.2g}",
        f"{row['score_error']:.2g}",
    ]


def _aligned(table: list[list[str]]) -> list[str]:
    """Lines of a table, the first column to the left and the others to the right."""
    hats = [[cell.count("\u0302") for cell in line] for line in table]  # a combining hat takes no room
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    lines = []
    for line, extra in zip(table, hats, strict=True):
        sized = list(zip(line, np.add(widths, extra), strict=True))
        lines.append("  ".join([sized[0][0].ljust(sized[0][1]), *(cell.rjust(width) for cell, width in sized[1:])]))
    return lines
