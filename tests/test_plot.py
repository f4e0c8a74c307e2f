"""Drawings hold the data they are given, on the axes they are given."""

import builtins

import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import numpyro_bridges as nb
from numpyro_bridges import datasets, plot
from numpyro_bridges.guiding._score import Standard

pytestmark = pytest.mark.usefixtures("compile_quickly")

matplotlib = pytest.importorskip("matplotlib", reason="matplotlib is not installed")
matplotlib.use("Agg")
plt = pytest.importorskip("matplotlib.pyplot")


@pytest.fixture(autouse=True)
def _close():
    yield
    plt.close("all")


@pytest.fixture(scope="module")
def shapes():
    return datasets.ellipses(num_points=12)


@pytest.fixture(scope="module")
def paths(shapes):
    """(7, 21, 12, 2): straight lines from one ellipse to another with noise that vanishes at both
    ends.
    """
    t = np.linspace(0.0, 1.0, 21)[:, None, None]
    noise = np.random.default_rng(0).normal(size=(7, 21, 12, 2))
    return (1.0 - t) * shapes.points[0] + t * shapes.points[3] + 0.1 * t * (1.0 - t) * noise


def test_outlines(shapes):
    lines = plot.outlines(shapes.points, mean=shapes.mean, linewidth=0.5, alpha=0.3)
    assert lines.axes.get_aspect() == 1.0 and not lines.axes.axison
    drawn = np.stack([path.vertices for path in lines.get_paths()])
    np.testing.assert_array_equal(drawn[:, :-1], shapes.points)
    np.testing.assert_array_equal(drawn[:, -1], shapes.points[:, 0])  # closed
    assert (lines.get_linewidth()[0], lines.get_alpha()) == (0.5, 0.3)
    mean = lines.axes.collections[1]
    np.testing.assert_array_equal(mean.get_paths()[0].vertices[:-1], shapes.mean)
    (x0, x1), (y0, y1) = lines.axes.get_xlim(), lines.axes.get_ylim()
    low, high = shapes.points.min(axis=(0, 1)), shapes.points.max(axis=(0, 1))
    assert x0 <= low[0] and y0 <= low[1] and x1 >= high[0] and y1 >= high[1]


def test_one_open_outline_with_a_missing_point_on_given_axes(shapes):
    figure, ax = plt.subplots()
    outline = shapes.points[2].copy()
    outline[4] = np.nan
    lines = plot.outlines(outline, ax, closed=False)
    assert lines.axes is ax and ax.axison and len(plt.get_fignums()) == 1
    assert len(lines.get_paths()[0].vertices) == 12
    figure.canvas.draw()


def test_path(paths):
    ts = np.linspace(0.0, 3.0, 21) ** 2
    lines = plot.path(paths[0], ts=ts, num_outlines=5)
    drawn = np.stack([path.vertices[:-1] for path in lines.get_paths()])
    np.testing.assert_array_equal(drawn, paths[0][[0, 5, 10, 15, 20]])
    np.testing.assert_array_equal(lines.get_array(), ts[[0, 5, 10, 15, 20]])
    lines.figure.colorbar(lines)
    lines.figure.canvas.draw()
    assert lines.get_clim() == (0.0, 9.0)
    assert len(plot.path(paths[0, :3], trajectories=False).axes.collections) == 1


@pytest.mark.parametrize(("direction", "axis"), [("row", 0), ("column", 1)])
def test_bridge_fan(shapes, paths, direction, axis):
    frames = plot.bridge_fan(
        paths, shapes.points[0], shapes.points[3], num_frames=3, direction=direction, max_outlines=5
    )
    frames[0].figure.canvas.draw()
    assert [text.get_text() for text in frames[0].axes.texts] == ["$t = 0$", "$t = 0.5$", "$t = 1$"]
    drawn = [np.stack([path.vertices[:-1] for path in frame.get_paths()]) for frame in frames]
    for outlines, index in zip(drawn, [0, 10, 20], strict=True):
        shift = outlines - paths[:5, index]
        np.testing.assert_allclose(shift, np.broadcast_to(shift[0, 0], shift.shape), atol=1e-12)
    ends = [(outlines[..., axis].min(), outlines[..., axis].max()) for outlines in drawn]
    ends = ends if direction == "row" else [(-high, -low) for low, high in ends]
    assert ends[0][1] < ends[1][0] and ends[1][1] < ends[2][0]  # frames do not overlap
    (legend,) = frames[0].figure.legends
    assert {text.get_text() for text in legend.get_texts()} == {"start", "bridges", "target"}


def test_score_field(shapes):
    points = shapes.points[1]
    arrows = np.arange(24.0).reshape(12, 2)
    quiver = plot.score_field(points, arrows, length=0.5)
    drawn = np.stack([quiver.U, quiver.V], axis=1)
    np.testing.assert_allclose(drawn, arrows * 0.5 / np.linalg.norm(arrows[-1]))
    quiver.figure.canvas.draw()
    assert np.all(quiver.axes.get_xlim()[1] >= (points + drawn)[:, 0].max())
    assert not plot.score_field(points, np.zeros((12, 2))).U.any()


@pytest.fixture(scope="module")
def flows(shapes):
    """Bridges of the same shapes as landmarks and as coefficients, with a path each."""
    start, target = shapes.points[0], shapes.points[3]
    landmarks, basis = nb.Landmarks(12, 2), nb.FourierBasis(2, 2, num_quadrature=9)
    kernel, match = nb.GaussianKernel(0.5, 0.5), nb.InexactMatch(1e-3)
    bridges = {
        "points": nb.GuidedBridge(
            nb.KunitaFlow(landmarks, kernel),
            match.at(target),
            x0=start,
            ts=np.linspace(0.0, 2.0, 9),
        ),
        "series": nb.GuidedBridge(
            nb.KunitaFlow(basis, kernel, noise="grid"),
            match.at(basis.project(target)),
            x0=basis.project(start),
            ts=np.linspace(0.0, 2.0, 6),
        ),
    }
    paths = {
        name: bridge.path(jr.normal(jr.key(0), bridge.noise_shape))
        for name, bridge in bridges.items()
    }
    return bridges, paths


@pytest.mark.parametrize("scale", [None, 0.05])
def test_score_frames(flows, shapes, tmp_path, scale):
    bridges, paths = flows
    quivers = plot.score_frames(
        bridges, paths, [0.0, 0.8, 1.9], tmp_path / "frames.png", scale=scale
    )
    assert (tmp_path / "frames.png").stat().st_size > 0 and not plt.get_fignums()
    drawn, lengths = [], []
    for line, (name, bridge) in zip(quivers, bridges.items(), strict=True):
        indices = {"points": [0, 3, 7], "series": [0, 2, 4]}[name]
        for quiver, k in zip(line, indices, strict=True):
            t, x = bridge.ts[k], paths[name][k]
            field = np.asarray(bridge.sde.covariance(t, x)) @ np.asarray(bridge.score(t, x))
            points, field = (np.asarray(bridge.sde.space.to_points(part)) for part in (x, field))
            np.testing.assert_allclose(quiver.get_offsets(), points)
            arrows = np.stack([quiver.U, quiver.V], axis=1)
            drawn.append(np.linalg.norm(arrows) / np.linalg.norm(field))
            lengths.append(np.linalg.norm(arrows, axis=1).max())
            np.testing.assert_allclose(arrows, drawn[-1] * field, atol=1e-12)
            assert quiver.axes.get_title() == f"$t = {t:.3g}$"
            (x0, x1), (y0, y1) = quiver.axes.get_xlim(), quiver.axes.get_ylim()
            corners = np.concatenate([points, points + arrows])
            assert np.all(corners > [x0, y0]) and np.all(corners < [x1, y1])
    np.testing.assert_allclose(drawn, drawn[0])  # one scale for all frames
    extent = max(np.ptp(quiver.get_offsets(), axis=0).max() for line in quivers for quiver in line)
    assert (
        drawn[0] == pytest.approx(scale) if scale else max(lengths) == pytest.approx(extent / 3.0)
    )
    targets = [line[0].axes.collections[0].get_paths()[0].vertices[:-1] for line in quivers]
    np.testing.assert_allclose(targets[0], shapes.points[3])
    space = bridges["series"].sde.space
    np.testing.assert_allclose(targets[1], space.to_points(bridges["series"].condition.observed))
    assert "the drift that conditioning adds" in quivers[0][0].figure.get_supxlabel()
    labels = [line[0].axes.texts[0].get_text() for line in quivers]
    assert labels == list(bridges)


def test_score_frames_of_one_bridge(flows, tmp_path):
    """Guides on one path share its columns' titles; one bridge needs no name."""
    (bridge, _), (path, _) = (part.values() for part in flows)
    frozen = bridge.with_guide(nb.FrozenGuide())
    alone = plot.score_frames(frozen, path, 0.5, tmp_path / "a.png")
    pair = plot.score_frames({"receding": bridge, "frozen": frozen}, path, 0.5, tmp_path / "b.png")
    assert [len(line) for line in alone] == [1] and [len(line) for line in pair] == [1, 1]
    assert [line[0].axes.get_title() for line in pair] == ["$t = 0.5$", ""]
    assert not np.allclose(pair[0][0].U, pair[1][0].U)


def test_score_frames_errors(flows):
    bridges, paths = flows
    one, path = bridges["points"], paths["points"]
    with pytest.raises(
        ValueError, match=r"`paths` must have the names of `bridges`, \['a'\]; got \['b'\]"
    ):
        plot.score_frames({"a": one}, {"b": path}, [0.0], "never.png")
    with pytest.raises(
        ValueError, match=r"`paths` must have a state for each .*\(9, 12, 2\); got \(5, 12, 2\)"
    ):
        plot.score_frames(one, path[:5], [0.0], "never.png")
    with pytest.raises(
        ValueError, match=r"`times` must lie in \[0.0, 2.0\), before the end; got \[2.\]"
    ):
        plot.score_frames(one, path, 2.0, "never.png")
    with pytest.raises(ValueError, match="`paths` must lead to finite drifts"):
        plot.score_frames(one, np.asarray(path) * np.nan, 0.0, "never.png")
    line = nb.GuidedBridge(
        nb.BrownianMotion(1.0),
        nb.InexactMatch(0.1).at([1.0, 2.0]),
        x0=[0.0, 1.0],
        t1=1.0,
        num_steps=2,
    )
    with pytest.raises(ValueError, match=r"`paths` must have the shape \(T, q, 2\), got \(1, 2\)"):
        plot.score_frames(line, np.zeros((3, 2)), 0.0, "never.png")


LADDER = nb.Tree.from_newick("((a:1,b:2)ab:1,c:4):1;")  # root, ab with its parent at 1, three tips


def drawn_on(ax, layer):
    """Vertices of the shapes of one layer, in inches from the lower left corner of the figure, by
    their order.
    """
    ax.figure.canvas.draw()
    lines = [line for line in ax.collections if line.get_zorder() == layer]
    points = [
        line.get_transform().transform([path.vertices for path in line.get_paths()][0])
        for line in lines
    ]
    return [inches / ax.figure.dpi for inches in points]


def test_tree():
    branches = plot.tree(LADDER)
    ax = branches.axes
    # Tips lie at 0, −1 and −2 from top to bottom, an inner node in the middle of its children.
    depths, rows = [0, 1, 2, 3, 4, 5], [-1.25, -1.25, -0.5, 0, -1, -2]
    drawn = np.stack([path.vertices for path in branches.get_paths()])
    above = [0, 1, 2, 2, 1]
    corners = [
        [[depths[up], rows[up]], [depths[up], rows[i]], [depths[i], rows[i]]]
        for i, up in enumerate(above, 1)
    ]
    np.testing.assert_allclose(drawn, corners)
    assert [text.get_text() for text in ax.texts] == ["a", "b", "c"]
    assert [tuple(text.xy) for text in ax.texts] == [(3, 0), (4, -1), (5, -2)]
    assert ax.get_xlabel() == "time since the root" and ax.get_xlim() == (0, 5)
    with pytest.raises(ValueError, match="`tree` must be a `Tree`"):
        plot.tree("(a:1,b:1);")


def test_tree_with_shapes(shapes):
    """One scale for all shapes, tips beside their ends, inner nodes on them, with outlines of draws
    around.
    """
    rng = np.random.default_rng(0)
    cloud = shapes.points[1] + 0.1 * rng.normal(size=(60, 12, 2))
    given = {"a": shapes.points[0], 5: shapes.points[3], "ab": shapes.points[1]}
    branches = plot.tree(
        LADDER, shapes=given, draws={2: cloud, 0: cloud}, size=0.8, max_outlines=10
    )
    ax = branches.axes
    outlines = dict(zip([2, 0, 3, 5], drawn_on(ax, 4), strict=True))
    at = {
        node: ax.transData.transform(xy) / ax.figure.dpi for node, xy in nodes_of(branches).items()
    }
    chosen = cloud[np.linspace(0, 59, 10).round().astype(int)]
    expected = {0: chosen.mean(axis=0), 2: given["ab"], 3: given["a"], 5: given[5]}
    extents = [np.ptp(points, axis=0) for points in (chosen.reshape(-1, 2), *expected.values())]
    scale = 0.8 / np.max(extents)
    for node, outline in expected.items():
        middle = (outline.min(0) + outline.max(0)) / 2
        on_paper = outlines[node][:-1] - at[node]
        shift = on_paper[0] - scale * (outline - middle)[0]
        np.testing.assert_allclose(on_paper - shift, scale * (outline - middle), atol=1e-9)
        beside = shift[0] - scale * np.max(extents, axis=0)[0] / 2
        assert (
            np.allclose(shift, 0, atol=1e-9)
            if node in (0, 2)
            else beside > 0 and abs(shift[1]) < 1e-9
        )
    bands = [line for line in ax.collections if line.get_zorder() == 3]
    drawn = np.stack([path.vertices[:-1] for path in bands[0].get_paths()])
    middle = (given["ab"].min(0) + given["ab"].max(0)) / 2
    np.testing.assert_allclose(drawn, chosen - middle)
    assert len(bands) == 2 and bands[0].get_alpha() < 1


def nodes_of(branches):
    """Where the nodes lie on the axes, from the ends of the branches."""
    ends = [path.vertices for path in branches.get_paths()]
    return {0: ends[0][0]} | {node: end[-1] for node, end in enumerate(ends, 1)}


def test_tree_of_arrays_on_given_axes(shapes):
    """An array for all nodes is the same as shapes by number; a node without shape is NaN; a chain
    names its nodes.
    """
    figure, axes = plt.subplots(2)
    chain = nb.Tree.chain([1.0, 3.0], names=["young", "old"])
    several = np.stack([np.full((12, 2), np.nan), shapes.points[0], shapes.points[1]])
    first = plot.tree(
        chain, axes[0], shapes=several, draws=np.stack([several, several]), closed=False
    )
    plot.tree(chain, axes[1], shapes={"young": several[1], 2: several[2]}, closed=False)
    assert first.axes is axes[0] and len(plt.get_fignums()) == 1
    whole, by_name = drawn_on(axes[0], 4), drawn_on(axes[1], 4)
    assert [len(outline) for outline in whole] == [12, 12]
    for one, other in zip(whole, by_name, strict=True):
        np.testing.assert_allclose(one - one[0], other - other[0], atol=1e-9)
    assert sorted(text.get_text() for text in axes[0].texts) == ["old", "young"]


def test_tree_errors(shapes):
    point = shapes.points[0]
    with pytest.raises(
        ValueError, match=r"`shapes` must be given by names of nodes, .* from 0 to 5; got 'd'"
    ):
        plot.tree(LADDER, shapes={"d": point})
    with pytest.raises(
        ValueError, match=r"`draws\['a'\]` must have the shape \(S, n, 2\), got \(12, 2\)"
    ):
        plot.tree(LADDER, draws={"a": point})
    with pytest.raises(
        ValueError, match=r"`shapes` must have the shape \(num_nodes, n, 2\) with 6 nodes, got \(4"
    ):
        plot.tree(LADDER, shapes=shapes.points)
    with pytest.raises(ValueError, match="`size` must be a positive number of inches; got 0"):
        plot.tree(LADDER, size=0)


def test_posterior():
    rng = np.random.default_rng(0)
    samples = {
        "location": rng.normal(size=4000),
        "scale": np.abs(rng.normal(size=4000)),
        "noise": np.ones((4, 2)),
    }
    prior = {"location": 3.0 * rng.normal(size=4000), "elsewhere": np.ones(9)}
    areas = plot.posterior(samples, prior, truth={"scale": 0.5})
    areas[0].figure.canvas.draw()
    assert [area.axes.get_xlabel() for area in areas] == ["location", "scale"]
    before, posterior = (areas[0].axes.lines[i].get_xydata().T for i in range(2))
    after = areas[1].axes.lines[0].get_xydata().T
    # A kernel estimate from 4000 draws has a standard error of about 0.01 here.
    np.testing.assert_allclose(
        posterior[1], np.exp(-(posterior[0] ** 2) / 2.0) / np.sqrt(2.0 * np.pi), atol=0.04
    )
    np.testing.assert_allclose(
        before[1], np.exp(-(before[0] ** 2) / 18.0) / np.sqrt(18.0 * np.pi), atol=0.015
    )
    np.testing.assert_allclose(
        after[1], np.exp(-(after[0] ** 2) / 2.0) * np.sqrt(2.0 / np.pi), atol=0.09
    )
    assert after[0].min() == 0.0
    for grid, density in (posterior, after):
        step = grid[1] - grid[0]
        area = step * (density.sum() - density[[0, -1]].sum() / 2.0)
        assert area == pytest.approx(1.0, abs=0.02)
    low, high = areas[0].axes.lines[2].get_xdata()
    np.testing.assert_allclose((low, high), np.quantile(samples["location"], [0.05, 0.95]))


def test_posterior_of_equal_draws_on_given_axes():
    _, ax = plt.subplots()
    (area,) = plot.posterior({"a": np.full(10, 2.0)}, axes=ax)
    assert area.axes is ax
    ax.figure.canvas.draw()


def test_errors(shapes, paths):
    points = shapes.points[0]
    with pytest.raises(
        ValueError, match=r"`shapes` must have the shape \(n, 2\) or \(N, n, 2\), got \(5, 3\).*:2"
    ):
        plot.outlines(np.ones((5, 3)))
    with pytest.raises(
        ValueError, match=r"`path` must have the shape \(K \+ 1, n, 2\), got \(12, 2\)"
    ):
        plot.path(points)
    with pytest.raises(
        ValueError, match=r"`ts` must have the shape \(21,\), one time for each state, got \(4,\)"
    ):
        plot.path(paths[0], ts=np.arange(4.0))
    with pytest.raises(ValueError, match=r"`paths` must have the shape \(S, K \+ 1, n, 2\)"):
        plot.bridge_fan(paths[0], points, points)
    with pytest.raises(
        ValueError, match=r"`arrows` must have the shape of `points` \(12, 2\), got \(3, 2\)"
    ):
        plot.score_field(points, points[:3])
    with pytest.raises(ValueError, match="at least one scalar parameter"):
        plot.posterior({"noise": np.ones((4, 2))})
    with pytest.raises(ValueError, match=r"`samples\['a'\]` must be finite"):
        plot.posterior({"a": np.array([1.0, np.nan])})
    with pytest.raises(
        ValueError, match=r"`axes` must be as many as the parameters \['a', 'b'\], got 1"
    ):
        plot.posterior({"a": np.arange(3.0), "b": np.arange(3.0)}, axes=plt.subplots()[1])


def test_without_matplotlib(monkeypatch, shapes):
    real = builtins.__import__

    def without(name, *args, **kwargs):
        if name.startswith("matplotlib"):
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    for draw in (
        lambda: plot.outlines(shapes.points),
        lambda: plot.posterior({"a": np.arange(3.0)}),
        lambda: plot.tree(LADDER),
    ):
        with pytest.raises(ImportError, match=r"pip install 'numpyro_bridges\[examples\]'"):
            draw()


def test_deformation(shapes):
    """A grid of a known path: as `carry` has it, coloured by the area of its cells; the outlines of
    start and end.
    """
    flow = nb.KunitaFlow(nb.Landmarks(12, 2), nb.GaussianKernel(0.3, 0.8))
    path = np.linspace(shapes.points[0], shapes.points[3], 6)
    mesh = plot.deformation(flow, path, num_lines=8, margin=0.5)
    corners = np.asarray(mesh.get_coordinates())
    area = np.asarray(mesh.get_array()).reshape(corners.shape[:2])
    low, high = path[0].min(axis=0), path[0].max(axis=0)
    reach = 0.5 * (high - low).max()
    np.testing.assert_allclose(
        corners[0, 0], flow.carry(path, (low - reach)[None])[-1, 0], atol=1e-10
    )
    np.testing.assert_allclose(
        corners[-1, -1], flow.carry(path, (high + reach)[None])[-1, 0], atol=1e-10
    )
    sides = (high - low + 2 * reach) / (np.array(area.shape) - 1)
    # diagonals
    one, other = corners[1:, 1:] - corners[:-1, :-1], corners[:-1, 1:] - corners[1:, :-1]
    cells = (one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0]) / 2 / np.prod(sides)
    at_corners = 2.0**area
    mean = (
        at_corners[1:, 1:] + at_corners[1:, :-1] + at_corners[:-1, 1:] + at_corners[:-1, :-1]
    ) / 4
    np.testing.assert_allclose(cells, mean, rtol=0.02)
    assert mesh.get_clim()[1] == pytest.approx(np.abs(area).max()) and np.ptp(area) > 0.3
    drawn = [line.vertices for lines in mesh.axes.collections[-2:] for line in lines.get_paths()]
    np.testing.assert_allclose(drawn[0][:-1], path[0])
    np.testing.assert_allclose(drawn[1][:-1], path[-1])
    mesh.figure.canvas.draw()


def test_deformation_refuses(shapes):
    path, kernel = np.stack([shapes.points[0]] * 2), nb.GaussianKernel(0.3, 0.8)
    with pytest.raises(ValueError, match="`flow` must be a flow"):
        plot.deformation(nb.BrownianMotion(1.0), path)
    with pytest.raises(ValueError, match=r"`flow` must move points of the plane.*R\^3"):
        plot.deformation(nb.KunitaFlow(nb.Landmarks(12, 3), kernel), path)
    with pytest.raises(ValueError, match="`num_lines` must be an integer, at least 2; got 1"):
        plot.deformation(nb.KunitaFlow(nb.Landmarks(12, 2), kernel), path, num_lines=1)


def test_training(tmp_path):
    """The network that was kept has a dot; what follows is pale."""
    columns = {
        "seconds": np.arange(6.0),
        "bound": np.array([-np.inf, -3.0, -2.0, -1.0, -1.5, -0.5]),
    }
    columns["ess"] = np.array([0.1, 0.2, 0.5, 0.6, 0.6, 0.2])
    columns["kept"] = np.array([0.0, 1.0, 1.0, 1.0, 0.0, 0.0])
    guide = nb.ScoreGuide(nb.FrozenGuide(), abs, standard(), history=columns)
    figure = plot.training({"a": guide, "b": guide}, tmp_path / "training.png")
    assert (tmp_path / "training.png").stat().st_size > 0 and not plt.get_fignums()
    for ax, values in zip(figure.axes, (columns["bound"], 100 * columns["ess"]), strict=True):
        pale, whole, dot = ax.lines[:3]
        np.testing.assert_array_equal(dot.get_xydata(), [[3.0, values[3]]])
        assert pale.get_alpha() < 1 and len(whole.get_xdata()) == 4 and len(pale.get_xdata()) == 3
    assert [text.get_text() for text in figure.axes[0].get_legend().get_texts()] == ["a", "b"]
    with pytest.raises(
        ValueError, match=r"`guides\['a'\]` must have a history of its training.*`nb.scores.fit`"
    ):
        plot.training(
            {"a": nb.ScoreGuide(nb.FrozenGuide(), abs, standard())}, tmp_path / "never.png"
        )


def standard():
    return Standard(*(jnp.ones(shape) for shape in ((), (2, 1), (2, 1), (2, 1), 0, 0)))
