"""The process that runs backwards.

With time τ = t1 − t the reversed process has the drift −b + div a and the diffusion of the SDE. A
solution h of the backward equation, read in τ, is its density weighted by exp ∫ c,

    c = ½ ∇·div a − ∇·b,

so that h(t, ·) is the law of a weighted cloud that starts at what is observed (Milstein,
Schoenmakers and Spokoiny 2004; Baker, Schauer and Sommer 2025). Guided by ∇log p(t, ·), the density
of the SDE itself, it is the time reversal (Haussmann and Pardoux 1986).
"""

from jaxtyping import Array, Float

from .._types import RealScalar, State
from ..sdes import AbstractSDE, divergence
from ..spaces import AbstractSpace


class ReversedSDE(AbstractSDE):
    """dY = (−b + div a)(clock − τ, Y) dτ + σ(clock − τ, Y) dW, with clock the time at which it
    starts, t1.
    """

    sde: AbstractSDE
    clock: Float[Array, ""]
    space: AbstractSpace | None

    def __init__(self, sde: AbstractSDE, clock: Float[Array, ""]):
        self.sde = sde
        self.clock = clock
        self.space = sde.space

    def drift(self, t: RealScalar, x: State) -> State:
        t = self.clock - t
        return self.sde.covariance_divergence(t, x) - self.sde.drift(t, x)

    def noise(self, t, x):
        return self.sde.noise(self.clock - t, x)

    def has_constant_covariance(self, x):
        return self.sde.has_constant_covariance(x)

    def check_state(self, x):
        self.sde.check_state(x)

    def rate(self, t: RealScalar, x: State) -> Float[Array, ""]:
        """c."""
        t = self.clock - t
        return 0.5 * self.sde.covariance_double_divergence(t, x) - divergence(
            lambda y: self.sde.drift(t, y), x
        )
