"""Batches over devices: particles, specimens, chains and edges are spread, never the state of one.

Every device runs a program of its own on its share, and waits for no other: its loops end when they
end.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, PartitionSpec

from ._checks import positive_integer, require, require_instance, words


def spread(
    fn: Callable,
    mesh: Mesh | None = None,
    *,
    axis: str | None = None,
    batch_size: int | None = None,
) -> Callable:
    """`fn` of one item, for a batch of them, in equal shares on several devices.

        weights = jax.jit(nb.spread(bridge.log_weight, mesh))(noises)

    It is `jax.vmap(fn)`, which is what each device does with its share; a share of one is not
    batched at all. Of keys there is one for each item, so that what is drawn does not depend on the
    number of devices. Inside `jax.jit`.

    **Arguments:**

    - `fn`: of arrays, or pytrees of them. What it reads besides its arguments is on every device.
    - `mesh`: a `jax.sharding.Mesh` of one axis, of this process or of several. By default, as many
      of the devices of this process as give equal shares; one, where `jax_default_device` says
      which.
    - `axis`: of a mesh of several axes, the one to spread along. The others repeat the work.
    - `batch_size`: how many items a device runs at once; all of its share by default.

    **Returns:** a function of arguments with the batch in front, of which the results stay where
    they are computed.

    **Errors:** `ValueError` where the devices do not divide the batch.
    """
    require(callable(fn), f"`fn` must be a function; got {words(fn)}.")
    require_mesh(mesh, axis)
    batch_size = None if batch_size is None else positive_integer(batch_size, "batch_size")

    def spread_fn(*args):
        size = len(jax.tree.leaves(args)[0])
        devices = mesh_for(size, "the batch", mesh, axis)
        name = None if devices is None else axis or devices.axis_names[0]
        share = size if devices is None else size // devices.shape[name]

        def of_share(*args):
            if devices is not None and share == 1:
                # as it is: under `jax.vmap` a branch would be taken both ways
                one = fn(*jax.tree.map(lambda x: x[0], args))
                return jax.tree.map(lambda x: jnp.expand_dims(x, 0), one)
            if batch_size is not None and batch_size < share:
                return jax.lax.map(lambda args: fn(*args), args, batch_size=batch_size)
            return jax.vmap(fn)(*args)

        if devices is None:
            return of_share(*args)
        along = PartitionSpec(name)
        # unchecked: the first carry of a loop is often a constant, which does not vary over devices
        # as the next does
        mapped = jax.shard_map(
            of_share, mesh=devices, in_specs=along, out_specs=along, check_vma=False
        )
        return mapped(*args)

    return spread_fn


def mesh_for(
    size: int, name: str, mesh: Mesh | None = None, axis: str | None = None
) -> Mesh | None:
    """The mesh for a batch of `size` items, which an error calls `name`; None on one device."""
    require_mesh(mesh, axis)
    if mesh is None:
        # A user who has said which device gets that one. Else those of this process only, as many
        # as divide the batch: what runs on those of several has to be called in each process.
        chosen = getattr(jax.config, "jax_default_device", None)
        local = jax.local_devices() if chosen is None else []
        number = max((n for n in range(1, len(local) + 1) if size % n == 0), default=1)
        return None if number == 1 else Mesh(np.array(local[:number]), "devices")
    number = mesh.shape[axis or mesh.axis_names[0]]
    require(
        size % number == 0,
        f"{name} must be a multiple of the {number} devices of `mesh`; got {size}. Make it one, "
        "or give a smaller mesh.",
    )
    # whatever the types of its axes: what comes out of a mesh of explicit ones asks for a sharding
    # at each step
    return Mesh(mesh.devices, mesh.axis_names)


def gather(tree: Any) -> Any:
    """The same arrays, those that lie on several devices whole on one device of every process."""

    def whole(x):
        if not isinstance(x, jax.Array) or len(x.sharding.device_set) == 1:
            return x
        # Through NumPy, which makes an array on one device of what lies on several.
        here = x.is_fully_addressable or x.is_fully_replicated
        return jnp.asarray(
            np.asarray(x if here else multihost_utils.process_allgather(x, tiled=True))
        )

    return jax.tree.map(whole, tree)


def is_writer(mesh: Mesh | None) -> bool:
    """Whether this process, the first of several, writes the files of a run on a mesh."""
    return mesh is None or not mesh.is_multi_process or jax.process_index() == 0


def wait_for_all(mesh: Mesh | None, what: str) -> None:
    """Until all processes of a mesh are here."""
    if mesh is not None and mesh.is_multi_process:
        multihost_utils.sync_global_devices(what)


def require_mesh(mesh: Any, axis: Any = None) -> None:
    """A mesh of one axis, or one of whose axes is named, or none."""
    if mesh is None:
        require(
            axis is None, f"`axis` must be one of `mesh`, and there is none; got {words(axis)}."
        )
        return
    require_instance(
        mesh, Mesh, "mesh", 'a `jax.sharding.Mesh`, such as `jax.make_mesh((8,), ("devices",))`'
    )
    names = mesh.axis_names
    require(
        axis is not None or len(names) == 1,
        f"`mesh` must have one axis; got {len(names)}, {names}. Make it "
        '`jax.sharding.Mesh(mesh.devices.ravel(), "devices")`.',
    )
    require(
        axis is None or axis in names,
        f"`axis` must be one of `mesh`, {names}; got {words(axis)}.",
    )
