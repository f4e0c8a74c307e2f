"""MCMC that survives a kill: a run in intervals, each of which is on disk when it ends.

A directory holds NumPy archives,

- `draws_<iteration>.npz`: what was kept of the interval that starts there, `(chains, draws, ...)`:
  samples as `z/<site>`, extra fields under their names, thinned noise as `noise/<site>`;
- `state.npz`: the number of iterations done, the states of the chains after them, as
  `state/<field>` (random keys as their data), and the settings of the run.

A file is written beside its place, synced, and moved there. Draws come first and the state commits
them: draws from its iteration on belong to an interval that was cut off, and are written anew.
"""

import copy
import hashlib
import json
import sys
import warnings
from functools import partial
from zipfile import BadZipFile

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jax.sharding import Mesh
from jax.tree_util import keystr, tree_flatten_with_path
from numpyro.infer import MCMC
from numpyro.util import is_prng_key, nested_attrgetter
from tqdm.auto import tqdm

from .._checks import as_path, positive_integer, require, require_instance, require_key, words
from .._devices import gather, is_writer, mesh_for, spread, wait_for_all
from .._files import write_whole
from ._posterior import noise_sites, sites_of


def run_checkpointed(
    mcmc: MCMC,
    path,
    rng_key,
    /,
    *args,
    interval: int = 100,
    keep_noise: int | None = None,
    extra_fields=(),
    init_params=None,
    mesh: Mesh | None = None,
    **kwargs,
) -> None:
    """`mcmc.run(rng_key, *args, ...)` in intervals that are saved; where a run was cut off, it goes
    on from there.

        run_checkpointed(mcmc, "wings_run", jax.random.key(0), wings)  # and after a crash: the same
        line again

    The draws are, bit for bit, those of a run that was never cut off, given the same machine,
    devices and versions. Afterwards `mcmc` is as after `run`. The same call with a larger
    `num_samples` makes a chain longer. With thinning by k, draws k, 2k, ... after the warm-up are
    kept.

    **Arguments:**

    - `mcmc`: of any kernel and chain method. A callable method is applied within `jax.jit`.
    - `path`: a directory, made if need be, for this run alone and for one process at a time.
    - `rng_key`, `args`, `kwargs`, `extra_fields`, `init_params`: as for `run`.
    - `interval`: the number of iterations, warm-up included, between two savings: at most as many
      are lost to a kill.
    - `mesh`: the devices that share the chains, as for `numpyro_bridges.spread`, of any kernel and
      in place of `chain_method`. On another mesh a run goes on to rounding, not bit for bit. The
      processes of a mesh of several call this together, with one `path` that all of them see; the
      first writes.
    - `keep_noise`: by default the driving noise of the draws is dropped. With k > 1 every k-th
      draw's is kept, in `mcmc.get_extra_fields()["noise"]`, for the bridges of `to_arviz`; with 1
      it stays among the samples.

    **Errors:** `ValueError` if `path` holds a run with other settings or arguments, or something
    else. Ctrl-C raises `KeyboardInterrupt`, after `mcmc` has been given the draws of all complete
    intervals.

    A change of the model itself, or of what it takes from outside its arguments, shows only in how
    the chains start; it leads to a warning.
    """
    require_instance(mcmc, MCMC, "mcmc", "an `MCMC` of NumPyro")
    require_key(rng_key, "rng_key", several=mcmc.num_chains > 1)
    good = isinstance(extra_fields, (tuple, list)) and all(
        isinstance(name, str) for name in extra_fields
    )
    require(good, f"`extra_fields` must be names of fields; got {words(extra_fields)}.")
    interval = positive_integer(interval, "interval")
    keep_noise = None if keep_noise is None else positive_integer(keep_noise, "keep_noise")
    require(
        mcmc.post_warmup_state is None,
        "`mcmc` must do its own warm-up: set `mcmc.post_warmup_state` to None.",
    )
    folder = as_path(path, "path")
    require(
        folder.is_dir() or not folder.exists(),
        f"`path` must be a directory, or a new name; {folder} is a file.",
    )
    require(
        mesh is None or mcmc.num_chains > 1,
        f"`mesh` is for several chains, and `mcmc` has {mcmc.num_chains}: `MCMC(..., "
        "num_chains=8)`.",
    )
    mesh_for(mcmc.num_chains, "`num_chains` of `mcmc`", mesh)
    # The chains are started anew even where a run goes on: the start says what a state looks like,
    # and whether model and data are those of the run on disk.
    chains = _Chains(
        mcmc, rng_key, args, kwargs, init_params, extra_fields, keep_noise, interval, mesh
    )
    state, done = _load_state(folder, chains)
    total = mcmc.num_warmup + mcmc.num_samples
    require(
        done <= total,
        f"`num_samples` must be {done - mcmc.num_warmup} or more, as many as `path` {folder} "
        f"holds; got {mcmc.num_samples}.",
    )
    divergences = np.sum(_load_draws(folder, chains, done).get("diverging", 0))
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with tqdm(total=total, initial=done, disable=not mcmc.progress_bar) as bar:
            while done < total:
                # the next multiple of the interval: a run that was made longer may begin within one
                stop = min((done // interval + 1) * interval, total)
                state, draws = chains.advance(state, done, stop)
                if is_writer(chains.mesh):
                    # draws first: the state commits them
                    if draws:
                        _write(_draws_file(folder, done), draws)
                    _write(folder / "state.npz", chains.record(state, stop))
                divergences += np.sum(draws.get("diverging", 0))
                bar.update(stop - done)
                done = stop
                if not bar.disable:
                    bar.set_description(
                        "warmup" if done < mcmc.num_warmup else "sample", refresh=False
                    )
                    count = f"{divergences} divergences" if "diverging" in chains.fields else ""
                    bar.set_postfix_str(", ".join(filter(None, (chains.diagnostics(state), count))))
    except KeyboardInterrupt:
        # from the files, since the interrupt may have come between the two of an interval
        state, done = _load_state(folder, chains)
        _hand_over(folder, chains, state, done)
        print(
            f"Interrupted: of {total} iterations {done} are in {folder}, and of "
            f"{mcmc.num_samples} draws {max(done - mcmc.num_warmup, 0)} (before thinning) in "
            "`mcmc`. The same call goes on from there.",
            file=sys.stderr,
        )
        raise
    # the other processes read what the first one has written
    wait_for_all(chains.mesh, "the draws are written")
    _hand_over(folder, chains, state, done)


class _Chains:
    """The chains of an `MCMC`, advanced by any number of iterations with one compiled program."""

    def __init__(
        self, mcmc, rng_key, args, kwargs, init_params, extra_fields, keep_noise, interval, mesh
    ):
        self.mcmc = mcmc
        self.args = args
        self.kwargs = kwargs
        self.interval = interval
        self.sampler = copy.copy(mcmc.sampler)  # `init` leaves functions in it
        # as `MCMC` reads them: "z", or "~z.site" for a site that is not kept
        names = dict.fromkeys([mcmc._sample_field, *mcmc._default_fields, *extra_fields])
        dropped = [name for name in names if name.startswith("~")]
        self.fields = [name for name in names if not name.startswith("~")]
        self.removed = {name.removeprefix(f"~{mcmc._sample_field}.") for name in dropped}
        self.noise = () if keep_noise == 1 else _noise_of(self.sampler, args, kwargs)
        self.keep_noise = keep_noise
        self.batched = mcmc.num_chains > 1 and mcmc.chain_method == "vectorized" and mesh is None
        self.mesh = mesh or getattr(mcmc.sampler, "_mesh", None)

        self.start = self._started(rng_key, init_params, mesh)
        for name in self.fields:
            _require_field(self._first(self.start), name)
        # one number for each array, that another model or other data would change
        leaves = jax.tree.leaves(_plain(self.start))
        self.fingerprint = np.array([np.sum(np.abs(x), dtype=float) for x in leaves])
        one = self.start if self.batched else self._first(self.start)
        self.draw = jax.eval_shape(self._collect, one)
        self._program = _over_chains(mcmc, mesh, self._advance, jax.jit)

        inputs = {"rng_key": rng_key, "args": args, "kwargs": kwargs, "init_params": init_params}
        self.settings = {
            **self._settings_of_run(mesh),
            "extra_fields": sorted(extra_fields),
            **_settings_of(self.sampler, "kernel"),
            **{name: _described(value) for name, value in _named(inputs).items()},
            **self._shapes(),
        }

    def _started(self, rng_key, init_params, mesh):
        """The states of the chains before the first iteration, on the host."""
        mcmc = self.mcmc
        keys = rng_key
        if mcmc.num_chains > 1 and is_prng_key(rng_key):  # and not one for each chain
            keys = jr.split(rng_key, mcmc.num_chains)

        def init(x, _):
            key, params = x
            return self.sampler.init(key, mcmc.num_warmup, params, self.args, self.kwargs)

        inputs = keys, jax.tree.map(jnp.asarray, init_params)
        start = jax.tree.map(_array, _over_chains(mcmc, mesh, init)(inputs, ()))
        # to the host and back, as a state that is read from a file: both start alike
        return _rebuilt(_named(gather(_plain(start))), start)

    def _settings_of_run(self, mesh) -> dict:
        mcmc = self.mcmc
        method = "mesh" if mesh else getattr(mcmc.chain_method, "__name__", mcmc.chain_method)
        # without `num_samples`, which may grow
        return {
            "num_warmup": mcmc.num_warmup,
            "num_chains": mcmc.num_chains,
            "chain_method": method if mcmc.num_chains > 1 else None,
            "thinning": mcmc.thinning,
            "interval": self.interval,
            "keep_noise": self.keep_noise,
        }

    def _shapes(self) -> dict:
        """Types and shapes of a draw and of the states, which the model decides."""
        shapes = _named({"draw": self.draw, "state": self.start})
        return {f"the shape of {name}": f"{x.dtype}{list(x.shape)}" for name, x in shapes.items()}

    def advance(self, state, begin, end):
        """The state after iteration `end`, and arrays `(chains, draws, ...)` kept since `begin`."""
        state, draws = self._program(state, (begin, end))
        named, draws = gather((_named(_plain(state)), draws))
        kept = {}
        for name, x in draws.items():
            x = np.asarray(x)
            # chains in front: a vectorised batch has its draws there, one chain has no axis
            x = x.swapaxes(0, 1) if self.batched else x[None] if self.mcmc.num_chains == 1 else x
            # the program's arrays are as long as any interval needs
            kept[name] = x[:, : self.count(name, end) - self.count(name, begin)]
        return _rebuilt(named, self.start), kept if any(x.size for x in kept.values()) else {}

    def record(self, state, done):
        """What `state.npz` holds."""
        header = {
            "iterations": done,
            "settings": json.dumps(self.settings),
            "start": self.fingerprint,
        }
        return header | _named({"state": _plain(state)})

    def count(self, name, i):
        """How many draws the first i iterations leave."""
        every = self.mcmc.thinning * (self.keep_noise if name.startswith("noise/") else 1)
        # without a branch, since i may be traced
        return (i > self.mcmc.num_warmup) * (i - self.mcmc.num_warmup) // every

    def diagnostics(self, state) -> str:
        return self.sampler.get_diagnostics_str(self._first(state))

    def _first(self, state):
        """The state of one chain."""
        one = self.mcmc.num_chains == 1 or self.sampler.is_ensemble_kernel
        return state if one else _chain(state, 0)

    def _collect(self, state):
        """The fields of a draw, as `MCMC` has them, and the noise apart."""
        fields = {name: nested_attrgetter(name)(state) for name in self.fields}
        # constrained here, so that files hold what users see
        constrain = self.mcmc.postprocess_fn or self.sampler.postprocess_fn(self.args, self.kwargs)
        constrain = jax.vmap(constrain) if self.batched else constrain
        samples = constrain(fields[self.mcmc._sample_field])
        if isinstance(samples, dict):
            if self.keep_noise and self.noise:
                fields["noise"] = {k: v for k, v in samples.items() if k in self.noise}
            samples = {k: v for k, v in samples.items() if k not in self.removed.union(self.noise)}
        return _plain(jax.tree.map(_array, fields | {self.mcmc._sample_field: samples}))

    def _advance(self, state, bounds):
        """Iterations of a chain, or a vectorised batch, between bounds known only at run time."""
        begin, end = bounds
        shapes = _named(jax.eval_shape(self._collect, state))
        empty = {k: jnp.zeros(x.shape, x.dtype) for k, x in shapes.items()}
        # as many as an interval after the warm-up keeps: one program serves every interval
        sizes = {name: self.count(name, self.mcmc.num_warmup + self.interval) + 1 for name in empty}

        def step(i, carry):
            state, draws = carry
            state = self.sampler.sample(state, self.args, self.kwargs)

            def is_kept(name):
                return self.count(name, i + 1) > self.count(name, i)

            # noise is kept at some of the draws only, so "" asks for all that may be kept
            draw = jax.lax.cond(
                is_kept(""), lambda state: _named(self._collect(state)), lambda _: empty, state
            )
            # what is not kept is written out of range, which JAX drops
            places = {
                k: jnp.where(is_kept(k), self.count(k, i) - self.count(k, begin), sizes[k])
                for k in draw
            }
            return state, {k: draws[k].at[places[k]].set(draw[k], mode="drop") for k in draw}

        draws = {k: jnp.zeros((sizes[k], *x.shape), x.dtype) for k, x in empty.items()}
        return jax.lax.fori_loop(begin, end, step, (state, draws))


def _over_chains(mcmc, mesh, fn, jit=lambda fn: fn):
    """`fn(x, common)`, x of one chain, for all: on a mesh, or by the chain method of `mcmc`."""
    method = mcmc.chain_method
    if mesh is None and (mcmc.num_chains == 1 or method == "vectorized"):
        return jit(fn)
    if mesh is not None or method == "parallel":
        jit = jax.jit
        method = partial(spread, mesh=mesh)
    if not isinstance(method, str):
        return jit(lambda x, common: method(lambda x: fn(x, common))(x))
    # "sequential": one compiled program, called for one chain after the other
    one = jit(fn)
    stack = partial(jax.tree.map, lambda *leaves: jnp.stack(leaves))
    return lambda x, common: stack(*[one(_chain(x, c), common) for c in range(mcmc.num_chains)])


def _require_field(state, name) -> None:
    try:
        nested_attrgetter(name)(state)
    except (AttributeError, IndexError, KeyError, TypeError) as e:
        known = ", ".join(getattr(state, "_fields", ()))
        raise ValueError(
            f"`extra_fields` must be names of fields, of {known}; got {name!r}."
        ) from e


def _chain(x, c):
    return jax.tree.map(lambda leaf: leaf[c], x)


def _noise_of(sampler, args, kwargs) -> tuple[str, ...]:
    if not callable(model := getattr(sampler, "model", None)):
        return ()
    return noise_sites(sites_of(model, args, kwargs))


def _array(x):
    return x if hasattr(x, "dtype") else jnp.asarray(x)


def _is_key(x) -> bool:
    return jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def _plain(tree):
    """Typed keys as their data."""
    return jax.tree.map(lambda x: jr.key_data(x) if _is_key(x) else x, tree)


def _named(tree) -> dict:
    """Leaves by their paths."""
    return {
        keystr(path, simple=True, separator="/"): leaf
        for path, leaf in tree_flatten_with_path(tree)[0]
    }


def _rebuilt(arrays, like):
    """A tree from its named leaves on the host, with the keys and dtypes of another."""

    def leaf(x, new):
        # NumPy's format knows no bfloat16: `view` gives its bytes their meaning back
        return jr.wrap_key_data(new, impl=jr.key_impl(x)) if _is_key(x) else new.view(x.dtype)

    leaves = [leaf(x, np.asarray(arrays[name])) for name, x in _named(like).items()]
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


def _settings_of(kernel, name) -> dict:
    """The numbers and switches of a kernel, and of its blocks."""
    settings: dict = {name: type(kernel).__name__}
    for field, value in vars(kernel).items():
        if isinstance(value, bool | int | float | str):
            settings[f"{name}.{field.lstrip('_')}"] = value
    # the blocks of `Gibbs`
    for i, block in enumerate(getattr(kernel, "_kernels", ())):
        settings |= _settings_of(block, f"{name}.blocks.{i}")
    return settings


def _described(x) -> str:
    """A value that a file can hold: a short one in full, others by a hash or their type."""
    if not hasattr(x, "dtype"):
        # the `repr` of an object has its address, which differs from run to run
        plain = isinstance(x, bool | int | float | complex | str)
        return repr(x) if plain else type(x).__qualname__
    data = np.asarray(jr.key_data(x) if _is_key(x) else x)
    value = data.tolist()
    if data.size > 8:
        value = f"with SHA-256 {hashlib.sha256(data.tobytes()).hexdigest()[:12]}"
    return f"{x.dtype}{list(x.shape)} {value}"


def _draws_file(folder, begin):
    return folder / f"draws_{begin:09}.npz"


def _write(file, arrays) -> None:
    write_whole(file, lambda f: np.savez(f, **arrays))


def _read(file) -> dict:
    try:
        with open(file, "rb") as f, np.load(f, allow_pickle=False) as arrays:
            return dict(arrays)
    except (BadZipFile, EOFError, TypeError, ValueError) as e:
        raise ValueError(
            f"`path` holds a {file.name} that cannot be read, {file}. Choose another path."
        ) from e


def _load_state(folder, chains):
    """The last state that was committed, and its iteration; the start, if there is none."""
    file = folder / "state.npz"
    if not file.exists():
        return chains.start, 0
    stored = _read(file)
    require(
        {"iterations", "settings", "start"} <= set(stored),
        f"{file} is of another program. Choose another `path`.",
    )
    # both ways: a setting that only one of the two has differs as well
    old = json.loads(str(stored["settings"]))
    new = chains.settings
    for name in dict.fromkeys([*new, *old]):
        require(
            old.get(name) == new.get(name),
            f"`path` {folder} holds a run with another {name}: {old.get(name)} there, "
            f"{new.get(name)} in this call. Choose another path, or go back to the old setting.",
        )
    # a warning only: the start differs by rounding between versions, and a model is no setting
    if not np.allclose(stored["start"], chains.fingerprint, rtol=1e-5):
        warnings.warn(
            f"the chains of `path` {folder} started elsewhere than this call would start them: "
            "the model, data that it takes from outside its arguments, or a version has changed. "
            "If it is the model, choose another path.",
            stacklevel=3,
        )
    state = {
        name.removeprefix("state/"): x for name, x in stored.items() if name.startswith("state/")
    }
    return _rebuilt(state, chains.start), int(stored["iterations"])


def _load_draws(folder, chains, done) -> dict:
    """The draws of the intervals before `done`, by name; none before the end of the warm-up."""
    if not (expected := chains.count("", done)):
        return {}
    # by name is by number, which has leading zeros; later files are of an interval cut off
    parts = [
        _read(file)
        for file in sorted(folder.glob("draws_*.npz"))
        if int(file.stem.removeprefix("draws_")) < done
    ]
    draws = {}
    for name in _named(chains.draw) if parts else ():
        draws[name] = np.concatenate([part[name] for part in parts], 1)
    found = next(iter(draws.values())).shape[1] if draws else 0
    require(
        found == expected,
        f"`path` {folder} lacks draws: {found} of {expected} are there. Choose another path.",
    )
    return draws


def _hand_over(folder, chains, state, done) -> None:
    """Leaves `mcmc` as after `run`."""
    draws = _load_draws(folder, chains, done)
    mcmc = chains.mcmc
    mcmc._args = chains.args
    mcmc._kwargs = chains.kwargs
    mcmc._last_state = jax.tree.map(jnp.asarray, state)
    mcmc._states = jax.tree.map(jnp.asarray, _rebuilt(draws, chains.draw)) if draws else None
    mcmc._states_flat = None
    mcmc._keep_noise = chains.keep_noise  # for `to_arviz`
