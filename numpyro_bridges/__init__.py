"""Conditioned stochastic differential equations on function spaces as NumPyro likelihoods."""

from . import (
    datasets as datasets,
    infer as infer,
    io as io,
    plot as plot,
    scores as scores,
    shapes as shapes,
    weights as weights,
)
from ._compare import Comparison as Comparison, compare as compare
from ._devices import spread as spread
from .bridges import GuidedBridge as GuidedBridge
from .conditioning import (
    AbstractCondition as AbstractCondition,
    AbstractDensityMatch as AbstractDensityMatch,
    AbstractMatch as AbstractMatch,
    CurrentMatch as CurrentMatch,
    CylinderSet as CylinderSet,
    DensityMatch as DensityMatch,
    ExactMatch as ExactMatch,
    HuberMatch as HuberMatch,
    InexactMatch as InexactMatch,
    IntervalCensored as IntervalCensored,
    ProcrustesMatch as ProcrustesMatch,
    StudentMatch as StudentMatch,
    VarifoldMatch as VarifoldMatch,
)
from .distributions import (
    DiffusionEndpoint as DiffusionEndpoint,
    DiffusionTree as DiffusionTree,
    NoiseReparam as NoiseReparam,
    sample as sample,
)
from .evidence import EvidenceEstimate as EvidenceEstimate, estimate_evidence as estimate_evidence
from .guiding import (
    AbstractGuide as AbstractGuide,
    DriftGuide as DriftGuide,
    FrozenGuide as FrozenGuide,
    GeodesicGuide as GeodesicGuide,
    GuidedStep as GuidedStep,
    RecedingGuide as RecedingGuide,
    ScoreGuide as ScoreGuide,
    Unguided as Unguided,
)
from .infer import (
    TemperedEvidence as TemperedEvidence,
    estimate_model_evidence as estimate_model_evidence,
    estimate_tree_evidence as estimate_tree_evidence,
    log_likelihood as log_likelihood,
    to_arviz as to_arviz,
)
from .kernels import (
    AbstractKernel as AbstractKernel,
    GaussianKernel as GaussianKernel,
    MaternKernel as MaternKernel,
)
from .sdes import (
    SDE as SDE,
    AbstractSDE as AbstractSDE,
    BrownianMotion as BrownianMotion,
    ControlNoise as ControlNoise,
    GridNoise as GridNoise,
    KunitaFlow as KunitaFlow,
    LandmarkNoise as LandmarkNoise,
    LinearSDE as LinearSDE,
    SemilinearSDE as SemilinearSDE,
    SpectralNoise as SpectralNoise,
    simulate as simulate,
)
from .spaces import (
    AbstractBasis as AbstractBasis,
    AbstractSpace as AbstractSpace,
    CosineBasis as CosineBasis,
    FourierBasis as FourierBasis,
    FourierSquare as FourierSquare,
    Landmarks as Landmarks,
    SineBasis as SineBasis,
)
from .trees import Tree as Tree
