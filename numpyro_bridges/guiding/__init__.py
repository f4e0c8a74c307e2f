from ._continuous import (
    continuous_terms as continuous_terms,
)
from ._continuous import (
    exact_message as exact_message,
)
from ._continuous import (
    levy_area as levy_area,
)
from ._continuous import (
    travel_continuous as travel_continuous,
)
from ._continuous import (
    weight_rate as weight_rate,
)
from ._edge import arrive as arrive
from ._edge import retrace as retrace
from ._edge import travel as travel
from ._grid import time_grid as time_grid
from ._guides import (
    AbstractGuide as AbstractGuide,
)
from ._guides import (
    AbstractPlan as AbstractPlan,
)
from ._guides import (
    DriftGuide as DriftGuide,
)
from ._guides import (
    FrozenGuide as FrozenGuide,
)
from ._guides import (
    RecedingGuide as RecedingGuide,
)
from ._guides import (
    backward_filter as backward_filter,
)
from ._steering import (
    AbstractSteering as AbstractSteering,
)
from ._steering import (
    DriftSteering as DriftSteering,
)
from ._steering import (
    GaussianSteering as GaussianSteering,
)
from ._step import GridNoise as GridNoise
from ._step import GuidedStep as GuidedStep
from ._step import GuidedTerm as GuidedTerm
