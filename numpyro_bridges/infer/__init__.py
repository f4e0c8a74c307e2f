"""Inference: what NumPyro's samplers leave to do for models with driving noise."""

from ._arviz import HMC_FIELDS as HMC_FIELDS
from ._arviz import to_arviz as to_arviz
