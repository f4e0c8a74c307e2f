"""Several bridges on one estimand: one evidence by different guides, and what each costs."""

import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jax.sharding import Mesh
from jaxtyping import PRNGKeyArray

from . import weights
from ._checks import (
    choice,
    known_number,
    positive_integer,
    require,
    require_instance,
    require_key,
    require_mapping,
    words,
)
from ._closed import close
from ._linalg import apply, full_precision
from ._types import RealScalar, State
from .bridges import GuidedBridge
from .evidence import EvidenceEstimate, driving_noise, timed_estimate
from .plot._comparison import draw_comparison

_SCORE_PATHS = 64
_JOINT_ERRORS = 3.0
_LEAST_ESS = 100.0  # below it a standard error is itself too uncertain
_RESOLUTION = 1.0  # nats: what agrees must not be able to differ by more


@dataclass(frozen=True, repr=False)
class Comparison:
    """What `compare` found. `str` of it is a table with the verdict beneath.

    `rows[name]` holds, as plain numbers,

    - `log_evidence` and its `standard_error`, in nats; `rounding`, the part of an estimate that
      rounding may account for, in nats.
    - `ess`, the effective number of particles, and `ess_fraction`, of all particles.
    - `pareto_k`, −inf where the weights are equal to rounding; `trusted`, whether the estimate and
      its standard error can be taken at their word, see `EvidenceEstimate`; `doubt`, why not.
    - `seconds`, the run without compilation, and `training_seconds`; `seconds_per_effective_sample`
      of the run and `seconds_per_effective_sample_with_training` of both.
    - `score_error`, NaN where no score was given.

    What cannot be computed is NaN, and the estimate then not to be trusted.
    """

    num_particles: int
    rows: dict[str, dict[str, Any]]

    @classmethod
    def of(cls, estimates: Mapping[str, EvidenceEstimate]) -> "Comparison":
        """Of estimates by name, of one evidence and with independent errors. Times are NaN."""
        good = isinstance(estimates, Mapping) and len(estimates) > 0
        require(
            good, f"`estimates` must be a dictionary of estimates by name; got {words(estimates)}."
        )
        for name, estimate in estimates.items():
            require_instance(
                estimate, EvidenceEstimate, f"estimates[{name!r}]", "an `EvidenceEstimate`"
            )
        rows = {name: _row(estimate, math.nan, 0.0) for name, estimate in estimates.items()}
        return cls(min(len(estimate.log_weights) for estimate in estimates.values()), rows)

    def agree(self, first: str, second: str) -> bool | None:
        """Whether two log evidences lie within 3 joint standard errors, and rounding.

        None where that cannot be known: where one of them is not to be trusted, and where the draws
        are too few, an ESS below 100 or 3 joint standard errors of more than a nat. Weights that
        are equal to rounding are enough of them, however few.
        """
        choice(first, "first", self.rows)
        choice(second, "second", self.rows)
        if self._unknown(first, second):
            return None
        gap, joint, rounding = self._gap(first, second)
        return bool(gap <= _JOINT_ERRORS * joint + rounding)

    @property
    def verdict(self) -> str:
        """A sentence for every pair: whether they agree, and what is not to be trusted in it."""
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
            raise ImportError(
                "`to_pandas` needs pandas: pip install pandas. `rows` holds the same."
            ) from error
        return pandas.DataFrame.from_dict(self.rows, orient="index")

    def plot(self, path: Any) -> Any:
        """Log evidences ± 2 standard errors, ESS in percent and seconds per effective sample,
        written to a file.

        **Arguments:** `path`: where to; matplotlib knows the format by its ending.

        **Returns:** the `Figure`, closed. Grey is not to be trusted. **Errors:** `ImportError`
        without matplotlib.
        """
        return draw_comparison(self.rows, path)

    def __str__(self) -> str:
        header = [
            "",
            "log evidence",
            "SE",
            "ESS",
            "ESS, %",
            "k̂",
            "s / ESS",
            "with training",
            "score error",
        ]
        table = [header, *([name, *_cells(row)] for name, row in self.rows.items())]
        if all(math.isnan(row["score_error"]) for row in self.rows.values()):
            table = [line[:-1] for line in table]
        # of fewer than two particles there is no threshold
        few = self.num_particles < 2
        threshold = math.nan if few else weights.pareto_k_threshold(self.num_particles)
        rule = "k̂ needs more" if few else f"k̂ must be below {threshold:.2f}"
        return "\n".join(
            [*_aligned(table), f"Particles of each: {self.num_particles}; {rule}.", self.verdict]
        )

    __repr__ = __str__

    def _gap(self, first: str, second: str) -> tuple[float, float, float]:
        """The distance of two log evidences, its standard error, and what rounding explains."""
        a = self.rows[first]
        b = self.rows[second]
        joint = math.hypot(a["standard_error"], b["standard_error"])
        return abs(a["log_evidence"] - b["log_evidence"]), joint, a["rounding"] + b["rounding"]

    def _unknown(self, first: str, second: str) -> str:
        """What keeps two estimates from being compared; empty where nothing does."""
        names = list(dict.fromkeys((first, second)))  # once, where both are the same
        if not all(self.rows[name]["trusted"] for name in names):
            return "cannot be compared"
        _, joint, _ = self._gap(first, second)
        # weights that are all equal, of error 0, are enough however few
        few = [
            name
            for name in names
            if self.rows[name]["ess"] < _LEAST_ESS and self.rows[name]["standard_error"] > 0
        ]
        if few:
            each = ", ".join(f"{self.rows[name]['ess']:.0f} of {name}" for name in few)
            return (
                f"have too few draws to compare: an ESS of {each}, and {_LEAST_ESS:.0f} are needed"
            )
        if _JOINT_ERRORS * joint > _RESOLUTION:
            return (
                f"have too few draws to compare: {_JOINT_ERRORS:.0f} joint standard errors are "
                f"{3 * joint:.2g} nats"
            )
        return ""

    def _sentence(self, first: str, second: str) -> str:
        gap, joint, rounding = self._gap(first, second)
        found = self._unknown(first, second)
        if not found and gap <= rounding:
            found = "agree to rounding"
        elif not found:
            errors = gap / joint if joint > 0 else math.inf
            found = "agree" if self.agree(first, second) else "do not agree"
            found += f": they differ by {gap:.2g}, or {errors:.1f} joint standard errors"
        return f"{first} and {second} {found}.{self._distrust(first, second)}"

    def _distrust(self, *names: str) -> str:
        doubts = [
            f"{name} ({self.rows[name]['doubt']})" for name in names if self.rows[name]["doubt"]
        ]
        return f" Not to be trusted: {', '.join(doubts)}." if doubts else ""


def compare(
    bridges: Mapping[str, GuidedBridge],
    key: PRNGKeyArray,
    *,
    num_particles: int = 1024,
    batch_size: int | None = None,
    training_seconds: Mapping[str, float] | None = None,
    score: Callable[[RealScalar, State], State] | None = None,
    mesh: Mesh | None = None,
) -> Comparison:
    """Estimate one evidence by several bridges, and say whether they agree and what each costs.

    **Arguments:**

    - `bridges`: by name; they differ in nothing but their guides, `{"a": bridge, "b":
      bridge.with_guide(guide)}`.
    - `key`: split, so that the estimates' errors are independent.
    - `num_particles`: number S of paths of each bridge. Of a single one there is no standard error,
      and no trust.
    - `batch_size`: how many a device runs at once; memory is bounded by it. At most 256 by default.
    - `training_seconds`: by name, seconds spent on training a guide. By default the last entry of
      `guide.history["seconds"]` where the guide has a history, and 0 where it has none.
    - `score`: (t, x) ↦ ∇ log h(t, x), shaped like x, where it is known. The `score_error` of a
      guide's score s is then

          E ∫ |s − ∇ log h|²_a dt / E ∫ |∇ log h|²_a dt,    |u|²_a = uᵀ a(t, x) u,

      over 64 of the weighted paths (self-normalised) and the steps of the grid, t and x being those
      at a step's start.
    - `mesh`: the devices that share the paths of each bridge, as for `spread`.

    **Returns:** a `Comparison`. Run times are measured after compilation, one bridge after the
    other.

    **Errors:** `ValueError` where the bridges differ in their SDE, condition, start, grid or solver
    (the continuous weight of a diffrax solver has another expectation): there is then no one number
    to agree on.
    """
    _check_bridges(bridges)
    require_key(key)
    require_mapping(training_seconds, "training_seconds")
    good = score is None or callable(score)
    require(good, f"`score` must be a function (t, x) of a time and a state; got {words(score)}.")
    training_seconds = {} if training_seconds is None else training_seconds
    unknown = sorted(set(training_seconds) - set(bridges))
    require(
        not unknown,
        f"`training_seconds` must be of the bridges {sorted(bridges)}; got {unknown} too.",
    )
    num_particles = positive_integer(num_particles, "num_particles")
    if batch_size is None:
        batch_size = min(256, num_particles)
    batch_size = positive_integer(batch_size, "batch_size")
    rows = {}
    # a key each: with one for all the errors of two guides would be correlated
    keys_of_bridges = jr.split(key, len(bridges))
    for (name, bridge), key_bridge in zip(bridges.items(), keys_of_bridges, strict=True):
        estimate, seconds = timed_estimate(bridge, key_bridge, num_particles, batch_size, mesh)
        trained = training_seconds.get(name, _trained_seconds(bridge))
        trained = known_number(trained, f"training_seconds[{name!r}]")
        # those of the first particles of the estimate
        keys = jr.split(key_bridge, num_particles)[:_SCORE_PATHS]
        rows[name] = _row(estimate, seconds, trained)
        if score is not None:
            rows[name]["score_error"] = _checked_score_error(bridge, score, keys)
    return Comparison(num_particles, rows)


def _check_bridges(bridges) -> None:
    require(
        isinstance(bridges, Mapping) and len(bridges) > 0,
        '`bridges` must be a dictionary of bridges by name, such as {"guided": bridge}; '
        f"got {bridges!r}.",
    )
    for name, bridge in bridges.items():
        require_instance(bridge, GuidedBridge, f"bridges[{name!r}]", "a `GuidedBridge`")
    # all that the evidence depends on; guides alone may differ
    (first, reference), *others = bridges.items()
    for name, bridge in others:
        for field in ("sde", "condition", "x0", "ts", "solver"):
            mine = getattr(bridge, field)
            theirs = getattr(reference, field)
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


def _row(estimate: EvidenceEstimate, seconds: float, trained: float) -> dict[str, Any]:
    num_particles = estimate.log_weights.shape[0]
    # one particle has an ESS of 1 and a bounded tail, both without meaning
    meant = 1.0 if num_particles > 1 else math.nan
    ess = float(estimate.ess) * meant

    def per_effective_sample(seconds: float) -> float:
        return seconds / ess if ess else math.inf

    return {
        "log_evidence": float(estimate.log_evidence),
        "standard_error": float(estimate.standard_error),
        "rounding": estimate.rounding,
        "ess": ess,
        "ess_fraction": ess / num_particles,
        "pareto_k": estimate.pareto_k * meant,
        "trusted": estimate.trusted,
        "doubt": estimate.doubt,
        "seconds": seconds,
        "training_seconds": trained,
        "score_error": math.nan,
        "seconds_per_effective_sample": per_effective_sample(seconds),
        "seconds_per_effective_sample_with_training": per_effective_sample(seconds + trained),
    }


def _checked_score_error(bridge: GuidedBridge, score, keys) -> float:
    require(
        callable(score), f"`score` must be a function (t, x) of a time and a state; got {score!r}."
    )
    # frozen as it is now: JAX would go on with what an older call of the same function has read
    score = close(score, bridge.ts[0], bridge.x0)
    require(
        score.shape == bridge.x0.shape,
        f"`score` must return a vector like the state, {bridge.x0.shape}; got {score.shape}.",
    )
    return float(_score_error(bridge, score, keys))


@eqx.filter_jit
@full_precision
def _score_error(bridge: GuidedBridge, score, keys):
    # |u|²_a of the difference and of the exact score, at one state
    def squares(t, x, s):
        s_exact = score(t, x)
        a = bridge.sde.covariance(t, x)
        return jnp.stack([jnp.sum(u * apply(a, u)) for u in (s - s_exact, s_exact)])

    def integrals(key):
        path, log_weight = bridge.path_and_log_weight(driving_noise(bridge, key))
        along = jax.vmap(squares)(bridge.ts[:-1], path[:-1], bridge.scores(path))
        # ∫ dt by the elapsed times, which have digits that dates have lost
        return jnp.diff(bridge.grid.elapsed) @ along, log_weight

    found, log_weights = jax.lax.map(integrals, keys)
    # weighted, since the expectation is over conditioned paths and these are the guide's
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
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    lines = []
    for line in table:
        # a combining hat takes no room
        hats = [cell.count("\u0302") for cell in line]
        (name, name_width), *others = zip(line, np.add(widths, hats), strict=True)
        numbers = [cell.rjust(width) for cell, width in others]
        lines.append("  ".join([name.ljust(name_width), *numbers]))
    return lines
