"""Inference: MCMC kernels made for driving noise, and what NumPyro's leave to do."""

from ._arviz import to_arviz as to_arviz
from ._checkpoint import run_checkpointed as run_checkpointed
from ._evidence import (
    TemperedEvidence as TemperedEvidence,
    estimate_model_evidence as estimate_model_evidence,
    estimate_tree_evidence as estimate_tree_evidence,
)
from ._hmc import (
    FunctionSpaceHMC as FunctionSpaceHMC,
    FunctionSpaceHMCState as FunctionSpaceHMCState,
)
from ._integrate_noise import integrate_noise as integrate_noise
from ._log_likelihood import LogLikelihood as LogLikelihood, log_likelihood as log_likelihood
from ._pcn import PCN as PCN, PCNL as PCNL, PCNState as PCNState
from ._posterior import init_to_guided_mean as init_to_guided_mean, noise_sites as noise_sites
from ._pseudo_marginal import (
    CorrelatedPseudoMarginal as CorrelatedPseudoMarginal,
    CorrelatedPseudoMarginalMALA as CorrelatedPseudoMarginalMALA,
    PseudoMarginalState as PseudoMarginalState,
)
from ._statistics import fields as fields
