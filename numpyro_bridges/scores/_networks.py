"""Networks `network(t, x, v, theta)`: `ScoreGuide` says what they are given. Ours start at zero,
`UNet` does not.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from .._checks import known_number, positive_integer, require, require_instance, require_key, words

State2 = Float[Array, "n dim"]


def time_features(t: Float[Array, ""], num: int) -> Float[Array, " 2*num"]:
    """cos and sin of t at `num` frequencies from 1/2 to 8 turns, whatever the state's scale."""
    angles = 2 * jnp.pi * t * jnp.asarray(np.geomspace(0.5, 8.0, num), t.dtype)
    return jnp.concatenate([jnp.cos(angles), jnp.sin(angles)])


class MLP(eqx.Module):
    """A fully connected network on all coordinates; for states of a fixed size.

    **Arguments:** `shape`: of the state, (n, dim). `context`: size of theta. `width`, `depth`: of
    the hidden layers.
    """

    layers: eqx.nn.MLP
    num_times: int = eqx.field(static=True)

    def __init__(
        self,
        shape: tuple[int, int],
        context: int = 0,
        *,
        key: PRNGKeyArray,
        width: int = 64,
        depth: int = 3,
    ):
        require_key(key)
        self.num_times = 4
        size = _size(shape)
        context = positive_integer(context, "context", least=0)
        width = positive_integer(width, "width")
        depth = positive_integer(depth, "depth", least=0)
        layers = eqx.nn.MLP(3 * size + context + 8 + 3, size, width, depth, jax.nn.silu, key=key)
        self.layers = eqx.tree_at(lambda m: m.layers[-1], layers, replace_fn=_zero)

    def __call__(self, t, x: State2, v: State2, theta: Float[Array, " c"]) -> State2:
        left = jnp.maximum(1 - t, 0)
        near = jnp.arcsinh(x.ravel() / jnp.sqrt(left + 1e-3))
        times = jnp.stack([t, jnp.sqrt(left), jnp.log(left + 1e-3) / 3])
        features = [x.ravel(), near, v.ravel(), theta, times, time_features(t, self.num_times)]
        output = self.layers(jnp.concatenate(features).astype(x.dtype)).reshape(x.shape)
        return output / jnp.sqrt(left + 0.01).astype(x.dtype)


class PointNetwork(eqx.Module):
    """A network on a set of points, for any number of them: trained at 32 points, it can be used at
    128.

    Point i has features h_i; a layer adds to it an MLP of h_i and of averages over the other
    points,

        (1/n) Σ_j exp(−|v_i − v_j|²/2 l²) V h_j,      a few learned widths l,

    so that it commutes with relabelling, does not see translations, and has a limit as points fill
    a curve.

    **Arguments:** `dim`: of the points. `context`: size of theta. `width`: of the features.
    `depth`: layers. `heads`: widths l.
    """

    inner: eqx.nn.Linear
    values: list[eqx.nn.Linear]
    updates: list[eqx.nn.MLP]
    log_widths: Float[Array, " heads"]
    outer: eqx.nn.Linear

    def __init__(
        self,
        dim: int,
        context: int = 0,
        *,
        key: PRNGKeyArray,
        width: int = 16,
        depth: int = 2,
        heads: int = 2,
    ):
        require_key(key)
        dim = positive_integer(dim, "dim")
        context = positive_integer(context, "context", least=0)
        width = positive_integer(width, "width")
        heads = positive_integer(heads, "heads")
        depth = positive_integer(depth, "depth", least=0)
        key_in, key_out, *keys = jr.split(key, 2 + 2 * depth)
        self.inner = eqx.nn.Linear(2 * dim + context + 10, width, key=key_in)
        self.values = [eqx.nn.Linear(width, width, key=k) for k in keys[:depth]]
        self.updates = [
            eqx.nn.MLP((1 + heads) * width, width, width, 1, jax.nn.silu, key=k)
            for k in keys[depth:]
        ]
        self.log_widths = jnp.linspace(jnp.log(0.15), jnp.log(3.0), heads)
        self.outer = _zero(eqx.nn.Linear(width, dim, key=key_out))

    def __call__(self, t, x: State2, v: State2, theta: Float[Array, " c"]) -> State2:
        n = x.shape[0]
        square = jnp.sum((v[:, None] - v[None]) ** 2, -1)
        near = (
            jnp.exp(
                -0.5 * square[None] * jnp.exp(-2 * self.log_widths.astype(x.dtype))[:, None, None]
            )
            / n
        )
        time = jnp.concatenate(
            [jnp.stack([t, jnp.sqrt(jnp.maximum(1 - t, 0))]), time_features(t, 4), theta]
        )
        shared = jnp.broadcast_to(time.astype(x.dtype), (n, time.shape[0]))
        h = jax.vmap(self.inner)(jnp.concatenate([x, v, shared], axis=1))
        for value, update in zip(self.values, self.updates, strict=True):
            means = jnp.einsum("hij,jw->ihw", near, jax.vmap(value)(h)).reshape(n, -1)
            h = h + jax.vmap(update)(jnp.concatenate([h, means], axis=1))
        return jax.vmap(self.outer)(h)


class Singular(eqx.Module):
    """Another network, preconditioned for a score that is singular near the end; for
    `guide=Unguided()`.

    With l = √(1 − t + softness) the output is (network(t, x/l, v, θ) + g(t) x/l) / l, g a learned
    function of the time. Near an observed end ∇log h is −a⁻¹(x − v)/(1 − t) up to smaller terms,
    and x − v is of size √(1 − t): what is learned is then of size 1 at all times.

    **Arguments:** `network`: as for `ScoreGuide`. `softness`: the part of the duration, before the
    end, in which l stops shrinking: where the grid's last steps are short, or the observation's
    noise is known.
    """

    network: Any
    gain: eqx.nn.MLP
    softness: float = eqx.field(static=True)

    def __init__(self, network: Any, *, key: PRNGKeyArray, softness: float = 0.0):
        require_key(key)
        require(
            callable(network),
            f"`network` must be a function (t, x, v, theta); got {words(network)}.",
        )
        softness = known_number(
            softness, "softness", "a number from 0 on", lambda value: value >= 0
        )
        gain = eqx.nn.MLP(10, "scalar", 16, 1, jax.nn.silu, key=key)
        self.gain = eqx.tree_at(lambda m: m.layers[-1], gain, replace_fn=_zero)
        self.network = network
        self.softness = softness

    def __call__(self, t, x: State2, v: State2, theta: Float[Array, " c"]) -> State2:
        length = jnp.sqrt(jnp.maximum(1 - t, 0) + self.softness)
        y = x / length
        time = jnp.concatenate(
            [jnp.stack([t, jnp.sqrt(jnp.maximum(1 - t, 0))]), time_features(t, 4)]
        )
        return (self.network(t, y, v, theta) + self.gain(time.astype(x.dtype)) * y) / length


class UNet(eqx.Module):
    """The fully connected U-net of Baker et al. (2024), appendix: time enters every level, batch
    normalisation.

    Levels of two dense layers, down and up with skip connections, SiLU; the time embedding scales
    and shifts the first layer of a level, which is residual. Build it with `UNet.build(...)`, which
    returns it `WithState`: batch normalisation keeps running means.

    **Arguments:** `shape`: of the state. `widths`: of the levels on the way down, `(8N, 4N, 2N, N)`
    in the paper. `embedding`: size of the time embedding, and of the first layer.
    """

    inner: eqx.nn.Linear
    down: list["_Level"]
    middle: eqx.nn.Linear
    up: list["_Level"]
    outer: eqx.nn.Linear
    embedding: int = eqx.field(static=True)

    def __init__(
        self, shape: tuple[int, int], widths: Sequence[int], embedding: int, *, key: PRNGKeyArray
    ):
        size, widths, embedding = _checked(shape, widths, embedding, key)
        key_in, key_middle, key_out, *keys = jr.split(key, 3 + 2 * len(widths))
        self.embedding = embedding
        self.inner = _xavier(size, embedding, key_in)
        ins = [embedding, *widths[:-1]]
        self.down = [
            _Level(a, b, embedding, key=k)
            for a, b, k in zip(ins, widths, keys[: len(widths)], strict=True)
        ]
        self.middle = _xavier(widths[-1], widths[-1], key_middle)
        back = widths[::-1]
        ins = [back[0], *back[:-1]]
        self.up = [
            _Level(a + b, b, embedding, key=k)
            for a, b, k in zip(ins, back, keys[len(widths) :], strict=True)
        ]
        self.outer = _xavier(widths[0], size, key_out)

    @classmethod
    def build(cls, shape, widths, embedding, *, key: PRNGKeyArray) -> "WithState":
        """The network with its running means."""

        _checked(shape, widths, embedding, key)

        @eqx.filter_jit  # one program, in place of a small one for each array
        def made(key):
            return WithState(*eqx.nn.make_with_state(cls)(shape, widths, embedding, key=key))

        return made(key)

    @classmethod
    def published(cls, shape, num_bases: int, *, key: PRNGKeyArray) -> "WithState":
        """The network for N basis functions or landmarks, in the plane."""
        N = positive_integer(num_bases, "num_bases")
        return cls.build(shape, (8 * N, 4 * N, 2 * N, N), 4 * N, key=key)

    def __call__(self, t, x, v, theta, state):
        half = self.embedding // 2
        angles = 100.0 * t * jnp.asarray(128.0 ** (-np.arange(half) / half), x.dtype)
        time = jnp.concatenate([jnp.sin(angles), jnp.cos(angles)]).astype(x.dtype)
        h = jax.nn.silu(self.inner(x.ravel()))
        kept = []
        for level in self.down:
            h, state = level(h, time, state)
            kept.append(h)
        h = h + jax.nn.silu(self.middle(h))
        for level in self.up:
            h, state = level(jnp.concatenate([h, kept.pop()]), time, state)
        return self.outer(h).reshape(x.shape), state


class _Level(eqx.Module):
    """Two dense layers and batch normalisation; the first is residual, scaled and shifted by the
    time embedding.
    """

    first: eqx.nn.Linear
    time: eqx.nn.Linear
    second: eqx.nn.Linear
    norm: eqx.nn.BatchNorm

    def __init__(self, size_in: int, size: int, embedding: int, *, key: PRNGKeyArray):
        keys = jr.split(key, 3)
        self.first = _xavier(size_in, size_in, keys[0])
        self.time = _xavier(embedding, 2 * size_in, keys[1])
        self.second = _xavier(size_in, size, keys[2])
        self.norm = eqx.nn.BatchNorm(size, axis_name="batch", mode="batch")

    def __call__(self, x, time, state):
        scale, shift = jnp.split(self.time(time), 2)
        h = x + jax.nn.silu(self.first(x) * (1 + scale) + shift)
        return self.norm(jax.nn.silu(self.second(h)), state)


class WithState(eqx.Module):
    """A network that keeps state between batches, `network(t, x, v, theta, state)`, as
    `eqx.nn.make_with_state` gives.

    Called, it is in inference mode. Its state is renewed by score matching on one problem;
    `"residual"`, and `draw`, leave it as it is.
    """

    network: Any
    state: eqx.nn.State

    def __check_init__(self):
        require(callable(self.network), f"`network` must be a function; got {words(self.network)}.")
        require_instance(self.state, eqx.nn.State, "state", "what `eqx.nn.make_with_state` gives")

    def __call__(self, t, x, v, theta):
        return eqx.nn.inference_mode(self.network)(t, x, v, theta, self.state)[0]


ROWWISE = (0, 0, None, None)
"""Axes of (t, x, v, theta): the rows of a batch share their target and context."""


def over_batch(network, t, x, v, theta, spread: Callable):
    """Outputs of rows of (t, x), and the network with its state renewed, of all rows; `spread(fn,
    size)` maps.
    """
    if isinstance(network, WithState):
        mapped = jax.vmap(network.network, (*ROWWISE, None), (0, None), axis_name="batch")
        outputs, state = mapped(t, x, v, theta, network.state)
        return outputs, WithState(network.network, state)
    return spread(lambda t, x: network(t, x, v, theta), len(t))(t, x), network


def _size(shape: tuple[int, int]) -> int:
    """Of a state, in numbers."""
    require(
        isinstance(shape, Sequence) and not isinstance(shape, str) and 1 <= len(shape) <= 2,
        f"`shape` must be that of a state, (n, dim); got {words(shape)}.",
    )
    return math.prod(positive_integer(number, "shape") for number in shape)


def _checked(shape, widths, embedding, key) -> tuple[int, list[int], int]:
    """What a `UNet` is built from."""
    require_key(key)
    require(
        isinstance(widths, Sequence) and not isinstance(widths, str) and len(widths) > 0,
        f"`widths` must be those of one level or more, such as (64, 32); got {words(widths)}.",
    )
    embedding = positive_integer(embedding, "embedding", least=2)
    require(
        embedding % 2 == 0, f"`embedding` must be even, a cosine for each sine; got {embedding}."
    )
    return _size(shape), [positive_integer(width, "widths") for width in widths], embedding


def _xavier(size_in: int, size: int, key: PRNGKeyArray) -> eqx.nn.Linear:
    """Glorot and Bengio's normal initialisation, biases 0."""
    linear = _zero(eqx.nn.Linear(size_in, size, key=key))
    weight = jnp.sqrt(2.0 / (size_in + size)) * jr.normal(
        key, linear.weight.shape, linear.weight.dtype
    )
    return eqx.tree_at(lambda m: m.weight, linear, weight.astype(linear.weight.dtype))


def _zero(linear: eqx.nn.Linear) -> eqx.nn.Linear:
    return jax.tree.map(jnp.zeros_like, linear)
