"""A user's own SDE, from functions with diffrax's signature."""

import inspect
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx

from .._checks import require
from .._linalg import compose, transpose
from .._types import RealScalar, State, Structured
from ..spaces import AbstractSpace
from ._base import AbstractSDE, depends_on


class _Static(eqx.Module):
    """A function without parameters, which jit may hash."""

    function: Callable = eqx.field(static=True)

    def __call__(self, t, x, args):
        return self.function(t, x, args)


def _wrapped(f: Callable) -> Any:
    """A module keeps its leaves; a plain function becomes static."""
    return f if isinstance(f, eqx.Module) else _Static(f)


class SDE(AbstractSDE):
    """dX = drift(t, X, args) dt + diffusion(t, X, args) dW, stepped by Euler–Maruyama.

    **Arguments:**

    - `drift`: `f(t, x, args)`, shaped like x.
    - `diffusion`: `f(t, x, args)`: a scalar, a diagonal `(n,)`, a matrix `(n, k)` or a lineax operator. It acts on the
      first axis of the state; k may be smaller (hypo-elliptic) or larger than n.
    - `args`: the parameters, a pytree of arrays. Anything a prior is put on belongs here, or is a leaf of an
      `equinox.Module` passed as `drift` or `diffusion`.
    - `space`: where states live, for the H-norm of conditions; Euclidean if not given.
    """

    drift_function: Callable
    diffusion_function: Callable
    args: Any
    space: AbstractSpace | None

    def __init__(self, drift: Callable, diffusion: Callable, args: Any = None, *, space: AbstractSpace | None = None):
        for name, f in (("drift", drift), ("diffusion", diffusion)):
            if not callable(f):
                raise ValueError(
                    f"`{name}` must be a function f(t, x, args); got {f!r}. Wrap it: `lambda t, x, args: ...`."
                )
            require(
                _takes_three(f),
                f"`{name}` must be a function f(t, x, args) of three arguments; got {f!r}. Add those it does without.",
            )
        self.drift_function, self.diffusion_function = _wrapped(drift), _wrapped(diffusion)
        self.args = jax.tree.map(lambda leaf: _parameter(leaf), args)
        self.space = space

    def drift(self, t: RealScalar, x: State) -> State:
        return jnp.asarray(self.drift_function(t, x, self.args), x.dtype)

    def noise(self, t: RealScalar, x: State) -> tuple[Structured, Structured]:
        sigma = self.diffusion_function(t, x, self.args)
        if isinstance(sigma, lx.AbstractLinearOperator):
            sigma = lx.diagonal(sigma) if lx.is_diagonal(sigma) else sigma.as_matrix()
        sigma = jnp.asarray(sigma, x.dtype)
        require(
            sigma.ndim <= 2,
            f"`diffusion` must return a scalar, a diagonal (n,) or a matrix (n, k); got shape {sigma.shape}.",
        )
        return sigma, compose(sigma, transpose(sigma))

    def has_constant_covariance(self, x: State) -> bool:
        return not depends_on(lambda y: self.noise(0.0, y)[0], x)


def _parameter(leaf: Any) -> jax.Array:
    """A leaf of `args` as an array, its type kept."""
    try:
        return jnp.asarray(leaf)
    except TypeError as e:
        raise ValueError(
            f"`args` must hold numbers and arrays, the parameters; got {leaf!r}. Let the function itself hold the rest."
        ) from e


def _takes_three(f: Callable) -> bool:
    try:
        inspect.signature(f).bind(None, None, None)
    except TypeError:
        return False
    except ValueError:  # it does not tell
        pass
    return True
