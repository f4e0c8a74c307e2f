"""Batches on several devices, and in several processes: the same numbers as on one.

The runs of the table are done here, on one device, and by this file as a script on 8 devices. The
referee is the run on one device, whose own referees are in the tests of what is run.
"""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from jax.sharding import Mesh

import numpyro_bridges as nb
from numpyro_bridges._devices import gather

pytestmark = [pytest.mark.usefixtures("compile_quickly"), pytest.mark.numpyro]

X0, DATUM = np.array([0.2]), np.array([0.9])
OU = nb.LinearSDE(-1.0, 0.5)
MATCH = nb.InexactMatch(0.01)
BRIDGE = nb.GuidedBridge(OU, MATCH.at(DATUM), x0=X0, t1=1.0, num_steps=2, guide=nb.Unguided())


def evidence(mesh):
    found = nb.estimate_evidence(BRIDGE, jr.key(0), 48, batch_size=2, mesh=mesh)
    return found.log_weights, found.log_evidence, found.standard_error, found.ess


def comparison(mesh):
    bridges = {"unguided": BRIDGE, "guided": BRIDGE.with_guide(nb.FrozenGuide())}
    rows = nb.compare(bridges, jr.key(1), num_particles=16, mesh=mesh).rows.values()
    return [row[name] for row in rows for name in ("log_evidence", "ess")]


def tempered(mesh):
    """A pilot run of particles, and chains."""
    law = nb.DiffusionEndpoint(OU, X0, MATCH, t1=1.0, num_steps=1)
    sizes = {"num_particles": 8, "num_islands": 8, "num_moves": 2, "batch_size": 8}
    found = nb.estimate_tree_evidence(
        law, DATUM, jr.key(2), method="bridge", progress=False, mesh=mesh, **sizes
    )
    return found.log_estimates, found.inverse_temperatures, found.accept_prob


RUNS = {
    "evidence": evidence,
    "comparison": comparison,
    "tempered": tempered,
}


def results(mesh) -> dict:
    return {name: np.concatenate([np.ravel(x) for x in run(mesh)]) for name, run in RUNS.items()}


def started(file, num_devices, *arguments):
    settings = {
        "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={num_devices}",
        "JAX_ENABLE_X64": "1",
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
        "PYTHONPATH": str(Path(nb.__file__).parents[1]),
    }
    return subprocess.Popen(
        [sys.executable, __file__, str(file), *arguments],
        env=os.environ | settings,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """On one device, and on 8."""
    file = tmp_path_factory.mktemp("devices") / "found.npz"
    process = started(file, 8)
    one = results(None)
    printed = process.communicate(timeout=300)[0]
    assert process.returncode == 0, printed[-3000:]
    with np.load(file) as eight:
        return one, dict(eight)


@pytest.mark.parametrize("name", RUNS)
def test_eight_devices_are_one(name, found):
    one, eight = found[0][name], found[1][name]
    assert np.std(one) > 0.1
    np.testing.assert_allclose(eight, one, rtol=1e-12, atol=1e-12)


def main(file):
    mesh = Mesh(np.array(jax.devices()), "devices")
    assert mesh.size == 8
    np.savez(file, **results(mesh))


if __name__ == "__main__":
    main(*sys.argv[1:])
