"""What kernels report of their draws, and ArviZ's names of it."""

from typing import Any

import numpy as np
from numpyro.infer import HMC, NUTS, Gibbs
from numpyro.infer.mcmc import MCMCKernel

from .._checks import require_instance
from ._hmc import FunctionSpaceHMC
from ._pcn import AbstractPCN
from ._pseudo_marginal import AbstractPseudoMarginal

_HMC_FIELDS = (
    "potential_energy",
    "energy",
    "accept_prob",
    "num_steps",
    "adapt_state.step_size",
    "diverging",
)

# the first that a kernel is an instance of: NUTS is a subclass of HMC
_FIELDS = {
    HMC: _HMC_FIELDS,
    FunctionSpaceHMC: _HMC_FIELDS,
    AbstractPCN: ("potential_energy", "accept_prob", "diverging"),
    AbstractPseudoMarginal: ("potential_energy", "accept_prob", "step_size", "diverging"),
}

_ARVIZ_NAMES = {
    "potential_energy": "lp",
    "accept_prob": "acceptance_rate",
    "num_steps": "n_steps",
    "adapt_state.step_size": "step_size",
}


def fields(kernel) -> tuple[str, ...]:
    """What a kernel can report of each draw: `mcmc.run(key, data,
    extra_fields=nb.infer.fields(kernel))`.

    **Arguments:** `kernel`: NUTS, HMC, a kernel of this package, or `Gibbs`, which reports what its
    blocks do.

    **Returns:** names of fields of the kernel's state; of any other kernel, those that NumPyro
    collects by default.
    """
    require_instance(kernel, MCMCKernel, "kernel", "a kernel of MCMC, such as `NUTS(model)`")
    return tuple(path + name for block, path, _ in _blocks(kernel) for name in _fields_of(block))


def statistics(fields: dict[str, Any], kernel) -> dict[str, Any]:
    """Arrays under ArviZ's names; those of a block of `Gibbs` with its prefix."""
    # what is no array, such as thinned noise by site, is no statistic
    found = {name: value for name, value in fields.items() if hasattr(value, "shape")}
    for block, path, prefix in _blocks(kernel):
        # a list, since the dictionary shrinks
        chosen = [name for name in list(found) if name.startswith(path)]
        own = {name.removeprefix(path): found.pop(name) for name in chosen}
        own = {_ARVIZ_NAMES.get(name, name): value for name, value in own.items()}
        if "lp" in own:
            own["lp"] = -own["lp"]  # a potential is minus the log density
        if "n_steps" in own and isinstance(block, NUTS):
            # a tree of depth d has 2^d − 1 steps, or fewer where it was cut off
            own["tree_depth"] = np.log2(np.asarray(own["n_steps"])).astype(int) + 1
        found |= {prefix + name: value for name, value in own.items()}
    diverging = [np.asarray(value) for name, value in found.items() if name.endswith("_diverging")]
    if diverging and "diverging" not in found:
        found["diverging"] = np.any(diverging, axis=0)
    return found


def _fields_of(kernel) -> tuple[str, ...]:
    known = [names for kind, names in _FIELDS.items() if isinstance(kernel, kind)]
    default = tuple(name for name in kernel.default_fields if name != kernel.sample_field)
    return known[0] if known else default


def _blocks(kernel, path="", prefix="") -> list[tuple[Any, str, str]]:
    """The kernels that make a draw, with the path of its state and the prefix of its names."""
    if not isinstance(kernel, Gibbs):
        return [(kernel, path, prefix)]
    kernels = [block for block, _ in kernel.blocks]
    names = [type(block).__name__.lower() for block in kernels]
    # two blocks of one kind are told apart by their numbers
    names = [f"{name}{i}" if names.count(name) > 1 else name for i, name in enumerate(names)]
    leaves = []
    for i, (block, name) in enumerate(zip(kernels, names, strict=True)):
        # a block may be a `Gibbs` itself
        leaves += _blocks(block, f"{path}block_states.{i}.", f"{prefix}{name}_")
    return leaves
