from ._base import (
    AbstractSDE as AbstractSDE,
    AffineStep as AffineStep,
    Transition as Transition,
    divergence as divergence,
    simulate as simulate,
)
from ._kunita import KunitaFlow as KunitaFlow
from ._linear import BrownianMotion as BrownianMotion, LinearSDE as LinearSDE
from ._noise import (
    AbstractNoise as AbstractNoise,
    GridNoise as GridNoise,
    LandmarkNoise as LandmarkNoise,
    SpectralNoise as SpectralNoise,
)
from ._sde import SDE as SDE
