"""The training loop: whole chunks of updates on the device, an average of the iterates, the best of
which is kept.
"""

import hashlib
import json
import time
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import optax
from jax.sharding import Mesh
from jaxtyping import Array, PRNGKeyArray
from tqdm.auto import tqdm

from .._checks import flag, known_number, positive_integer, require, words
from .._devices import gather, is_writer, wait_for_all
from .._files import write_whole


class Training(eqx.Module):
    """How a network is trained.

    **Arguments:**

    - `num_updates`: at most. `batch_size`: paths, or particles of a cloud, per update; of
      `"matching"` a quarter of the paths of a cloud and a sixteenth of the points of an update.
    - `optimizer`: of optax; by default Adam with a warm-up of 50 updates and a cosine decay from
      `learning_rate`, the gradient's norm clipped to 1.
    - `average`: decay of the exponential average of the iterates, which is what is judged and
      returned; 0 is none. At update i it is (1 + i)/(10 + i) if that is less, so that the start is
      soon forgotten.
    - `interval`: updates between looks at the held-out paths. `held_out`: their number.
    - `patience`: looks without a better bound after which training stops; `None` does not stop and
      keeps the last network in place of the best.
    - `one_step`: the targets of score matching are those of one step, with all their noise, as was
      usual.

    `Training.published()` is the schedule of Baker et al. (2024).
    """

    num_updates: int = eqx.field(static=True)
    batch_size: int = eqx.field(static=True)
    optimizer: optax.GradientTransformation = eqx.field(static=True)
    average: float = eqx.field(static=True)
    interval: int = eqx.field(static=True)
    held_out: int = eqx.field(static=True)
    patience: int | None = eqx.field(static=True)
    one_step: bool = eqx.field(static=True)

    def __init__(
        self,
        num_updates: int = 2000,
        batch_size: int = 64,
        *,
        learning_rate: float = 2e-3,
        optimizer: optax.GradientTransformation | None = None,
        average: float = 0.99,
        interval: int = 100,
        held_out: int = 256,
        patience: int | None = 5,
        one_step: bool = False,
    ):
        self.num_updates = positive_integer(num_updates, "num_updates")
        self.batch_size = positive_integer(batch_size, "batch_size")
        self.interval = min(positive_integer(interval, "interval"), self.num_updates)
        self.held_out = positive_integer(held_out, "held_out")
        average = known_number(average, "average", "in [0, 1)", lambda value: 0 <= value < 1)
        learning_rate = _rate(learning_rate)
        if optimizer is None:
            warm = min(50, self.num_updates // 4)
            schedule = optax.warmup_cosine_decay_schedule(
                0.0, learning_rate, warm, self.num_updates, 0.01 * learning_rate
            )
            optimizer = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(schedule))
        good = isinstance(optimizer, optax.GradientTransformation)
        require(
            good,
            "`optimizer` must be one of optax, such as `optax.adam(1e-3)`; got "
            f"{words(optimizer)}.",
        )
        self.optimizer = optimizer
        self.average = average
        self.patience = None if patience is None else positive_integer(patience, "patience")
        self.one_step = flag(one_step, "one_step")

    @classmethod
    def published(cls, num_epochs: int = 100, learning_rate: float = 1e-4) -> "Training":
        """Epochs of 40 batches of 50 paths; 500 updates of warm-up, Adam; one-step targets.

        The rate falls to a hundredth of `learning_rate`, which is 1e-4 as published.
        """
        total = 40 * positive_integer(num_epochs, "num_epochs")
        learning_rate = _rate(learning_rate)
        schedule = optax.warmup_cosine_decay_schedule(
            0.0, learning_rate, min(500, total // 2), total, 0.01 * learning_rate
        )
        settings = {"average": 0.0, "interval": 40, "patience": None, "one_step": True}
        return cls(
            total, 50, learning_rate=learning_rate, optimizer=optax.adam(schedule), **settings
        )


def _rate(value: Any) -> float:
    return known_number(value, "learning_rate", "positive", lambda rate: rate > 0)


class _State(eqx.Module):
    """All that training needs to go on: saved as it is."""

    network: Any
    average: Any
    optimizer: Any
    best: Any
    best_value: Array
    best_ess: Array
    waited: Array
    update: Array
    history: dict[str, Array]


Loss = Callable[..., tuple[Array, Any]]
_PREPARED = 25  # updates, for which what is prepared serves
Judge = Callable[[Any], tuple[Array, ...]]


def train(
    network: Any,
    loss: Loss,
    judge: Judge,
    key: PRNGKeyArray,
    training: Training,
    *,
    name: str = "training",
    file: Path | None = None,
    problem: Any = None,
    progress: bool = True,
    watch: Callable[[Any, dict[str, Array]], None] | None = None,
    mesh: Mesh | None = None,
    prepare: Callable[[Any, PRNGKeyArray], Any] | None = None,
) -> tuple[Any, dict[str, Array]]:
    """The best network, and the history.

    `loss(network, key)` gives the loss of a batch and the network with its own state renewed; with
    `prepare` it is `loss(network, key, prepared)`, where `prepare(network, key)` is called after
    each look and 25 updates, with the average. `judge(network)`, compiled, gives a value to be
    maximised, the bound and the ESS fraction on held-out paths, and what else it likes. A network
    of a better value is kept unless its ESS is less than half of that of the one kept before: the
    bound E log w is little moved by large weights, and may rise where the ESS falls. Update i uses
    `fold_in(key, i)`: the same key gives the same network, however often training is resumed from
    `file`, which is refused where it was written for another `problem` (a pytree of arrays),
    another key or other settings. `watch(network, history)` is called at each look with the network
    that was looked at. Seconds are of the updates, compilation apart. The file is written by the
    first process of `mesh`, over which the loss spreads its paths.
    """
    optimizer = training.optimizer
    decay = training.average
    looks = -(-training.num_updates // training.interval) + 1
    columns = ("update", "loss", "bound", "ess", "seconds", "kept")
    empty = {column: jnp.full(looks, jnp.nan) for column in columns}
    arrays, static = eqx.partition(network, eqx.is_inexact_array)
    state = _State(
        arrays,
        arrays,
        optimizer.init(arrays),
        arrays,
        jnp.array(-jnp.inf),
        jnp.array(jnp.nan),
        jnp.zeros((), int),
        jnp.zeros((), int),
        empty,
    )

    @eqx.filter_jit
    def advance(state: _State) -> tuple[_State, Array]:
        first = state.update
        last = jnp.minimum(state.update + training.interval, training.num_updates)

        def update(prepared, i, carry):
            arrays, average, memory, losses = carry

            def value(arrays):
                loss_value, renewed = loss(
                    eqx.combine(arrays, static), jr.fold_in(key, i), *prepared
                )
                return loss_value, eqx.filter(renewed, eqx.is_inexact_array)

            (batch_loss, renewed), gradient = jax.value_and_grad(value, has_aux=True)(arrays)
            with jax.numpy_dtype_promotion("standard"):  # optax needs it
                steps, memory = optimizer.update(gradient, memory, renewed)
                arrays = optax.apply_updates(renewed, steps)
            kept = jnp.minimum(decay, (1 + i) / (10 + i))
            average = jax.tree.map(
                lambda a, b: (kept * a + (1 - kept) * b).astype(a.dtype), average, arrays
            )
            return arrays, average, memory, losses.at[i - first].set(batch_loss)

        def block(carry):
            i, (arrays, average, memory, losses) = carry
            prepared = ()
            stop = last
            if prepare is not None:
                key_prepare = jr.fold_in(key, training.num_updates + i)  # no update has this number
                prepared = (prepare(eqx.combine(average, static), key_prepare),)
                stop = jnp.minimum(i + _PREPARED, last)
            carry = arrays, average, memory, losses
            return stop, jax.lax.fori_loop(i, stop, partial(update, prepared), carry)

        start = state.network, state.average, state.optimizer, jnp.zeros(training.interval)
        _, (arrays, average, memory, losses) = jax.lax.while_loop(
            lambda carry: carry[0] < last, block, (first, start)
        )
        new = (arrays, average, memory, last)
        where = lambda s: (s.network, s.average, s.optimizer, s.update)  # noqa: E731
        return eqx.tree_at(where, state, new), losses

    def look(state: _State, loss_value, seconds) -> _State:
        judged = judge(eqx.combine(state.average, static))
        return _looked(state, judged, loss_value, seconds, training)

    def show(state: _State) -> None:
        if watch is not None:
            watch(eqx.combine(state.average, static), _rows(state))

    label = _label(name, problem, arrays, key, training)
    if file is not None and file.exists():
        state = _load(file, state, label)
    else:
        state = look(state, jnp.nan, 0.0)
    wait_for_all(mesh, f"{name} begins")
    compiled = advance.lower(state).compile()
    show(state)
    spent = float(np.nanmax(np.asarray(state.history["seconds"])))
    with tqdm(
        total=training.num_updates, initial=int(state.update), desc=name, disable=not progress
    ) as bar:
        while int(state.update) < training.num_updates and not _stopped(state, training):
            begin = time.perf_counter()
            new, losses = gather(jax.block_until_ready(compiled(state)))
            if not bool(jnp.all(jnp.isfinite(losses))):
                first = int(state.update) + int(jnp.argmax(~jnp.isfinite(losses)))
                warnings.warn(
                    f"{name} stopped: the loss was not finite at update {first}. The network is "
                    "the best of those before; a smaller `learning_rate` or more time steps may "
                    "help.",
                    stacklevel=3,
                )
                break
            spent += time.perf_counter() - begin
            done = int(new.update) - int(state.update)
            state = look(new, jnp.sum(losses) / done, spent)
            if file is not None and is_writer(mesh):
                _save(file, state, label)
            row = {k: float(np.asarray(v)[-1]) for k, v in _rows(state).items()}
            ess = "" if np.isnan(row["ess"]) else f", ESS {100 * row['ess']:.1f} %"
            bar.set_postfix_str(f"loss {row['loss']:.4g}, bound {row['bound']:.4g}{ess}")
            bar.update(done)
            show(state)
    return eqx.combine(state.best, static), _rows(state)


def _looked(state: _State, judged, loss_value, seconds, training: Training) -> _State:
    """The state with the average kept if it is better than what was kept, and a row of history."""
    value, bound, ess, *_ = judged
    higher = bool(value > state.best_value)
    better = higher and not bool(ess < state.best_ess / 2)
    # without patience the last network is wanted, if it is one
    better = better or (training.patience is None and bool(value > -jnp.inf))
    i = -(-int(state.update) // training.interval)
    # NumPy: each length would be another program
    history = {k: np.array(v) for k, v in state.history.items()}
    history["update"][i] = float(state.update)
    history["loss"][i] = loss_value
    history["bound"][i] = bound
    history["ess"][i] = ess
    history["seconds"][i] = seconds
    history["kept"][i] = better
    return eqx.tree_at(
        lambda s: (s.best, s.best_value, s.best_ess, s.waited, s.history),
        state,
        (
            state.average if better else state.best,
            jnp.where(better, value, state.best_value),
            jnp.where(better, ess, state.best_ess),
            jnp.zeros((), int) if higher else state.waited + 1,
            {k: jnp.asarray(v) for k, v in history.items()},
        ),
    )


def _rows(state: _State) -> dict[str, Array]:
    """The history of the looks that were made."""
    made = np.isfinite(np.asarray(state.history["update"]))
    return {k: jnp.asarray(np.asarray(v)[made]) for k, v in state.history.items()}


def _stopped(state: _State, training: Training) -> bool:
    return training.patience is not None and int(state.waited) >= training.patience


def _label(
    name: str, problem: Any, network: Any, key: PRNGKeyArray, training: Training
) -> dict[str, Any]:
    """What a saved training belongs to. An optimizer is known by the shape of its state only."""
    settings = {k: v for k, v in vars(training).items() if k != "optimizer"}
    label = {
        "method": name,
        "problem": _digest(problem),
        "network": _digest(network),
        "key": _digest(key),
    }
    return label | {f"training.{k}": v for k, v in settings.items()}


def _digest(tree: Any) -> str:
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(tree):
        if eqx.is_array_like(leaf):
            is_key = isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
            value = np.asarray(jr.key_data(leaf) if is_key else leaf)
            digest.update(f"{value.dtype}{value.shape}".encode() + value.tobytes())
    return digest.hexdigest()


def _save(file: Path, state: _State, label: dict[str, Any]) -> None:
    """A line that says whose it is, and the leaves."""

    def write(f):
        f.write(json.dumps(label).encode() + b"\n")
        eqx.tree_serialise_leaves(f, state)

    file.parent.mkdir(parents=True, exist_ok=True)
    write_whole(file, write)


def _load(file: Path, state: _State, label: dict[str, Any]) -> _State:
    with open(file, "rb") as f:
        try:
            saved = json.loads(f.readline())
        except ValueError:
            saved = {}
        other = [k for k in label if saved.get(k) != label[k]]
        require(
            not other,
            f"`directory` holds the training of something else: {file} differs in "
            f"{', '.join(other)}. Repeat the call that began it, or give another directory.",
        )
        return eqx.tree_deserialise_leaves(f, state)
