"""Correlated pseudo-marginal Metropolis-Hastings.

Andrieu and Roberts (2009); Deligiannidis, Doucet and Pitt (2018).

The likelihood of each datum is estimated by the mean of the weights of N bridges, which is
unbiased,

    p̂(v | θ, u) = Π_s 1/N Σ_i p(v_s | θ, u_{s,i}),    u_{s,i} ~ N(0, I),

and the chain of (θ, u) has the posterior of θ as margin, whatever N. The estimate is kept with its
noise u, and never renewed at the same point. Proposals of u are correlated with it, u' = ρ u + √(1
- ρ²) ξ, so that the errors of the two estimates cancel.
"""

import math
import warnings
from abc import abstractmethod
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jax import Array
from jax.scipy.special import logsumexp
from jax.sharding import Mesh

from .. import weights
from .._checks import concrete, known_number, positive_integer, require
from ._draws import surely_heavy
from ._kernel import POSITIVE, PROPORTION_OR_0, UNSEALED, AbstractBridgeKernel
from ._posterior import Sites, driven_by, energies_of, groups_of, init_to_guided_mean
from ._reference import Windows, start_windows, update_windows
from ._rotation import choose, kick, metropolis, normal_like, rotate, total

_PILOT = 256  # bridges by which the number of particles is chosen
# of the log estimate, at most: above it chains stick; far below 1, particles are wasted
_BEST_SD = 1.7


class PseudoMarginalState(NamedTuple):
    """State of the pseudo-marginal kernels.

    - `z`: unconstrained parameters, and for each datum the noise of one bridge, drawn with the
      weights.
    - `particles`: u, noise with an axis of N in front. `potential_energy`: minus log prior and log
      estimate.
    - `force`: minus its gradient in the parameters, for MALA. `step_size`: in whitened parameters.
    - `diverging`: the estimate of the proposal was NaN. `seal`: by which a chain knows that it
      starts again.
    """

    i: Array
    z: Sites
    particles: Sites
    potential_energy: Array
    force: Array
    step_size: Array
    windows: Windows
    accept_prob: Array
    mean_accept_prob: Array
    diverging: Array
    rng_key: Array
    seal: Array


class AbstractPseudoMarginal(AbstractBridgeKernel):
    def __init__(
        self,
        model,
        num_particles: int | None = None,
        *,
        correlation: float = 0.9,
        step_size: float | None = None,
        max_particles: int = 64,
        init_strategy=init_to_guided_mean,
        mesh: Mesh | None = None,
    ):
        super().__init__(model, init_strategy, mesh)
        # u' = cos(φ) u + sin(φ) ξ with ρ = cos(φ)
        self._turn = math.acos(known_number(correlation, "correlation", *PROPORTION_OR_0))
        self._step_size = step_size
        if step_size is not None:
            self._step_size = known_number(step_size, "step_size", *POSITIVE)
        self._num_particles = (
            None if num_particles is None else positive_integer(num_particles, "num_particles")
        )
        self._max_particles = positive_integer(max_particles, "max_particles")

    @abstractmethod
    def _evaluate(self, potential, theta: Array) -> tuple:
        """The potential, `(value, energies)`, and minus its gradient, 0 for a random walk."""

    @abstractmethod
    def _best_step(self, d: int) -> float:
        """The step in whitened parameters, were their posterior normal."""

    @property
    def num_particles(self) -> int | None:
        """N; `None` before it is chosen."""
        return self._num_particles

    def get_diagnostics_str(self, state):
        step = float(state.step_size)
        rate = float(state.mean_accept_prob)
        return f"{self._num_particles} particles, step size {step:.2e}. acc. prob={rate:.2f}"

    def _check(self, model_args, model_kwargs):
        sites = super()._check(model_args, model_kwargs)
        if self._num_particles is None:
            # N is a shape: it must be a number here, even where NumPyro traces the start
            with jax.ensure_compile_time_eval():
                log_weights = self._pilot(model_args, model_kwargs)
            pilot = [concrete(w) for w in log_weights]
            require(
                all(w is not None for w in pilot),
                "`num_particles` must be given where the model's arguments are traced.",
            )
            self._num_particles = _choose(pilot, self._max_particles)
        return sites

    def _pilot(self, model_args, model_kwargs):
        """Log weights of bridges at the mode of the parameters, `(bridges, data)`."""

        @jax.jit
        def log_weights(key):
            key_start, key_noise = jr.split(key)
            z = self._start(key_start, model_args, model_kwargs)
            _, noise, unravel = self._parts(z)
            reference, _ = self._laplace(None, model_args, model_kwargs)
            self._owners = driven_by(self._model, model_args, model_kwargs, z, self._noise)

            def one(key):
                z = unravel(reference.mean) | normal_like(key, noise)
                return energies_of(self._model, model_args, model_kwargs, z, self._owners)[1]

            # a few at a time, for memory
            energies = jax.lax.map(one, jr.split(key_noise, _PILOT), batch_size=32)
            return [-energy.reshape(_PILOT, -1) for energy in energies]

        # a key of its own: N is a setting of the kernel, the same for every chain
        return log_weights(jr.key(0))

    def _init_one(self, key, z, energies, reference, model_args, model_kwargs):
        key, key_particles, key_pick = jr.split(key, 3)
        theta, noise, unravel = self._parts(z)
        require(
            theta.size > 0,
            f"{type(self).__name__} moves parameters, and the model has none but its noise.",
        )
        self._owners = driven_by(self._model, model_args, model_kwargs, z, self._noise)
        particles = normal_like(
            key_particles, noise, (positive_integer(self._num_particles, "num_particles"),)
        )
        potential = self._potential(particles, unravel, model_args, model_kwargs)
        (value, energies), force = self._evaluate(potential, theta)
        z = unravel(theta) | self._pick(key_pick, particles, energies)
        step = self._best_step(theta.size) if self._step_size is None else self._step_size
        zero = jnp.zeros_like(value)
        no = jnp.array(False)
        windows = start_windows(reference)
        i = jnp.array(0)
        step = jnp.asarray(step, value.dtype)
        return PseudoMarginalState(
            i, z, particles, value, force, step, windows, zero, zero, no, key, UNSEALED
        )

    @property
    def _energies(self):
        return "z", "potential_energy", "force"

    def _refreshed(self, state, model_args, model_kwargs):
        theta, _, unravel = self._parts(state.z)
        potential = self._potential(state.particles, unravel, model_args, model_kwargs)
        (value, _), force = self._evaluate(potential, theta)
        return state._replace(potential_energy=value, force=force)

    def _potential(self, particles, unravel, model_args, model_kwargs):
        """-log of prior and estimate as a function of θ, and the energies of the particles."""

        def potential(theta):
            sites = unravel(theta)

            def one(noise):
                return energies_of(
                    self._model, model_args, model_kwargs, sites | noise, self._owners
                )

            rest, energies = jax.vmap(one)(particles)
            # log 1/N Σ_i p(v_s | θ, u_{s,i}), for each datum s before their sum: particles of one
            # datum are averaged whatever those of others are
            estimates = [logsumexp(-energy, axis=0) - math.log(len(energy)) for energy in energies]
            # the prior of θ, the same for every particle
            return rest[0] - total(estimates), energies

        return potential

    def _pick(self, key, particles, energies):
        """For each datum the noise of one particle, drawn in proportion to the weights."""
        groups = groups_of(particles, self._owners)
        picked = {}
        keys = jr.split(key, len(groups))
        for key_g, group, energy in zip(keys, groups, energies, strict=True):
            # noises of one group are weighed together, and come from one particle
            index = jr.categorical(key_g, -energy, axis=0)
            for name in group:
                u = particles[name]
                at = index.reshape((1,) + index.shape + (1,) * (u.ndim - 1 - index.ndim))
                picked[name] = jnp.take_along_axis(u, at, axis=0)[0]
        return picked

    def _sample_one(self, state, still, model_args, model_kwargs):
        key, key_p, key_u, key_accept, key_pick = jr.split(state.rng_key, 5)
        theta, _, unravel = self._parts(state.z)
        reference = state.windows.reference
        # `still`: a step of no length, which evaluates where the chain starts again
        step_size = state.step_size * ~still
        half = 0.5 * step_size
        # In y = L⁻¹ (θ − μ): kick, move, kick. Without a force it is a random walk, y' = y + ε p;
        # with one it is one leapfrog step, which is MALA's proposal.
        p = jr.normal(key_p, theta.shape, theta.dtype)
        p, before = kick(p, reference.whiten_gradient(state.force), half)
        theta_new = theta + step_size * reference.scale @ p
        # the noise of all particles turns with it: this keeps N(0, I), so that the ratio of
        # estimates alone decides
        fresh = normal_like(key_u, state.particles)
        particles, _ = rotate(state.particles, fresh, self._turn * ~still)
        potential = self._potential(particles, unravel, model_args, model_kwargs)
        (value, energies), force = self._evaluate(potential, theta_new)
        _, after = kick(p, reference.whiten_gradient(force), half)
        # the old estimate is the one in the state: drawn anew, it would change the target
        error = value - state.potential_energy + total(before) + total(after)
        rate, accept = metropolis(key_accept, error)
        z_new = unravel(theta_new) | self._pick(key_pick, particles, energies)
        moved = z_new, particles, value, force
        kept = state.z, state.particles, state.potential_energy, state.force
        z, particles, value, force = choose(accept | still, moved, kept)
        windows, _ = update_windows(state.windows, state.i, self._num_warmup, self._parts(z)[0])
        windows = choose(self._warming(state), windows, state.windows)
        return state._replace(
            i=state.i + 1,
            z=z,
            particles=particles,
            potential_energy=value,
            force=force,
            windows=windows,
            accept_prob=rate,
            mean_accept_prob=self._running_mean(state, rate),
            diverging=jnp.isnan(error),
            rng_key=key,
        )


class CorrelatedPseudoMarginal(AbstractPseudoMarginal):
    """Random walk of the parameters on averaged weights: no gradients, and no noise in the
    posterior.

        MCMC(CorrelatedPseudoMarginal(model), num_warmup=500, num_samples=5000)

    **Arguments:**

    - `model`: a NumPyro model with sites of driving noise; its other latent sites are continuous
      parameters.
    - `num_particles`: N, the bridges of each datum. By default it is chosen before the run, the
      smallest by which the log estimate has a standard deviation of at most 1.7 at the mode, where
      chains are most efficient, with a warning if `max_particles` do not suffice, or the weights of
      256 bridges have too heavy a tail to tell. Where one particle has a standard deviation below
      1, the guide is good.
    - `correlation`: ρ, of the noise of successive proposals.
    - `step_size`: of the walk, in units of the parameters' reference, a Laplace approximation that
      is renewed in the warm-up. By default 2.56 / √d for d parameters (Sherlock, Thiery, Roberts
      and Rosenthal, 2015).
    - `init_strategy`, `mesh`: as for `FunctionSpaceHMC`.

    The noise of the posterior is that of one particle for each datum: paths can be had from it as
    from any kernel.
    """

    def _evaluate(self, potential, theta):
        return potential(theta), jnp.zeros_like(theta)

    def _best_step(self, d):
        return 2.56 / math.sqrt(d)


class CorrelatedPseudoMarginalMALA(AbstractPseudoMarginal):
    """`CorrelatedPseudoMarginal` whose parameters are proposed by the Metropolis-adjusted Langevin
    algorithm.

    Its default step is 1.65 / d^(1/6) (Roberts and Rosenthal, 1998).
    """

    def _evaluate(self, potential, theta):
        found, gradient = jax.value_and_grad(potential, has_aux=True)(theta)
        return found, -gradient

    def _best_step(self, d):
        return 1.65 * d ** (-1 / 6)


def _choose(log_weights, largest: int) -> int:
    """The fewest particles by which the log estimate varies little enough, from pilot weights."""
    # fixed, so that the same model and data have the same N
    rng = np.random.default_rng(0)
    pilot = [np.asarray(w, float) for w in log_weights]
    _warn_of_tails(np.concatenate(pilot, axis=1).T)
    # 1, 2, 3, 4, 6, 8, 12, ...
    powers = [2**k for k in range(11)]
    between = [3 * n // 2 for n in powers[1:]]
    counts = sorted(n for n in powers + between if n <= largest)
    for n in counts:
        sd = np.std(sum(_resampled(rng, w, n) for w in pilot))
        if sd <= _BEST_SD:
            return n
    warnings.warn(
        f"the log estimate of {counts[-1]} particles has a standard deviation of {sd:.1f}: above "
        f"{_BEST_SD} the chain sticks. Choose a better guide, allow more by `max_particles`, or "
        "use FunctionSpaceHMC.",
        stacklevel=2,
    )
    return counts[-1]


def _warn_of_tails(log_weights) -> None:
    """A warning where weights `(data, bridges)` cannot tell how much a log estimate varies.

    The log forgives more than a mean does: the average k̂ has to be below 1, beyond which there is
    no mean to be estimated, and none may surely be above the threshold.
    """
    with jax.ensure_compile_time_eval():
        shapes = np.clip(np.asarray(weights.pareto_k(log_weights)), 0.0, 2.0)
    if np.mean(shapes) < 1 and not np.any(surely_heavy(shapes, log_weights.shape[1])):
        return
    warnings.warn(
        "the number of particles is chosen by weights with too heavy a tail: k̂ is "
        f"{np.mean(shapes):.2f} on average over the data and at most {np.max(shapes):.2f}. The "
        "log estimate varies more than they say, and the chain may stick. Choose a better guide, "
        "or give `num_particles`.",
        stacklevel=4,
    )


def _resampled(rng, log_weights, n, replicates=500):
    """Log estimates of all data from n of the pilot weights, drawn anew in each replicate."""
    picks = rng.integers(len(log_weights), size=(replicates, n, log_weights.shape[1]))
    values = np.take_along_axis(log_weights[None], picks, axis=1)
    # a log mean of exponentials, relative to the largest
    top = values.max(1, keepdims=True)
    log_means = top[:, 0] + np.log(np.mean(np.exp(values - top), 1))
    return np.sum(log_means, -1)
