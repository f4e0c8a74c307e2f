"""Type aliases. A state is one shape, `(n, dim)`, or a plain vector `(n,)`; code is for one state,
callers vmap.
"""

from typing import TYPE_CHECKING, TypeAlias

from jaxtyping import Array, Float

State: TypeAlias = Float[Array, "n *dim"]
"""One state, `(n, dim)` or `(n,)`."""

Noise: TypeAlias = Float[Array, "k *dim"]
"""The standard normal noise of one step, one row per driving noise."""

Structured: TypeAlias = Float[Array, "..."]
"""A linear map on the first axis of a state: `()` a multiple of the identity, `(n,)` a diagonal,
`(m, n)` a matrix.
"""

if TYPE_CHECKING:
    RealScalar: TypeAlias = float | int | Array
else:
    RealScalar: TypeAlias = float | int | Float[Array, ""]
"""A time or a parameter: a Python number or a 0-d array."""
