"""Drawings of shapes, bridges, trees, scores and posteriors with matplotlib.

Every function draws on the axes it is given, or makes its own, and returns what it drew. Shapes are
(n, 2). The colours can be told apart by colour-blind readers (after Okabe & Ito); time runs from
dark to light.
"""

from ._deformation import deformation as deformation
from ._posterior import posterior as posterior
from ._scores import score_frames as score_frames
from ._shapes import (
    bridge_fan as bridge_fan,
    outlines as outlines,
    path as path,
    score_field as score_field,
)
from ._training import training as training
from ._tree import tree as tree
