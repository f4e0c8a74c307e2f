# %% [markdown]
# # Shape along a phylogeny: how fast, on what length scale, and what were the ancestors like?
#
# A Kunita flow runs along the branches of a tree, from the root to the species: points close
# together move together, over a length scale ℓ, by amounts set by an amplitude α. Specimens differ
# from the shape of their species by independent normal errors at every point, of an SD that is a
# parameter too. MCMC draws from the posterior of these three and of the paths along the branches,
# whose ends are the ancestors.
#
#     python examples/phylogeny.py --shapes wings.tps --tree tree.nwk    # ID= is the species
#     python examples/phylogeny.py --shapes wings.csv --names species --tree tree.nex
#     python examples/phylogeny.py --shapes wings.tps --table specimens.csv --by specimen \
#         --names tip --tree tree.nwk
#     JAX_ENABLE_X64=1 python examples/phylogeny.py ... --nugget   # hundreds of specimens
#     python examples/phylogeny.py ... --quick       # under a minute, to see that all runs
#     python examples/phylogeny.py ... --run saved   # saved as it goes; after a kill the same line
#                                                    # goes on from there
#
# Shapes come in a tps or CSV file, row i being the same place on each; names are those of the tree,
# in Newick or NEXUS. A species without a shape is left out of the tree, a shape without its tip is
# an error; points may be missing.

# %%
import argparse
import os
import time
from pathlib import Path
from typing import NamedTuple

# threads of its own slow small matrices down, many times over
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import arviz as az
import jax
import jax.random as jr
import matplotlib
import numpy as np
import numpyro
import numpyro.distributions as dist
from numpyro.infer import MCMC, Predictive

import numpyro_bridges as nb

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

numpyro.set_host_device_count(2)


def options(description, **defaults):
    """A parser with what any run may choose."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument(
        "--quick", action="store_true", help="16 points, few steps and draws, 2 chains"
    )
    parser.add_argument(
        "--points", type=int, default=32, help="landmarks, at equal steps of their number"
    )
    parser.add_argument("--steps", type=int, default=6, help="on each branch")
    parser.add_argument(
        "--longest", type=float, help="instead, as many that none is longer, of a tree of height 1"
    )
    parser.add_argument("--warmup", type=int, default=200)
    parser.add_argument("--samples", type=int, default=400)
    parser.add_argument("--chains", type=int, default=4)
    parser.add_argument(
        "--fixed-root", action="store_true", help="the root is the mean, for certain"
    )
    parser.add_argument(
        "--nugget",
        action="store_true",
        help="points move on their own too, and specimens vary alike",
    )
    parser.add_argument(
        "--run", type=Path, help="a directory to save the run in as it goes, and to go on from"
    )
    parser.add_argument(
        "--sd",
        type=float,
        default=0.005,
        help="of a coordinate, where no species has two specimens",
    )
    parser.add_argument(
        "--magnify", type=float, default=1.0, help="deviations from the start in the drawing"
    )
    parser.add_argument("--open", action="store_true", help="curves whose ends do not meet")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=Path("output"))
    parser.set_defaults(**defaults)
    return parser


def files(parser, required):
    parser.add_argument(
        "--shapes", type=Path, required=required, help="a file that `io.read` reads"
    )
    parser.add_argument(
        "--table", type=Path, help="a CSV file with a row for each specimen, for columns of its own"
    )
    parser.add_argument(
        "--by", help="the column of that table with the ids; without it, row is for row"
    )


def settings(arguments):
    """Those of `--quick` where it was asked for."""
    if arguments.quick:
        arguments.points, arguments.steps, arguments.longest = min(arguments.points, 16), 3, None
        arguments.warmup, arguments.samples, arguments.chains = 30, 50, 2
    return arguments


# %% [markdown]
# ## The data
# The tree is made one unit high: amplitudes say what happens between its root and the present. It
# sees a row for each specimen of a species. The flow starts at its first split, around the mean
# that Brownian motion would have there given the means of the species, by generalised least
# squares.


# %%
class Data(NamedTuple):
    tree: nb.Tree  # of the species that were seen, with a row for each specimen
    rows: np.ndarray  # (specimens, n, dim), NaN where a point is missing
    means: dict[str, np.ndarray]  # of each species
    start: np.ndarray  # (n, dim)

    @property
    def several(self):
        """Whether a species has several specimens, so that something is known of the variation
        within.
        """
        return len(self.rows) > len(self.means)


def prepare(shapes, species, tree):
    """`Data` from shapes `(N, n, dim)` in register, the species of each, and a tree."""
    groups = {
        name: shapes[np.array([other == name for other in species])]
        for name in dict.fromkeys(species)
    }
    tips = [tree.names[tip] for tip in tree.tips]
    if not set(groups) <= set(tips):
        # says what is wrong with the names
        tree.rows({name: group[0] for name, group in groups.items()})
    lacking = [name for name in tips if name not in groups]
    if lacking:
        print(f"tips without shapes, left out: {', '.join(map(str, lacking))}")
    if len(groups) < 2:
        raise ValueError(
            f"a tree needs shapes of at least two of its tips; got those of {', '.join(groups)}."
        )
    tree = from_first_split(tree.pruned(groups))
    tree = tree.scaled(1 / tree.height)
    means = {name: np.nanmean(group, axis=0) for name, group in groups.items()}
    start = mean_at_root(tree, np.stack([means[tree.names[tip]] for tip in tree.tips]))
    tree = tree.observing(species)
    return Data(tree, tree.rows(shapes, names=species), means, start)


def from_first_split(tree):
    """The tree without time before its first split, which nothing is known of."""
    while tree.parents.count(0) == 1:
        parents = [-1, *(parent - 1 for parent in tree.parents[2:])]
        tree = nb.Tree(parents, tree.lengths[1:], tree.names[1:])
    return tree


def ancestry(tree):
    """Whether a node, of the second axis, is another or on its way from the root."""
    above = np.eye(tree.num_nodes, dtype=bool)
    for node, parent in enumerate(tree.parents[1:], 1):
        above[node] |= above[parent]
    return above


def mean_at_root(tree, rows):
    """Generalised least squares: weights 1ᵀ C⁻¹, C being the time that two tips have in common."""
    above = ancestry(tree)[list(tree.tips)]
    shared = np.max(np.where(above[:, None] & above, tree.depths, 0.0), axis=-1)
    weights = np.linalg.solve(shared + 1e-6 * np.eye(len(shared)), np.ones(len(shared)))
    rows = np.where(np.isnan(rows), np.nanmean(rows, axis=0), rows)
    return np.tensordot(weights / weights.sum(), rows, 1)


# %% [markdown]
# ## The model
# The root is as far from that mean as the flow would come in the time of another tree, a priori;
# with `--fixed-root` it is there. Where no species has two specimens nothing is known of the
# variation within, and its SD is given by `--sd`.
#
# Many specimens of a species tell its mean so well that a smooth flow cannot reach the means of
# all: without a remedy the length scale falls below the distance of neighbours. With `--nugget` a
# part of a point's variance is its own, and specimens differ from their species as species differ,
# by covariances that are in proportion.


# %%
def parameters(several, nugget):
    drawn = {
        "amplitude": numpyro.sample("amplitude", dist.LogNormal(-2.0, 1.0)),
        "length_scale": numpyro.sample("length_scale", dist.LogNormal(-1.0, 0.5)),
    }
    if several:
        drawn["within"] = numpyro.sample("within", dist.LogNormal(-4.0, 1.0))
    if nugget:
        drawn["nugget"] = numpyro.sample("nugget", dist.LogNormal(-2.0, 1.0))
    return drawn


def law_of(data, arguments, amplitude, length_scale, within=None, nugget=None):
    space, seen = nb.Landmarks(*data.start.shape, weights=1.0), np.isfinite(data.rows).all(axis=-1)
    within = arguments.sd if within is None else within
    # relative to the variance of the flow
    noise = None if nugget is None else nb.LandmarkNoise(nugget)
    flow = nb.KunitaFlow(space, nb.GaussianKernel(amplitude, length_scale), noise=noise)
    own = ()
    if nugget is not None and data.several:
        covariance = flow.covariance(0.0, data.start)
        match = nb.InexactMatch(within**2 * covariance / covariance[0, 0], space=space)
    elif seen.all():
        match = nb.InexactMatch.from_point_sd(within, space)
    else:
        match = jax.vmap(lambda points: nb.InexactMatch.from_point_sd(within, space, mask=points))(
            seen
        )
        own = ("match",)
    prior = {} if arguments.fixed_root else {"root_covariance": flow.covariance(0.0, data.start)}
    steps = arguments.steps if arguments.longest is None else data.tree.num_steps(arguments.longest)
    return nb.DiffusionTree(
        flow, data.start, match, tree=data.tree, num_steps=steps, per_row=own, **prior
    )


def model_of(data, arguments):
    def model(rows=None):
        law = law_of(data, arguments, **parameters(data.several, arguments.nugget))
        nb.sample("specimens", law, obs=rows)

    return model


# %% [markdown]
# ## Inference


# %%
def infer(data, arguments):
    """Posterior draws by chain, and results for ArviZ with the ancestors among the posterior."""
    kernel = nb.infer.FunctionSpaceHMC(model_of(data, arguments))
    run = {
        "num_warmup": arguments.warmup,
        "num_samples": arguments.samples,
        "num_chains": arguments.chains,
    }
    mcmc = MCMC(kernel, chain_method="vectorized", **run)
    start, key = time.perf_counter(), jr.key(arguments.seed)
    rows, fields = np.nan_to_num(data.rows), nb.infer.fields(kernel)
    if arguments.run is None:
        mcmc.run(key, rows, extra_fields=fields)
    else:
        nb.infer.run_checkpointed(mcmc, arguments.run, key, rows, extra_fields=fields, keep_noise=1)
    samples = jax.block_until_ready(mcmc.get_samples(group_by_chain=True))
    print(
        f"{time.perf_counter() - start:.0f} s for {run['num_chains']} chains of {arguments.warmup} "
        "+ ",
        end="",
    )
    print(
        f"{arguments.samples} draws; divergences: "
        f"{int(np.sum(mcmc.get_extra_fields()['diverging']))}"
    )
    prior = Predictive(parameters, num_samples=2000)(jr.key(1), data.several, arguments.nugget)
    results = nb.to_arviz(mcmc, prior=prior)
    results["posterior"]["ancestor"] = ancestors(data, arguments, results)
    return {name: samples[name] for name in prior}, prior, results


def ancestors(data, arguments, results):
    """The inner nodes, with names: a draw of parameters and noise is a draw of the paths."""
    tree, inner = data.tree, inner_nodes(data.tree, arguments)
    nodes = results["posterior_nodes"]["specimens"].sel(
        node=[tree.names[node] or f"node {node}" for node in inner]
    )
    labels = {
        "node": [name_of(tree, node) for node in inner],
        "coordinate": list("xyz"[: data.start.shape[1]]),
    }
    return nodes.assign_coords(labels)


def inner_nodes(tree, arguments):
    """Numbers of the ancestors that are not known."""
    return [
        node for node in range(int(arguments.fixed_root), tree.num_nodes) if node not in tree.tips
    ]


def name_of(tree, node):
    """Its own, or by the first and the last tip below it."""
    below = [tree.names[tip] for tip in tree.tips if ancestry(tree)[tip, node]]
    return tree.names[node] or f"{below[0]}–{below[-1]}"


def report(results, samples, prior):
    names = list(samples)
    print(az.summary(results, var_names=names).to_string())
    for name in names:
        before, after = np.std(prior[name]), np.std(samples[name])
        print(
            f"{name}: {np.mean(samples[name]):.4g}, prior SD {before:.2g}, posterior SD "
            f"{after:.2g}, ",
            end="",
        )
        print(f"ratio {after / before:.2g}")
    table = az.summary(results, var_names=["ancestor"])
    worst, least = table["r_hat"].astype(float).max(), table["ess_bulk"].astype(float).min()
    print(
        f"ancestors: {len(table)} coordinates, r_hat at most {worst:.3f}, bulk ESS at least "
        f"{least:.0f}"
    )


# %% [markdown]
# ## Does the model fit?
# Specimens are simulated at posterior draws. Their spread, between and within species, should be
# that of the data; and so should that of differences from the nearest point, which tells whether
# shapes are as smooth as the flow believes.


# %%
def spread(data, rows):
    """SD of a coordinate of species, of its difference from the nearest point, and of specimens of
    a species.
    """
    apart = np.linalg.norm(data.start[:, None] - data.start, axis=-1)
    nearest = np.argmin(apart + np.diag(np.full(len(apart), np.inf)), axis=1)
    rows = np.where(np.isnan(data.rows), np.nan, rows)
    species = np.array(data.tree.observed_names)
    means = {name: np.nanmean(rows[species == name], axis=0) for name in data.means}
    between = np.stack(list(means.values()))
    between -= np.nanmean(between, axis=0)
    found = {
        "species": rms(between),
        "species, from the nearest point": rms(between - between[:, nearest]),
    }
    if data.several:
        residuals = rows - np.stack([means[name] for name in species])
        freed = np.sqrt(1 - len(means) / len(rows))  # of the means
        found["specimens of a species"] = rms(residuals) / freed
    return found


def rms(x):
    return np.sqrt(np.nanmean(x**2))


def check(data, arguments, samples, num_draws=200):
    draws = {name: np.ravel(values) for name, values in samples.items()}
    chosen = np.linspace(0, len(draws["amplitude"]) - 1, num_draws).astype(int)
    draws = {name: values[chosen] for name, values in draws.items()}

    def simulate(drawn):
        draw, key = drawn
        return law_of(data, arguments, **draw).sample(key)

    simulated = jax.lax.map(simulate, (draws, jr.split(jr.key(2), num_draws)))
    spreads = [spread(data, rows) for rows in np.asarray(simulated)]
    for name, seen in spread(data, data.rows).items():
        low, high = np.quantile([one[name] for one in spreads], [0.025, 0.975])
        print(f"SD of {name}: {seen:.3g}, 95 % of those predicted in {low:.3g} to {high:.3g}")


# %% [markdown]
# ## What is left behind: a NetCDF file and two figures
# Outlines of posterior draws lie around the mean of each ancestor. They hold the uncertainty in
# parameters and paths, not that in the tree.


# %%
def save(data, samples, prior, results, arguments, name):
    arguments.output.mkdir(parents=True, exist_ok=True)
    written = [
        arguments.output / file
        for file in (f"{name}.nc", f"{name}_ladder.png", f"{name}_posterior.png")
    ]
    results.to_netcdf(str(written[0]), engine="h5netcdf")

    def drawn(shapes):
        magnified = data.start + arguments.magnify * (np.asarray(shapes) - data.start)
        return magnified[..., :2]

    draws = np.asarray(results["posterior"]["ancestor"])
    draws = draws.reshape(-1, *draws.shape[2:])
    bands = {node: drawn(draws[:, i]) for i, node in enumerate(inner_nodes(data.tree, arguments))}
    means = {name: drawn(mean) for name, mean in data.means.items()}
    size = np.clip(10 / len(means), 0.4, 1.0)  # inches
    fixed = {0: drawn(data.start)} if arguments.fixed_root else {}
    nb.plot.tree(data.tree, shapes=means | fixed, draws=bands, closed=not arguments.open, size=size)
    plt.gca().set_xlabel("time since the root, in heights of the tree")
    times = f", deviations × {arguments.magnify:g}" if arguments.magnify != 1 else ""
    plt.gcf().suptitle(f"species, ancestors and draws of them{times}", fontsize="medium")
    plt.savefig(written[1], dpi=150)
    plt.close()
    nb.plot.posterior({name: np.ravel(values) for name, values in samples.items()}, prior)
    plt.gcf().suptitle("posterior, and prior (dashed)", fontsize="medium")
    plt.savefig(written[2], dpi=150)
    plt.close()
    print("written: " + ", ".join(str(path) for path in written))


def analyse(data, arguments, name):
    """From data to files."""
    print(f"{len(data.rows)} specimens of {len(data.means)} species, {len(data.start)} points")
    samples, prior, results = infer(data, arguments)
    report(results, samples, prior)
    check(data, arguments, samples)
    save(data, samples, prior, results, arguments, name)


# %% [markdown]
# ## Files of your own


# %%
def read(arguments):
    """Shapes `(N, n, dim)` in register, the species of each, and the tree."""
    shapes, rows = read_shapes(arguments)
    species = column_of(rows, arguments.names, "--names")
    if arguments.nugget and np.isnan(shapes).any():
        raise ValueError(
            "--nugget needs shapes without missing points: their errors would not be independent."
        )
    if not arguments.aligned:
        shapes = nb.shapes.procrustes_align(shapes).shapes
    kept = not arguments.blanks
    return (
        shapes,
        species,
        nb.Tree.from_newick(arguments.tree, index=arguments.index, preserve_underscores=kept),
    )


def read_shapes(arguments):
    """Shapes `(N, n, dim)` as the file has them, NaN where a point is missing, and what it says of
    each, by column.
    """
    specimens = nb.io.read(arguments.shapes)
    if arguments.table is not None:
        specimens = nb.io.join(specimens, arguments.table, by=arguments.by)
    rows = [{"id": specimen.id} | dict(specimen.notes) for specimen in specimens]
    shapes = nb.io.stack(specimens).shapes
    count = shapes.shape[1]
    num_points = min(arguments.points, count)
    chosen = np.linspace(
        0, count - 1 if arguments.open else count, num_points, endpoint=arguments.open
    )
    return shapes[:, np.round(chosen).astype(int)], rows


def column_of(rows, column, option):
    """What a column says of each specimen."""
    known = [name for name in rows[0] if all(row.get(name) for row in rows)] if rows else []
    if column not in known:
        raise ValueError(
            f"{option} must be a column that every specimen has filled, one of {known}; got "
            f"{column!r}."
        )
    return [row[column] for row in rows]


def main():
    parser = options("Evolution of shape along a phylogeny.")
    files(parser, required=True)
    parser.add_argument("--tree", type=Path, required=True, help="a Newick or NEXUS file")
    parser.add_argument(
        "--names", default="id", help="the column or key with the species, as in the tree"
    )
    parser.add_argument("--index", type=int, help="which of several trees, from 0 on")
    parser.add_argument(
        "--blanks", action="store_true", help="underscores in names of the tree are blanks"
    )
    parser.add_argument(
        "--aligned", action="store_true", help="shapes are in register, and are taken as they are"
    )
    arguments = settings(parser.parse_args())
    try:
        data = prepare(*read(arguments))
    except (OSError, ValueError) as error:
        parser.error(str(error))
    analyse(data, arguments, "phylogeny")


if __name__ == "__main__":
    main()
