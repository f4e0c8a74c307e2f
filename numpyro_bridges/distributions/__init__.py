"""Diffusions as distributions of what is observed, and the sites of a NumPyro model."""

from ._driving_noise import DrivingNoise as DrivingNoise, NoiseBlocks as NoiseBlocks
from ._endpoint import DiffusionEndpoint as DiffusionEndpoint
from ._noise_driven import AbstractNoiseDriven as AbstractNoiseDriven
from ._sample import NoiseReparam as NoiseReparam, sample as sample
from ._tree import DiffusionTree as DiffusionTree
