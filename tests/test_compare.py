"""Several bridges on one estimand, against the closed form of an Ornstein–Uhlenbeck process."""

import builtins
import math
import re

import diffrax
import jax
import jax.random as jr
import numpy as np
import pytest
import scipy.stats

import numpyro_bridges as nb
from numpyro_bridges._compare import _score_error
from numpyro_bridges.guiding._steering import DriftSteering

pytestmark = pytest.mark.usefixtures("compile_quickly")

RATE, SIGMA, SHIFT, VARIANCE, T = 0.8, 0.6, 0.3, 0.05, 1.0
X0, V = np.array([0.1, 0.5]), np.array([0.7, -0.2])


def flow(u):
    """Mean map, shift and variance of the process over a time u, from their formulas."""
    decay = np.exp(-RATE * u)
    return decay, SHIFT * (1 - decay) / RATE, SIGMA**2 * (1 - decay**2) / (2 * RATE)


DECAY, MEAN_SHIFT, SPREAD = flow(T)
LOG_EVIDENCE = scipy.stats.norm(DECAY * X0 + MEAN_SHIFT, np.sqrt(SPREAD + VARIANCE)).logpdf(V).sum()


def exact_score(t, x):
    """∇ log N(v; φ x + s, (S + variance) I) with the flow over T − t; NumPy's numbers or JAX's."""
    decay = math.e ** (-RATE * (T - t))
    spread = SIGMA**2 * (1 - decay**2) / (2 * RATE)
    return decay * (V - decay * x - SHIFT * (1 - decay) / RATE) / (spread + VARIANCE)


def brownian_score(t, x):
    """The score of Brownian motion with the same noise, which knows no drift."""
    return (V - x) / (SIGMA**2 * (T - t) + VARIANCE)


def bridge(guide=None, num_steps=10, **kwargs):
    settings = {"x0": X0, "t1": T, "num_steps": num_steps} | kwargs
    sde = settings.pop("sde", nb.LinearSDE(-RATE, SIGMA, SHIFT))
    condition = settings.pop("condition", nb.InexactMatch(VARIANCE).at(V))
    return nb.GuidedBridge(sde, condition, guide=guide, **settings)


EXACT = bridge()
BROWNIAN = EXACT.with_guide(nb.FrozenGuide(nb.BrownianMotion(SIGMA**2)))
POOR = EXACT.with_guide(nb.FrozenGuide(nb.BrownianMotion(1e-3)))


@pytest.fixture(scope="module")
def found():
    bridges = {
        "exact": EXACT,
        "receding": EXACT.with_guide(nb.RecedingGuide()),
        "brownian": BROWNIAN,
    }
    return nb.compare(
        bridges,
        jr.key(3),
        num_particles=2500,
        score=exact_score,
        training_seconds={"brownian": 7.0},
    )


def test_evidence_is_the_closed_form(found):
    for name, row in found.rows.items():
        assert row["standard_error"] < 0.01, name
        assert abs(row["log_evidence"] - LOG_EVIDENCE) < 3 * row["standard_error"] + 1e-12, name
        assert row["trusted"] and row["ess_fraction"] == row["ess"] / 2500


def test_an_exact_guide_has_equal_weights(found):
    row = found.rows["exact"]
    assert row["pareto_k"] == -math.inf and row["ess"] == pytest.approx(2500)
    assert 0 < row["rounding"] < 1e-13
    assert found.rows["brownian"]["ess_fraction"] < 0.95


def test_verdict_of_agreement(found):
    lines = found.verdict.splitlines()
    assert lines[0] == "exact and receding agree to rounding."
    assert [line.split(":")[0] for line in lines[1:]] == [
        "exact and brownian agree",
        "receding and brownian agree",
    ]
    assert found.agree("exact", "brownian") and "trusted" not in found.verdict


def test_errors_are_independent():
    """Two bridges that are one differ by their noise, which has the spread of the joint standard
    error.
    """
    gaps = []
    for seed in range(40):
        pair = nb.compare({"a": BROWNIAN, "b": BROWNIAN}, jr.key(seed), num_particles=2500)
        a, b = pair.rows.values()
        gaps.append(
            (a["log_evidence"] - b["log_evidence"])
            / math.hypot(a["standard_error"], b["standard_error"])
        )
    # the sum of squares is chi-squared with 40 degrees of freedom, but for one failure in 1000
    low, high = scipy.stats.chi2(40).ppf([0.0005, 0.9995])
    assert low < np.sum(np.square(gaps)) < high


def test_score_error_of_the_exact_guide_is_rounding(found):
    assert 0 <= found.rows["exact"]["score_error"] < 1e-25


def relative_error(ts, paths, log_weights, score):
    """E ∫ |s − s*|²_a dt / E ∫ |s*|²_a dt by loops in NumPy."""
    error = size = 0.0
    for path, weight in zip(paths, np.exp(log_weights - np.max(log_weights)), strict=True):
        for k, dt in enumerate(np.diff(ts)):
            s, s_exact = score(ts[k], path[k]), exact_score(ts[k], path[k])
            error += weight * dt * SIGMA**2 * np.sum((s - s_exact) ** 2)
            size += weight * dt * SIGMA**2 * np.sum(s_exact**2)
    return error / size


def test_score_error_by_loops(found):
    keys = jr.split(jr.split(jr.key(3), 3)[2], 2500)[:64]
    runs = [BROWNIAN.path_and_log_weight(jr.normal(key, BROWNIAN.noise_shape)) for key in keys]
    paths, log_weights = (np.array(part) for part in zip(*runs, strict=True))
    expected = relative_error(np.array(BROWNIAN.ts), paths, log_weights, brownian_score)
    assert expected > 0.01
    np.testing.assert_allclose(found.rows["brownian"]["score_error"], expected, rtol=1e-10)


def test_score_error_is_an_integral_over_the_conditioned_process():
    """Over the Gaussian law of the conditioned process: X_t given v, by the joint normal of both."""
    ts = np.linspace(0.0, 1.0, 11) ** 2
    uneven = bridge(BROWNIAN.guide, t1=None, num_steps=None, ts=ts)
    error = size = 0.0
    for t, dt in zip(ts[:-1], np.diff(ts), strict=True):
        (before, s_before, S_before), (after, s_after, S_after) = flow(t), flow(T - t)
        mean = before * X0 + s_before
        gain = S_before * after / (after**2 * S_before + S_after + VARIANCE)
        mean, variance = mean + gain * (V - after * mean - s_after), S_before * (1 - gain * after)
        offset = brownian_score(t, mean) - exact_score(t, mean)
        slope = after**2 / (S_after + VARIANCE) - 1 / (SIGMA**2 * (T - t) + VARIANCE)
        error += dt * np.sum(offset**2 + slope**2 * variance)
        size += dt * np.sum(
            exact_score(t, mean) ** 2 + (after**2 / (S_after + VARIANCE)) ** 2 * variance
        )
    ratios = [
        float(_score_error(uneven, exact_score, jr.split(jr.key(seed), 64))) for seed in range(60)
    ]
    standard_error = np.std(ratios) / math.sqrt(len(ratios))
    assert standard_error < 0.02 * error / size
    assert abs(np.mean(ratios) - error / size) < 3 * standard_error


def test_a_wrong_weight_is_found(monkeypatch):
    """0.1 nats too many at every step, which neither the ESS nor k̂ can see."""
    right = DriftSteering.drive

    def wrong(self, z):
        u, log_weight = right(self, z)
        return u, log_weight + 0.1

    monkeypatch.setattr(DriftSteering, "drive", wrong)
    fresh = bridge(num_steps=9)
    bridges = {"right": fresh, "wrong": fresh.with_guide(nb.DriftGuide(nb.FrozenGuide()))}
    found = nb.compare(bridges, jr.key(0), num_particles=2000)
    assert not found.agree("right", "wrong") and found.rows["wrong"]["trusted"]
    assert found.verdict.startswith("right and wrong do not agree: they differ by 0.")
    assert found.rows["wrong"]["log_evidence"] - LOG_EVIDENCE == pytest.approx(0.8, abs=0.15)


def test_a_heavy_tail_is_not_trusted():
    found = nb.compare({"exact": EXACT, "poor": POOR}, jr.key(0), num_particles=500)
    row = found.rows["poor"]
    assert row["pareto_k"] >= nb.weights.pareto_k_threshold(500) and not row["trusted"]
    assert row["standard_error"] == math.inf and found.agree("exact", "poor") is None
    doubt = f"Not to be trusted: poor (k̂ = {row['pareto_k']:.2f}, and must be below 0.70)."
    assert found.verdict == f"exact and poor cannot be compared. {doubt}"


def row(log_evidence, standard_error, ess=500.0, doubt=""):
    return {
        "log_evidence": log_evidence,
        "standard_error": standard_error,
        "rounding": 1e-12,
        "ess": ess,
        "trusted": not doubt,
        "doubt": doubt,
    }


EQUAL = row(1.0, 0.0, ess=20.0)
PAIRS = [
    ("near", row(1.0, 0.1), row(1.4, 0.1), True, "agree: they differ by 0.4, or 2.8 joint"),
    ("far", row(1.0, 0.1), row(1.5, 0.1), False, "do not agree: they differ by 0.5, or 3.5"),
    (
        "untrusted",
        row(1.0, 0.1),
        row(1.0, 0.1, doubt="why"),
        None,
        "cannot .*Not .*: second \\(why\\)",
    ),
    (
        "few",
        row(1.0, 0.1),
        row(1.0, 0.1, ess=99.4),
        None,
        "too few draws .* ESS of 99 of second, and 100",
    ),
    (
        "far-and-few",
        row(1.0, 0.1, ess=5.0),
        row(9.0, 0.1),
        None,
        "too few draws .* ESS of 5 of first",
    ),
    (
        "blurred",
        row(1.0, 0.3),
        row(1.0, 0.3),
        None,
        "too few draws .* 3 joint standard errors are 1.3 nats",
    ),
    ("rounding", EQUAL, row(1.0 + 1e-12, 0.0, ess=20.0), True, "agree to rounding"),
    (
        "beyond-rounding",
        EQUAL,
        row(1.0 + 1e-11, 0.0, ess=20.0),
        False,
        "do not agree: they differ by 1e-11",
    ),
    ("one-equal", EQUAL, row(1.1, 0.1), True, "agree: "),
    ("one-equal-few", EQUAL, row(1.0, 0.1, ess=20.0), None, "too few draws .* ESS of 20 of second"),
]


@pytest.mark.parametrize(
    ("first", "second", "agree", "said"), [pytest.param(*c, id=n) for n, *c in PAIRS]
)
def test_what_can_be_said_of_two(first, second, agree, said):
    """Symmetric, and never an agreement of what is not known."""
    found = nb.Comparison(20, {"first": first, "second": second})
    assert found.agree("first", "second") is agree and found.agree("second", "first") is agree
    assert re.match(f"first and second (have )?{said}", found.verdict), found.verdict


def test_a_quick_run_says_that_it_is_one():
    found = nb.compare({"a": BROWNIAN, "b": BROWNIAN}, jr.key(0), num_particles=50)
    assert found.agree("a", "b") is None and "a and b have too few draws to compare" in str(found)


def test_one_particle_is_not_trusted():
    found = nb.compare({"exact": EXACT, "brownian": BROWNIAN}, jr.key(0), num_particles=1)
    for row in found.rows.values():
        hidden = (
            "standard_error",
            "ess",
            "ess_fraction",
            "pareto_k",
            "seconds_per_effective_sample",
        )
        assert all(math.isnan(row[name]) for name in hidden) and not row["trusted"]
    assert not found.agree("exact", "brownian") and not found.agree("exact", "exact")
    assert "exact and brownian cannot be compared" in found.verdict
    assert "Not to be trusted: exact (a single particle has no" in found.verdict
    assert found.agree("exact", "brownian") is None


@pytest.mark.parametrize(("weight", "shown"), [(np.nan, "nan"), (-np.inf, "-inf")])
def test_failed_weights_are_seen(monkeypatch, weight, shown):
    """A NaN in one step of one guide; and weights that are all zero."""
    right = DriftSteering.drive
    monkeypatch.setattr(
        DriftSteering, "drive", lambda self, z: (right(self, z)[0], z.sum() * 0 + weight)
    )
    fresh = bridge(num_steps=7 if np.isnan(weight) else 8)
    bridges = {"right": fresh, "failed": fresh.with_guide(nb.DriftGuide(nb.FrozenGuide()))}
    found = nb.compare(bridges, jr.key(0), num_particles=50)
    row = found.rows["failed"]
    assert (
        str(row["log_evidence"]) == shown
        and not row["trusted"]
        and not found.agree("right", "failed")
    )
    assert not math.isfinite(row["seconds_per_effective_sample"])
    assert "right and failed cannot be compared" in found.verdict
    assert f"Not to be trusted: failed (the log evidence is {shown})" in found.verdict


class TrainedGuide(nb.AbstractGuide):
    """A guide that remembers how long its training took."""

    history: dict

    def plan(self, sde, seen, reference, ts):
        return nb.FrozenGuide().plan(sde, seen, reference, ts)


def test_training_time(found):
    row = found.rows["brownian"]
    assert (
        row["seconds"] > 0
        and row["training_seconds"] == 7.0
        and found.rows["exact"]["training_seconds"] == 0.0
    )
    assert row["seconds_per_effective_sample"] == pytest.approx(row["seconds"] / row["ess"])
    assert row["seconds_per_effective_sample_with_training"] == pytest.approx(
        (row["seconds"] + 7.0) / row["ess"]
    )
    learned = EXACT.with_guide(TrainedGuide({"seconds": np.array([1.0, 2.5])}))
    assert (
        nb.compare({"a": learned}, jr.key(0), num_particles=20).rows["a"]["training_seconds"] == 2.5
    )
    given = nb.compare({"a": learned}, jr.key(0), num_particles=20, training_seconds={"a": 9.0})
    assert given.rows["a"]["training_seconds"] == 9.0


def test_batches_change_nothing_but_the_time():
    whole, parts = (
        nb.compare({"a": BROWNIAN}, jr.key(1), num_particles=50, batch_size=size).rows["a"]
        for size in (None, 16)
    )
    for name in ("log_evidence", "standard_error", "ess", "pareto_k"):
        assert whole[name] == pytest.approx(parts[name], rel=1e-10)


def test_table(found):
    lines = str(found).splitlines()
    assert [line.split()[0] for line in lines[:4]] == ["log", "exact", "receding", "brownian"]
    # the combining hat takes no room
    assert len({len(line.replace("\u0302", "")) for line in lines[:4]}) == 1
    assert "score error" in lines[0] and "k̂ must be below 0.70" in lines[4]
    assert str(found).endswith(found.verdict)
    alone = nb.compare({"a": BROWNIAN}, jr.key(0), num_particles=20)
    assert "score error" not in str(alone) and alone.verdict.startswith(
        "a: nothing to compare it with."
    )


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_to_pandas(found, monkeypatch):
    pandas = pytest.importorskip("pandas")
    frame = found.to_pandas()
    assert isinstance(frame, pandas.DataFrame) and list(frame.index) == list(found.rows)
    assert frame.loc["brownian", "ess"] == found.rows["brownian"]["ess"]
    real = builtins.__import__

    def without(name, *args, **kwargs):
        if name == "pandas":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ImportError, match="`to_pandas` needs pandas"):
        found.to_pandas()


def test_plot(found, tmp_path):
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    one = nb.compare({"one": EXACT}, jr.key(0), num_particles=1)
    both = nb.Comparison(2500, found.rows | one.rows)
    figure = both.plot(tmp_path / "both.png")
    assert (tmp_path / "both.png").stat().st_size > 0 and not plt.get_fignums()
    evidence, ess, seconds = figure.axes
    row = found.rows["brownian"]
    assert [text.get_text() for text in evidence.get_yticklabels()] == [*found.rows, "one"]
    (low, high) = evidence.containers[2].lines[2][0].get_segments()[0][:, 0]
    assert (high - low) == pytest.approx(4 * row["standard_error"])
    assert [text.get_text() for text in evidence.texts] == ["not to be trusted"]
    assert [bar.get_width() for bar in ess.patches[:3]] == [
        100 * row["ess_fraction"] for row in found.rows.values()
    ]
    assert ess.texts[3].get_text() == "nan" and ess.patches[3].get_width() == 0.0
    assert seconds.patches[2].get_width() == row["seconds_per_effective_sample_with_training"]
    assert seconds.patches[6].get_width() == row["seconds_per_effective_sample"]


def pair(**kwargs):
    return lambda: nb.compare({"a": EXACT, "b": bridge(**kwargs)}, jr.key(0))


REFUSED = [
    (
        "sde",
        pair(sde=nb.LinearSDE(-RATE, 0.7, SHIFT)),
        r"`bridges` .*one estimand; 'b' has another `sde` than 'a'",
    ),
    (
        "sde-class",
        pair(sde=nb.BrownianMotion(1.0)),
        "another `sde` than 'a': BrownianMotion, not LinearSDE",
    ),
    (
        "condition",
        pair(condition=nb.InexactMatch(0.1).at(V)),
        "'b' has another `condition`.*`bridge.with_guide",
    ),
    ("datum", pair(condition=nb.InexactMatch(VARIANCE).at(V + 1)), "'b' has another `condition`"),
    ("start", pair(x0=X0 + 1), "'b' has another `x0` than 'a'"),
    ("grid", pair(num_steps=20), r"another `ts` than 'a': shape \(21,\), not \(11,\)"),
    ("end", pair(t1=2.0), "'b' has another `ts` than 'a'"),
    (
        "solver",
        pair(guide=nb.FrozenGuide(), solver=diffrax.Euler()),
        "another `solver` than 'a': Euler, not GuidedStep",
    ),
    (
        "nothing",
        lambda: nb.compare({}, jr.key(0)),
        "`bridges` must be a dictionary of bridges by name.*got {}",
    ),
    ("list", lambda: nb.compare([EXACT], jr.key(0)), "`bridges` must be a dictionary"),  # type: ignore
    (
        "number",
        lambda: nb.compare({"a": 3}, jr.key(0)),
        r"`bridges\['a'\]` must be a `GuidedBridge`; got 3",
    ),
    (
        "training-of-another",
        lambda: nb.compare({"a": EXACT}, jr.key(0), training_seconds={"c": 1.0}),
        r"`training_seconds` must be of the bridges \['a'\]; got \['c'\]",
    ),
    (
        "no-particle",
        lambda: nb.compare({"a": EXACT}, jr.key(0), num_particles=0),
        "`num_particles` must be .*got 0",
    ),
    (
        "no-batch",
        lambda: nb.compare({"a": EXACT}, jr.key(0), batch_size=0),
        "`batch_size` must be .*got 0",
    ),
    (
        "score-number",
        lambda: nb.compare({"a": EXACT}, jr.key(0), num_particles=5, score=3),
        r"`score` must be a function \(t, x\)",
    ),
    (
        "score-shape",
        lambda: nb.compare({"a": EXACT}, jr.key(0), num_particles=5, score=lambda t, x: x.sum()),
        r"`score` must return .*\(2,\); got \(\)",
    ),
]


@pytest.mark.parametrize(
    ("make", "message"), [pytest.param(*case, id=name) for name, *case in REFUSED]
)
def test_refused(make, message):
    with pytest.raises(ValueError, match=f"(?s){message}"):
        make()


def test_one_solver_for_all():
    """The continuous weight on one grid has one expectation, whatever the auxiliary process; biased
    at fixed dt.
    """
    euler = bridge(nb.FrozenGuide(), num_steps=40, solver=diffrax.Euler())
    found = nb.compare(
        {"a": euler, "b": euler.with_guide(BROWNIAN.guide)}, jr.key(0), num_particles=500
    )
    assert found.agree("a", "b") and jax.tree.leaves(found.rows)
