"""Spaces of curves and of fields: a state is an array (size, dim), or (size,) for values in R."""

from ._base import AbstractSpace as AbstractSpace
from ._basis import (
    AbstractBasis as AbstractBasis,
    CosineBasis as CosineBasis,
    FourierBasis as FourierBasis,
    FourierSquare as FourierSquare,
    SineBasis as SineBasis,
)
from ._landmarks import Landmarks as Landmarks
