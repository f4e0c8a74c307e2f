"""Kernels: docstring formulas retyped in NumPy, closed forms against SciPy quadrature, what is
refused.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import dblquad, quad

from numpyro_bridges.kernels import GaussianKernel, MaternKernel, QuadratureCovariance

# M_p(r) e^r, typed out.
MATERN = {
    0: lambda r: 1 + 0 * r,
    1: lambda r: 1 + r,
    2: lambda r: 1 + r + r**2 / 3,
    3: lambda r: 1 + r + 6 / 15 * r**2 + 1 / 15 * r**3,
    4: lambda r: 1 + r + 45 / 105 * r**2 + 10 / 105 * r**3 + 1 / 105 * r**4,
}
A, L = 0.7, 0.4
KERNELS = {
    "gaussian": (GaussianKernel(A, L), lambda r: A * np.exp(-(r**2) / (2 * L**2))),
    **{f"matern-{p}": (MaternKernel(A, L, p), partial(lambda r, f: A * f(r / L) * np.exp(-r / L), f=f))
       for p, f in MATERN.items() if p in (0, 1, 4)},
    "combination": (
        2.0 * GaussianKernel(A, L) + MaternKernel(0.3, 1.1, order=1) * 0.5,
        lambda r: 2 * A * np.exp(-(r**2) / (2 * L**2)) + 0.15 * (1 + r / 1.1) * np.exp(-r / 1.1),
    ),
}  # fmt: skip
CASES = pytest.mark.parametrize("kernel, formula", KERNELS.values(), ids=KERNELS)


@eqx.filter_jit
def matrix(kernel, x, y):
    return kernel.matrix(x, y)


def points(n, dim, seed=0):
    return np.random.default_rng(seed).normal(size=(n, dim))


def distances(x, y):
    return np.array([[np.sqrt(np.sum((a - b) ** 2)) for b in y] for a in x])


@CASES
@pytest.mark.parametrize("dim", [1, 2])
def test_matrix(kernel, formula, dim):
    x, y = points(6, dim), points(4, dim, seed=1)
    np.testing.assert_allclose(matrix(kernel, x, y), formula(distances(x, y)), rtol=1e-13)
    np.testing.assert_allclose(kernel(x[0], y[1]), formula(distances(x, y))[0, 1], rtol=1e-13)
    np.testing.assert_allclose(kernel.variance, formula(0.0), rtol=1e-14)
    K = np.asarray(matrix(kernel, x, x))
    np.testing.assert_array_equal(K, K.T)
    np.testing.assert_array_equal(np.diag(K), np.full(6, kernel.variance))


@CASES
def test_positive_definite(kernel, formula):
    K = matrix(kernel, x := points(20, 2), x)
    assert np.linalg.eigvalsh(K)[0] > 1e-9


@pytest.mark.parametrize("order", MATERN)
def test_matern_orders(order):
    s = np.array([0.0, 0.01, 1.0, 30.0])
    r = np.sqrt(s)
    np.testing.assert_allclose(
        MaternKernel(A, L, order).profile(s), MATERN[order](r) * np.exp(-r), rtol=1e-14
    )
    assert MaternKernel(A, L).order == 4


def test_a_regularised_root_makes_no_difference():
    # r = √(ρ² + 1e-8), as other implementations write it.
    x = np.concatenate([points(8, 2), points(1, 2)])
    r = np.sqrt(distances(x, x) ** 2 / 0.25**2 + 1e-8)
    np.testing.assert_allclose(
        matrix(MaternKernel(0.1, 0.25), x, x), 0.1 * MATERN[4](r) * np.exp(-r), rtol=2e-8
    )


@CASES
def test_gradient(kernel, formula):
    # Coincident points, against differences; the last two are apart.
    x = jnp.array([[0.1, 0.2], [0.1, 0.2], [0.5, -0.3], [0.9, 0.4]])
    weights = points(4, 4)

    @jax.jit
    def f(x):
        return jnp.sum(weights * kernel.matrix(x, x))

    gradient, h = jax.jit(jax.grad(f))(x), 1e-6
    assert np.all(np.isfinite(gradient))
    for i, j in [(0, 0), (1, 1), (2, 0), (3, 1)]:
        step = h * jnp.zeros_like(x).at[i, j].set(1.0)
        np.testing.assert_allclose(gradient[i, j], (f(x + step) - f(x - step)) / (2 * h), atol=1e-6)
    parameters = jax.jit(jax.grad(lambda k: jnp.sum(k.matrix(x, x))))(kernel)
    assert all(np.isfinite(leaf) for leaf in jax.tree.leaves(parameters))


@pytest.mark.parametrize("order", [1, 4])
def test_curvature_at_coincident_points(order):
    # M_p(r) = 1 - r² / 2(2p - 1) + ...
    kernel, x = MaternKernel(A, L, order), jnp.array([0.3, -0.2])
    hessian = jax.jit(jax.hessian(lambda y: kernel(x, y)))(x)
    np.testing.assert_allclose(hessian, -A / (L**2 * (2 * order - 1)) * np.eye(2), atol=1e-12)


def test_orders_grow_towards_the_gaussian():
    # M_p(r √(2ν)) → exp(-r²/2).
    r, p = 1.3, 60
    np.testing.assert_allclose(
        MaternKernel(1.0, 1 / np.sqrt(2 * p + 1), p)(jnp.array([0.0]), jnp.array([r])),
        np.exp(-(r**2) / 2),
        rtol=1e-2,
    )


# Closed forms.


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_gaussian_convolution(dim):
    covariance = GaussianKernel(A, L).convolved(dim)
    x, y = points(3, dim), points(2, dim, seed=1)
    expected = A**2 * (np.pi * L**2) ** (dim / 2) * np.exp(-(distances(x, y) ** 2) / (4 * L**2))
    assert isinstance(covariance, GaussianKernel)
    np.testing.assert_allclose(matrix(covariance, x, y), expected, rtol=1e-13)


def quadrature_1d(first, second, u):
    f = lambda y: first(abs(y)) * second(abs(u - y))  # noqa: E731
    return quad(f, -8, 8, points=[0.0, u], epsabs=1e-12, limit=200)[0]


@CASES
def test_convolution_on_the_line(kernel, formula, request):
    u = 0.35
    if "combination" in request.node.callspec.id:
        kernel = 2.0 * GaussianKernel(A, L) + GaussianKernel(0.3, 1.1)

        def formula(r):
            return 2 * A * np.exp(-(r**2) / (2 * L**2)) + 0.3 * np.exp(-(r**2) / (2 * 1.1**2))

    value = kernel.convolved(1)(jnp.array([0.1]), jnp.array([0.1 + u]))
    np.testing.assert_allclose(value, quadrature_1d(formula, formula, u), rtol=1e-9)


def test_convolution_in_the_plane():
    first, second = GaussianKernel(A, L), GaussianKernel(0.3, 0.7)

    def f(y2, y1):
        left = np.exp(-(y1**2 + y2**2) / (2 * L**2))
        return (2 * A * left + 0.3 * np.exp(-(y1**2 + y2**2) / (2 * 0.7**2))) * (
            2 * A * np.exp(-((y1 - 0.2) ** 2 + (y2 - 0.5) ** 2) / (2 * L**2))
            + 0.3 * np.exp(-((y1 - 0.2) ** 2 + (y2 - 0.5) ** 2) / (2 * 0.7**2))
        )

    value = (2.0 * first + second).convolved(2)(jnp.zeros(2), jnp.array([0.2, 0.5]))
    np.testing.assert_allclose(value, dblquad(f, -5, 5, -5, 5, epsabs=1e-9)[0], rtol=1e-7)


@pytest.mark.parametrize("order", [1, 4])
def test_matern_convolution_in_space(order):
    # In R³ with both centres on an axis: cylinder coordinates (z, ρ), dy = 2π ρ dρ dz.
    def profile(r):
        return A * MATERN[order](r / L) * np.exp(-r / L)

    u = 0.5
    z, wz = np.polynomial.legendre.leggauss(200)
    z, wz = u / 2 + 10 * z, 10 * wz
    rho, w = np.polynomial.legendre.leggauss(200)
    rho, w = 5 * (rho + 1), 5 * w
    near, far = np.hypot(z[:, None], rho), np.hypot(z[:, None] - u, rho)
    expected = np.sum(wz[:, None] * w * 2 * np.pi * rho * profile(near) * profile(far))
    covariance = MaternKernel(A, L, order).convolved(3)
    assert covariance.order == 2 * order + 2
    np.testing.assert_allclose(
        covariance(jnp.zeros(3), jnp.array([0.0, 0.0, u])), expected, rtol=1e-6
    )


@CASES
def test_spectral_density_on_the_line(kernel, formula):
    for omega in (0.0, 0.9, 4.0):
        transform = (
            2 * quad(formula, 0, np.inf, weight="cos", wvar=omega)[0]
            if omega
            else 2 * quad(formula, 0, 40)[0]
        )
        np.testing.assert_allclose(
            kernel.spectral_density(jnp.array([omega]), 1), transform, rtol=1e-6
        )


@CASES
@pytest.mark.parametrize("dim", [2, 3])
def test_spectral_density_gives_the_kernel_back(kernel, formula, dim):
    # k(u) = (2π)^-dim ∫ q̂ cos(ω·u) dω at u = 0, in polar coordinates; heavy tails need a
    # substitution.
    area = {2: 2 * np.pi, 3: 4 * np.pi}[dim]
    t, w = np.polynomial.legendre.leggauss(200)
    t, w = np.pi / 4 * (t + 1), np.pi / 4 * w
    omega = np.tan(t)
    q = kernel.spectral_density(np.stack([omega] + [0 * omega] * (dim - 1), axis=1), dim)
    total = np.sum(w * q * area * omega ** (dim - 1) / np.cos(t) ** 2) / (2 * np.pi) ** dim
    np.testing.assert_allclose(total, formula(0.0), rtol=1e-6)


@pytest.mark.parametrize("kernel, dim", [(GaussianKernel(A, L), 2), (MaternKernel(A, L, 2), 3)])
def test_the_density_of_a_convolution_is_the_square(kernel, dim):
    omega = points(5, dim)
    np.testing.assert_allclose(
        kernel.convolved(dim).spectral_density(omega, dim),
        kernel.spectral_density(omega, dim) ** 2,
        rtol=1e-12,
    )


def test_quadrature_covariance():
    x = 0.5 * points(4, 2)
    box = QuadratureCovariance(GaussianKernel(A, L), [-4.0, -4.0], [4.0, 4.0], 32)
    exact = GaussianKernel(A, L).convolved(2)
    np.testing.assert_allclose(K := matrix(box, x, x), matrix(exact, x, x), rtol=1e-9)
    np.testing.assert_allclose(box.variance, exact.variance, rtol=1e-9)
    np.testing.assert_allclose(K, K.T, rtol=1e-14)
    uneven = QuadratureCovariance(
        MaternKernel(A, L), np.array([-5.0, -4]), np.array([5.0, 4]), (50, 40)
    )
    assert uneven.centres.shape == (2000, 2)
    np.testing.assert_allclose(uneven.centres[0], [-4.9, -3.9])
    np.testing.assert_allclose(uneven.cell_volume, 0.04)
    # On the line the Matérn convolution is closed.
    line = QuadratureCovariance(MaternKernel(A, L), [-12.0], [12.0], 400)
    u = np.array([[0.0], [0.7]])
    np.testing.assert_allclose(
        matrix(line, u, u), matrix(MaternKernel(A, L).convolved(1), u, u), rtol=1e-8
    )


# Parameters, precision, transformations.


@CASES
def test_precision_follows_the_points(kernel, formula):
    x = jnp.asarray(points(3, 2), jnp.float32)
    box = QuadratureCovariance(kernel, [-1.0, -1.0], [1.0, 1.0], 4)
    results = [matrix(kernel, x, x), matrix(box, x, x), kernel.spectral_density(x, 2)]
    assert [r.dtype for r in results] == [jnp.float32] * 3
    np.testing.assert_allclose(results[0], formula(distances(x, x)), rtol=1e-5)


def test_integers_are_numbers():
    kernel = GaussianKernel(1, np.int64(2))
    assert {kernel.amplitude.dtype, kernel.length_scale.dtype} == {jnp.dtype("float64")}
    assert not kernel.amplitude.weak_type
    np.testing.assert_allclose(
        kernel.matrix(np.array([[0]]), np.array([[2]])), np.exp(-0.5), rtol=1e-14
    )
    mixed = GaussianKernel(jnp.float32(0.5), 2.0)
    assert mixed.convolved(2).variance.dtype == jnp.float64


def test_numpy_factors():
    x = points(3, 2)
    for kernel in (np.float64(2.0) * GaussianKernel(A, L), jnp.asarray(2.0) * GaussianKernel(A, L)):
        np.testing.assert_allclose(
            kernel.matrix(x, x), 2 * GaussianKernel(A, L).matrix(x, x), rtol=1e-15
        )
    with pytest.raises(TypeError, match="unsupported operand"):
        GaussianKernel(A, L) + 1.0


def test_traced_parameters():
    x = points(3, 2)

    @jax.jit
    def total(amplitude):
        return jnp.sum(
            (2.0 * GaussianKernel(amplitude, L) + GaussianKernel(1.0, 0.9))
            .convolved(2)
            .matrix(x, x)
        )

    values = jax.vmap(total)(jnp.array([0.5, -1.0]))  # a traced value cannot be checked
    np.testing.assert_allclose(values[0], total(0.5), rtol=1e-14)
    assert np.isfinite(jax.grad(total)(0.5))


def test_a_batch_of_kernels():
    amplitudes, x = jnp.array([0.5, 1.0, 2.0]), jnp.asarray(points(3, 2))
    for make in (
        lambda a: GaussianKernel(a, L),
        lambda a: MaternKernel(a, L),
        lambda a: a * GaussianKernel(1.0, L),
        lambda a: GaussianKernel(a, L) + GaussianKernel(1.0, 1.0),
        lambda a: QuadratureCovariance(GaussianKernel(a, L), [-1.0, -1.0], [1.0, 1.0], 8),
    ):
        kernels = jax.vmap(make)(amplitudes)
        together = eqx.filter_vmap(matrix, in_axes=(eqx.if_array(0), None, None))(kernels, x, x)
        np.testing.assert_allclose(together[2], matrix(make(2.0), x, x), rtol=1e-13)
        message = r"must be (a scalar|of shape \(dim,\)); got .*\(3.*`jax.vmap`"
        uses = [lambda k: k.matrix(x, x), lambda k: k.variance]
        if not isinstance(kernels, QuadratureCovariance):
            uses += [lambda k: k.spectral_density(x, 2), lambda k: k.convolved(1).matrix(x, x)]
        for use in uses:
            with pytest.raises(ValueError, match=message):
                jax.eval_shape(use, kernels)


@pytest.mark.parametrize("kernel_class", [GaussianKernel, MaternKernel])
@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf])
def test_parameters_are_positive(kernel_class, bad):
    with pytest.raises(
        ValueError, match=f"`amplitude` must be positive and finite; got {bad:g}.*LogNormal"
    ):
        kernel_class(bad, 1.0)
    with pytest.raises(
        ValueError, match=f"`length_scale` must be positive and finite; got {bad:g}.*LogNormal"
    ):
        kernel_class(1.0, bad)
    with pytest.raises(ValueError, match="`factor` must be positive and finite"):
        bad * kernel_class(1.0, 1.0)


@pytest.mark.parametrize(
    "make, message",
    [
        (
            lambda: GaussianKernel(np.ones(3), 1.0),
            r"`amplitude` must be a scalar; got .*shape \(3,\).*`jax.vmap`",
        ),
        (
            lambda: MaternKernel(1.0, [0.1]),
            r"`length_scale` must be a scalar; got .*shape \(1,\).*`jax.vmap`",
        ),
        (
            lambda: np.ones(2) * GaussianKernel(1.0, 1.0),
            r"`factor` must be a scalar; got .*shape \(2,\)",
        ),
        (lambda: GaussianKernel("a", 1.0), "`amplitude` must be a number.*got 'a'"),
        (
            lambda: MaternKernel(1.0, 1.0, order=-1),
            "`order` must be an integer, at least 0; got -1",
        ),
        (
            lambda: MaternKernel(1.0, 1.0, order=1.5),
            "`order` must be an integer, at least 0; got 1.5",
        ),
        (
            lambda: MaternKernel(1.0, 1.0).convolved(2),
            "odd dimensions only; got one in dimension 2.*`covariance=`",
        ),
        (
            lambda: (MaternKernel(1.0, 1.0) + GaussianKernel(1.0, 1.0)).convolved(1),
            "only; got.*`covariance=`",
        ),
        (
            lambda: (GaussianKernel(1.0, 1.0) + MaternKernel(1.0, 1.0)).convolved(1),
            "got MaternKernel.*`covariance=`",
        ),
        (
            lambda: BOX(lower=[1.0, 0.0]),
            r"`lower` must lie below `upper` on every axis; got \[1. 0.\] and \[1. 1.\]",
        ),
        (lambda: BOX(lower=[0.0]), r"corners of a box.*got shapes \(1,\) and \(2,\)"),
        (lambda: BOX(upper=[np.inf, 1.0]), "`upper` must be finite"),
        (
            lambda: BOX(num_cells=0),
            "`num_cells` must be a positive integer; got 0",
        ),
        (lambda: BOX(num_cells=[4]), r"`num_cells` must be a positive integer.*got \[4\]"),
        (lambda: BOX().convolved(2), "is a covariance: it is passed as `covariance=`"),
        (
            lambda: BOX().spectral_density(np.ones((1, 2)), 2),
            "not stationary.*`kernel.spectral_density",
        ),
        (
            lambda: GaussianKernel(1.0, 1.0).spectral_density(np.ones((4, 2)), 3),
            r"`omega`.*R\^3.*shape \(4, 2\)",
        ),
        (
            lambda: GaussianKernel(1.0, 1.0).matrix(np.ones((4, 2)), np.ones((4, 3))),
            "points of one dimension",
        ),
        (
            lambda: GaussianKernel(1.0, 1.0).matrix(np.ones(4), np.ones(4)),
            r"`x`.*\(n, dim\); got shape \(4,\)",
        ),
        (
            lambda: GaussianKernel(1.0, 1.0).matrix(np.ones((5, 4, 2)), np.ones((4, 2))),
            "`x`.*`jax.vmap`",
        ),
    ],
)
def test_refuses(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def BOX(lower=(0.0, 0.0), upper=(1.0, 1.0), num_cells=4):
    return QuadratureCovariance(
        GaussianKernel(1.0, 1.0), np.asarray(lower), np.asarray(upper), num_cells
    )
