"""Stochastic differential equations: their coefficients, noise and steps."""

from ._base import (
    AbstractSDE as AbstractSDE,
    AffineStep as AffineStep,
    Displaced as Displaced,
    Frame as Frame,
    Transition as Transition,
    divergence as divergence,
    still_frame as still_frame,
)
from ._flattened import Flattened as Flattened, for_every_column as for_every_column
from ._grid import TimeGrid as TimeGrid, time_grid as time_grid
from ._kunita import KunitaFlow as KunitaFlow
from ._linear import (
    BrownianMotion as BrownianMotion,
    LinearSDE as LinearSDE,
    as_covariance as as_covariance,
)
from ._noise import (
    AbstractNoise as AbstractNoise,
    ControlNoise as ControlNoise,
    GridNoise as GridNoise,
    LandmarkNoise as LandmarkNoise,
    SpectralNoise as SpectralNoise,
)
from ._sde import SDE as SDE, wrapped as wrapped
from ._semilinear import SemilinearSDE as SemilinearSDE
from ._simulate import law_of_end as law_of_end, simulate as simulate
