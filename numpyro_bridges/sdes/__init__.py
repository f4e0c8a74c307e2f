from ._base import AbstractSDE as AbstractSDE
from ._base import AffineStep as AffineStep
from ._base import Transition as Transition
from ._base import simulate as simulate
from ._kunita import KunitaFlow as KunitaFlow
from ._linear import BrownianMotion as BrownianMotion
from ._linear import LinearSDE as LinearSDE
from ._noise import (
    AbstractNoise as AbstractNoise,
)
from ._noise import (
    GridNoise as GridNoise,
)
from ._noise import (
    LandmarkNoise as LandmarkNoise,
)
from ._noise import (
    SpectralNoise as SpectralNoise,
)
from ._sde import SDE as SDE
