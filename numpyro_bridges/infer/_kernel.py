"""What the kernels share: they are NumPyro kernels of a model whose noise carries the
`driving_noise` mark.
"""

import copy
from abc import abstractmethod
from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import numpyro
from jax.core import Tracer
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh
from numpyro.distributions import biject_to
from numpyro.infer.gibbs import GIBBS_SITES_KWARG
from numpyro.infer.mcmc import MCMCKernel
from numpyro.infer.util import constrain_fn
from numpyro.util import is_prng_key

from .._checks import as_float, concrete, require, words
from .._devices import mesh_for, require_mesh, spread
from ..distributions import NoiseBlocks
from ._posterior import (
    Sites,
    constrained,
    init_to_guided_mean,
    is_latent,
    is_noise,
    misfit,
    not_finite,
    sites_of,
    supports_that_move,
)
from ._reference import Reference, laplace
from ._rotation import choose
from ._seal import of_arguments, with_key

# Rules of settings, in words and as a test.
POSITIVE = "positive and finite", lambda x: x > 0
PROPORTION = "in (0, 1)", lambda x: 0 < x < 1
PROPORTION_OR_0 = "in [0, 1)", lambda x: 0 <= x < 1

UNSEALED: Any = np.uint32(0)  # of a state that is being made

_QUICKLY_COMPILED = {"xla_backend_optimization_level": 1}
"""Half the time of compiling, for a program that runs once and hardly more slowly."""


class AbstractBridgeKernel(MCMCKernel):
    """A kernel of a model, written for one chain and mapped over several. Values in its state are
    unconstrained.
    """

    def __init__(self, model, init_strategy=init_to_guided_mean, mesh: Mesh | None = None):
        require(
            callable(model),
            f"`model` must be a NumPyro model, a callable; got {type(model).__name__}.",
        )
        require(
            callable(init_strategy),
            "`init_strategy` must be a strategy such as `init_to_median`; got "
            f"{words(init_strategy)}.",
        )
        require_mesh(mesh)
        self._model = model
        self._init_strategy = init_strategy
        self._mesh = mesh
        self._sample_fn = None
        self._noise: tuple[str, ...] = ()
        self._blocks: dict[str, NoiseBlocks | None] = {}
        self._owners: dict[str, str] | None = None

    _follows_misfit = False
    """Whether `_init_one` needs Φ and its gradient."""

    @abstractmethod
    def _init_one(self, key, z: Sites, energies, reference: Reference, model_args, model_kwargs):
        """The state of one chain that starts at z. `energies`: Φ and its gradient there, where they
        were asked for.
        """

    @abstractmethod
    def _sample_one(self, state, still, model_args, model_kwargs):
        """The next state of one chain. Where `still`, of a move of no time, which is accepted."""

    @property
    @abstractmethod
    def _energies(self) -> tuple[str, ...]:
        """The fields that depend on the arguments of the model."""

    @abstractmethod
    def _refreshed(self, state, model_args, model_kwargs):
        """The state with its energies evaluated again."""

    @property
    def model(self):
        return self._model

    @property
    def sample_field(self):
        return "z"

    @property
    def default_fields(self):
        return ("z", "diverging")

    def init(self, rng_key, num_warmup, init_params, model_args, model_kwargs):
        model_kwargs = dict(model_kwargs or {})
        self._num_warmup = num_warmup
        sites = self._check(model_args, model_kwargs)
        num_chains = None if is_prng_key(rng_key) else len(rng_key)
        if init_params is not None:
            # `Gibbs` passes constrained values
            constrained = GIBBS_SITES_KWARG in model_kwargs
            init_params = _starts(init_params, sites, constrained, num_chains) or None

        def one(key, z, energies, reference):
            state = self._init_one(key, z, energies, reference, model_args, model_kwargs)
            return _sealed(state, _seal_of(model_args, model_kwargs))

        def start(keys, init_params):
            if num_chains is None:
                keys, init_params = jax.tree.map(lambda x: x[None], (keys, init_params))
            keys, keys_start, keys_reference = jax.vmap(partial(jr.split, num=3), out_axes=1)(keys)
            begins = jax.vmap(lambda key: self._start(key, model_args, model_kwargs))(keys_start)
            begins |= init_params or {}

            def starts(reference):
                if init_params is not None:
                    return begins
                return jax.vmap(self._drawn, (0, 0, None))(keys_reference, begins, reference)

            # one search, for all chains
            first = init_params and jax.tree.map(lambda x: x[0], init_params)
            reference, energies = self._laplace(first, model_args, model_kwargs, starts)
            chains = keys, starts(reference), energies
            if num_chains is None:
                chains = jax.tree.map(lambda x: x[0], chains)
            return over_chains(partial(one, reference=reference))(*chains)

        if num_chains is not None:
            over_chains = partial(spread, mesh=mesh_for(num_chains, "`num_chains`", self._mesh))
        else:
            require(
                self._mesh is None,
                "`mesh` is for chains that run at once, and this is one: `MCMC(kernel, "
                'num_chains=8, chain_method="vectorized")`. In `Gibbs`, and for '
                "`run_checkpointed`, leave it out of the kernel.",
            )
            over_chains = lambda fn: fn  # noqa: E731

        def sample(state, model_args, model_kwargs):
            seal = _seal_of(model_args, model_kwargs)
            return over_chains(lambda state: self._next(state, seal, model_args, model_kwargs))(
                state
            )

        self._sample_fn = sample
        options = _QUICKLY_COMPILED if _takes_compiler_options() else None
        state = jax.jit(start, compiler_options=options)(rng_key, init_params)
        self._check_start(state, num_chains, model_args, model_kwargs)
        return state

    def sample(self, state, model_args, model_kwargs):
        step = self._sample_fn
        if step is None:
            raise ValueError("`init` must be called before `sample`.")
        return step(state, model_args, dict(model_kwargs or {}))

    def refresh(self, state, model_args, model_kwargs):
        state = self._refreshed(state, model_args, model_kwargs)
        return _sealed(state, _seal_of(model_args, model_kwargs))

    def _next(self, state, seal, model_args, model_kwargs):
        """The next state of one chain. Where the energies are stale, a move of no time renews them
        first.

        It is the program of the draw itself: another would have to be compiled, and a branch would
        be taken in every draw of chains under `jax.vmap`.
        """

        def draw(j, state):
            new = self._sample_one(state, j < 0, model_args, model_kwargs)
            renewed = state._replace(**{name: getattr(new, name) for name in self._energies})
            return choose(j < 0, renewed, new)

        stale = state.seal != with_key(seal, state.rng_key)
        return _sealed(jax.lax.fori_loop(jnp.where(stale, -1, 0), 1, draw, state), seal)

    def postprocess_fn(self, model_args, model_kwargs):
        """Constrained values, and those of deterministic sites."""
        # NumPyro calls it as it is
        return jax.jit(partial(constrained, self._model, model_args, model_kwargs or {}))

    def get_constrain_fn(self, model_args, model_kwargs):
        # For the sites of other blocks of `Gibbs`, on which no support depends, any value will do.
        seeded = numpyro.handlers.seed(self._model, 0)
        return partial(constrain_fn, seeded, model_args, model_kwargs or {})

    def wrap_model(self, wrapper):
        kernel = copy.copy(self)
        kernel._model = wrapper(self._model)
        kernel._sample_fn = None
        return kernel

    def __getstate__(self):
        return self.__dict__ | {"_sample_fn": None}

    def _latent(self, key, strategy, model_args, model_kwargs):
        """The latent sites, with values by an initialisation strategy."""
        sites = sites_of(self._model, model_args, model_kwargs, key, strategy)
        return {k: site for k, site in sites.items() if is_latent(site)}

    def _check(self, model_args, model_kwargs):
        # noise at zero need not be drawn, which is to be compiled; a prior draw may be a start that
        # the model refuses
        sites = self._latent(0, init_to_guided_mean, model_args, model_kwargs)
        name = type(self).__name__
        discrete = [k for k, site in sites.items() if site["fn"].support.is_discrete]
        require(
            not discrete,
            f"{name} cannot draw the discrete sites {discrete}: give them a block of `Gibbs`.",
        )
        self._noise = tuple(sorted(k for k, site in sites.items() if is_noise(site)))
        self._blocks = {k: sites[k]["infer"].get("blocks") for k in self._noise}
        require(
            bool(self._noise),
            f"{name} found no driving noise among the latent sites {sorted(sites)}: observe a law "
            "with `numpyro_bridges.sample`, or mark the noise's site by `infer={'driving_noise': "
            "True}`.",
        )
        others = model_kwargs.get(GIBBS_SITES_KWARG)
        if others and set(sites) != set(self._noise):
            self._check_supports(sites, others, model_args, model_kwargs)
        return sites

    def _check_supports(self, sites, others, model_args, model_kwargs):
        """`Gibbs` asks for the constrained values of a block without those of the others."""
        own = {name: site["value"] for name, site in sites.items()}

        def given(others):
            kwargs = model_kwargs | {GIBBS_SITES_KWARG: others}
            return self._latent(0, lambda site: own.get(site["name"]), model_args, kwargs)

        moving = supports_that_move(given, others)
        require(
            not moving,
            f"the supports of the sites {moving} depend on sites of other blocks of `Gibbs`: make "
            "them one block.",
        )

    def _check_start(self, state, num_chains, model_args, model_kwargs):
        """The energy, and the gradient if the kernel follows it, are finite where each chain
        starts.
        """
        slopes = jax.tree.leaves(self._slopes(state))
        known = [x for x in map(concrete, (state.potential_energy, *slopes)) if x is not None]
        if len(known) <= len(slopes):  # some are traced
            return
        rows = [x.reshape(num_chains or 1, -1) for x in known]
        good = np.all([np.isfinite(x).all(1) for x in rows], axis=0)
        if good.all():
            return
        chain = int(np.argmin(good))
        z = state.z if num_chains is None else {name: x[chain] for name, x in state.z.items()}
        value = rows[0][chain, 0]
        what = "gradient is not finite" if np.isfinite(value) else f"potential energy is {value}"
        where = "" if num_chains is None else f" of chain {chain}"
        found = not_finite(self._model, model_args, model_kwargs, z, bool(slopes))
        raise ValueError(
            f"the {what} at the start{where}: give other `init_params`, or check the model's data. "
            f"Not finite: {'; '.join(found)}."
        )

    def _slopes(self, state):
        """The gradient that the kernel follows."""
        return state.force

    def _start(self, key, model_args, model_kwargs) -> Sites:
        sites = self._latent(key, self._init_strategy, model_args, model_kwargs)
        return {k: biject_to(site["fn"].support).inv(site["value"]) for k, site in sites.items()}

    def _laplace(self, init_params, model_args, model_kwargs, starts=None):
        """A Laplace approximation of the parameters' posterior: one search, whatever the keys of
        the chains. With Φ and its gradient at `starts` of it, z of all chains, where the kernel
        follows them.
        """
        z = self._start(jr.key(0), model_args, model_kwargs) | (init_params or {})
        theta, noise, unravel = self._parts(z)

        def potential(theta, noise):
            return self._misfit(unravel(theta) | noise, model_args, model_kwargs)

        visit = None
        if self._follows_misfit and starts is not None:
            visit = lambda found: jax.vmap(lambda z: self._parts(z)[:2])(starts(found))  # noqa: E731
        reference, found = laplace(potential, theta, noise, visit=visit)
        if found is None:
            return reference, None
        values, (slopes, forces) = found
        return reference, (values, jax.vmap(unravel)(slopes) | forces)

    def _drawn(self, key, z, reference: Reference) -> Sites:
        """z with parameters from the reference."""
        theta, noise, unravel = self._parts(z)
        return unravel(reference.colour(jr.normal(key, theta.shape, theta.dtype))) | noise

    def _misfit(self, z, model_args, model_kwargs):
        """Φ(θ, z)."""
        return misfit(self._model, model_args, model_kwargs, z)

    def _parts(self, z: Sites):
        """θ `(d,)`, the noise, and how θ becomes sites again."""
        theta, unravel = ravel_pytree({k: v for k, v in z.items() if k not in self._noise})
        return theta, {k: z[k] for k in self._noise}, unravel

    def _warming(self, state):
        return state.i < self._num_warmup

    def _running_mean(self, state, rate):
        """Mean acceptance since the start of the warm-up, then since its end."""
        n = jnp.where(self._warming(state), state.i, state.i - self._num_warmup) + 1
        mean = jnp.where(n == 1, 0.0, state.mean_accept_prob)
        return mean + (rate - mean) / n


def _takes_compiler_options() -> bool:
    """Those of the CPU's compiler. JAX refuses them within another program, where every array is
    traced, and they are not to undo what `jax_disable_most_optimizations` asks for.
    """
    within = isinstance(jnp.zeros(()), Tracer)
    optimized = not jax.config.read("jax_disable_most_optimizations")
    return jax.default_backend() == "cpu" and optimized and not within


def _seal_of(model_args, model_kwargs):
    """Of what the model is given, but for the values of other blocks of `Gibbs`, which tells when
    they change.
    """
    kwargs = {name: x for name, x in (model_kwargs or {}).items() if name != GIBBS_SITES_KWARG}
    return of_arguments((tuple(model_args), kwargs))


def _sealed(state, seal):
    return state._replace(seal=with_key(seal, state.rng_key))


def _starts(values, sites, constrained: bool, num_chains: int | None) -> Sites:
    """`init_params` as unconstrained arrays, chains in front."""
    require(
        isinstance(values, Mapping),
        f"`init_params` must be a dictionary by sites; got {words(values)}.",
    )
    unknown = sorted(set(values) - set(sites))
    require(
        not unknown,
        f"`init_params` has values for {unknown}; the latent sites are {sorted(sites)}.",
    )
    chains = () if num_chains is None else (num_chains,)
    starts = {}
    for name, value in values.items():
        transform = biject_to(sites[name]["fn"].support)
        shape = jnp.shape(sites[name]["value"])
        shape = chains + (shape if constrained else transform.inverse_shape(shape))
        x = as_float(value, f"init_params['{name}']")
        require(
            x.shape == shape,
            f"`init_params['{name}']` must have shape {shape}, "
            f"{'' if constrained else 'un'}constrained{', chains in front' if chains else ''}; "
            f"got {x.shape}.",
        )
        starts[name] = transform.inv(x) if constrained else x
    return starts
