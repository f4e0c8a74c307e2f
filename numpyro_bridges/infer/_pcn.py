"""Preconditioned Crank-Nicolson moves of the noise, for `Gibbs` beside a kernel of the parameters.

Cotter, Roberts, Stuart and White (2013).

A move turns the noise z by an angle φ towards an independent p ~ N(0, I),

    z' = cos(φ) z + sin(φ) p,

which N(0, I) survives, and is accepted on the likelihood ratio alone: the rate does not depend on
the grid. `PCNL`, the Langevin version, also kicks p by the gradient of the log likelihood, for half
of φ before the turn and half of φ after.

Data that are independent given the parameters, each with its own noise, move at once and are
accepted one by one: one evaluation of the model updates them all, and each has its own angle.

So do the clades of a tree, given the noise before them: Ψ is a sum over the branches, and the noise
of a branch enters its own term and those below it. A move turns the noise of all branches of one
level, those that are as many branches from the root, or of all that is below them too; each is
accepted on what changes in its clade.
"""

from abc import ABC, abstractmethod
from math import pi
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jax import Array
from jax.sharding import Mesh

from .._checks import choice, flag, known_number, positive_integer, require
from ..distributions import NoiseBlocks
from ._kernel import PROPORTION, UNSEALED, AbstractBridgeKernel
from ._posterior import Sites, driven_by, energies_of, groups_of, init_to_guided_mean
from ._rotation import half_square, kick, metropolis, normal_like, rotate, total


class PCNState(NamedTuple):
    """State of `PCN` and `PCNL`.

    - `z`: the noise. `potential_energy`: minus the log joint density, up to what does not depend on
      the noise.
    - `energies`: -log p(v_s | θ, z_s), an array for each noise site; one number where data share
      noise, or where it has other uses. With `blocks` those of a tree have an axis for its branches
      behind. `force`: minus their gradient, in `PCNL`.
    - `angles`: φ, shaped as `energies`, adapted in the warm-up. `accept_prob`: the mean over data
      and moves.
    - `diverging`: an energy was NaN. `seal`: by which a chain knows that it starts again, perhaps
      on other data.
    """

    i: Array
    z: Sites
    potential_energy: Array
    energies: tuple[Array, ...]
    force: Sites
    angles: tuple[Array, ...]
    accept_prob: Array
    mean_accept_prob: Array
    diverging: Array
    rng_key: Array
    seal: Array


class AbstractPCN(AbstractBridgeKernel):
    def __init__(
        self,
        model,
        *,
        num_moves: int = 1,
        num_blocks: int = 1,
        blocks: str | None = None,
        angle: float = 1.0,
        adapt_angle: bool = True,
        target_accept_prob: float = 0.4,
        init_strategy=init_to_guided_mean,
        mesh: Mesh | None = None,
    ):
        super().__init__(model, init_strategy, mesh)
        # In single precision π/2 is above π/2.
        self._angle = known_number(angle, "angle", "in (0, π/2]", lambda x: 0 < x < pi / 2 + 1e-6)
        self._target = known_number(target_accept_prob, "target_accept_prob", *PROPORTION)
        self._adapt_angle = flag(adapt_angle, "adapt_angle")
        self._num_moves = positive_integer(num_moves, "num_moves")
        self._num_blocks = positive_integer(num_blocks, "num_blocks")
        self._kind = None if blocks is None else choice(blocks, "blocks", ("branch", "clade"))
        require(
            self._kind is None or self._num_blocks == 1,
            f"`num_blocks` cuts time steps, and `blocks` a tree; got {num_blocks} and {blocks!r}. "
            "Give one of them.",
        )
        self._cuts: list[AbstractBlocks] = []

    @abstractmethod
    def _evaluate(self, z: Sites, model_args, model_kwargs) -> tuple[tuple[Array, ...], Sites]:
        """Energies, and the force on the noise; an empty one, if the energies alone decide."""

    def _energies_of(self, z, model_args, model_kwargs):
        return energies_of(
            self._model, model_args, model_kwargs, z, self._owners, self._kind is not None
        )[1]

    def get_diagnostics_str(self, state):
        angles = jnp.concatenate([jnp.ravel(some) for some in state.angles])
        angle = float(jnp.mean(angles))
        return f"mean angle {angle:.2f}. acc. prob={float(state.mean_accept_prob):.2f}"

    def _init_one(self, key, z, energies, reference, model_args, model_kwargs):
        parameters = sorted(set(z) - set(self._noise))
        require(
            not parameters,
            f"{type(self).__name__} moves noise alone, and the model has parameters, "
            f"{parameters}: give them a block, `Gibbs([({type(self).__name__}(model), "
            "noise_sites), (NUTS(model), None)])`.",
        )
        few = [
            name for name in z if self._num_blocks > (z[name].shape[-3] if z[name].ndim > 2 else 1)
        ]
        require(
            not few, f"`num_blocks` must be at most the number of time steps; {few} have fewer."
        )
        # which site each noise drives, by the model's own structure: where noises have other uses,
        # all are decided together
        self._owners = driven_by(self._model, model_args, model_kwargs, z)
        self._cuts = self._cut(z)
        energies, force = self._evaluate(z, model_args, model_kwargs)
        angles = tuple(jnp.full_like(energy, self._angle) for energy in energies)
        # an angle for each decision: data that are hard to move get small ones of their own
        i = jnp.array(0)
        zero = jnp.zeros_like(total(energies))
        no = jnp.array(False)
        return PCNState(
            i, z, _potential(z, energies), energies, force, angles, zero, zero, no, key, UNSEALED
        )

    def _cut(self, z) -> "list[AbstractBlocks]":
        """How the noise of each group is cut."""
        if self._kind is None:
            return [_TimeBlocks(self._num_blocks)] * len(groups_of(z, self._owners))
        # energies by branch exist for the noise of trees alone, which must have no other use
        require(
            any(blocks is not None for blocks in self._blocks.values()),
            "`blocks` needs the noise of a `DiffusionTree`, of `numpyro_bridges.sample`; "
            f"{sorted(z)} have none.",
        )
        require(
            self._owners is not None,
            f"`blocks` needs noise that drives one site and has no other use; {sorted(z)} are not "
            "so.",
        )
        cuts = [self._blocks[name] for name in sorted(z)]
        return [
            _TimeBlocks(1) if cut is None else _TreeBlocks(cut, self._kind == "clade")
            for cut in cuts
        ]

    @property
    def _energies(self):
        return "potential_energy", "energies", "force"

    def _refreshed(self, state, model_args, model_kwargs):
        energies, force = self._evaluate(state.z, model_args, model_kwargs)
        return state._replace(
            potential_energy=_potential(state.z, energies), energies=energies, force=force
        )

    def _sample_one(self, state, still, model_args, model_kwargs):
        key, key_moves = jr.split(state.rng_key)

        def move(m, carry):
            state, rates = carry
            state, rate = self._move(
                jr.fold_in(key_moves, m), m, state, still, model_args, model_kwargs
            )
            return state, rates + rate / self._num_moves

        start = (state._replace(diverging=jnp.array(False)), jnp.zeros_like(state.accept_prob))
        # `still`: a draw that starts a chain again renews the energies and moves nothing; one move
        # of no angle does it, without a second copy of the model in the program
        new, rate = jax.lax.fori_loop(0, jnp.where(still, 1, self._num_moves), move, start)
        return new._replace(
            i=state.i + 1,
            potential_energy=_potential(new.z, new.energies),
            accept_prob=rate,
            mean_accept_prob=self._running_mean(state, rate),
            rng_key=key,
        )

    def _move(self, key, m, state, still, model_args, model_kwargs):
        """Turns the noise of one block, or one level of a tree, and decides for each datum."""
        key_p, key_accept = jr.split(key)
        old = state.z
        groups = groups_of(state.z, self._owners)
        # blocks and levels take turns by the number of the move, over the whole chain
        number = state.i * self._num_moves + m
        turns = {
            name: cut.turns(number, jnp.where(still, 0.0, angle), old[name])
            for group, cut, angle in zip(groups, self._cuts, state.angles, strict=True)
            for name in group
        }
        # kick, turn, kick: reversible, and of volume 1. What the kicks change of ½ |p|² is the
        # work by which the ratio of likelihoods is corrected; without a force there is none.
        p, before = _kicked(normal_like(key_p, old), state.force, turns)
        new, p = rotate(old, p, turns)
        energies, force = self._evaluate(new, model_args, model_kwargs)
        _, after = _kicked(p, force, turns)

        accept = {}
        decisions = []
        rates = []
        asked = []
        for key, group, cut, e_new, e_old in zip(
            jr.split(key_accept, len(groups)),
            groups,
            self._cuts,
            energies,
            state.energies,
            strict=True,
        ):
            # each decision by the energy and the work of its own noise
            work = sum(
                cut.summed(before[name] + after[name], e_new) for name in group if name in force
            )
            rate, decision = metropolis(key, cut.judged(number, e_new - e_old + work))
            accepted = cut.applied(number, decision) | still
            accept |= {name: cut.widened(accepted, old[name]) for name in group}
            decisions.append(accepted)
            # branches of other levels have no rate in this move, and do not adapt
            asked.append(jnp.broadcast_to(cut.asked(number), rate.shape))
            rates.append(jnp.where(asked[-1], rate, 0.0))

        def chosen(new, old):
            return {name: jnp.where(accept[name], new[name], old[name]) for name in new}

        state = state._replace(
            z=chosen(new, old),
            energies=jax.tree.map(jnp.where, tuple(decisions), energies, state.energies),
            force=chosen(force, state.force),
            angles=tuple(
                jnp.where(own, self._adapted(state, a, r), a)
                for own, a, r in zip(asked, state.angles, rates, strict=True)
            ),
            diverging=state.diverging | jnp.isnan(total(energies)),
        )
        return state, total(rates) / total(asked)

    def _adapted(self, state, angle: Array, rate: Array) -> Array:
        """Robbins-Monro: the rate tends to its target, or stays above it at the angle π/2."""
        if not self._adapt_angle:
            return angle
        # steps whose sum is infinite and whose squares have a finite one
        gain = (state.i + 1.0) ** -0.6
        new = jnp.clip(angle * jnp.exp(gain * (rate - self._target)), 1e-3, pi / 2)
        return jnp.where(self._warming(state), new, angle)


class PCN(AbstractPCN):
    """Preconditioned Crank-Nicolson moves of the noise: no gradients.

        nuts = NUTS(model, init_strategy=init_to_guided_mean)
        Gibbs([(PCN(model, num_moves=3), noise_sites), (nuts, None)])

    NUTS's own start, uniform values, is far out for parameters of a flow: its steps may stay tiny.

    **Arguments:**

    - `model`: a NumPyro model with sites of driving noise, and no other latent sites but those of
      other blocks.
    - `num_moves`: moves for each draw.
    - `num_blocks`: the time steps are cut into that many blocks, of which every move turns the
      next. It helps where whole paths are hardly accepted.
    - `blocks`: for the noise of a `DiffusionTree`. "branch": a move turns the noise of the branches
      of one level, as many branches from the root, and every move takes the next level; each branch
      is accepted on what changes below it, and has its own angle. "clade": all noise below them
      turns too. Without it the tree is accepted as a whole.
    - `angle`: φ in (0, π/2], π/2 being an independent proposal. Adapted in the warm-up, for each
      datum on its own, to `target_accept_prob`, unless `adapt_angle=False`.
    - `mesh`: as for `FunctionSpaceHMC`; not inside `Gibbs`.
    """

    def _evaluate(self, z, model_args, model_kwargs):
        return self._energies_of(z, model_args, model_kwargs), {}


class PCNL(AbstractPCN):
    """Preconditioned Crank-Nicolson Langevin moves: `PCN` with gradients, for small φ."""

    def __init__(self, model, *, target_accept_prob: float = 0.7, **settings):
        super().__init__(model, target_accept_prob=target_accept_prob, **settings)

    def _evaluate(self, z, model_args, model_kwargs):
        def energy(z):
            energies = self._energies_of(z, model_args, model_kwargs)
            return total(energies), energies

        gradient, energies = jax.grad(energy, has_aux=True)(z)
        return energies, jax.tree.map(jnp.negative, gradient)


def _potential(z, energies):
    return total(energies) + half_square(z)


def _kicked(p, force, turns):
    """Forces act for half of the turn, where there are any."""
    # `PCN` has an empty force
    new, change = kick({n: p[n] for n in force}, force, {n: 0.5 * turns[n] for n in force})
    return p | new, change


class AbstractBlocks(ABC):
    """Which noise a move turns, and what is decided; energies and angles have its shape."""

    @abstractmethod
    def turns(self, number, angle, noise) -> Array:
        """The angle of every noise in the move of this number."""

    @abstractmethod
    def asked(self, number) -> Array:
        """Whose moves are decided."""

    @abstractmethod
    def judged(self, number, change) -> Array:
        """What each move changes, of what each energy changes."""

    @abstractmethod
    def applied(self, number, decision) -> Array:
        """Which energies change, of which moves are accepted."""

    @abstractmethod
    def summed(self, a, energies) -> Array:
        """The sum over the noise of each energy."""

    @abstractmethod
    def widened(self, a, noise) -> Array:
        """What belongs to an energy, for its noise."""


class _TimeBlocks(AbstractBlocks):
    """Blocks of time steps, axis −3 of the noise. Each datum is decided on its own."""

    def __init__(self, num_blocks: int):
        self._num_blocks = num_blocks

    def turns(self, number, angle, noise):
        if self._num_blocks == 1:
            return self.widened(angle, noise)
        # step i belongs to block ⌊i · blocks / steps⌋, so that sizes differ by one at most
        steps = noise.shape[-3]
        inside = jnp.arange(steps) * self._num_blocks // steps == number % self._num_blocks
        return self.widened(angle, noise) * inside.astype(noise.dtype)[:, None, None]

    def asked(self, number):
        return jnp.array(True)

    def judged(self, number, change):
        return change

    def applied(self, number, decision):
        return decision

    def summed(self, a, energies):
        return jnp.sum(a, axis=tuple(range(energies.ndim, a.ndim)))

    def widened(self, a, noise):
        return a.reshape(a.shape + (1,) * (noise.ndim - a.ndim))


class _TreeBlocks(AbstractBlocks):
    """Branches of a tree, each with an energy and rows of noise. A move takes one level."""

    def __init__(self, blocks: NoiseBlocks, whole_clades: bool):
        above = blocks.above
        self._count = len(above)
        self._whole_clades = whole_clades
        self._rows = np.repeat(np.arange(len(above)), blocks.sizes)
        # the branches from the root to each, itself included: its level is their number
        lineages = []
        for i, parent in enumerate(above):
            lineages.append([*(lineages[parent] if parent >= 0 else []), i])
        depth = max(map(len, lineages))
        # for each level and branch: the branch of that level at or above it; none is the number of
        # branches
        self._owners = np.full((depth, len(above)), len(above))
        for i, lineage in enumerate(lineages):
            self._owners[: len(lineage), i] = lineage

    def _owner(self, number):
        """For each branch the one of this move's level at or above it, with which it is decided."""
        return jnp.asarray(self._owners)[number % len(self._owners)]

    def turns(self, number, angle, noise):
        moving = self._owner(number) < self._count if self._whole_clades else self.asked(number)
        return self.widened(jnp.where(moving, self.applied(number, angle), 0.0), noise)

    def asked(self, number):
        return self._owner(number) == jnp.arange(self._count)

    def judged(self, number, change):
        # all that changes below a branch of the level is its own; branches above the level do not
        # change, and are added up at one place more
        total = jnp.zeros((*change.shape[:-1], self._count + 1), change.dtype)
        return total.at[..., self._owner(number)].add(change)[..., :-1]

    def applied(self, number, decision):
        # that place, of branches that no decision is about, is False
        padded = jnp.concatenate([decision, jnp.zeros_like(decision[..., :1])], -1)
        return padded[..., self._owner(number)]

    def summed(self, a, energies):
        return jnp.zeros_like(energies).at[..., self._rows].add(jnp.sum(a, (-2, -1)))

    def widened(self, a, noise):
        return a[..., self._rows, None, None]
