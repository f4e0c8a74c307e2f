"""Batches on several devices, and in several processes: the same numbers as on one.

What the table runs is run here, on one device, and by this file as a script on 8 devices, and in
two processes of two devices each. The referee is the run on one device, whose own referees are in
the tests of what is run.
"""

import os
import socket
import subprocess
import sys
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from jax.sharding import Mesh
from numpyro.infer import HMC, MCMC

import numpyro_bridges as nb
from numpyro_bridges import _checks
from numpyro_bridges._devices import gather
from numpyro_bridges.infer import FunctionSpaceHMC, _checkpoint, run_checkpointed
from numpyro_bridges.scores import _training

pytestmark = [pytest.mark.usefixtures("compile_quickly"), pytest.mark.numpyro]

if __name__ == "__main__" and len(sys.argv) > 2:
    # after the package is imported, and before anything is computed
    jax.distributed.initialize(f"localhost:{sys.argv[3]}", 2, int(sys.argv[2]))

X0, DATUM = np.array([0.2]), np.array([0.9])
OU = nb.LinearSDE(-1.0, 0.5)
MATCH = nb.InexactMatch(0.01)
BRIDGE = nb.GuidedBridge(OU, MATCH.at(DATUM), x0=X0, t1=1.0, num_steps=2, guide=nb.Unguided())


def model(datum):
    mean = numpyro.sample("mean", dist.Normal(0.0, 2.0))
    law = nb.DiffusionEndpoint(nb.LinearSDE(-1.0, 0.6, mean), X0, MATCH, t1=1.0, num_steps=1)
    nb.sample("wing", law, obs=datum)


def evidence(mesh, folder):
    found = nb.estimate_evidence(BRIDGE, jr.key(0), 48, batch_size=2, mesh=mesh)
    return found.log_weights, found.log_evidence, found.standard_error, found.ess


def comparison(mesh, folder):
    found = nb.compare({"a": BRIDGE}, jr.key(1), num_particles=48, batch_size=2, mesh=mesh)
    return [found.rows["a"][name] for name in ("log_evidence", "standard_error", "ess")]


def tempered(mesh, folder):
    law = nb.DiffusionEndpoint(OU, X0, MATCH, t1=1.0, num_steps=1, guide=nb.Unguided())
    sizes = {"num_particles": 8, "num_islands": 2, "num_moves": 1, "batch_size": 8}
    found = nb.estimate_tree_evidence(law, DATUM, jr.key(2), progress=False, mesh=mesh, **sizes)
    return found.log_estimates, found.inverse_temperatures, found.accept_prob


SIZES = {"num_warmup": 3, "num_samples": 3, "num_chains": 8, "progress_bar": False}


def vectorised(mesh, folder):
    """By default on all devices of a process."""
    mcmc = MCMC(FunctionSpaceHMC(model), chain_method="vectorized", **SIZES)
    mcmc.run(jr.key(3), DATUM)
    samples = mcmc.get_samples(group_by_chain=True)["mean"]
    assert len(samples.sharding.device_set) == jax.device_count()
    return gather(samples), gather(mcmc.last_state.z["mean"])


def hmc():
    return HMC(model, trajectory_length=None, num_steps=2)


def checkpointed(mesh, folder):
    def run(name, method="sequential", mesh=mesh, **settings):
        mcmc = MCMC(hmc(), chain_method=method, **SIZES | settings)
        run_checkpointed(mcmc, folder / name, jr.key(4), DATUM, interval=2, mesh=mesh)
        return mcmc.get_samples(group_by_chain=True)["mean"]

    found = run("whole")
    if mesh is not None and not mesh.is_multi_process:
        # a chain on each device is NumPyro's way; cut off, it goes on bit for bit
        run("cut", "parallel", None, num_samples=1)
        np.testing.assert_array_equal(run("cut", "parallel", None), found)
    return [found]


def trained(mesh, folder):
    """A few updates, saved and gone on with; their paths and the held-out ones."""
    sde = nb.SDE(lambda t, x, a: jnp.sin(3 * x), lambda t, x, a: 0.5, None)
    network = nb.scores.MLP((1, 1), key=jr.key(5), width=8, depth=1)
    with warnings.catch_warnings():
        # so few updates may bring nothing, which is no matter here
        warnings.filterwarnings("ignore", ".*brought nothing", UserWarning)
        found = nb.scores.fit(
            sde,
            MATCH.at(DATUM),
            x0=X0,
            t1=1.0,
            num_steps=2,
            key=jr.key(6),
            guide=nb.Unguided(),
            network=network,
            training=nb.scores.Training(8, 8, interval=4, held_out=32, learning_rate=0.05),
            directory=folder,
            progress=False,
            mesh=mesh,
        )
    return [found.history[name] for name in ("bound", "ess", "gain", "gain_error")]


RUNS = {
    "evidence": evidence,
    "comparison": comparison,
    "tempered": tempered,
    "vectorised": vectorised,
    "checkpointed": checkpointed,
    "trained": trained,
}


IN_TWO_PROCESSES = ["evidence", "checkpointed", "trained"]  # and, by tests/test_docs.py, others


def results(mesh, folder, names=RUNS) -> dict:
    found = {name: RUNS[name](mesh, folder) for name in names}
    return {name: np.concatenate([np.ravel(x) for x in values]) for name, values in found.items()}


def started(folder, num_devices, *arguments):
    count = f"--xla_force_host_platform_device_count={num_devices}"
    settings = {
        "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {count}",
        "JAX_ENABLE_X64": "1",
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
        "PYTHONPATH": str(Path(nb.__file__).parents[1]),
    }
    return subprocess.Popen(
        [sys.executable, __file__, str(folder), *map(str, arguments)],
        env=os.environ | settings,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def ended(process, file) -> dict:
    """What it has found."""
    printed = process.communicate(timeout=300)[0]
    assert process.returncode == 0, printed[-3000:]
    with np.load(file) as found:
        return dict(found)


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """On one device, and on 8."""
    one, eight = (tmp_path_factory.mktemp(name) for name in ("one", "eight"))
    process = started(eight, 8)
    return results(None, one), ended(process, eight / "found_0.npz")


@pytest.mark.parametrize("name", RUNS)
def test_eight_devices_are_one(name, found):
    one, eight = (results[name] for results in found)
    assert np.std(one) > 0.1
    np.testing.assert_allclose(eight, one, rtol=1e-12, atol=1e-12)


def test_two_processes_are_one(found, tmp_path):
    """Each of them knows all; files are written by the first, and read by both."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    processes = [started(tmp_path, 2, rank, port) for rank in range(2)]
    for rank, process in enumerate(processes):
        two = ended(process, tmp_path / f"found_{rank}.npz")
        assert set(two) == set(IN_TWO_PROCESSES)
        for name in two:
            np.testing.assert_allclose(two[name], found[0][name], rtol=1e-12, atol=1e-12)


ONE = jax.devices()[:1]
EIGHT = Mesh(np.array(ONE * 8), "devices")  # for what is refused before anything runs
GRID = Mesh(np.array(ONE * 4).reshape(2, 2), ("rows", "columns"))


def several(num_chains, **settings):
    sizes = {"num_warmup": 1, "num_samples": 1, "progress_bar": False}
    return MCMC(num_chains=num_chains, **sizes, **settings)


REFUSED = {
    "shares": (
        lambda: nb.spread(jnp.sin, EIGHT)(np.ones(12)),
        "the batch must be a multiple of the 8 devices of `mesh`; got 12. Make it one, or give",
    ),
    "axes": (
        lambda: nb.spread(jnp.sin, GRID),
        r"`mesh` must have one axis; got 2, \('rows', 'columns'\). Make it "
        r"`jax.sharding.Mesh\(mesh.dev",
    ),
    "axis": (
        lambda: nb.spread(jnp.sin, GRID, axis="devices"),
        r"`axis` must be one of `mesh`, \('rows', 'columns'\); got 'devices'",
    ),
    "no mesh": (
        lambda: nb.spread(jnp.sin, axis="rows"),
        "`axis` must be one of `mesh`, and there is none; got 'rows'",
    ),
    "list": (
        lambda: nb.spread(jnp.sin, ONE),
        r"`mesh` must be a `jax.sharding.Mesh`, such as `jax.make_mesh\(\(8,\), .*; got \[",
    ),
    "evidence": (
        lambda: nb.estimate_evidence(BRIDGE, jr.key(0), 12, mesh=EIGHT),
        "`num_particles` must be a multiple of the 8 devices of `mesh`; got 12",
    ),
    "comparison": (
        lambda: nb.compare({"a": BRIDGE}, jr.key(0), num_particles=12, mesh=EIGHT),
        "`num_particles` must be a multiple of the 8 devices of `mesh`; got 12",
    ),
    "tempered": (
        lambda: nb.estimate_model_evidence(
            model, jr.key(0), DATUM, num_particles=8, num_islands=4, method="bridge", mesh=EIGHT
        ),
        "`num_islands` must be a multiple of the 8 devices of `mesh`; got 4",
    ),
    "kernel": (lambda: FunctionSpaceHMC(model, mesh=GRID), "`mesh` must have one axis"),
    "chains": (
        lambda: several(6, sampler=KERNEL, chain_method="vectorized").run(jr.key(0), DATUM),
        "`num_chains` must be a multiple of the 8 devices of `mesh`; got 6",
    ),
    "one chain": (
        lambda: several(8, sampler=KERNEL, chain_method="sequential").run(jr.key(0), DATUM),
        "`mesh` is for chains that run at once, and this is one: `MCMC",
    ),
    "checkpointed": (
        lambda: run_checkpointed(several(6, sampler=hmc()), "unused", jr.key(0), mesh=EIGHT),
        "`num_chains` of `mcmc` must be a multiple of the 8 devices of `mesh`; got 6",
    ),
    "one checkpointed": (
        lambda: run_checkpointed(several(1, sampler=hmc()), "unused", jr.key(0), mesh=EIGHT),
        "`mesh` is for several chains, and `mcmc` has 1",
    ),
    "trained": (
        lambda: nb.scores.fit(
            OU,
            MATCH.at(DATUM),
            x0=X0,
            t1=1.0,
            key=jr.key(0),
            training=nb.scores.Training(batch_size=12),
            mesh=EIGHT,
        ),
        "`batch_size` of `training` must be a multiple of the 8 devices of `mesh`; got 12",
    ),
}
KERNEL = FunctionSpaceHMC(model, mesh=EIGHT)


@pytest.mark.filterwarnings("ignore:There are not enough devices to run parallel chains")
@pytest.mark.parametrize("name", REFUSED)
def test_refused(name):
    call, message = REFUSED[name]
    with pytest.raises(ValueError, match=message):
        call()


def check_spread():
    """Against NumPy: values, and on which of 8 devices they are."""
    devices = jax.devices()
    mesh = Mesh(np.array(devices), "i")
    x = np.arange(24.0).reshape(24, 1)
    shift = jnp.ones(1)

    def fn(x, key):
        return {"moved": 2 * x["x"] + shift, "key": jr.fold_in(key, 1), "none": None}

    def check(found, number):
        assert len(found["moved"].sharding.device_set) == number
        np.testing.assert_array_equal(found["moved"], 2 * x[: len(found["moved"])] + 1)

    def run(size, *args, **settings):
        batch = {"x": x[:size]}, jr.split(jr.key(0), 24)[:size]
        return jax.jit(nb.spread(fn, *args, **settings))(*batch)

    keys = jr.key_data(run(24, Mesh(np.array(devices[:1]), "i"))["key"])
    for settings in ({}, {"batch_size": 2}, {"batch_size": 3}, {"axis": "i"}):
        found = run(24, mesh, **settings)
        check(found, 8)
        np.testing.assert_array_equal(jr.key_data(found["key"]), keys)
    check(run(8, mesh), 8)  # one each
    # by default, as many as have equal shares; 11 are prime
    for size, number in ((24, 8), (12, 6), (4, 4), (1, 1), (11, 1)):
        check(run(size), number)
    with jax.default_device(devices[3]):
        found = run(24)
        assert found["moved"].sharding.device_set == {devices[3]}
    # along one axis of two, and a mesh of explicit types, of whose results no sharding is asked
    grid = Mesh(np.array(devices).reshape(4, 2), ("rows", "columns"))
    check(run(6, grid, axis="columns"), 8)
    explicit = jax.make_mesh((8,), ("i",), axis_types=(jax.sharding.AxisType.Explicit,))
    found = run(24, explicit)
    np.testing.assert_array_equal(jnp.sort(found["moved"][::3], axis=0), 2 * x[::3] + 1)

    def loop(x):
        """As long as x says, from a constant."""
        return jax.lax.fori_loop(0, x, lambda i, sum: sum + x, 0)

    numbers = np.arange(16)
    np.testing.assert_array_equal(jax.jit(nb.spread(loop, mesh))(numbers), numbers**2)


def check_parts(mesh):
    """Of values of which other processes hold parts nothing is asked but what all of them can do."""
    x = jax.jit(nb.spread(lambda x: -x, mesh))(np.ones(4))
    assert _checks.concrete(x) is None and _checks.known(x, "x") is None
    match = nb.InexactMatch(x)  # which is refused where it is known to be negative
    np.testing.assert_array_equal(gather(match.variance), -np.ones(4))
    with pytest.raises(ValueError, match="`x` must be known before .* each process holds all"):
        _checks.known_float(x, "x")


def main(folder):
    rank, names, count = jax.process_index(), IN_TWO_PROCESSES, 4
    mesh = Mesh(np.array(jax.devices()), "devices")
    if jax.process_count() == 1:
        check_spread()
        names, count = RUNS, 8
    else:
        check_parts(mesh)
    if rank == 1:
        _checkpoint._write = _training._save = None  # writing is an error
    assert mesh.size == count
    np.savez(Path(folder) / f"found_{rank}.npz", **results(mesh, Path(folder), names))


if __name__ == "__main__":
    main(sys.argv[1])
