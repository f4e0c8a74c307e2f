from ._base import (
    AbstractCondition as AbstractCondition,
)
from ._base import (
    AbstractMatch as AbstractMatch,
)
from ._base import (
    Observation as Observation,
)
from ._base import (
    Target as Target,
)
from ._cylinder import CylinderSet as CylinderSet
from ._cylinder import IntervalCensored as IntervalCensored
from ._match import ExactMatch as ExactMatch
from ._match import InexactMatch as InexactMatch
from ._message import GaussianMessage as GaussianMessage
from ._message import whitened_log_density as whitened_log_density
from ._normal import log_interval_probability as log_interval_probability
