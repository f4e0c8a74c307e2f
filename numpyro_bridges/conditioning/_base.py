"""What is seen of the end state.

A *match* is a model of observation; `match.at(v)` is a *condition*, the match at its datum. A
bridge asks a condition for three things: the linear observation that it makes of the end state, a
value near which to linearise, and the value that a path is led to, which is the datum itself or,
for a set, a draw inside it.
"""

import abc
from collections.abc import Callable
from typing import ClassVar, Self

import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
from jaxtyping import Array, Float, PRNGKeyArray

from .._linalg import apply, congruence
from .._types import State, Structured
from ..sdes import AbstractSDE


class Observation(eqx.Module):
    """v = operator x + N(0, factor factorᵀ), or v = operator x where `factor` is None.

    Its density is multiplied by exp(log_scale).
    """

    operator: Structured
    factor: Structured | None
    log_scale: Float[Array, ""]

    @property
    def exact(self) -> bool:
        """Whether it has no noise."""
        return self.factor is None

    @property
    def covariance(self) -> Structured:
        """factor factorᵀ, 0 where it is exact."""
        # of the least rank: what adds to it promotes it
        one = jnp.ones((), self.operator.dtype)
        return 0 * one if self.factor is None else congruence(self.factor, one)


class Target(eqx.Module):
    """The value that the path is led to, and the log weight of having chosen it."""

    value: State
    log_weight: Float[Array, ""]


class AbstractCondition(eqx.Module):
    """An event, or an observed value, of the end state.

    A subclass says what linear function of the end state is seen and with which Gaussian noise;
    what is not linear is an `AbstractDensityMatch`. Here the sum of all rows is seen with an error:

        class Total(nb.AbstractCondition):
            value: Array  # (1, dim)
            variance: Array
            exact: ClassVar[bool] = False
            num_extra_noises: ClassVar[int] = 0

            def check(self, sde, x):
                if self.value.shape != (1, *x.shape[1:]):
                    raise ValueError(f"`value` must be of shape {(1, *x.shape[1:])}.")

            def observation(self, sde, x):
                return Observation(jnp.ones((1, len(x))), jnp.sqrt(self.variance), jnp.zeros(()))

            def reference(self, sde, x):
                return x + (self.value - x.sum(axis=0)) / len(x)

            def log_value(self, law_mean, law_factor):
                return gaussian_log_density(self.value - law_mean, law_factor)

            def target(self, law_mean, law_factor, noise):
                return Target(self.value, jnp.zeros(()))

            def noise_from_target(self, law_mean, law_factor, seen):
                return jnp.zeros((0, *seen.shape))
    """

    num_extra_noises: eqx.AbstractClassVar[int]
    """Rows of noise that choose the target, before the first step."""

    is_approximated: ClassVar[bool] = False
    """Whether paths are led by an approximation, an observation of all columns of a state together:
    `anchored` finds it and `correction` weighs it. It is of x.reshape(-1), where other observations
    are of each column alike."""

    @property
    @abc.abstractmethod
    def exact(self) -> bool:
        """Whether the end state is pinned; decides the default grid."""

    @abc.abstractmethod
    def check(self, sde: AbstractSDE, x: State) -> None:
        """`ValueError` where the condition does not fit states shaped like x."""

    @abc.abstractmethod
    def observation(self, sde: AbstractSDE, x: State) -> Observation:
        """What is seen of a state shaped like x."""

    @abc.abstractmethod
    def reference(self, sde: AbstractSDE, x: State) -> State:
        """A state like x that meets the condition: where an auxiliary process is linearised."""

    @abc.abstractmethod
    def log_value(self, law_mean: State, law_factor: Structured) -> Float[Array, ""]:
        """log h̃, if what is seen is N(mean, factor factorᵀ): log density, or log probability."""

    @abc.abstractmethod
    def target(
        self, law_mean: State, law_factor: Structured, noise: Float[Array, "extra k *dim"]
    ) -> Target:
        """The value to be led to, given the guide's law N(mean, factor factorᵀ) of what is seen."""

    @abc.abstractmethod
    def noise_from_target(
        self, law_mean: State, law_factor: Structured, seen: State
    ) -> Float[Array, "extra m *dim"]:
        """The extra noise with which `target` chooses `seen`."""

    def closed(self, x: State) -> "AbstractCondition":
        """The same for states shaped like x, with what a user's functions read frozen."""
        return self

    def anchored(
        self, sde: AbstractSDE, find_law: Callable[[], tuple[State, Structured]]
    ) -> "AbstractCondition":
        """The condition with the observation that paths are led by, where it has none of itself.

        `find_law()` gives mean and covariance, nearly, of the unconditioned end state.
        """
        return self

    def drawn(self, extra: Float[Array, "extra k *dim"]) -> "AbstractCondition":
        """The condition with what the rows of extra noise choose of it, before a path is led."""
        return self

    def draw_of(
        self, x: State, shape: tuple[int, ...], key: PRNGKeyArray | None
    ) -> Float[Array, "extra k *dim"]:
        """Rows of extra noise for `drawn`, `shape`, of a path that is known and ends in x."""
        return jnp.zeros(shape, x.dtype)

    def correction(self, sde: AbstractSDE, x: State) -> Float[Array, ""]:
        """Log density at the end state x: of the condition, less that of what led the path."""
        return jnp.zeros((), x.dtype)

    def displaced(self, shift: State) -> "AbstractCondition":
        """The condition on what is seen less `shift`; here by adding it, which costs digits."""
        return _Displaced(self, shift)


class _Displaced(AbstractCondition):
    """A condition that knows values, asked about displacements by `shift`."""

    condition: AbstractCondition
    shift: State

    def __init__(self, condition: AbstractCondition, shift: State):
        self.condition = condition
        self.shift = shift

    @property
    def num_extra_noises(self):
        return self.condition.num_extra_noises

    @property
    def exact(self):
        return self.condition.exact

    def check(self, sde, x):
        self.condition.check(sde, x)

    def observation(self, sde, x):
        return self.condition.observation(sde, x)

    def reference(self, sde, x):
        return self.condition.reference(sde, x)

    def log_value(self, law_mean, law_factor):
        return self.condition.log_value(law_mean + self.shift, law_factor)

    def target(self, law_mean, law_factor, noise):
        target = self.condition.target(law_mean + self.shift, law_factor, noise)
        return Target(target.value - self.shift, target.log_weight)

    def noise_from_target(self, law_mean, law_factor, seen):
        return self.condition.noise_from_target(
            law_mean + self.shift, law_factor, seen + self.shift
        )


class AbstractMatch(eqx.Module):
    """A model of observation of the end state.

    `at(v)` is the condition that v was seen, often one that exists; it must be the density, in v,
    of what `sample` draws. Here each coordinate is read off to the nearest multiple of a unit:

        class Rounded(nb.AbstractMatch):
            unit: Array

            def at(self, observed):
                observed = jnp.asarray(observed, float)
                return nb.CylinderSet(observed - self.unit / 2, observed + self.unit / 2)

            def sample(self, key, sde, x):
                return self.unit * jnp.round(x / self.unit)

            def check_density(self):
                pass
    """

    @abc.abstractmethod
    def at(self, observed) -> AbstractCondition:
        """The condition that `observed` was seen."""

    @abc.abstractmethod
    def sample(self, key: PRNGKeyArray, sde: AbstractSDE, x: State) -> Array:
        """An observation of the end state x."""

    def closed(self, x: State, observed: State) -> Self:
        """For states like x and data like `observed`, with what a user's functions read frozen."""
        return self

    def example(self, sde: AbstractSDE, x: State) -> Array:
        """A datum that could be seen of x: for its shape, and where the real one is masked."""
        # Which one does not matter, so the key is no argument.
        return self.sample(jr.key(0), sde, x)

    @abc.abstractmethod
    def check_density(self) -> None:
        """`ValueError` if `at(v)`'s evidence is not a density of what `sample` draws."""


def lift(operator: Structured, x: State, value: State) -> State:
    """The state nearest to x with `operator` x = value."""
    if operator.ndim == 0:
        return value / operator
    if operator.ndim == 1:
        d = operator if x.ndim == 1 else operator[:, None]
        # 0 is a row that is not seen, and stays; the inner `where` keeps the slope finite.
        return jnp.where(d == 0, x, value / jnp.where(d == 0, 1, d))
    # x + L⁺ (v − L x): L⁺ r is the shortest way that changes L x by r
    inverse = jnp.linalg.pinv(operator)
    for _ in range(2):  # the second time to the last digit
        x = x + inverse @ (value - apply(operator, x))
    return x
