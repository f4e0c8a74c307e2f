"""Hamiltonian Monte Carlo on function space, jointly for noise and parameters.

Beskos, Pinski, Sanz-Serna and Stuart (2011), for the noise.

With x = (y, z), y the parameters whitened by their reference, and standard normal momentum p,

    H = Ψ(x) + ½ |x|² + ½ |p|²,    Ψ = -log p(θ, z | v) - ½ |x|².

The Gaussian part is a rotation of (x, p) by the step ε, which is exact; Ψ acts by kicks, p ← p - ½ε
∇Ψ, before and after it. ½ |x|² + ½ |p|² never enters the acceptance: the energy's error is the
change of Ψ plus the work of the kicks, which has a limit as the grid is refined, and so the same
step is good on every grid.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import jax.random as jr
from jax import Array
from jax.sharding import Mesh

from .._checks import flag, known_number, positive_integer
from ._kernel import POSITIVE, PROPORTION, PROPORTION_OR_0, UNSEALED, AbstractBridgeKernel
from ._posterior import Sites, init_to_guided_mean
from ._reference import Windows, start_windows, update_windows
from ._rotation import choose, half_square, metropolis, normal_like, trajectory
from ._step_size import StepSize, start_step_size, update_step_size

_MAX_ENERGY_ERROR = 1000.0  # a transition above it is called divergent, as in NumPyro


class AdaptState(NamedTuple):
    """`step_size`: ε. `averaging`: its dual averaging. `windows`: of the parameters' reference."""

    step_size: Array
    averaging: tuple
    windows: Windows


class FunctionSpaceHMCState(NamedTuple):
    """State of `FunctionSpaceHMC`, under the names of NumPyro's `HMCState`.

    - `z`: unconstrained values. `misfit`, `gradient`: Φ, minus the log density without the noise's
      prior.
    - `potential_energy`: minus the log joint density. `energy`: with the kinetic energy of the
      accepted end.
    - `num_steps`: gradients of this draw. `diverging`: the energy was NaN, or off by more than
      1000.
    - `seal`: by which a chain knows that it starts again, perhaps on other data, and renews its
      energies.
    """

    i: Array
    z: Sites
    misfit: Array
    gradient: Sites
    potential_energy: Array
    energy: Array
    num_steps: Array
    accept_prob: Array
    mean_accept_prob: Array
    diverging: Array
    adapt_state: AdaptState
    rng_key: Array
    seal: Array


class FunctionSpaceHMC(AbstractBridgeKernel):
    """Hamiltonian Monte Carlo whose step does not shrink as the grid is refined.

        MCMC(FunctionSpaceHMC(model), num_warmup=200, num_samples=500)

    **Arguments:**

    - `model`: a NumPyro model with sites of driving noise. Its other latent sites are continuous
      parameters, with a dense mass matrix that is adapted in the warm-up, and started at a Laplace
      approximation.
    - `step_size`: ε, an angle, adapted in the warm-up unless `adapt_step_size=False`. It is never
      below `trajectory_length / max_num_steps`: a smaller one is raised to that.
    - `target_accept_prob`: of that adaptation.
    - `trajectory_length`: the angle by which the Gaussian part turns (π/2 forgets it), jittered by
      ± `jitter` of itself. A draw takes `trajectory_length / step_size` gradients, rounded up.
    - `max_num_steps`: bounds that number, adapted or not. The trajectory keeps its length.
    - `init_strategy`: the noise starts at zero, the guided mean path; parameters at their prior
      medians, from where the Laplace approximation is sought. Chains start at draws from it, or at
      `init_params`.
    - `mesh`: the devices that share the chains of `chain_method="vectorized"`, as for
      `numpyro_bridges.spread`.
    """

    def __init__(
        self,
        model,
        *,
        step_size: float = 1.0,
        target_accept_prob: float = 0.8,
        adapt_step_size: bool = True,
        trajectory_length: float = 2.1,
        jitter: float = 0.2,
        max_num_steps: int = 32,
        init_strategy=init_to_guided_mean,
        mesh: Mesh | None = None,
    ):
        super().__init__(model, init_strategy, mesh)
        self._step_size = known_number(step_size, "step_size", *POSITIVE)
        self._target = known_number(target_accept_prob, "target_accept_prob", *PROPORTION)
        self._adapt_step_size = flag(adapt_step_size, "adapt_step_size")
        self._length = known_number(trajectory_length, "trajectory_length", *POSITIVE)
        self._jitter = known_number(jitter, "jitter", *PROPORTION_OR_0)
        self._max_num_steps = positive_integer(max_num_steps, "max_num_steps")

    _follows_misfit = True

    def get_diagnostics_str(self, state):
        step = float(state.adapt_state.step_size)
        steps = int(state.num_steps)
        return f"{steps} steps of size {step:.2e}. acc. prob={float(state.mean_accept_prob):.2f}"

    def _init_one(self, key, z, energies, reference, model_args, model_kwargs):
        phi, gradient = energies
        least, _ = self._step_bounds
        step = jnp.maximum(jnp.asarray(self._step_size, phi.dtype), least)
        adapt = AdaptState(*start_step_size(step), start_windows(reference))
        energy = phi + half_square(self._parts(z)[1])
        i = jnp.zeros((), int)
        zero = jnp.zeros_like(phi)
        no = jnp.array(False)
        return FunctionSpaceHMCState(
            i, z, phi, gradient, energy, energy, i, zero, zero, no, adapt, key, UNSEALED
        )

    def _slopes(self, state):
        return state.gradient

    @property
    def _energies(self):
        return "misfit", "gradient", "potential_energy"

    def _refreshed(self, state, model_args, model_kwargs):
        phi, gradient = jax.value_and_grad(self._misfit)(state.z, model_args, model_kwargs)
        return state._replace(
            misfit=phi,
            gradient=gradient,
            potential_energy=phi + half_square(self._parts(state.z)[1]),
        )

    def _sample_one(self, state, still, model_args, model_kwargs):
        key, key_momentum, key_length, key_accept = jr.split(state.rng_key, 4)
        reference = state.adapt_state.windows.reference
        theta, noise, unravel = self._parts(state.z)
        slope, force, _ = self._parts(state.gradient)
        y = reference.whiten(theta)

        def to_sites(x):
            return unravel(reference.colour(x[0])) | x[1]

        def psi(x):
            return self._misfit(to_sites(x), model_args, model_kwargs) - half_square(x[0])

        # Rounding may lift the quotient above its bound, and the step may come from another kernel.
        steps = jnp.ceil(self._length / state.adapt_state.step_size)
        steps = jnp.where(still, 1, jnp.clip(steps, 1, self._max_num_steps)).astype(int)
        turn = (
            jr.uniform(key_length, (), y.dtype, 1 - self._jitter, 1 + self._jitter) * self._length
        )
        angle = jnp.where(still, 0.0, turn / steps)
        x = (y, noise)
        old = state.misfit - half_square(y)
        gradient = reference.whiten_gradient(slope) - y, force
        p = normal_like(key_momentum, x)
        x, p, new, (slope, force), work = trajectory(
            jax.value_and_grad(psi), x, p, old, gradient, angle, steps
        )
        error = new - old + work
        rate, accept = metropolis(key_accept, error)
        moved = (
            to_sites(x),
            new + half_square(x[0]),
            unravel(reference.colour_gradient(slope + x[0])) | force,
        )
        z, phi, gradient = choose(accept | still, moved, (state.z, state.misfit, state.gradient))
        potential = phi + half_square(self._parts(z)[1])
        return FunctionSpaceHMCState(
            state.i + 1,
            z,
            phi,
            gradient,
            potential,
            potential + half_square(p),
            steps,
            rate,
            self._running_mean(state, rate),
            ~(error < _MAX_ENERGY_ERROR),
            self._adapted(state, rate, self._parts(z)[0]),
            key,
            state.seal,
        )

    @property
    def _step_bounds(self) -> tuple[float, float]:
        """Of the step as it adapts; the lower one holds for every step.

        Two steps at least, where they are allowed: with one, parameters stick where their posterior
        is far from the reference.
        """
        return self._length / self._max_num_steps, self._length / min(2, self._max_num_steps)

    def _adapted(self, state, rate, theta) -> AdaptState:
        adapt = state.adapt_state
        windows, renewed = update_windows(adapt.windows, state.i, self._num_warmup, theta)
        step = StepSize(adapt.step_size, adapt.averaging)
        if self._adapt_step_size:
            last = state.i == self._num_warmup - 1
            step = update_step_size(
                step, self._target - rate, self._step_bounds, renew=renewed, last=last
            )
        new = AdaptState(*step, windows)
        return choose(self._warming(state), new, adapt)
