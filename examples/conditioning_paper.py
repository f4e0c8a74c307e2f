# %% [markdown]
# # Conditioning shape processes: the experiments of a paper
#
# Baker, Yang, Severinsen, Hipsley and Sommer (2024), "Conditioning non-linear and
# infinite-dimensional diffusion processes": its experiments on shapes, with this library's bridges.
# The paper learns every score from nothing; here a learned score corrects a guided bridge, weights
# make it exact, and ESS and k̂ say how good it is.
#
#     python examples/conditioning_paper.py            # mosquito wings, all figures
#     python examples/conditioning_paper.py --quick    # some two minutes
#     python examples/conditioning_paper.py --figures bridge --start a.csv --end b.csv
#     python examples/conditioning_paper.py --figures species --specimens all.csv --labels table.csv
#
# Files: tps or CSV, any number of points, the same in all files, row i being the same place on each
# shape. Shapes are aligned, and drawn in units of the start's larger extent: a kernel of width 0.1
# is a tenth of it.

# %%
import argparse
import csv
import gzip
import json
import os
from pathlib import Path

# threads of its own slow small matrices down, many times over
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import jax.numpy as jnp
import jax.random as jr
import matplotlib
import numpy as np

import numpyro_bridges as nb

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

FIGURES = ("circles", "outline", "brownian", "bridge", "species", "scores")
parser = argparse.ArgumentParser()
parser.add_argument("--quick", action="store_true", help="few points, steps, updates and paths")
parser.add_argument("--figures", nargs="+", choices=FIGURES, default=FIGURES)
parser.add_argument(
    "--start", type=Path, help="a tps or CSV file; of several specimens, their mean"
)
parser.add_argument("--end", type=Path, nargs="+", help="files; the first specimen of each")
parser.add_argument(
    "--specimens", type=Path, help="one file of many specimens, for the figure `species`"
)
parser.add_argument(
    "--labels", type=Path, help="a CSV table with a row for each of them, and their species"
)
parser.add_argument("--label", default="species", help="the column of that table")
parser.add_argument(
    "--id", default="id", help="the column of a CSV file that tells specimens apart"
)
parser.add_argument("--points", type=int, default=32, help="landmarks of the bridges")
parser.add_argument("--width", type=float, default=0.1, help="of the kernel, for the bridges")
parser.add_argument("--updates", type=int, default=150, help="of each training")
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--output", type=Path, default=Path("output"))
arguments, _ = parser.parse_known_args()
quick = arguments.quick
num_points, num_steps = (16, 20) if quick else (arguments.points, 50)
num_particles = 256 if quick else 2048
updates = 20 if quick else arguments.updates
NOISE = 0.2  # SD of a point's observation, of the RMS distance between start and end
arguments.output.mkdir(parents=True, exist_ok=True)
keys = dict(zip(FIGURES, jr.split(jr.key(arguments.seed), len(FIGURES)), strict=True))
numbers = {}

# %% [markdown]
# ## Shapes
# Points are taken at equal steps of their number, so that what corresponds stays together.


# %%
def read(file):
    """Shapes `(N, n, 2)` of a file, curves before landmarks."""
    tps = Path(file.stem if file.suffix == ".gz" else file.name).suffix.lower() == ".tps"
    specimens = nb.io.read_tps(file) if tps else nb.io.read_csv(file, id=arguments.id)
    return np.stack([np.concatenate(s.curves) if s.curves else s.landmarks for s in specimens])


def prepared(shapes, start=None):
    """Aligned shapes and their start, by default their mean, in units of the start's extent."""
    shapes = shapes if start is None else np.concatenate([start[None], shapes])
    aligned, mean, *_ = nb.shapes.procrustes_align(shapes)
    start, ends = (mean, aligned) if start is None else (aligned[0], aligned[1:])
    extent = np.ptp(start, axis=0).max()
    return start / extent, ends / extent


def transition():
    """Start and end of the bridges, and their names."""
    if arguments.start is None or arguments.end is None:
        wings = nb.datasets.mosquito_wings(num_points=96)
        far = int(np.argmax(np.sum((wings.points - wings.mean) ** 2, axis=(1, 2))))
        start, ends = prepared(wings.points)
        return start, ends[far], ("mean wing", wings.names[far])
    start = read(arguments.start)
    start = start[0] if len(start) == 1 else nb.shapes.mean_shape(start)
    start, ends = prepared(np.stack([read(file)[0] for file in arguments.end]), start)
    return start, ends[0], (arguments.start.stem, arguments.end[0].stem)


def one_of_each():
    """A mean, one specimen of each species by name."""
    if arguments.specimens is not None and arguments.labels is not None:
        shapes = read(arguments.specimens)
        opened = gzip.open if arguments.labels.suffix == ".gz" else open
        with opened(arguments.labels, "rt", encoding="utf-8", newline="") as file:
            labels = [row[arguments.label] for row in csv.DictReader(file)]
        if len(labels) != len(shapes):
            raise SystemExit(
                f"--labels must have a row for each of {len(shapes)} specimens, and has "
                f"{len(labels)}."
            )
    elif arguments.start is not None and arguments.end is not None:
        start = read(arguments.start)
        start = start[0] if len(start) == 1 else nb.shapes.mean_shape(start)
        start, ends = prepared(np.stack([read(file)[0] for file in arguments.end]), start)
        return start, dict(zip([file.stem for file in arguments.end], ends, strict=True))
    else:
        wings = nb.datasets.mosquito_wings(num_points=96)
        shapes, labels = wings.points, wings.labels
    mean, aligned = prepared(shapes)
    common = [label for label in dict.fromkeys(labels) if list(labels).count(label) > 4]
    return mean, {
        label: aligned[list(labels).index(label)] for label in common[: 2 if quick else 5]
    }


def landmarks(shape, num=None):
    """So many of the points, at equal steps of their number."""
    num = num_points if num is None else num
    return jnp.asarray(shape[np.round(np.arange(num) * len(shape) / num).astype(int)])


# %% [markdown]
# ## Processes
# `sd` is that of a point at time 1. On a Fourier basis the noise is a random Fourier series in the
# plane, with as many frequencies as the kernel's width asks for; it does not depend on how the
# shape is discretised.


# %%
def flow(space, width, sd, spectral=False):
    kernel = nb.GaussianKernel(sd / (np.sqrt(np.pi) * width), width)
    if not spectral and isinstance(space, nb.Landmarks):
        return nb.KunitaFlow(space, kernel)
    num_modes = int(np.ceil(2.6 * (1.5 + 8.6 * width) / (2 * np.pi * width)))
    return nb.KunitaFlow(space, kernel, noise=nb.SpectralNoise(num_modes, diameter=1.5))


def rms(difference):
    return float(np.sqrt(np.mean(np.sum(np.asarray(difference) ** 2, axis=-1))))


def learned(bridge, key, *, network=None, draw=None):
    training = nb.scores.Training(
        updates, 8 if quick else 16, interval=max(updates // 5, 1), held_out=128
    )
    if network is None and isinstance(bridge.sde.space, nb.Landmarks):
        network = nb.scores.PointNetwork(2, width=16, depth=1, key=key)
    settings = {"network": network, "training": training, "draw": draw, "progress": False}
    found = nb.scores.fit(
        bridge.sde,
        bridge.condition,
        x0=bridge.x0,
        ts=bridge.ts,
        key=key,
        guide=bridge.guide,
        **settings,
    )
    return bridge.with_guide(found)


def weighted_paths(bridge, key, num):
    """`num` paths of the conditioned process: drawn from many guided ones in proportion to
    exp(log_weight).
    """
    key_noise, key_choice = jr.split(key)
    noise = jr.normal(key_noise, (num_particles, *bridge.noise_shape))
    paths, log_weights = jax.lax.map(
        bridge.path_and_log_weight, noise, batch_size=min(256, num_particles)
    )
    weights = np.asarray(jax.nn.softmax(log_weights), dtype=float)
    points = (float(jr.uniform(key_choice)) + np.arange(num)) / num
    chosen = np.minimum(np.searchsorted(np.cumsum(weights), points), num_particles - 1)
    chosen = np.asarray(jr.permutation(key_choice, jnp.asarray(chosen)))
    different = len(np.unique(chosen))
    print(
        f"  {num} paths resampled from {num_particles} by exp(log_weight); {different} different "
        "ones among them"
    )
    return np.asarray(paths)[chosen], different


def report(figure, name, bridges, key, **settings):
    comparison = nb.compare(bridges, key, num_particles=num_particles, **settings)
    print(f"{figure}: {name}\n{comparison}")
    numbers.setdefault(figure, {})[name] = comparison.rows
    return comparison


def save(name):
    plt.savefig(arguments.output / name, dpi=150)
    plt.close()
    print(f"written: {arguments.output / name}")


def panels(num_rows, num_columns, size=2.3, shape=None):
    """Axes without frames, `size` inches wide, in the proportions of a shape."""
    aspect = 0.65 if shape is None else np.ptp(shape[:, 1]) / np.ptp(shape[:, 0])
    inches = (size * num_columns, (1.2 * size * aspect + 0.35) * num_rows)
    figure, axes = plt.subplots(
        num_rows, num_columns, figsize=inches, squeeze=False, layout="constrained"
    )
    for ax in axes.flat:
        ax.set_aspect("equal")
        ax.set_axis_off()
    return figure, axes


def magnifier(start, ends):
    """What makes small deviations from the start visible, and a word on it."""
    times = max(1, int(0.08 / rms(ends - start)))
    words = f"deviations from the start × {times}" if times > 1 else ""
    return lambda shapes: np.asarray(start + times * (np.asarray(shapes) - start)), words


# %% [markdown]
# ## Circles, carried by kernels of several widths
# In a row one noise: the more basis functions, the nearer the curves to their limit. Dots are as
# many landmarks, carried by the same noise. (The real basis 1, cos, sin, ... has an odd number of
# functions.)


# %%
def circles():
    widths, modes = (0.1, 0.2, 0.4), (2, 4, 8, 12)
    steps = 20 if quick else 100
    figure, axes = panels(len(widths), len(modes))
    for line, width in zip(axes, widths, strict=True):
        ends = {}
        for ax, m in zip(line, modes, strict=True):
            paths = [
                circle_path(space, width, steps)
                for space in (nb.FourierBasis(m, 2), nb.Landmarks(2 * m + 1, 2))
            ]
            lines = nb.plot.path(paths[0], ax, num_outlines=6, trajectories=False)
            ax.plot(*paths[1][-1].T, "o", markersize=3, color="#d55e00", zorder=3)
            ends[2 * m + 1] = paths[0][-1], paths[1][-1]
        numbers.setdefault("circles", {})[str(width)] = circle_errors(ends, width)
        line[0].text(
            -0.05,
            0.5,
            f"width {width}",
            transform=line[0].transAxes,
            rotation=90,
            ha="right",
            va="center",
        )
    for ax, m in zip(axes[0], modes, strict=True):
        ax.set_title(f"{2 * m + 1} basis functions", fontsize=10)
    limits = np.array([ax.axis() for ax in axes.flat])
    for ax in axes.flat:
        ax.axis((limits[:, 0].min(), limits[:, 1].max(), limits[:, 2].min(), limits[:, 3].max()))
    figure.colorbar(lines, ax=axes, label="time", shrink=0.5)
    save("circles.png")


def circle_path(space, width, steps):
    s = 2 * np.pi * np.arange(200) / 200
    circle = 0.5 * np.stack([np.cos(s), np.sin(s)], axis=1)
    sde = flow(space, width, sd=0.15, spectral=True)
    x0 = start_state(space, circle)
    noise = jr.normal(keys["circles"], (steps, sde.noise_size(x0), 2))
    path = nb.simulate(sde, x0, jnp.linspace(0.0, 1.0, steps + 1), noise)
    if isinstance(space, nb.Landmarks):
        return np.asarray(path)
    return np.asarray(jax.vmap(lambda x: space.evaluate(x, s))(path))


def start_state(space, shape):
    """A shape as a state: its landmarks, or its Fourier coefficients."""
    return (
        landmarks(shape, space.size)
        if isinstance(space, nb.Landmarks)
        else space.project(jnp.asarray(shape))
    )


def circle_errors(ends, width):
    finest = ends[max(ends)][0]
    errors = {}
    for n, (curve, points) in ends.items():
        on_curve = landmarks(finest, n)
        errors[str(n)] = {"fourier": rms(curve - finest), "landmarks": rms(points - on_curve)}
        print(
            f"circles: width {width}, {n} functions: RMS distance at time 1 to the curve of "
            f"{max(ends)}:",
            end=" ",
        )
        print(
            f"Fourier {errors[str(n)]['fourier']:.4f}, landmarks {errors[str(n)]['landmarks']:.4f}"
        )
    return errors


# %% [markdown]
# ## An outline without a condition
# Points that are close together move together, over a tenth of the outline's extent.


# %%
def outline():
    start, _, names = transition()
    x0 = landmarks(start, 32 if quick else 64)
    sde = flow(nb.Landmarks(len(x0), 2), 0.1, sd=0.1)
    ts = jnp.linspace(0.0, 1.0, num_steps + 1)
    path = np.asarray(
        nb.simulate(sde, x0, ts, jr.normal(keys["outline"], (num_steps, sde.noise_size(x0), 2)))
    )
    figure, axes = panels(1, 1, size=5.5, shape=start)
    lines = nb.plot.path(path, axes[0, 0], num_outlines=4, trajectories=False)
    lines.set_alpha(0.7)
    for i in range(0, len(x0), len(x0) // 8):
        axes[0, 0].plot(*path[:, i].T, color="#d55e00", linewidth=1.2, zorder=3)
        axes[0, 0].plot(*path[0, i], "o", color="#d55e00", markersize=4, zorder=3)
    axes[0, 0].set_title(f"{names[0]}, unconditioned, kernel width 0.1", fontsize=10)
    figure.colorbar(lines, ax=axes, label="time", shrink=0.6)
    numbers["outline"] = {"rms_displacement": rms(path[-1] - path[0])}
    print(
        f"outline: RMS displacement of {len(x0)} points at time 1: "
        f"{numbers['outline']['rms_displacement']:.3f}"
    )
    save("outline.png")


# %% [markdown]
# ## Brownian motion between shapes
# Q-Brownian motion with variances that fall with the frequency, the same process in both
# discretisations: N Fourier coefficients, or the N points that they give. The default guide is
# exact here. Beside it, one that takes the noise to be white, and for inexact matches a network
# that learns what this one lacks. ∇log h has a closed form, so the error of each score is known.


# %%
def brownian():
    start, end, names = transition()
    basis = nb.FourierBasis(4 if quick else 8, 2)
    n = basis.size
    frequencies = np.concatenate([[0], np.repeat(np.arange(1, basis.num_modes + 1), 2)])
    spread = rms(landmarks(end, n) - landmarks(start, n))
    variances = jnp.asarray(spread**2 * (1.0 + frequencies) ** -2.0)
    points = nb.Landmarks(n, 2)
    values = basis.basis(points.grid)
    processes = {
        "Fourier": nb.BrownianMotion(variances, space=basis),
        "landmarks": nb.BrownianMotion(values * variances @ values.T, space=points),
    }
    matches = {"exact": nb.ExactMatch(), "inexact": nb.InexactMatch((NOISE * spread) ** 2 / n)}
    figure, axes = panels(2, 2, size=3.6, shape=start)
    found = {}
    for line, (kind, sde) in zip(axes, processes.items(), strict=True):
        for ax, (match_name, match) in zip(line, matches.items(), strict=True):
            x0, v = (basis.project(landmarks(shape, n)) for shape in (start, end))
            x0, v = (x0, v) if kind == "Fourier" else (values @ x0, values @ v)
            bridge = nb.GuidedBridge(sde, match.at(v), x0=x0, t1=1.0, num_steps=num_steps)
            found[kind, match_name] = brownian_row(f"{kind}, {match_name}", bridge, v)
            draw_brownian(ax, bridge, f"{kind}, {match_name}")
    figure.suptitle(
        "Brownian bridges: start (dark), end (orange), 20 paths at time 1/2", fontsize=10
    )
    save("brownian.png")
    for match_name in matches:
        gap = float(found["Fourier", match_name] - found["landmarks", match_name]) - n * np.log(n)
        print(
            f"brownian: {match_name}: log density in coefficients, less that in points, less N log "
            f"N: {gap:.4f}"
        )
        numbers["brownian"][f"{match_name}: gap of the discretisations"] = gap


def brownian_row(name, bridge, v):
    """Compares the exact guide, a white one and its learned correction; the log evidence."""
    a = bridge.sde.covariance(0.0, bridge.x0)
    a = jnp.diag(a) if a.ndim == 1 else a
    noise = (
        0.0
        if bridge.condition.exact
        else bridge.condition.match.variance / bridge.sde.space.weights
    )

    def score(t, x):
        return jnp.linalg.solve(a * (bridge.ts[-1] - t) + noise * jnp.eye(len(a)), v - x)

    white = bridge.with_guide(nb.FrozenGuide(nb.BrownianMotion(jnp.mean(jnp.diag(a)))))
    bridges = {"guided": bridge}
    if not bridge.condition.exact and (not quick or name == "Fourier, inexact"):
        bridges["white guide"] = white
        network = nb.scores.MLP(bridge.x0.shape, key=keys["brownian"])
        bridges["learned on it"] = learned(white, keys["brownian"], network=network)
    return report("brownian", name, bridges, keys["brownian"], score=score).rows["guided"][
        "log_evidence"
    ]


def draw_brownian(ax, bridge, title):
    space = bridge.sde.space
    s = 2 * np.pi * np.arange(100) / 100
    paths = jax.vmap(bridge.path)(jr.normal(keys["brownian"], (20, *bridge.noise_shape)))
    curves = jax.vmap(jax.vmap(lambda x: space.evaluate(x, s)))(paths)
    middle = int(np.abs(np.asarray(bridge.ts) - 0.5).argmin())
    nb.plot.outlines(curves[:, middle], ax)
    nb.plot.outlines(curves[0, 0], ax, color="#003f5c", linewidth=1.6)
    nb.plot.outlines(curves[:, -1].mean(0), ax, color="#d55e00", linewidth=1.6)
    ax.set_title(title, fontsize=9)


# %% [markdown]
# ## The bridge between two outlines
# Guided, and with a learned correction. What is drawn has the conditioned law: paths are resampled
# from many in proportion to their weights.


# %%
def bridge():
    start, end, names = transition()
    x0, v = landmarks(start), landmarks(end)
    space = nb.Landmarks(num_points, 2)
    spread = rms(v - x0)
    sde, seen = (
        flow(space, arguments.width, sd=spread),
        nb.InexactMatch.from_point_sd(NOISE * spread, space),
    )
    guided = nb.GuidedBridge(sde, seen.at(v), x0=x0, t1=1.0, num_steps=num_steps)
    bridges = {"guided": guided, "learned": learned(guided, keys["bridge"])}
    comparison = report("bridge", f"{names[0]} to {names[1]}", bridges, keys["bridge"])
    best = max(bridges, key=lambda name: comparison.rows[name]["ess"])
    print(f"bridge: drawn with the {best} bridge")
    paths, different = weighted_paths(bridges[best], keys["bridge"], 40 if quick else 120)
    numbers["bridge"]["drawn"] = {"bridge": best, "paths": len(paths), "different": different}
    magnified, words = magnifier(x0, v)
    draw_bridge(magnified(paths), x0, f"{names[0]} to {names[1]}", words)
    nb.plot.bridge_fan(magnified(paths), x0, magnified(v), num_frames=5, max_outlines=len(paths))
    plt.gcf().suptitle(f"{len(paths)} paths" + (f"; {words}" if words else ""), fontsize=9)
    save("bridge_times.png")


def draw_bridge(paths, x0, name, words):
    figure, axes = panels(1, 2, size=4.5, shape=x0)
    lines = nb.plot.path(paths[0], axes[0, 0], num_outlines=8)
    axes[0, 0].set_title("one path", fontsize=9)
    nb.plot.path(paths[:20].mean(0), axes[0, 1], num_outlines=5, trajectories=False)
    for i in range(0, num_points, num_points // 8):
        axes[0, 1].plot(*paths[:20, :, i].T, color="#8a8a8a", linewidth=0.4, alpha=0.6, zorder=1)
        axes[0, 1].plot(*paths[:20, :, i].mean(0).T, color="#d55e00", linewidth=1.4, zorder=3)
    axes[0, 1].set_title("20 paths of 8 points, and their mean", fontsize=9)
    figure.suptitle(f"{name}; {words}" if words else name, fontsize=9)
    figure.colorbar(lines, ax=axes, label="time", shrink=0.8)
    save("bridge.png")


# %% [markdown]
# ## From the mean to one specimen of each species
# One network for all targets.


# %%
def species():
    mean, ends = one_of_each()
    x0, targets = landmarks(mean), jnp.stack([landmarks(end) for end in ends.values()])
    space = nb.Landmarks(num_points, 2)
    spread = rms(targets - x0)
    sde, seen = (
        flow(space, arguments.width, sd=spread),
        nb.InexactMatch.from_point_sd(NOISE * spread, space),
    )

    def draw(key):
        return sde, seen.at(targets[jr.randint(key, (), 0, len(targets))]), x0

    first = nb.GuidedBridge(sde, seen.at(targets[0]), x0=x0, t1=1.0, num_steps=num_steps)
    guide = learned(first, keys["species"], draw=draw).guide
    figure, axes = panels(2, len(ends), size=2.6, shape=mean)
    magnified, words = magnifier(x0, targets)
    for (above, below), name, v in zip(axes.T, ends, targets, strict=True):
        guided = nb.GuidedBridge(sde, seen.at(v), x0=x0, t1=1.0, num_steps=num_steps)
        bridges = {"guided": guided, "learned": guided.with_guide(guide)}
        comparison = report("species", name, bridges, keys["species"])
        best = max(bridges, key=lambda kind: comparison.rows[kind]["ess"])
        paths = magnified(weighted_paths(bridges[best], keys["species"], 20)[0])
        lines = nb.plot.path(paths.mean(0), above, num_outlines=4)
        above.set_title(name, fontsize=9)
        nb.plot.outlines(paths[:, num_steps // 2], below)
        nb.plot.outlines(x0, below, color="#003f5c", linewidth=1.4)
        nb.plot.outlines(magnified(v), below, color="#d55e00", linewidth=1.4)
    figure.colorbar(lines, ax=axes[0], label="time")
    title = "above: mean of 20 paths; below: start (dark), end (orange), paths at time 1/2"
    figure.suptitle(title + (f"\n{words}" if words else ""), fontsize=9)
    save("species.png")


# %% [markdown]
# ## Score fields for several numbers of basis functions
# One bridge in Fourier coefficients, cut at several frequencies, along a path of each.


# %%
def scores():
    start, end, names = transition()
    bridges, paths, spread = {}, {}, rms(end - start)
    for m in (2, 4) if quick else (4, 8, 12):
        space = nb.FourierBasis(m, 2)
        x0, v = start_state(space, start), start_state(space, end)
        sde = flow(space, arguments.width, sd=spread)
        seen = nb.InexactMatch((NOISE * spread) ** 2 / space.size)
        guided = nb.GuidedBridge(sde, seen.at(v), x0=x0, t1=1.0, num_steps=num_steps)
        found = {"guided": guided}
        if not quick:
            found["learned"] = learned(guided, keys["scores"])
        name = f"{space.size} functions"
        comparison = report("scores", name, found, keys["scores"])
        bridges[name] = found[max(found, key=lambda kind: comparison.rows[kind]["ess"])]
        paths[name] = weighted_paths(bridges[name], keys["scores"], 1)[0][0]
    file = arguments.output / "scores.png"
    nb.plot.score_frames(bridges, paths, (0.0, 0.25, 0.5, 0.75, 0.95), file)
    print(f"written: {file}")


# %%
drawings = {f.__name__: f for f in (circles, outline, brownian, bridge, species, scores)}
for name in arguments.figures:
    drawings[name]()
(arguments.output / "conditioning_paper.json").write_text(json.dumps(numbers, indent=1))
