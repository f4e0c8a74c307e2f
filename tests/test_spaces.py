"""Spaces: formulas retyped in NumPy, one curve in several discretisations, what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from numpyro_bridges.spaces import FourierBasis, Landmarks

SPACES = [Landmarks(8, 2), Landmarks(7, 3, weights=1.0), FourierBasis(4, 1)]


def curve(s, dim=2):
    """A curve of bandwidth 3 in R^dim."""
    s = np.asarray(s)
    x = np.cos(s) + 0.3 * np.sin(2 * s) - 0.1
    y = 0.5 * np.sin(s) + 0.2 * np.cos(3 * s) - 0.7 * np.sin(3 * s)
    return np.stack([x, y, x - y], axis=1)[:, :dim]


def name(space):
    return f"{type(space).__name__}-{space.size}-{space.dim}"


def grid(n):
    return 2 * np.pi * np.arange(n) / n


def states(space, count=1):
    rng = np.random.default_rng(3)
    return jnp.asarray(rng.normal(size=(count, space.size, space.dim)))


def test_fourier_functions():
    s = np.array([0.0, 0.3, 2.0, 6.1])
    r = np.sqrt(2)
    expected = [np.ones(4)]
    for j in (1, 2, 3):
        expected += [r * np.cos(j * s), r * np.sin(j * s)]
    basis = FourierBasis(3, 2).basis(s)
    np.testing.assert_allclose(basis, np.stack(expected, axis=1), atol=1e-14)
    np.testing.assert_allclose(jax.jit(FourierBasis(3, 2).basis)(s), basis, atol=1e-14)


@pytest.mark.parametrize(
    "num_modes, num_quadrature", [(1, None), (40, None), (4, 9), (4, 10), (7, 64)]
)
def test_fourier_basis_is_orthonormal(num_modes, num_quadrature):
    space = FourierBasis(num_modes, 2, num_quadrature=num_quadrature)
    phi = space.to_points(jnp.eye(space.size)[:, :2])
    assert phi.shape == (space.num_quadrature, 2) == (num_quadrature or max(4 * num_modes, 32), 2)
    # From s alone, by the plain sum: (1/q) Σ φ_i φ_j.
    phi = np.asarray(space.basis(space.grid))
    np.testing.assert_allclose(phi.T @ phi / len(phi), np.eye(space.size), atol=1e-12)
    np.testing.assert_allclose(space.from_points(phi), np.eye(space.size), atol=1e-12)


def test_from_points_keeps_trailing_axes():
    space = FourierBasis(3, 2)
    fields = np.random.default_rng(0).normal(size=(space.num_quadrature, 5, 2))
    expected = (
        np.einsum("qn,qkd->nkd", np.asarray(space.basis(space.grid)), fields) / space.num_quadrature
    )
    np.testing.assert_allclose(space.from_points(fields), expected, atol=1e-14)


def test_quadratic_fields_have_exact_coefficients():
    space, fine = FourierBasis(12, 2), FourierBasis(12, 2, num_quadrature=200)
    x = states(space)[0]
    np.testing.assert_allclose(
        space.from_points(space.to_points(x) ** 2),
        fine.from_points(fine.to_points(x) ** 2),
        atol=1e-12,
    )


def test_landmarks_are_their_own_points():
    space = Landmarks(6, 2)
    x = states(space)[0]
    assert space.to_points(x) is x and space.from_points(x) is x


@pytest.mark.parametrize(
    "weights, expected",
    [(None, np.full(4, 0.25)), (1.0, np.ones(4)), (2, np.full(4, 2.0)), ([1, 2, 3, 4.5], None)],
)
def test_inner_product_of_landmarks(weights, expected):
    weights = np.asarray(weights) if isinstance(weights, list) else weights
    expected = weights if expected is None else expected
    space = Landmarks(4, 3, weights)
    x, y = states(space, 2)
    np.testing.assert_array_equal(space.weights, expected)
    by_hand = sum(expected[i] * np.dot(x[i], y[i]) for i in range(4))
    np.testing.assert_allclose(space.inner(x, y), by_hand, rtol=1e-14)
    np.testing.assert_allclose(space.norm(x) ** 2, space.squared_norm(x), rtol=1e-14)
    np.testing.assert_allclose(
        jax.grad(space.squared_norm)(x), 2 * expected[:, None] * x, rtol=1e-14
    )


def test_norm_is_the_same_in_every_space():
    # ∫ |x|² ds/2π of `curve`: squares of the amplitudes, halved, and the constant squared.
    truth = (1 + 0.09 + 0.25 + 0.04 + 0.49) / 2 + 0.01
    for space in (Landmarks(7, 2), Landmarks(64, 2), FourierBasis(3, 2)):
        x = space.project(curve(grid(80)))
        np.testing.assert_allclose(space.squared_norm(x), truth, rtol=1e-13)


def test_norm_converges_for_a_rough_curve():
    s = grid(4096)
    square = np.stack([np.abs(np.sin(s)), np.abs(np.sin(s + 1.0))], axis=1)  # corners, ∫ = 1
    for n in (16, 64, 256):
        assert abs(Landmarks(n, 2).squared_norm(square[:: 4096 // n]) - 1) < 1e-12
        space = FourierBasis(n, 2, num_quadrature=4096)
        assert 0 < 1 - space.squared_norm(space.from_points(square)) < 0.5 / n**3


@pytest.mark.parametrize("space", SPACES, ids=name)
def test_a_band_limited_curve_is_exact(space):
    fine = curve(s := np.array([0.1, 1.0, 2.5, 4.0, 6.2]), space.dim)
    x = space.project(curve(grid(space.size), space.dim))
    np.testing.assert_allclose(space.evaluate(x, s), fine, atol=1e-13)
    uneven = np.sort(np.random.default_rng(1).uniform(0, 2 * np.pi, 40))
    np.testing.assert_allclose(space.project(curve(uneven, space.dim), uneven), x, atol=1e-11)
    np.testing.assert_allclose(space.project(space.evaluate(x, grid(31))), x, atol=1e-13)


@pytest.mark.parametrize("n", [1, 2, 5, 6])
def test_landmarks_interpolate(n):
    space = Landmarks(n, 2)
    x = states(space)[0]
    np.testing.assert_allclose(space.evaluate(x, space.grid), x, atol=1e-14)
    # Lagrange functions: Σ_j cos js / n over |j| < n/2, and half a cosine at n/2.
    s = np.array([0.2, 3.3])
    dirichlet = 1 + sum(2 * np.cos(j * s) for j in range(1, (n + 1) // 2))
    dirichlet = dirichlet + (n % 2 == 0) * np.cos(n * s / 2)
    np.testing.assert_allclose(space.basis(s)[:, 0], dirichlet / n, atol=1e-14)
    np.testing.assert_allclose(jax.jit(lambda s: space.basis(s))(s), space.basis(s), atol=1e-14)


COARSE = [Landmarks(7, 2), Landmarks(8, 2, weights=1.0), FourierBasis(4, 2)]
FINER = [Landmarks(16, 2), Landmarks(9, 2), FourierBasis(4, 2), FourierBasis(20, 2)]


@pytest.mark.parametrize("coarse", COARSE, ids=name)
@pytest.mark.parametrize("finer", FINER, ids=name)
def test_refine_keeps_the_curve(coarse, finer):
    x = states(coarse)[0]
    y = coarse.refine(x, finer)
    assert y.shape == (finer.size, 2)
    s = np.linspace(0, 6, 11)
    np.testing.assert_allclose(finer.evaluate(y, s), coarse.evaluate(x, s), atol=1e-13)
    np.testing.assert_allclose(finer.project(coarse.evaluate(x, grid(50))), y, atol=1e-13)


def test_refine_to_a_coarser_space():
    x = states(fine := FourierBasis(6, 2))[0]
    np.testing.assert_allclose(fine.refine(x, FourierBasis(2, 2)), x[:5], atol=1e-14)
    y = states(many := Landmarks(12, 2))[0]
    np.testing.assert_allclose(many.refine(y, Landmarks(4, 2)), y[::3], atol=1e-14)


@pytest.mark.parametrize("space", SPACES, ids=name)
def test_precision_follows_the_state(space):
    x = states(space)[0].astype(jnp.float32)
    s = np.linspace(0, 6, 20)

    @jax.jit
    def everything(x):
        values, fields = space.evaluate(x, s), space.to_points(x)
        fine = space.refine(x, FourierBasis(5, space.dim))
        return (
            space.from_points(fields),
            space.project(values, s),
            values,
            fields,
            fine,
            space.norm(x),
        )

    results = everything(x)
    assert [r.dtype for r in results] == [jnp.float32] * 6
    for again in results[:2]:
        np.testing.assert_allclose(again, x, atol=1e-5)


def test_spaces_are_pytrees():
    assert jax.tree.leaves(FourierBasis(3, 2)) == []
    (weights,) = jax.tree.leaves(space := Landmarks(5, 2))
    assert weights.shape == (5,) and not weights.weak_type
    x = states(space)[0]
    norms = jax.vmap(lambda w: Landmarks(5, 2, weights=w).squared_norm(x))(jnp.array([1.0, 2.0]))
    np.testing.assert_allclose(norms, [np.sum(x**2), 2 * np.sum(x**2)], rtol=1e-14)


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: Landmarks(0, 2), "`num_points` must be a positive integer.*got 0"),
        (lambda: Landmarks(4.5, 2), "`num_points` must be a positive integer.*got 4.5"),
        (lambda: Landmarks(4, -1), "`dim` must be a positive integer.*got -1"),
        (lambda: FourierBasis(0, 2), "`num_modes` must be a positive integer.*got 0"),
        (lambda: FourierBasis(3, 0), "`dim` must be a positive integer.*got 0"),
        (lambda: FourierBasis(3, 2, num_quadrature=6), "`num_quadrature` must be at least .* = 7.*got 6"),
        (lambda: Landmarks(4, 2, weights=[1.0, 2.0]), r"`weights` must be .* of shape \(4,\).*shape \(2,\)"),
        (lambda: Landmarks(4, 2, weights=0.0), "`weights` must be positive.*left out by the condition"),
        (lambda: Landmarks(2, 2, weights=np.array([1.0, np.nan])), "`weights` must be positive and finite"),
        (lambda: Landmarks(4, 2, weights="all"), "`weights` must be a number .*got 'all'"),
    ],
)  # fmt: skip
def test_construction_refuses(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_use_refuses():
    space = Landmarks(4, 2)
    x = jnp.ones((4, 2))
    shape = r"must have shape \(4, 2\); got \(1, 2\).*`jax.vmap`"
    for f in (space.norm, lambda y: space.inner(x, y), lambda y: space.evaluate(y, np.zeros(1))):
        with pytest.raises(ValueError, match=shape):
            f(jnp.ones((1, 2)))
    with pytest.raises(ValueError, match=r"at least 4 points of dimension 2.*got shape \(3, 2\)"):
        space.project(jnp.ones((3, 2)))
    with pytest.raises(
        ValueError, match=r"`s` must have one parameter for each of 5 points; got shape \(4,\)"
    ):
        space.project(jnp.ones((5, 2)), np.zeros(4))
    with pytest.raises(ValueError, match=r"`s` must be a vector of parameters; got shape \(\)"):
        space.evaluate(x, 0.3)
    with pytest.raises(ValueError, match=r"`finer` must hold curves in R\^2; got .* dimension 3"):
        space.refine(x, Landmarks(8, 3))
    with pytest.raises(ValueError, match=r"a row for each of 32 points; got shape \(7, 2\)"):
        FourierBasis(3, 2).from_points(jnp.ones((7, 2)))
    batch = jax.vmap(lambda w: Landmarks(4, 2, weights=w))(jnp.array([1.0, 2.0]))
    with pytest.raises(
        ValueError, match=r"`weights` must be of shape \(4,\); got \(2, 4\).*`jax.vmap`"
    ):
        batch.norm(x)
