"""Conditioned stochastic differential equations on function spaces as NumPyro likelihoods."""

from . import datasets as datasets
from . import infer as infer
from . import io as io
from . import plot as plot
from .bridges import GuidedBridge as GuidedBridge
from .conditioning import (
    AbstractCondition as AbstractCondition,
)
from .conditioning import (
    AbstractMatch as AbstractMatch,
)
from .conditioning import (
    CylinderSet as CylinderSet,
)
from .conditioning import (
    ExactMatch as ExactMatch,
)
from .conditioning import (
    InexactMatch as InexactMatch,
)
from .conditioning import (
    IntervalCensored as IntervalCensored,
)
from .distributions import (
    DiffusionEndpoint as DiffusionEndpoint,
)
from .distributions import (
    NoiseReparam as NoiseReparam,
)
from .distributions import (
    sample as sample,
)
from .evidence import EvidenceEstimate as EvidenceEstimate
from .evidence import estimate_evidence as estimate_evidence
from .guiding import (
    AbstractGuide as AbstractGuide,
)
from .guiding import (
    DriftGuide as DriftGuide,
)
from .guiding import (
    FrozenGuide as FrozenGuide,
)
from .guiding import (
    GuidedStep as GuidedStep,
)
from .guiding import (
    RecedingGuide as RecedingGuide,
)
from .infer import to_arviz as to_arviz
from .kernels import (
    AbstractKernel as AbstractKernel,
)
from .kernels import (
    GaussianKernel as GaussianKernel,
)
from .kernels import (
    MaternKernel as MaternKernel,
)
from .sdes import (
    SDE as SDE,
)
from .sdes import (
    AbstractSDE as AbstractSDE,
)
from .sdes import (
    BrownianMotion as BrownianMotion,
)
from .sdes import (
    GridNoise as GridNoise,
)
from .sdes import (
    KunitaFlow as KunitaFlow,
)
from .sdes import (
    LandmarkNoise as LandmarkNoise,
)
from .sdes import (
    LinearSDE as LinearSDE,
)
from .sdes import (
    SpectralNoise as SpectralNoise,
)
from .sdes import (
    simulate as simulate,
)
from .spaces import AbstractSpace as AbstractSpace
from .spaces import FourierBasis as FourierBasis
from .spaces import Landmarks as Landmarks
