"""Results for ArviZ: 0.x, an `InferenceData`, and 1.x, a `DataTree`.

The driving noise is left out: thousands of numbers, none of them of interest. The log likelihood is
that of `log_likelihood`, with noise and effects of a unit integrated out. What is conditional on
them, log p(v_i | z, u, θ), has the same harmonic mean over the posterior; but that is a mean of
weights whose spread grows with what the datum says of z and u, and leave-one-out by it is off by
many nats.
"""

import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpyro.infer import MCMC
from numpyro.ops.provenance import eval_provenance

from .._checks import flag, positive_integer, require, require_mapping
from ..distributions import DiffusionEndpoint, DiffusionTree
from ._controls import has_controls, missing_variance, warn_of_missing
from ._draws import is_datum, mask_of, model_of, spaced, with_noise
from ._log_likelihood import LogLikelihood, log_likelihood as integrated
from ._posterior import is_latent, is_noise, sites_of
from ._statistics import statistics


def to_arviz(
    mcmc: MCMC,
    *,
    prior: dict | None = None,
    posterior_predictive: dict | None = None,
    coords: dict | None = None,
    dims: dict | None = None,
    noise: bool = False,
    nodes: bool = True,
    paths: int | None = None,
    log_likelihood: bool | LogLikelihood = True,
) -> Any:
    """The result of an MCMC run, for ArviZ.

    **Arguments:**

    - `mcmc`: after `run`, with any kernel of a model. Sample statistics are what the run has
      collected: `extra_fields=nb.infer.fields(kernel)` asks for all.
    - `prior`, `posterior_predictive`: dictionaries from `numpyro.infer.Predictive`. Those of the
      posterior may come from flat draws or from draws by chain (`batch_ndims=2`), and from some of
      the draws: a warning says so, and flat ones then count as one chain, since theirs are not
      known.
    - `coords`, `dims`: as in ArviZ; plates name their axes.
    - `noise`: keep the driving noise in the posterior.
    - `nodes`: add the states of the nodes of every observed `DiffusionTree`, of all draws whose
      noise was kept.
    - `paths`: the bridges of how many draws of each chain to add, evenly spaced, at most all whose
      noise was kept; none by default.
    - `log_likelihood`: what `nb.log_likelihood(mcmc, ...)` has returned, for leave-one-out by
      `arviz.loo`. By default it is asked for as it is: 200 draws of 16 particles. `False`: none.

    **Returns:** an `InferenceData` (ArviZ 0.x) or a `DataTree` (1.x) with the groups of the
    dictionaries and

    - `posterior`, and `observed_data`. Data masked in every draw (`handlers.mask`, `obs_mask`) are
      NaN.
    - `log_likelihood`: one value for each datum of each observed site, with its noise and the
      effects of its unit integrated out (`nb.log_likelihood` says how, and which data have none;
      `numpyro.factor` sites are no data). Its draws are some of those of the posterior. Left out
      are data masked in every draw, which say nothing: where a site has some, its seen data are one
      axis, `wing_seen`, and coordinates such as `wing_specimens` say which they are. A
      `DiffusionTree` has one value for each seen node, on the axis `node`.
    - `posterior_nodes`: of each observed `DiffusionTree` the states, with axes `chain`, `draw`, the
      plates, `node`, `point` (unless states are vectors) and `coordinate`: ancestors, and tips
      behind their errors. Nodes without a name are `node 7`, by their number in the tree. Left out
      are nodes that lead to nothing seen, and those that do not vary: a fixed root, tips that are
      seen exactly. Their R-hat and ESS are in `arviz.summary(data, group="posterior_nodes")`.
    - `sample_stats`: under ArviZ's names. Those of a block of `Gibbs` have the class of its kernel
      in front, `pcn_acceptance_rate`, numbered where blocks share it, `nuts0_lp`; a draw is
      `diverging` if any block was.
    - `posterior_paths`: for each observed `DiffusionEndpoint` the bridges, with axes `chain`,
      `draw`, the plates, `time`, `point` (unless states are vectors) and `coordinate`. An axis in
      which sites differ has the site's name in front, `wing_time`. Times that vary with the draws
      or the data are a variable, `wing_times`. A `DiffusionTree` has axes `branch`, labelled by the
      node at its end, and `step`, and its times are a variable always.

    A `/` in a name, as `handlers.scope` makes them, becomes a `.`: in a `DataTree` and in a NetCDF
    file it would be a group. `dims` and `coords` may be given with either.

    A warning says where draws need more controls than a flow has, `ControlNoise`, by the variance
    that is missing.

    **Errors:** `ValueError` for a kernel without a model, for `paths` without such a site, or
    without its noise, for predictions that are not draws of this run, and for names that differ
    only in `/` and `.`.
    """
    for name, groups in (
        ("prior", prior),
        ("posterior_predictive", posterior_predictive),
        ("coords", coords),
        ("dims", dims),
    ):
        require_mapping(groups, name)
    noise = flag(noise, "noise")
    nodes = flag(nodes, "nodes")
    paths = None if paths is None else positive_integer(paths, "paths")
    if not isinstance(log_likelihood, LogLikelihood):
        log_likelihood = flag(log_likelihood, "log_likelihood")
    run = _Run(mcmc, noise, coords or {}, dims or {})
    seen = run.seen()
    found = integrated(mcmc) if log_likelihood is True else log_likelihood
    datasets = {}
    if found:
        datasets["log_likelihood"] = _log_likelihood(run, found, seen)
    _warn_of_controls(run)
    if nodes and run.trees:
        datasets |= _nodes(run)
    if paths is not None:
        datasets["posterior_paths"] = _paths(run, paths)
    if posterior_predictive:
        datasets["posterior_predictive"] = _predictive(run, posterior_predictive)
    fields = mcmc.get_extra_fields(group_by_chain=True)
    groups = {
        "posterior": run.visible(run.samples),
        "sample_stats": statistics(fields, mcmc.sampler),
        "observed_data": {
            name: _without(value, seen.get(name)) for name, value in run.observed.items()
        },
    }
    if prior is not None:
        groups |= _prior(run, prior)
    groups = {group: jax.device_get(values) for group, values in groups.items() if values}
    return _from_groups(groups, datasets, run.coords, run.dims)


class _Run:
    """A run, and what its model says at its draws.

    - `sites`: those of a trace of the model, by name; `observed`: the data of those that have some,
      `trees`: the trees of observed `DiffusionTree`s, `hidden`: sites that are not to be shown.
    - `samples`: with axes for chains and draws.
    """

    def __init__(self, mcmc, noise, coords, dims):
        model, self._replay = model_of(mcmc)
        self.mcmc = mcmc
        self.sites = sites_of(model, mcmc._args, mcmc._kwargs)
        self.observed = {name: s["value"] for name, s in self.sites.items() if is_datum(s)}
        self.hidden = set() if noise else {name for name, s in self.sites.items() if is_noise(s)}
        self.trees = {
            name: self.law(name).tree
            for name in self.observed
            if isinstance(self.law(name), DiffusionTree)
        }
        self.samples = mcmc.get_samples(group_by_chain=True)
        self.coords = _plainly(coords)
        axes_of = _plates(self.sites) | dims
        self.dims = {_plain(name): [_plain(a) for a in axes] for name, axes in axes_of.items()}

    def law(self, name):
        return self.sites[name]["fn"]

    def visible(self, draws):
        return {name: value for name, value in draws.items() if name not in self.hidden}

    def lost(self, samples):
        """Values of the latent sites that these samples have not kept: any will do, where what is
        asked for does not need them.
        """
        return {
            name: site["value"]
            for name, site in self.sites.items()
            if is_latent(site) and name not in samples
        }

    def at(self, of, names, values):
        """`of(law, value)` of each of the sites, at these values of all latent ones."""
        found = self._replay(lambda site: values.get(site["name"]), names)
        return {name: of(law, value) for name, (law, value) in found.items()}

    def over_draws(self, of, names, samples, places=None):
        """The same for each draw of the samples, or for those in some places."""
        lost = self.lost(samples)
        return _mapped(lambda draw: self.at(of, names, lost | draw), samples, places)

    def unknown(self, of, names, samples):
        """Names of the sites for which `of` needs what is lost."""
        lost = self.lost(samples)
        if not lost:
            return set()
        first = {name: value[0, 0] for name, value in samples.items()}
        needs = eval_provenance(lambda lost: self.at(of, names, first | lost), lost=lost)
        return {
            name for name, sources in needs.items() if frozenset().union(*jax.tree.leaves(sources))
        }

    def seen(self):
        """Of the sites with a mask: which data count in any draw."""
        masked = [name for name in self.observed if mask_of(self.law(name)) is not None]
        if not masked:
            return {}
        found = self.over_draws(lambda law, _: mask_of(law), masked, self.samples)
        return {name: mask.any(axis=(0, 1)) for name, mask in found.items()}

    def leading(self, names):
        """Of sites with driving noise: names of the axes of their batches."""
        # a noise has three axes of its own: branches, or one, then steps and numbers
        return {
            name: _leading_axes(name, self.law(name).noise.ndim - 3, self.dims) for name in names
        }


def _log_likelihood(run, found, seen):
    labels = {name: _labels(tree, dict.fromkeys(tree.observed)) for name, tree in run.trees.items()}
    axes = {}
    counted = {}
    # sites that share the effects of their units have one value together, under the first's name
    for name, together in found.sites.items():
        number = found.values[name].ndim - 2 - (together[0] in run.trees)
        axes[name] = _leading_axes(together[0], number, run.dims)
        if all(site in seen for site in together):
            counted[name] = np.any([_whole(seen[site], number) for site in together], axis=0)
    data = _seen_only(found.values, counted, axes, run.coords, labels)
    return data.assign_coords(draw=_numbers(run.coords, found.draws))


def _warn_of_controls(run):
    def missing(law, _):
        return missing_variance(law)

    controlled = [name for name in run.observed if has_controls(run.law(name))]
    if controlled and not run.unknown(missing, controlled, run.samples):
        for name, found in run.over_draws(missing, controlled, run.samples).items():
            warn_of_missing(name, found, run.law(name))


def _nodes(run):
    """The group of the nodes' states; none where their noise was not kept."""
    draws, driving = with_noise(run.mcmc)
    if run.unknown(_states, run.trees, driving):
        return {}
    found = run.over_draws(_states, run.trees, driving)
    leading = run.leading(run.trees)
    return {"posterior_nodes": _of_nodes(found, leading, draws, run.coords, run.trees)}


def _paths(run, number):
    """The group of the bridges of a number of draws of each chain."""

    def bridge(law, value):
        return law.path(value), law.times

    draws, driving = with_noise(run.mcmc)
    places = spaced(len(draws), number)
    kinds = (DiffusionEndpoint, DiffusionTree)
    driven = [name for name in run.observed if isinstance(run.law(name), kinds)]
    require(
        driven,
        "`paths` needs an observed `DiffusionEndpoint` or `DiffusionTree`; the model observes "
        f"{sorted(run.observed)}.",
    )
    lost = sorted(run.lost(driving))
    require(
        not run.unknown(bridge, driven, driving),
        f"`paths` needs the noise that drives {driven}, and the run has not kept {lost}. Run it "
        f"without {[f'~z.{name}' for name in lost]} in `extra_fields`; if it is checkpointed, with "
        "`keep_noise`, of at most `num_samples`.",
    )
    found = run.over_draws(bridge, driven, driving, places)
    ends = {name: _labels(tree, tree.active) for name, tree in run.trees.items()}
    return _labelled(found, run.leading(driven), draws[places], run.coords, ends)


def _predictive(run, draws):
    shape = next(iter(run.samples.values())).shape[:2]
    ndims = {name: np.ndim(site["value"]) for name, site in run.sites.items()}
    variables = {}
    for name, value in _by_chain(run.visible(draws), ndims, shape).items():
        axes = _leading_axes(name, value.ndim - 2, run.dims)
        variables[name] = (["chain", "draw", *axes], value)
    return _dataset(variables, run.coords)


def _prior(run, draws):
    """Two groups: of what is observed, and of the rest. All draws are of one chain."""
    prior = {}
    predictive = {}
    for name, value in run.visible(draws).items():
        group = predictive if name in run.observed else prior
        group[name] = np.asarray(value)[None]
    return {"prior": prior, "prior_predictive": predictive}


def _plates(sites) -> dict:
    """Names of the leading axes of each site, from its plates."""
    frames = {
        name: sorted(site["cond_indep_stack"], key=lambda frame: frame.dim)
        for name, site in sites.items()
    }
    return {name: [frame.name for frame in stack] for name, stack in frames.items() if stack}


def _leading_axes(name, number, dims) -> list[str]:
    """Of one site: as many names as it has axes for its data."""
    names = list(dims.get(_plain(name), ()))[:number]
    return names + [f"{name}_dim_{i}" for i in range(len(names), number)]


def _by_chain(draws, ndims, shape) -> dict:
    """Predictions with axes for chains and draws in front: `shape`, those of the run, or fewer."""
    draws = {name: np.asarray(value) for name, value in draws.items()}
    if not draws:
        return {}
    numbers = {value.ndim - ndims[name] for name, value in draws.items() if name in ndims}
    if numbers not in ({1}, {2}):  # the model has other axes without its data
        numbers = {2 if all(value.shape[:2] == shape for value in draws.values()) else 1}
    number = numbers.pop()
    leading = {value.shape[:number] for value in draws.values()}
    require(
        len(leading) == 1 and 0 not in min(leading),
        "`posterior_predictive` must hold the same draws of every site; got leading axes "
        f"{sorted(leading)}.",
    )
    axes = leading.pop()
    whole = axes in (shape, (shape[0] * shape[1],))
    if not whole:
        warnings.warn(
            f"`posterior_predictive` holds draws {axes} of a run of {shape[0]} chains and "
            f"{shape[1]} draws: its chains and draws are not those of the posterior.",
            stacklevel=4,
        )
    axes = shape if whole else (1,) * (2 - number) + axes
    return {name: value.reshape(axes + value.shape[number:]) for name, value in draws.items()}


def _whole(mask, number):
    """Whether anything counts of each datum, of as many axes."""
    return mask.any(axis=tuple(range(number, mask.ndim)))


def _without(value, mask):
    """The data of a site, NaN where they are masked."""
    if mask is None or mask.all():
        return value
    mask = mask.reshape(mask.shape + (1,) * (np.ndim(value) - mask.ndim))
    return np.where(mask, value, np.nan)


def _states(law, observed):
    """Of the root and all nodes that lead to something seen, `(nodes, n, dim)` behind a batch."""
    nodes = np.array((0, *law.tree.active))
    return jnp.take(law.nodes(observed), nodes, axis=law.noise.ndim - 3)


def _labels(tree, nodes) -> list[str]:
    return [tree.names[node] or f"node {node}" for node in nodes]


def _axis(name, axis, labels) -> str:
    """The name of an axis, with that of the site in front where sites differ in its labels."""
    return axis if len({tuple(own) for own in labels.values()}) == 1 else f"{name}_{axis}"


def _of_nodes(found, leading, draws, coords, trees):
    """A dataset of the states of the nodes of each tree that vary."""
    values = {}
    labels = {}
    inner = {}
    for name, every in found.items():
        number = 2 + len(leading[name])
        before = tuple(range(number))
        # NaN where masked
        spread = np.fmax.reduce(every, axis=before) - np.fmin.reduce(every, axis=before)
        varies = np.fmax.reduce(spread.reshape(len(spread), -1), axis=1) > 1e-6 * np.nanmax(
            np.abs(every)
        )
        own = _labels(trees[name], [0, *trees[name].active])
        labels[name] = [label for label, kept in zip(own, varies, strict=True) if kept]
        values[name] = np.compress(varies, every, axis=number)
        inner[name] = dict(
            zip(("coordinate", "point"), values[name].shape[:number:-1], strict=False)
        )
    agree = len({tuple(sizes.items()) for sizes in inner.values()}) == 1
    variables = {
        name: (
            ["chain", "draw", *leading[name], _axis(name, "node", labels)]
            + [axis if agree else f"{name}_{axis}" for axis in reversed(inner[name])],
            values[name],
        )
        for name in found
    }
    own = {_axis(name, "node", labels): labels[name] for name in found}
    return _dataset(variables, coords).assign_coords(own | {"draw": _numbers(coords, draws)})


def _numbers(coords, draws):
    """Labels of some of the draws."""
    return np.asarray(coords.get("draw", range(draws[-1] + 1)))[draws]


def _seen_only(found, seen, axes, coords, nodes):
    """A dataset of the log likelihoods of each site's data, without those that are masked.

    `nodes`: labels of the last axis of some.
    """
    variables = {}
    labels = {_axis(name, "node", nodes): own for name, own in nodes.items() if name in found}
    for name, values in found.items():
        last = [_axis(name, "node", nodes)] if name in nodes else []
        mask = seen.get(name, np.ones((), bool))
        if mask.all():
            variables[name] = (["chain", "draw", *axes[name], *last], values)
        elif mask.any():
            variables[name] = (["chain", "draw", f"{name}_seen", *last], values[:, :, mask])
            for axis, size, places in zip(axes[name], mask.shape, np.nonzero(mask), strict=True):
                label = axis.removeprefix(f"{name}_")
                labels[f"{name}_{label}"] = (
                    f"{name}_seen",
                    np.asarray(coords.get(axis, range(size)))[places],
                )
    return _dataset(variables, coords).assign_coords(labels)


def _mapped(fn, samples, kept=None) -> dict:
    """`fn` of every draw, or of those kept: chain by chain and a few draws at once, which bounds
    the memory.
    """
    chains, draws = next(iter(samples.values())).shape[:2]
    number, kept = (draws, slice(None)) if kept is None else (len(kept), kept)
    # a remainder would be compiled once more
    at_once = max(n for n in range(1, 9) if number % n == 0)
    program = jax.jit(lambda values: jax.lax.map(fn, values, batch_size=at_once))
    done = [
        program({name: np.asarray(value[c])[kept] for name, value in samples.items()})
        for c in range(chains)
    ]
    return jax.tree.map(lambda *parts: np.stack(parts), *done)


def _labelled(found, leading, kept, coords, branches):
    """A dataset of the bridges and times of each site, with axes `(chain, draw, ..., time, point,
    coordinate)`.

    `branches`: labels of those of trees, which have the axes `branch` and `step` in place of
    `time`.
    """
    grids = {
        name: _grid(path[0, 0], times, len(leading[name]), branches.get(name))
        for name, (path, times) in found.items()
    }
    taken = set().union(*leading.values())

    def label(name, axis):
        agreed = len({grid[axis] for grid in grids.values() if axis in grid}) == 1
        return axis if agreed and axis not in taken else f"{name}_{axis}"

    variables = {}
    labels = {"draw": _numbers(coords, kept)}
    for name, (path, times) in found.items():
        axes = [label(name, axis) for axis in grids[name]]
        variables[name] = (["chain", "draw", *leading[name], *axes], path)
        if name in branches:
            labels[axes[0]] = branches[name]
            own = leading[name] if times.ndim > 4 else ()
            variables[f"{name}_times"] = (["chain", "draw", *own, *axes[:2]], times)
        elif isinstance(grids[name]["time"], tuple):
            labels[axes[0]] = times[0, 0]
        else:
            own = leading[name] if times.ndim > 3 else ()
            variables[f"{name}_times"] = (["chain", "draw", *own, axes[0]], times)
    return _dataset(variables, coords).assign_coords(labels)


def _dataset(variables, coords):
    """With labels for every axis: those given, where they are as many, or numbers."""
    import xarray

    data = xarray.Dataset(variables)
    given = {
        axis: coords[axis] for axis, size in data.sizes.items() if len(coords.get(axis, ())) == size
    }
    return data.assign_coords({axis: np.arange(size) for axis, size in data.sizes.items()} | given)


def _grid(path, times, number, branches) -> dict:
    """What two sites with a common axis agree in: its length, and the times if they do not vary
    with the draws.
    """
    first = ("time",) if branches is None else ("branch", "step")
    axes = (
        (*first, "point", "coordinate")
        if path.ndim - number == len(first) + 2
        else (*first, "coordinate")
    )
    if branches is not None:
        return dict(zip(axes, path.shape[number:], strict=True)) | {"branch": tuple(branches)}
    fixed = {"time": tuple(times[0, 0])} if times.ndim == 3 and np.all(times == times[0, 0]) else {}
    return dict(zip(axes, path.shape[number:], strict=True)) | fixed


def _plain(name: str) -> str:
    return name.replace("/", ".")


def _plainly(names) -> dict:
    """A dictionary with plain names; `ValueError` if two of them are the same."""
    plain = {_plain(name): value for name, value in names.items()}
    same = sorted(name for name in names if name != _plain(name) and _plain(name) in names)
    require(
        not same, f"{same} become names of other sites, `/` being written `.`: rename these sites."
    )
    return plain


def _from_groups(groups, datasets, coords, dims):
    import arviz
    import xarray

    groups = {group: _plainly(values) for group, values in groups.items()}
    datasets = {
        group: data.rename(
            {name: _plain(name) for name in (*data.variables, *data.dims) if "/" in name}
        )
        for group, data in datasets.items()
        if data.data_vars
    }
    if int(arviz.__version__.split(".")[0]) < 1:
        data = arviz.from_dict(coords=coords, dims=dims, **groups)  # pyright: ignore[reportArgumentType]
        if datasets:
            data.add_groups(datasets)
        return data
    data = arviz.from_dict(groups, coords=coords, dims=dims)
    return data.assign({name: xarray.DataTree(dataset) for name, dataset in datasets.items()})
