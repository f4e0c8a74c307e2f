"""Spaces of closed curves, discretised: a state is an array (size, dim)."""

from ._base import AbstractSpace as AbstractSpace
from ._fourier import FourierBasis as FourierBasis
from ._landmarks import Landmarks as Landmarks
