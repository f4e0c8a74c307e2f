"""Bridges inside `jax.shard_map` as it is by default, which wants loops typed by what varies over
devices.
"""

import os
import subprocess
import sys
from pathlib import Path

PROGRAM = """
import jax, jax.numpy as jnp, jax.random as jr, numpy as np
import numpyro_bridges as nb
from jax.sharding import Mesh, PartitionSpec as P

mesh = Mesh(np.array(jax.devices()), "i")
assert mesh.size == 2
x0, B = np.array([0.2, -0.1]), jnp.array([[-1.0, 0.3], [0.0, -0.5]])
own = nb.SDE(lambda t, x, a: -a * x, lambda t, x, a: a * (1 + 0.1 * x**2), 0.6)
row = jnp.array([[1.0, 1.0]])
cases = [
    (nb.LinearSDE(B, 0.5), lambda y: nb.InexactMatch(0.1, row).at(y[:1])),
    (own, lambda y: nb.ExactMatch().at(y)),
    (nb.BrownianMotion(jnp.eye(2)), lambda y: nb.CylinderSet(y - 1, y + 1)),
]
ys = jnp.array([[0.3, 0.4], [0.5, -0.2]])
for sde, condition in cases:
    def log_weight(y, z):
        return nb.GuidedBridge(sde, condition(y), x0=x0, t1=1.0, num_steps=3).log_weight(z)

    shape = nb.GuidedBridge(sde, condition(ys[0]), x0=x0, t1=1.0, num_steps=3).noise_shape
    z = jr.normal(jr.key(0), (2, *shape))
    f = jax.value_and_grad(log_weight) if sde is own else lambda *args: (log_weight(*args),)
    spread = jax.shard_map(jax.vmap(f), mesh=mesh, in_specs=P("i"), out_specs=P("i"))
    for found, truth in zip(jax.jit(spread)(ys, z), jax.jit(jax.vmap(f))(ys, z)):
        np.testing.assert_allclose(found, truth, rtol=1e-10)
"""


def test_values_and_gradients_are_those_of_one_device():
    settings = {
        "XLA_FLAGS": os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=2",
        "JAX_ENABLE_X64": "1",
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
        "PYTHONPATH": str(Path(__file__).parents[1]),
    }
    run = subprocess.run(
        [sys.executable, "-c", PROGRAM], env=os.environ | settings, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr[-2000:]
