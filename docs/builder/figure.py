"""The figure of the landing page: a bridge from one wing to another, at true scale."""

import io

import jax
import matplotlib
from matplotlib.figure import Figure

import numpyro_bridges as nb

NUM_POINTS, NUM_STEPS, NUM_OUTLINES = 64, 40, 5
START, END = "PS 41", "AE 61"  # those of the set that differ most


def wing_bridge() -> str:
    """An SVG: outlines of one path from a *Psorophora* to an *Aedes*, and the way of each point."""
    wings = nb.datasets.mosquito_wings(NUM_POINTS)
    start, end = (wings.points[wings.names.index(name)] for name in (START, END))
    flow = nb.KunitaFlow(nb.Landmarks(NUM_POINTS, 2), nb.GaussianKernel(0.05, 0.4))
    seen = nb.InexactMatch.from_point_sd(0.005, flow.space).at(end)
    guide = nb.RecedingGuide()  # compiles sooner than the default
    bridge = nb.GuidedBridge(flow, seen, x0=start, t1=1.0, num_steps=NUM_STEPS, guide=guide)
    path = bridge.path(jax.random.normal(jax.random.key(4), bridge.noise_shape))

    figure = Figure(figsize=(8.0, 3.4), layout="constrained")
    ax = figure.subplots()
    lines = nb.plot.path(path, ax, num_outlines=NUM_OUTLINES)
    ax.set_axis_off()
    bar = figure.colorbar(lines, ax=ax, orientation="horizontal", shrink=0.4, aspect=40, pad=0.02)
    bar.set_ticks([0.0, 1.0], labels=["one wing", "another"])
    bar.outline.set_visible(False)
    file = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "wing"}):
        figure.savefig(file, format="svg", transparent=True, metadata={"Date": None})
    return file.getvalue()
