"""The evidence of laws whose weights vary too much for importance sampling: trees, and models with
priors.

Of a model with parameters θ, driving noise z and likelihood p(v | θ, z),

    Z(β) = ∫ p(θ) N(z; 0, I) p(v | θ, z)^β dθ dz,    Z(0) = 1,    Z(1) = p(v).

Tempered distributions are moved by Hamiltonian Monte Carlo on function space, which keeps N(0, I)
exactly at every β. The temperatures, the step sizes and the reference of the parameters are those
that a pilot run has found; what follows takes them as given. Two estimates of log Z(1), in opposite
directions:

- "smc": particles from the prior, reweighted by p(v | θ, z)^Δβ, resampled and moved
  [@delmoral2006]. The product of the mean weights is unbiased, for any moves and any number of
  particles, since the schedule is fixed.
- "bridge": chains from the posterior down to the prior. The ratios Z(β') / Z(β) are those of bridge
  sampling between neighbours [@meng1996], with the draws of all chains.
"""

import math
from contextlib import ExitStack
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import numpyro
import numpyro.distributions as dist
from jax import Array
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh
from numpyro import handlers
from numpyro.distributions import biject_to
from tqdm.auto import tqdm

from .._checks import (
    choice,
    flag,
    positive_integer,
    require,
    require_instance,
    require_key,
    require_mapping,
)
from .._devices import gather, mesh_for, spread
from ..distributions import AbstractNoiseDriven, sample
from ..weights import log_mean_exp
from ._posterior import Sites, is_latent, is_noise, prior_and_likelihood, sites_of
from ._reference import Reference, from_moments, if_finite
from ._rotation import choose, half_square, metropolis, normal_like, trajectory

_ESS = 0.5
"""Between neighbouring temperatures, of the pilot's particles: a fraction of their number."""
_ACCEPTANCE = 0.8
"""Which the step sizes of the pilot run aim at."""
_LENGTH = 1.6
"""Angle of a trajectory, in radians: about π/2, which forgets a standard normal."""
_JITTER = 0.2
"""A fraction of it, so that no angle comes back again and again to where it was."""
_MAX_STEPS = 32
"""Of a trajectory: it bounds the time of a temperature at which steps are hardly accepted."""
_LEAST_CHANGE = 1e-4
"""Of β: the ESS may be smaller where log weights vary by thousands of nats."""


class TemperedEvidence(eqx.Module):
    """An estimate of a log evidence. `str` of it says whether it is to be trusted, and if not, why.

    - `log_evidence`, `standard_error`: in nats. The error is that of independent repetitions within
      the run, so that it holds whatever moves and draws have of autocorrelation; with 8 of them ± 2
      errors cover about 92 %.
    - `log_estimates`: `(num_islands,)`, what each repetition says: of "smc" its own log evidence,
      of "bridge" the jackknife's pseudo-values, whose mean is the estimate.
    - `inverse_temperatures`: β, `(T + 1,)`, from 0 to 1. `accept_prob`: `(T,)`, mean acceptance at
      each but the first, in the pilot run.
    - `num_particles`: particles of an island, or draws of a chain at each temperature.
    """

    log_evidence: Array
    standard_error: Array
    log_estimates: Array
    inverse_temperatures: np.ndarray
    accept_prob: np.ndarray
    num_particles: int
    method: str

    @property
    def trusted(self) -> bool:
        """Whether `log_evidence` ± 2 `standard_error` can be taken at its word.

        Both are finite, moves were accepted, and repetitions differ by less than 1.5 nats (SD): the
        mean of unbiased estimates that differ by more rests on the largest. What no particle has
        found cannot be seen.
        """
        return not self.doubt

    @property
    def doubt(self) -> str:
        """Why it is not to be trusted, in a few words; empty where it is."""
        if not bool(jnp.isfinite(self.log_evidence) & jnp.isfinite(self.standard_error)):
            error = float(self.standard_error)
            return f"the log evidence is {float(self.log_evidence):.2f} ± {error:.2g}"
        least = float(np.min(self.accept_prob))
        if least < 0.2:
            return f"moves are hardly accepted (mean {least:.2f} at one temperature)"
        # pseudo-values of a jackknife are no estimates of their own: no such rule for "bridge"
        spread = float(jnp.std(self.log_estimates, ddof=1))
        if spread > 1.5 and self.method == "smc":
            return f"islands differ by {spread:.1f} nats (SD): give more particles or moves"
        return ""

    def __str__(self) -> str:
        found = f"log evidence {float(self.log_evidence):.4g} ± {float(self.standard_error):.2g}"
        runs = len(self.log_estimates)
        count = len(self.inverse_temperatures) - 1
        of = f"{runs} islands of {self.num_particles} particles"
        if self.method == "bridge":
            of = f"{runs} chains of {self.num_particles} draws"
        rates = f"acceptance {np.min(self.accept_prob):.2f} to {np.max(self.accept_prob):.2f}"
        verdict = "" if self.trusted else f". Not to be trusted: {self.doubt}"
        return f"{found} ({self.method}, {of}, {count} temperatures, {rates}){verdict}"


def estimate_tree_evidence(
    law: AbstractNoiseDriven, data, key: Array, **settings
) -> TemperedEvidence:
    """Estimate p(data) of a tree, or of any law with driving noise, at fixed parameters, by
    tempering.

    For topologies, clocks and models to be compared, where the log weights of a law vary by more
    than 2 or 3 nats and `estimate_evidence` cannot be trusted.

        for name, tree in trees.items():
            law = nb.DiffusionTree(flow, x0, match, tree=tree, num_steps=10)
            print(name, nb.estimate_tree_evidence(law, tree.rows(shapes), jax.random.key(0)))

    **Arguments:** `law`: a `DiffusionTree` or `DiffusionEndpoint`. `data`: shaped as the law.
    `settings`: as of `estimate_model_evidence`.

    **Returns:** a `TemperedEvidence`.
    """
    require_instance(
        law, AbstractNoiseDriven, "law", "a law with driving noise, such as `DiffusionTree`"
    )
    require(
        data is not None,
        "`data` must be an array shaped as `law`; got None, which would be no data.",
    )
    return estimate_model_evidence(_observed, key, law, data, **settings)


def _observed(law, data):
    """A model that has the law alone."""
    # a plate for each axis of the batch, the last being −1
    with ExitStack() as stack:
        for i, size in enumerate(law.batch_shape[::-1], 1):
            stack.enter_context(numpyro.plate(f"axis_{i}", size, dim=-i))
        sample("data", law, obs=data)


def estimate_model_evidence(
    model,
    key: Array,
    *model_args,
    model_kwargs: dict | None = None,
    method: str = "smc",
    num_particles: int = 64,
    num_islands: int = 8,
    num_moves: int = 3,
    batch_size: int = 16,
    progress: bool = True,
    mesh: Mesh | None = None,
) -> TemperedEvidence:
    """Estimate p(data) of a NumPyro model with driving noise, its parameters integrated over their
    priors.

    **Arguments:**

    - `model`, `model_args`, `model_kwargs`: a NumPyro model and what it is called with, data
      included. All that it observes is its data, `numpyro.factor` too; priors must be proper, and
      latent sites continuous.
    - `method`: "smc" or "bridge", which share the pilot run and nothing else.
    - `num_particles`: of each island; of "bridge", the draws of each chain at each temperature.
    - `num_islands`: independent repetitions, at least 2, or chains. More of them tell the standard
      error better; more particles make each estimate better.
    - `num_moves`: trajectories of each particle at each temperature, in "smc".
    - `batch_size`: particles that a device evaluates at once; memory is bounded by it.
    - `progress`: show a bar.
    - `mesh`: the devices that share the particles of an island, or the chains, as for `spread`.

    **Returns:** a `TemperedEvidence`; NaN where the log density of a draw from the prior is NaN.

    The time goes into gradients, in "smc" about temperatures · islands · particles · (1 + moves ·
    steps of a trajectory), and there are about as many temperatures as log weights have nats of SD.
    """
    require(
        callable(model), f"`model` must be a NumPyro model, a callable; got {type(model).__name__}."
    )
    require_key(key)
    require_mapping(model_kwargs, "model_kwargs")
    choice(method, "method", ("smc", "bridge"))
    num_particles = positive_integer(num_particles, "num_particles", 4)
    num_islands = positive_integer(num_islands, "num_islands", 2)
    num_moves = positive_integer(num_moves, "num_moves")
    batch_size = positive_integer(batch_size, "batch_size")
    progress = flag(progress, "progress")
    mesh_for(num_particles, "`num_particles`", mesh)
    if method == "bridge":
        mesh_for(num_islands, "`num_islands`", mesh)
    run = _Run(model, model_args, model_kwargs or {}, batch_size, mesh)
    key_pilot, key = jr.split(key)
    # The schedule must not depend on the particles that it weighs, or "smc" would be biased: the
    # pilot finds it with particles of its own.
    with tqdm(desc="temperatures", disable=not progress) as bar:
        particles, stages, rates = _pilot(run, key_pilot, num_particles, num_moves, bar)
        bar.total = bar.n + len(stages) * (num_islands if method == "smc" else 1)
        if method == "smc":
            found = [
                _island(run, k, stages, num_particles, num_moves, bar)
                for k in jr.split(key, num_islands)
            ]
            estimates, log_evidence, error = _of_islands(jnp.stack(found))
        else:
            draws = _ladder(run, key, particles, stages, num_islands, num_particles, bar)
            changes = np.diff([0.0, *(float(stage.beta) for stage in stages)])
            estimates, log_evidence, error = _of_ladder(draws, changes)
    betas = np.array([0.0, *(float(stage.beta) for stage in stages)])
    return TemperedEvidence(
        log_evidence, error, estimates, betas, np.array(rates), num_particles, method
    )


class _Particles(NamedTuple):
    """Unconstrained values by site, and log p(v | θ, z) `(N,)`."""

    z: Sites
    log_likelihood: Array


class _Stage(NamedTuple):
    """A temperature, the steps of a trajectory there, and what whitens the parameters."""

    beta: Array
    num_steps: Array
    reference: Reference


class _Run:
    """The programs of one model."""

    def __init__(self, model, model_args, model_kwargs, batch_size: int, mesh: Mesh | None):
        self._model = model
        self._args = model_args
        self._kwargs = model_kwargs
        every = sites_of(model, model_args, model_kwargs)
        sites = {name: site for name, site in every.items() if is_latent(site)}
        _check_sites(sites)
        self._noise = {name for name, site in sites.items() if is_noise(site)}
        # shapes and order of the parameters are those of any draw
        self._unravel = self._parts(_unconstrained(sites))[2]
        self._spread = partial(spread, mesh=mesh, batch_size=batch_size)
        # compiled once for all temperatures and islands: β and the steps are arguments
        start = jax.jit(self._start)
        move = jax.jit(self._move, static_argnames="num_moves")
        self.start = lambda keys: gather(start(keys))
        self.move = lambda *args: gather(move(*args))
        self.resample = jax.jit(_resampled)
        self.fitted = jax.jit(self._fitted)

    def _parts(self, z: Sites):
        """θ `(d,)`, the noise, and how θ becomes sites again."""
        noise = {name: z[name] for name in self._noise}
        if len(noise) == len(z):
            return jnp.zeros((0,)), noise, lambda theta: {}
        theta, unravel = ravel_pytree({name: x for name, x in z.items() if name not in noise})
        return theta, noise, unravel

    def _evaluate(self, z: Sites):
        """-log p(θ) of unconstrained parameters, and log p(v | θ, z)."""
        return prior_and_likelihood(self._model, self._args, self._kwargs, z)

    def _fitted(self, z: Sites) -> Reference:
        """The reference of the parameters of all particles."""
        theta = jax.vmap(lambda z: self._parts(z)[0])(z)
        mean = jnp.mean(theta, 0)
        rest = theta - mean
        start = Reference(mean, jnp.eye(mean.size, dtype=mean.dtype))
        if not mean.size:
            return start
        return if_finite(from_moments(mean, rest.T @ rest, len(theta)), start)

    def _start(self, keys) -> _Particles:
        """Draws from the prior."""

        def one(key):
            seeded = handlers.seed(self._model, key)
            trace = handlers.trace(seeded).get_trace(*self._args, **self._kwargs)
            z = _unconstrained({name: site for name, site in trace.items() if is_latent(site)})
            return _Particles(z, self._evaluate(z)[1])

        return self._spread(one)(keys)

    def _move(self, particles: _Particles, key, stage: _Stage, num_moves: int):
        """Every particle moved: where it is, mean acceptance, log p(v | θ, z) after each move."""

        reference = stage.reference

        # x = (y, z): whitened parameters θ = μ + L y, and the noise
        def to_sites(x):
            return self._unravel(reference.colour(x[0])) | x[1]

        def one(particle, key):
            def psi(x):
                prior, log_likelihood = self._evaluate(to_sites(x))
                # Ψ of exp(−Ψ) N(y; 0, I) N(z; 0, I) ∝ p(θ) N(z; 0, I) p(v | θ, z)^β: the moves
                # keep the two normal laws exactly, and Ψ is what they must correct
                return prior - half_square(x[0]) - stage.beta * log_likelihood, log_likelihood

            value_and_grad = jax.value_and_grad(psi, has_aux=True)

            def move(carry, inputs):
                i, key = inputs
                x, value, gradient = carry
                still = i == 0  # a move of no time, which evaluates where the particle is
                key_momentum, key_angle, key_accept = jr.split(key, 3)
                p = normal_like(key_momentum, x)
                turn = _LENGTH * jr.uniform(key_angle, (), value[0].dtype, 1 - _JITTER, 1 + _JITTER)
                # one program for the evaluation and the moves: it has the gradient once
                steps = jnp.where(still, 1, stage.num_steps)
                angle = jnp.where(still, 0.0, turn / steps)
                y, _, new, slope, work = trajectory(
                    value_and_grad, x, p, value, gradient, angle, steps
                )
                rate, accept = metropolis(key_accept, new[0] - value[0] + work)
                carry = choose(accept | still, (y, new, slope), carry)
                return carry, (rate, carry[1][1])

            theta, noise, _ = self._parts(particle.z)
            x = reference.whiten(theta), noise
            # Ψ and its gradient depend on β and the reference: move 0 finds them
            value = jnp.zeros_like(particle.log_likelihood), particle.log_likelihood
            start = x, value, jax.tree.map(jnp.zeros_like, x)
            steps = jnp.arange(num_moves + 1), jr.split(key, num_moves + 1)
            (x, value, _), (rates, history) = jax.lax.scan(move, start, steps)
            return _Particles(to_sites(x), value[1]), jnp.mean(rates[1:]), history[1:]

        keys = jr.split(key, len(particles.log_likelihood))
        return self._spread(one)(particles, keys)


def _unconstrained(sites) -> Sites:
    return {name: biject_to(site["fn"].support).inv(site["value"]) for name, site in sites.items()}


def _check_sites(sites) -> None:
    require(
        any(map(is_noise, sites.values())),
        f"`model` must have driving noise; its latent sites are {sorted(sites)}. Observe a law "
        "with `numpyro_bridges.sample`.",
    )
    discrete = [name for name, site in sites.items() if site["fn"].support.is_discrete]
    require(
        not discrete,
        f"`model` must have continuous latent sites; {discrete} are discrete: sum them out.",
    )
    improper = [
        name for name, site in sites.items() if isinstance(site["fn"], dist.ImproperUniform)
    ]
    require(
        not improper,
        f"`model` must have proper priors, or it has no evidence; those of {improper} are "
        "improper.",
    )


def _resampled(particles: _Particles, key, change):
    """Particles resampled systematically by p(v | θ, z)^change, and the log of the mean weight."""
    log_weights = change * particles.log_likelihood
    count = log_weights.size
    # one uniform number places all: a particle of weight w is taken N w times, rounded up or down
    edges = jnp.cumsum(jax.nn.softmax(log_weights))
    places = (jnp.arange(count) + jr.uniform(key, (), edges.dtype)) / count * edges[-1]
    chosen = jnp.minimum(jnp.searchsorted(edges, places), count - 1)
    return jax.tree.map(lambda a: a[chosen], particles), log_mean_exp(log_weights)


def _pilot(run: _Run, key, num_particles, num_moves, bar):
    """Particles of the posterior, a stage for each temperature, and acceptances."""
    key, key_start = jr.split(key)
    particles = run.start(jr.split(key_start, num_particles))
    beta = 0.0
    step = _LENGTH / 2
    stages = []
    rates = []
    while beta < 1:
        key, key_resample, key_move = jr.split(key, 3)
        # reweighted to the next temperature, resampled, whitened by where they are, and moved
        new = _next_beta(beta, np.asarray(particles.log_likelihood, float))
        particles, _ = run.resample(particles, key_resample, new - beta)
        beta = new
        stage = _Stage(jnp.asarray(beta), jnp.asarray(_num_steps(step)), run.fitted(particles.z))
        particles, accepted, _ = run.move(particles, key_move, stage, num_moves)
        rate = float(jnp.mean(accepted))
        # longer steps where more than asked for are accepted, for the next temperature too
        step = step * np.exp(2 * (rate - _ACCEPTANCE))
        step = float(np.clip(step, _LENGTH / _MAX_STEPS, _LENGTH))
        stages.append(stage._replace(num_steps=jnp.asarray(_num_steps(step))))
        rates.append(rate)
        bar.set_postfix(pilot=f"{beta:.3g}")
        bar.update()
    return particles, stages, rates


def _num_steps(step: float) -> int:
    return math.ceil(_LENGTH / step - 1e-9)  # not one more for rounding


def _next_beta(beta: float, log_likelihood) -> float:
    """The next temperature, at which particles of the present one are still worth enough."""
    possible = np.sum(log_likelihood > -np.inf)
    if np.isnan(log_likelihood).any() or not possible:
        return 1.0  # the estimate is NaN, or 0

    def enough(change):
        # ESS = (Σ w)² / Σ w², of those that are possible; weights relative to the largest
        w = np.exp(change * (log_likelihood - np.max(log_likelihood)))
        return np.sum(w) ** 2 >= _ESS * possible * np.sum(w**2)

    if enough(1 - beta):
        return 1.0
    # bisection: the ESS falls as the change grows
    low = _LEAST_CHANGE
    high = 1 - beta
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if enough(middle) else (low, middle)
    return min(beta + low, 1.0)


def _island(run: _Run, key, stages, num_particles, num_moves, bar) -> Array:
    """The log evidence that one set of particles gives; its exponential is unbiased."""
    key, key_start = jr.split(key)
    particles = run.start(jr.split(key_start, num_particles))
    log_evidence = jnp.zeros(())
    beta = 0.0
    for stage in stages:
        key, key_resample, key_move = jr.split(key, 3)
        particles, log_mean = run.resample(particles, key_resample, stage.beta - beta)
        log_evidence = log_evidence + log_mean
        beta = stage.beta
        # nothing is weighed after the last temperature, so that moves there are of no use
        if stage is not stages[-1]:
            particles, _, _ = run.move(particles, key_move, stage, num_moves)
        # or JAX would run ahead of the bar
        jax.block_until_ready(particles)
        bar.update()
    return log_evidence


def _of_islands(estimates):
    """The log of their mean, and its standard error by the delta method."""
    # SD(log mean) ≈ SD(mean) / mean
    log_evidence = log_mean_exp(estimates)
    ratios = jnp.exp(estimates - log_evidence)
    return estimates, log_evidence, jnp.std(ratios, ddof=1) / math.sqrt(estimates.size)


def _ladder(run: _Run, key, particles, stages, num_chains, num_draws, bar):
    """log p(v | θ, z) of draws at every temperature, `(T + 1, chains, draws)`, from the prior on.

    Chains start at particles of the posterior; at each temperature a quarter of the draws, at the
    first all of them, is made before those that are kept.
    """
    key, key_start, key_prior = jr.split(key, 3)
    chosen = jr.choice(key_start, len(particles.log_likelihood), (num_chains,), replace=False)
    chains = jax.tree.map(lambda a: a[chosen], particles)
    found = []
    # downwards: a chain that has mixed at one temperature is nearly mixed at the next, wider one
    for i, stage in enumerate(stages[::-1]):
        key, key_warmup, key_move = jr.split(key, 3)
        warmup = num_draws if i == 0 else max(num_draws // 4, 1)
        chains, _, _ = run.move(chains, key_warmup, stage, warmup)
        chains, _, history = run.move(chains, key_move, stage, num_draws)
        found.append(np.asarray(history, float))
        bar.update()
    # β = 0 is the prior, from which independent draws can be had
    prior = run.start(jr.split(key_prior, num_chains * num_draws)).log_likelihood
    prior = np.asarray(prior, float).reshape(num_chains, num_draws)
    return np.stack([prior, *found[::-1]])


def _of_ladder(draws, changes):
    """Pseudo-values of the jackknife over chains, their mean, and its standard error."""
    chains = draws.shape[1]

    def estimate(kept):
        pairs = zip(changes, draws[:-1], draws[1:], strict=True)
        return sum(
            _log_ratio(change * lower[kept], change * upper[kept]) for change, lower, upper in pairs
        )

    # Chains are independent, their draws are not. Without chain c the estimate moves by about
    # 1/chains of what the chain says, which the pseudo-value magnifies again.
    every = np.arange(chains)
    whole = estimate(every)
    values = jnp.asarray([chains * whole - (chains - 1) * estimate(every != c) for c in every])
    return values, jnp.mean(values), jnp.std(values, ddof=1) / math.sqrt(chains)


def _log_ratio(lower, upper) -> float:
    """log Z' / Z by bridge sampling, from log weights q' / q of equally many draws of each."""
    # r = E_lower[w / (w + r)] / E_upper[1 / (w + r)], w = q' / q, iterated to its fixed point: for
    # equally many draws the estimate of least variance [@meng1996]
    ratio = _log_mean(lower)
    for _ in range(200):
        old = ratio
        ratio = _log_mean(lower - np.logaddexp(lower, old)) - _log_mean(-np.logaddexp(upper, old))
        if abs(ratio - old) < 1e-10:
            break
    return ratio


def _log_mean(x) -> float:
    return float(np.logaddexp.reduce(x, axis=None) - math.log(x.size))
