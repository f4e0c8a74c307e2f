"""Derivatives, at ordinary and at special values of the parameters."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

from numpyro_bridges._linalg import safe_sqrt
from numpyro_bridges.sdes._linear import _phi1

pytestmark = pytest.mark.usefixtures("compile_quickly")


def slope(f):
    """f′, elementwise."""
    return lambda x: jax.jvp(f, (x,), (jnp.ones_like(x),))[1]


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("order", range(4))
def test_phi_of_every_order(order, dtype):
    """φ₁⁽ʲ⁾(x) = ∫₀¹ sʲ e^{sx} ds by quadrature, through 0 and through the seam at 1."""
    x = np.array([-30.0, -3.0, -1.001, -1.0, -0.999, -0.1, -1e-6, -1e-20, 0, 1e-9, 1e-3, 0.5, 0.999, 1.0, 1.001, 9.0])
    f = _phi1
    for _ in range(order):
        f = slope(f)
    found = jax.jit(f)(jnp.asarray(x, dtype))
    truth = [scipy.integrate.quad(lambda s, y=y: s**order * np.exp(s * y), 0, 1, epsabs=0, epsrel=1e-13)[0] for y in x]
    np.testing.assert_allclose(found, truth, rtol=1000 * np.finfo(dtype).eps)


def test_a_root_at_zero():
    """Its derivative there is that of |y|, the mean of both sides; below 0 it is NaN, as it should be."""
    assert jax.grad(safe_sqrt)(0.0) == 0 and jax.jvp(safe_sqrt, (0.0,), (1.0,)) == (0, 0)
    assert jax.grad(lambda y: safe_sqrt(y * y))(0.0) == 0
    np.testing.assert_allclose(jax.grad(safe_sqrt)(2.0), 0.5 / np.sqrt(2), rtol=1e-15)
    assert np.isnan(safe_sqrt(jnp.asarray(-1.0)))
