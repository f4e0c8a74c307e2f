"""A user's own SDE, from functions with diffrax's signature."""

import inspect
from collections.abc import Callable
from contextlib import contextmanager
from copy import copy
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array

from .._checks import floating, require
from .._closed import Closed, close
from .._linalg import compose, transpose
from .._types import RealScalar, State, Structured
from ..spaces import AbstractSpace
from ._base import AbstractSDE, depends_on, require_space


class _Static(eqx.Module):
    """A function without parameters, which jit may hash."""

    function: Callable = eqx.field(static=True)

    def __call__(self, t, x, args):
        return self.function(t, x, args)


def wrapped(f: Callable) -> Any:
    """A function as part of a module: a pytree keeps its leaves, a plain function is static."""
    return _Static(f) if jax.tree_util.all_leaves((f,)) else f


@contextmanager
def _no_escape(name: str):
    """Says in words what JAX finds: a captured value of a traced program that has ended."""
    try:
        yield
    except jax.errors.UnexpectedTracerError as e:
        raise ValueError(
            f"`{name}` captured a value of a traced program that has ended: `jax.vmap`, `jax.jit` "
            "or `jax.grad` made this SDE from a function that closes over a parameter. Put the "
            "parameter into `args`, which f(t, x, args) is given, or make it a leaf of an "
            "`equinox.Module` that is the function."
        ) from e


class _Coefficient(eqx.Module):
    """Calls a user's function, or its own where that is a plain one; in the state's precision."""

    name: str = eqx.field(static=True)
    own: _Static | None
    """A function without leaves; one with leaves is an argument, so that they are traced."""

    def __call__(self, function: Callable | None, t: RealScalar, x: State, args: Any) -> Array:
        function = self.own if function is None else function
        assert function is not None
        with _no_escape(self.name):
            value = function(t, x, args)
        if isinstance(value, lx.AbstractLinearOperator):
            # A diagonal one keeps its structure, by which all that follows is elementwise.
            value = lx.diagonal(value) if lx.is_diagonal(value) else value.as_matrix()
        return jnp.asarray(floating(value, f"{self.name}(t, x, args)"), x.dtype)


class AbstractFunctionSDE(AbstractSDE):
    """An SDE of two functions f(t, x, args) of a user: `diffusion`, and one that pulls."""

    diffusion_function: Any
    args: Any
    space: AbstractSpace | None
    programs: tuple[Closed, Closed] | None
    pull: eqx.AbstractClassVar[str]
    """Name of the one that pulls; the field is called so, with `_function` behind."""

    def __init__(self, pull: Callable, diffusion: Any, args: Any, space: AbstractSpace | None):
        for name, f in ((self.pull, pull), ("diffusion", diffusion)):
            if not callable(f):
                raise ValueError(
                    f"`{name}` must be a function f(t, x, args); got {f!r}. Wrap it: `lambda t, x, "
                    "args: ...`."
                )
            require(
                _takes_three(f),
                f"`{name}` must be a function f(t, x, args) of three arguments; got {f!r}. Add "
                "those it does without.",
            )
        # The field has the name of the user's argument, which a subclass chooses.
        setattr(self, f"{self.pull}_function", wrapped(pull))
        self.diffusion_function = wrapped(diffusion)
        self.args = jax.tree.map(lambda leaf: _parameter(leaf), args)
        require_space(space)
        self.space = space
        self.programs = None

    def closed(self, t: RealScalar, x: State) -> Self:
        if self.programs is not None:
            return self  # as another bridge has closed it
        # A copy whose fields are set: a module is frozen, and to construct it anew would check and
        # wrap the functions again.
        closed = copy(self)
        programs = []
        for name in (self.pull, "diffusion"):
            field = f"{name}_function"
            function = getattr(self, field)
            # A plain function is in the program, and is kept no longer: what `jit` compares is the
            # program. A module is kept for its leaves, the parameters.
            own = function if isinstance(function, _Static) else None
            kept = None if own is function else function
            with _no_escape(name):
                programs.append(close(_Coefficient(name, own), kept, t, x, self.args))
            object.__setattr__(closed, field, kept)
        object.__setattr__(closed, "programs", tuple(programs))
        return closed

    def pulled(self, t: RealScalar, x: State) -> State:
        """The coefficient that pulls, at (t, x)."""
        coefficient = _Coefficient(self.pull, None) if self.programs is None else self.programs[0]
        return coefficient(getattr(self, f"{self.pull}_function"), t, x, self.args)

    def noise(self, t: RealScalar, x: State) -> tuple[Structured, Structured]:
        diffusion = _Coefficient("diffusion", None) if self.programs is None else self.programs[1]
        sigma = diffusion(self.diffusion_function, t, x, self.args)
        require(
            sigma.ndim <= 2,
            "`diffusion` must return a scalar, a diagonal (n,) or a matrix (n, k); got shape "
            f"{sigma.shape}.",
        )
        return sigma, compose(sigma, transpose(sigma))

    def has_constant_covariance(self, x: State) -> bool:
        # Of σ only: `noise` makes a from it.
        return not depends_on(lambda t, y: self.noise(t, y)[0], x, 1)


class SDE(AbstractFunctionSDE):
    """dX = drift(t, X, args) dt + diffusion(t, X, args) dW, stepped by Euler–Maruyama.

    **Arguments:**

    - `drift`: `f(t, x, args)`, shaped like x, for t in [t0, t1].
    - `diffusion`: `f(t, x, args)`: a scalar, a diagonal `(n,)`, a matrix `(n, k)` or a lineax
      operator. It acts on the first axis of the state; k may be smaller (hypo-elliptic) or larger
      than n.
    - `args`: the parameters, a pytree of arrays. Anything a prior is put on belongs here, or is a
      leaf of an `equinox.Module` passed as `drift` or `diffusion`.
    - `space`: where states live, for the H-norm of conditions; Euclidean if not given.

    Bridges and laws hold what the functions are at the moment when they are made: attributes,
    globals and closures that the functions read are frozen then, and captured arrays, traced ones
    too, are differentiated through.
    """

    drift_function: Any
    pull: ClassVar[str] = "drift"

    def __init__(
        self,
        drift: Callable,
        diffusion: Callable,
        args: Any = None,
        *,
        space: AbstractSpace | None = None,
    ):
        super().__init__(drift, diffusion, args, space)

    def drift(self, t: RealScalar, x: State) -> State:
        return self.pulled(t, x)


def _parameter(leaf: Any) -> jax.Array:
    """A leaf of `args` as an array, its type kept."""
    try:
        return jnp.asarray(leaf)
    except TypeError as e:
        raise ValueError(
            f"`args` must hold numbers and arrays, the parameters; got {leaf!r}. Let the function "
            "itself hold the rest."
        ) from e


def _takes_three(f: Callable) -> bool:
    try:
        inspect.signature(f).bind(None, None, None)
    except TypeError:
        return False
    except ValueError:  # it does not tell, as functions written in C
        pass
    return True
