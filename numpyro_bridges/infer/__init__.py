"""Inference: what NumPyro's samplers leave to do for models with driving noise."""

from ._arviz import HMC_FIELDS as HMC_FIELDS, to_arviz as to_arviz
