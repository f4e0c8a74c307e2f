"""Learned guides: networks that correct a guide, and ways to train them."""

from ..guiding import ScoreGuide as ScoreGuide, Unguided as Unguided
from ._fit import fit as fit, fit_tree as fit_tree
from ._networks import (
    MLP as MLP,
    PointNetwork as PointNetwork,
    Singular as Singular,
    UNet as UNet,
    WithState as WithState,
)
from ._training import Training as Training
