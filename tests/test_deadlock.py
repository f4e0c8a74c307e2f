"""Batched LAPACK calls that run at once must not wait for one another for ever.

jaxlib 0.10 does, on machines with few cores: this program hangs there.
"""

import os
import subprocess
import sys

PROGRAM = """
import jax
import jax.numpy as jnp

@jax.jit
def two_factorisations(a, b):
    return jnp.linalg.cholesky(a).sum() + jnp.linalg.cholesky(b).sum()

x = jax.random.normal(jax.random.key(0), (2, 300, 32, 32))
a, b = x @ x.mT + 32 * jnp.eye(32)
for _ in range(20):
    two_factorisations(a, b).block_until_ready()
"""


def test_two_batched_factorisations_at_once():
    threads = {"OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "XLA_FLAGS"}  # as in a user's process
    environment = {name: value for name, value in os.environ.items() if name not in threads}
    try:
        subprocess.run([sys.executable, "-c", PROGRAM], env=environment, timeout=90, check=True)
    except subprocess.TimeoutExpired as error:
        raise AssertionError(
            "jaxlib deadlocks in batched LAPACK calls: choose another version"
        ) from error
