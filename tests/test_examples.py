"""The README's first page and the examples run as they stand."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import numpyro_bridges as nb

ROOT = Path(__file__).parent.parent
# One thread, and programs that are compiled quickly: they run once.
ENVIRONMENT = os.environ | {
    "OPENBLAS_NUM_THREADS": "1",
    "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
    "PYTHONPATH": str(ROOT),
}


def run(*command, cwd):
    done = subprocess.run(
        [sys.executable, *command],
        cwd=cwd,
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def require_written(folder, *names):
    """Files of some size in the folder of what an example leaves."""
    for name in names:
        assert (folder / "output" / name).stat().st_size > 5000


def test_first_page(tmp_path):
    pytest.importorskip("ktch")
    page = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S).group(1)
    run_length = "num_warmup=200, num_samples=500, num_chains=4"
    assert run_length in page and "num_particles=4096" in page
    page = page.replace(run_length, "num_warmup=1, num_samples=4, num_chains=2")
    page = page.replace("num_particles=4096", "num_particles=256")
    (tmp_path / "page.py").write_text(
        page + "\nprint(path.shape, float(log_weight), *map(float, (\n"
        "    estimate.log_evidence, estimate.standard_error, estimate.ess, estimate.pareto_k)))\n"
    )
    out = run("page.py", cwd=tmp_path)
    assert "length_scale" in out and "log evidence" in out
    last = out.splitlines()[-1]
    *shape, log_weight, log_evidence, error, ess, k = last.replace("(", "").replace(")", "").split()
    assert [int(n.rstrip(",")) for n in shape] == [51, 32, 2]
    assert 100 < float(log_evidence) < 300 and float(error) < 0.2
    assert float(ess) > 50 and float(k) < 0.7
    assert abs(float(log_weight) - float(log_evidence)) < 10


def test_first_bridge(tmp_path):
    """Its own referee agrees with it: a density by quadrature."""
    pytest.importorskip("matplotlib")
    script = str(ROOT / "examples/first_bridge.py")
    out = run(script, "--quick", "--output", "output", cwd=tmp_path)
    away, error = (
        float(re.search(pattern, out).group(1))
        for pattern in (r"([\d.]+) standard errors away", r"log density of the end: .* ± ([\d.]+)")
    )
    assert away < 4 and error < 0.1 and "r_hat" in out
    names = ("first_bridge.nc", "first_bridge.png", "first_bridge_posterior.png")
    require_written(tmp_path, *names)


@pytest.mark.parametrize(
    "file",
    ["papilio/papilio_raw_10.tps", pytest.param("tyrannus/tyrannus.tps", marks=pytest.mark.slow)],
)
def test_from_a_file_to_a_posterior(file, shared_data, tmp_path):
    """The page's fifteen lines, on shapes that others digitised."""
    page = (ROOT / "docs" / "data.md").read_text(encoding="utf-8")
    (block,) = (
        found
        for found in re.findall(r"```python\n(.*?)```", page, re.S)
        if "print_summary" in found
    )
    _, block = block.split("ellipse in ellipses.points])\n")
    lines = [line for line in block.splitlines() if line.strip()]
    assert len(lines) <= 15
    block = block.replace("shapes.tps", str(shared_data / file))
    block = block.replace("num_warmup=100, num_samples=100", "num_warmup=10, num_samples=10")
    imports = page[page.index("import jax\nimport numpyro\n") :].partition("\n\nellipses")[0]
    (tmp_path / "page.py").write_text(f"{imports}\n{block}")
    out = run("page.py", cwd=tmp_path)
    assert "amplitude" in out and "length_scale" in out and "nan" not in out


def test_mosquito_wings(tmp_path):
    pytest.importorskip("ktch")
    pytest.importorskip("matplotlib")
    out = run(
        str(ROOT / "examples/mosquito_wings.py"), "--quick", "--output", "output", cwd=tmp_path
    )
    assert "r_hat" in out and "divergences: 0" in out
    require_written(tmp_path, "wings.nc", "bridges.png", "posterior.png", "score.png")


@pytest.mark.slow
def test_mosquito_wings_reads_files(tmp_path):
    pytest.importorskip("matplotlib")
    rng = np.random.default_rng(0)
    ellipses = nb.datasets.ellipses(num_points=16, aspects=(1.0, 1.2, 1.4)).points
    shapes = [ellipses[i % 3] + 0.02 * rng.normal(size=(16, 2)) for i in range(6)]
    specimens = [nb.io.Specimen(shape, id=str(i)) for i, shape in enumerate(shapes)]
    nb.io.write_tps(tmp_path / "shapes.tps", specimens)
    (tmp_path / "groups.csv").write_text("species\n" + "\n".join("ababab"))
    script = str(ROOT / "examples/mosquito_wings.py")
    chosen = "--shapes shapes.tps --groups groups.csv --column species --group a".split()
    out = run(script, *chosen, "--quick", "--output", "output", cwd=tmp_path)
    assert "3 shapes of a, 16 points" in out and "r_hat" in out
    require_written(tmp_path, "wings.nc", "bridges.png", "posterior.png", "score.png")
    done = subprocess.run(
        [sys.executable, script, *chosen[:-1], "c"],
        cwd=tmp_path,
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 2 and "--group must be one of ['a', 'b']; got 'c'" in done.stderr


def test_phylogeny_reads_files(tmp_path):
    """Three species, one of a single specimen, a point that is missing, and a tip without a shape."""
    pytest.importorskip("matplotlib")
    rng = np.random.default_rng(0)
    ellipses = dict(
        zip("abc", nb.datasets.ellipses(num_points=10, aspects=(1.0, 1.2, 1.5)).points, strict=True)
    )
    shapes = [ellipses[name] + 0.02 * rng.normal(size=(10, 2)) for name in "aabbc"]
    shapes[3][7] = np.nan
    nb.io.write_tps(
        tmp_path / "shapes.tps",
        [nb.io.Specimen(shape, id=str(i)) for i, shape in enumerate(shapes)],
    )
    (tmp_path / "table.csv").write_text("tip\n" + "\n".join("aabbc"))
    (tmp_path / "tree.nwk").write_text("(((a:1,b:1)ab:1,c:2):0.5,d:2.5);")
    chosen = "--shapes shapes.tps --table table.csv --names tip --tree tree.nwk --quick --output output".split()
    out = run(str(ROOT / "examples/phylogeny.py"), *chosen, cwd=tmp_path)
    assert (
        "tips without shapes, left out: d" in out and "5 specimens of 3 species, 10 points" in out
    )
    assert "r_hat" in out and "divergences: 0" in out and "ancestors: 40 coordinates" in out
    assert out.count("95 % of those predicted in") == 3
    require_written(tmp_path, "phylogeny.nc", "phylogeny_ladder.png", "phylogeny_posterior.png")


PREPARED = """
import sys
sys.path.insert(0, sys.argv.pop())
import numpy as np
import numpyro_bridges as nb
import phylogeny

# Generalised least squares on ((a:1,b:1):1,c:2): C⁻¹1 = (1/3, 1/3, 1/2).
tree = nb.Tree.from_newick("((a:2,b:2):2,c:4):3;")
shapes = np.random.default_rng(0).normal(size=(4, 3, 2))
data = phylogeny.prepare(shapes, ["b", "c", "a", "b"], tree)
np.testing.assert_allclose(data.tree.depths, [0, 0.5, 1, 1, 1])
a, b, c = shapes[2], shapes[[0, 3]].mean(axis=0), shapes[1]
np.testing.assert_allclose(data.start, (2 * a + 2 * b + 3 * c) / 7, atol=1e-5)
np.testing.assert_allclose(data.rows, shapes[[2, 0, 3, 1]])
assert phylogeny.name_of(data.tree, 1) == "a–b"

# A point has variance α² π ℓ² (1 + u) a time, between species and, in proportion, within.
chosen = phylogeny.settings(phylogeny.options("").parse_args(["--longest", "0.5"]))
law = phylogeny.law_of(data, chosen, amplitude=0.2, length_scale=0.5, within=0.1, nugget=0.3)
apart = np.sum((data.start[:, None] - data.start) ** 2, axis=-1)
expected = np.exp(-apart / (4 * 0.5**2)) + 0.3 * np.eye(3)
between = 0.2**2 * np.pi * 0.5**2 * expected
np.testing.assert_allclose(law.parts["sde"].covariance(0.0, data.start), between, rtol=1e-5)
np.testing.assert_allclose(law.parts["match"].observation(law.parts["sde"], data.start).covariance,
                           0.1**2 * expected / 1.3, rtol=1e-5)

# Means of a, b, c are 0, (1, 2, 3), 5 in both columns; of b one point was seen once.
rows = np.zeros((4, 3, 2))
rows[1], rows[2], rows[3] = [[0], [1], [np.nan]], [[2], [3], [3]], 5.0
of_means = np.array([[0, 0, 0], [1, 2, 3], [5, 5, 5]])
of_means = of_means - of_means.mean(axis=0)
start = np.array([[0.0, 0.0], [1.0, 0.0], [3.0, 0.0]])  # the second is nearest to both others
found = phylogeny.spread(data._replace(rows=rows, start=start), np.nan_to_num(rows))
differences = of_means - of_means[:, [1, 0, 1]]
expected = [np.sqrt(np.mean(of_means**2)), np.sqrt(np.mean(differences**2)), np.sqrt(4 / 11 * 4)]
np.testing.assert_allclose(list(found.values()), expected)

np.savetxt("shapes.csv", np.c_[shapes.reshape(4, 6)], delimiter=",", header="x1,y1,x2,y2,x3,y3", comments="")
open("named.csv", "w").write("id,x1,y1,x2,y2,x3,y3\\nAlpha,0,0,1,0,0,1\\nbeta,0,0,1,0,0,2\\n")
open("gap.csv", "w").write("id,x1,y1,x2,y2,x3,y3\\nalpha,0,0,1,0,0,1\\nbeta,0,0,1,0,,\\n")
open("tree.nwk", "w").write("(alpha:1,beta:1);")
wrong = "shapes.csv tree.nwk", "named.csv tree.nwk", "no.csv tree.nwk", "named.csv no.nwk", "gap.csv tree.nwk --nugget"
for names in wrong:
    shapes, tree, *more = names.split()
    sys.argv[1:] = ["--shapes", shapes, "--tree", tree, *more]
    try:
        phylogeny.main()
    except SystemExit as end:
        print(end.code, file=sys.stderr)
"""


def test_phylogeny_prepares_data_and_says_what_is_wrong(tmp_path):
    pytest.importorskip("matplotlib")
    command = [sys.executable, "-c", PREPARED, str(ROOT / "examples")]
    done = subprocess.run(
        command, cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stderr
    said = [line for line in done.stderr.splitlines() if "error:" in line]
    assert len(said) == 5 and done.stderr.split().count("2") == 5
    assert "--names must be a column that every specimen has filled, one of []; got 'id'" in said[0]
    assert "'Alpha'" in said[1] and "alpha" in said[1]
    assert (
        "no.csv" in said[2]
        and "no.nwk" in said[3]
        and "--nugget needs shapes without missing points" in said[4]
    )


@pytest.mark.slow
def test_comparing_models(tmp_path):
    """Its own referee agrees with it: two evidences by quadrature."""
    pytest.importorskip("matplotlib")
    script = str(ROOT / "examples/comparing_models.py")
    out = run(script, "--quick", "--output", "output", cwd=tmp_path)
    away = [float(errors) for errors in re.findall(r"([\d.]+) standard errors away", out)]
    assert len(away) == 2 and max(away) < 6  # of four islands: Student's t, 3 degrees of freedom
    assert float(re.search(r"probability of “wanders”: ([\d.]+)", out).group(1)) < 0.2
    require_written(tmp_path, "comparing_models.png")


@pytest.mark.slow
def test_hierarchical(tmp_path):
    """Its own referee agrees with it: the elpd by sums over a grid of the parameters."""
    pytest.importorskip("matplotlib")
    script = str(ROOT / "examples/hierarchical.py")
    out = run(script, "--quick", "--output", "output", cwd=tmp_path)
    integrated, exact = (
        float(re.search(pattern, out).group(1))
        for pattern in (r"elpd of new cells: (\S+)", r"elpd by quadrature: (\S+)")
    )
    assert abs(integrated - exact) < 1 and "r_hat" in out
    # of those who know the noise, and of a model of cells that are alike
    assert float(re.search(r"given noise and input.*: (\S+)", out).group(1)) > integrated + 2
    assert out.index("each its own ") < out.index("all alike ")
    require_written(tmp_path, "hierarchical.nc", "hierarchical.png")


@pytest.mark.slow
def test_mosquito_tree(tmp_path):
    pytest.importorskip("ktch")
    pytest.importorskip("matplotlib")
    out = run(
        str(ROOT / "examples/mosquito_tree.py"), "--quick", "--output", "output", cwd=tmp_path
    )
    assert (
        "126 specimens of 11 species, 16 points" in out
        and "r_hat" in out
        and "ancestors: 320 coordinates" in out
    )
    require_written(
        tmp_path, "mosquito_tree.nc", "mosquito_tree_ladder.png", "mosquito_tree_posterior.png"
    )


@pytest.mark.slow
def test_allen_cahn(tmp_path):
    pytest.importorskip("matplotlib")
    out = run(str(ROOT / "examples/allen_cahn.py"), "--quick", "--output", "output", cwd=tmp_path)
    assert "8 functions" in out and "r_hat" in out and "the truth: diffusivity 0.02" in out
    assert 80 <= float(re.search(r"([\d.]+) % of the true field", out).group(1))
    require_written(tmp_path, "allen_cahn.nc", "allen_cahn_field.png", "allen_cahn_posterior.png")


@pytest.mark.slow
def test_outlines(tmp_path):
    pytest.importorskip("ktch")
    pytest.importorskip("matplotlib")
    out = run(str(ROOT / "examples/outlines.py"), "--quick", "--output", "output", cwd=tmp_path)
    assert (
        out.count("r_hat") == 3
        and "varifolds less landmarks" in out
        and "varifolds less sliding" in out
    )
    require_written(tmp_path, "outlines.nc", "outlines.png", "outlines_posterior.png")


@pytest.mark.slow
def test_papilio_full(tmp_path):
    """Two numbers of landmarks, of which one has fewer controls; and a folder of outlines."""
    pytest.importorskip("matplotlib")
    s = np.linspace(0, 2 * np.pi, 1000, endpoint=False)
    ellipses = np.stack([np.stack([a * np.cos(s), np.sin(s)], axis=1) for a in (1.0, 1.2, 1.3)])
    (tmp_path / "data").mkdir()
    names = {"species": np.array(["Papilio_a", "Papilio_b"]), "species_index": np.array([0, 0, 1])}
    np.savez(tmp_path / "data/papilio.npz", aligned=ellipses, **names)
    chosen = "--quick --data data --pair a b --points 40 80 --output output".split()
    out = run(str(ROOT / "examples/papilio_full.py"), *chosen, cwd=tmp_path)
    assert "40 less 80 landmarks" in out
    require_written(
        tmp_path,
        "papilio.nc",
        "papilio_bridges.png",
        "papilio_deformation.png",
        "papilio_posterior.png",
    )


@pytest.mark.slow
def test_growth(tmp_path):
    pytest.importorskip("matplotlib")
    out = run(str(ROOT / "examples/growth.py"), "--quick", "--output", "output", cwd=tmp_path)
    assert "12 animals, 6 ages" in out and "r_hat" in out and "the truth: rate 3" in out
    require_written(tmp_path, "growth.nc", "growth_series.png", "growth_posterior.png")


@pytest.mark.slow
def test_learned_vs_guided(tmp_path):
    pytest.importorskip("ktch")
    pytest.importorskip("matplotlib")
    run(str(ROOT / "examples/learned_vs_guided.py"), "--quick", "--output", "output", cwd=tmp_path)
    found = json.loads((tmp_path / "output/learned_vs_guided.json").read_text())
    rows = found["comparison"]
    assert list(rows) == ["guided", "residual", "adjoint"]
    for row in rows.values():
        joint = (row["standard_error"] ** 2 + rows["guided"]["standard_error"] ** 2) ** 0.5
        assert abs(row["log_evidence"] - rows["guided"]["log_evidence"]) < 4 * joint + 1e-3, row
    # A check that all runs: so few draws have Monte Carlo errors that are themselves badly known.
    assert all(
        abs(z) < 6 for row in found["difference_in_errors"].values() for z in row.values()
    ), found
    require_written(tmp_path, "training.png", "comparison.png", "posteriors.png")


@pytest.mark.slow
def test_conditioning_paper(tmp_path):
    pytest.importorskip("ktch")
    pytest.importorskip("matplotlib")
    run(str(ROOT / "examples/conditioning_paper.py"), "--quick", "--output", "output", cwd=tmp_path)
    found = json.loads((tmp_path / "output/conditioning_paper.json").read_text())
    assert abs(found["brownian"]["exact: gap of the discretisations"]) < 1e-3
    for name in ("circles", "outline", "brownian", "bridge", "bridge_times", "species", "scores"):
        assert (tmp_path / "output" / f"{name}.png").stat().st_size > 5000


def test_conditioning_paper_reads_files(tmp_path):
    pytest.importorskip("matplotlib")
    ellipses = nb.datasets.ellipses(num_points=48, aspects=(1.0, 1.5))
    nb.io.write_csv(tmp_path / "start.csv", [nb.io.Specimen(ellipses.points[0])])
    nb.io.write_tps(tmp_path / "end.tps", [nb.io.Specimen(ellipses.points[1])])
    chosen = "--quick --figures outline --start start.csv --end end.tps --output output".split()
    assert "RMS displacement" in run(
        str(ROOT / "examples/conditioning_paper.py"), *chosen, cwd=tmp_path
    )


def test_calibration(tmp_path):
    """One model and kernel. By chance it fails once in 10 000 draws of the replicates."""
    pytest.importorskip("matplotlib")
    chosen = "--quick --models sine --kernels FunctionSpaceHMC --output output".split()
    out = run(str(ROOT / "benchmarks/calibration.py"), *chosen, cwd=tmp_path)
    (row,) = [json.loads(line) for line in out.splitlines()]
    assert row["replicates"] == 256 and len(row["uniformity"]) == 4, row
    assert min(row["uniformity"].values()) > 2.5e-5, row
    assert (tmp_path / "output" / "calibration.png").stat().st_size > 5000


@pytest.mark.slow
def test_mcmc_benchmark(tmp_path):
    out = run(str(ROOT / "benchmarks/mcmc.py"), "--quick", cwd=tmp_path)
    assert [json.loads(line)["kernel"] for line in out.splitlines()] == [
        "gibbs-pcn-nuts",
        "function-space-hmc",
    ]


@pytest.mark.slow
def test_guided_weight_benchmark(tmp_path):
    out = run(str(ROOT / "benchmarks/guided_weight.py"), "--quick", cwd=tmp_path)
    assert float(re.search(r'"value_difference": ([^,]*)', out).group(1)) < 1e-4


@pytest.mark.slow
def test_score_table_benchmark(tmp_path):
    """A small version: two landmarks, 20 updates of ours, from nothing."""
    pytest.importorskip("matplotlib")
    out = run(
        str(ROOT / "benchmarks/score_table.py"), "--quick", "--output", "output", cwd=tmp_path
    )
    (row,) = [json.loads(line) for line in out.splitlines()]
    assert row["error"] < 1 and row["reference"]["steps_per_second"] > 0, row
    assert (tmp_path / "output" / "score_table.png").stat().st_size > 5000
