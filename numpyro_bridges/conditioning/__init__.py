"""What is seen of the end of a process: matches, sets, and their densities."""

from ._base import (
    AbstractCondition as AbstractCondition,
    AbstractMatch as AbstractMatch,
    Observation as Observation,
    Target as Target,
    lift as lift,
)
from ._curves import (
    AbstractCurveMatch as AbstractCurveMatch,
    CurrentMatch as CurrentMatch,
    VarifoldMatch as VarifoldMatch,
)
from ._cylinder import CylinderSet as CylinderSet, IntervalCensored as IntervalCensored
from ._density import (
    AbstractDensityMatch as AbstractDensityMatch,
    DensityMatch as DensityMatch,
)
from ._distance import (
    HuberMatch as HuberMatch,
    ProcrustesMatch as ProcrustesMatch,
    StudentMatch as StudentMatch,
)
from ._fused import fused as fused
from ._match import ExactMatch as ExactMatch, InexactMatch as InexactMatch
from ._message import (
    GaussianMessage as GaussianMessage,
    gaussian_log_density as gaussian_log_density,
    where_possible as where_possible,
    whitened_log_density as whitened_log_density,
)
from ._normal import log_interval_probability as log_interval_probability
