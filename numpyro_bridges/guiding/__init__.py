"""Guides: what leads the paths of a bridge to its datum, and the steps that they lead."""

from ._continuous import (
    continuous_terms as continuous_terms,
    exact_message as exact_message,
    levy_area as levy_area,
    travel_continuous as travel_continuous,
    weight_rate as weight_rate,
)
from ._edge import (
    arrive as arrive,
    reach as reach,
    retrace as retrace,
    retrace_reach as retrace_reach,
    travel as travel,
)
from ._few_noises import are_few as are_few
from ._geodesic import GeodesicGuide as GeodesicGuide, default_guide as default_guide
from ._guides import (
    AbstractGuide as AbstractGuide,
    AbstractPlan as AbstractPlan,
    DriftGuide as DriftGuide,
    FrozenGuide as FrozenGuide,
    RecedingGuide as RecedingGuide,
    backward_filter as backward_filter,
)
from ._score import (
    LearnedSteering as LearnedSteering,
    ScoreGuide as ScoreGuide,
    ScorePlan as ScorePlan,
    Standard as Standard,
    Unguided as Unguided,
)
from ._steering import (
    AbstractSteering as AbstractSteering,
    DriftSteering as DriftSteering,
    GaussianSteering as GaussianSteering,
)
from ._step import GridNoise as GridNoise, GuidedStep as GuidedStep, GuidedTerm as GuidedTerm
