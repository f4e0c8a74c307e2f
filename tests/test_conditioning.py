"""Matches, conditions and messages against SciPy's normal laws and dense conditioning; normal tails
by quadrature.
"""

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
import scipy.linalg
import scipy.special
import scipy.stats
from helpers import as_matrix, columns
from models import CURVE, Q, W

import numpyro_bridges as nb
from numpyro_bridges.conditioning import GaussianMessage, log_interval_probability
from numpyro_bridges.conditioning._normal import (
    log_ndtri,
    truncated_quantile,
    truncated_quantile_inverse,
)

pytestmark = pytest.mark.usefixtures("compile_quickly")


def close(found, truth, atol=1e-11):
    np.testing.assert_allclose(found, truth, rtol=0, atol=atol)


# Matches. A datum of three rows; the SDE gives the state's space and nothing else.

EYE = np.eye(3)
PAIR = np.array([[1.0, 0.5, 0.0], [0.0, 1.0, -0.3]])
PICK = EYE[[2, 0]]
SEEN = np.array([True, False, True])
WEIGHTED = nb.Landmarks(3, 2, weights=W)
VALUE = np.array([[0.6, -0.2], [0.1, 0.8], [-0.5, 0.3]])

# name: match, the rows L x that it sees, their covariance
MATCHES = {
    "number": (nb.InexactMatch(0.05), EYE, 0.05 * EYE),
    "vector": (nb.InexactMatch([0.1, 0.2, 0.3]), EYE, np.diag([0.1, 0.2, 0.3])),
    "matrix": (nb.InexactMatch(Q), EYE, Q),
    "operator": (nb.InexactMatch(0.05, PAIR), PAIR, 0.05 * np.eye(2)),
    "operator-matrix": (nb.InexactMatch(Q[:2, :2], PAIR), PAIR, Q[:2, :2]),
    "mask": (nb.InexactMatch(0.05, mask=SEEN), EYE[SEEN], 0.05 * np.eye(2)),
    "mask-vector": (nb.InexactMatch([0.1, 0.2, 0.3], mask=SEEN), EYE[SEEN], np.diag([0.1, 0.3])),
    "weights": (nb.InexactMatch(0.05, space=WEIGHTED), EYE, np.diag(0.05 / W)),
    "weights-vector": (
        nb.InexactMatch([0.1, 0.2, 0.3], space=WEIGHTED),
        EYE,
        np.diag([0.1, 0.2, 0.3] / W),
    ),
    "weights-matrix": (nb.InexactMatch(Q, space=WEIGHTED), EYE, Q / np.sqrt(np.outer(W, W))),
    "weights-picked": (
        nb.InexactMatch(0.05, PICK, space=WEIGHTED),
        PICK,
        np.diag(0.05 / W[[2, 0]]),
    ),
    "weights-operator": (nb.InexactMatch(0.05, PAIR, space=WEIGHTED), PAIR, 0.05 * np.eye(2)),
    "weights-mask": (
        nb.InexactMatch(0.05, mask=SEEN, space=WEIGHTED),
        EYE[SEEN],
        np.diag(0.05 / W[SEEN]),
    ),
    "point-sd": (nb.InexactMatch.from_point_sd(0.2, WEIGHTED), EYE, np.diag(0.04 * W.mean() / W)),
}


def datum(match, L):
    """The value of L x at VALUE; where rows are masked, all rows, the hidden one missing."""
    hidden = getattr(match, "mask", None)
    return L @ VALUE if hidden is None else np.where(SEEN[:, None], VALUE, np.nan)


def message(match, sde, v, x):
    condition = match.at(v)
    condition.check(sde, x)
    seen = condition.observation(sde, x)
    v = condition.observed
    return GaussianMessage(seen.operator, jnp.zeros_like(v), seen.factor, v, seen.log_scale)


@pytest.mark.parametrize("name", MATCHES)
def test_inexact_match(name):
    """Its density, score and kernel, and the nearest state that meets it; the space of the match or
    of the SDE.
    """
    match, L, noise = MATCHES[name]
    x, v = CURVE, L @ VALUE
    law = scipy.stats.multivariate_normal(np.zeros(len(noise)), noise)
    truth = sum(law.logpdf((v - L @ x)[:, c]) for c in (0, 1))
    # two columns of half a log determinant each
    kernel = truth + np.linalg.slogdet(2 * np.pi * noise)[1]
    mesh = nb.LinearSDE(-0.5, 0.4, space=match.space)
    operator = None if match.operator.ndim == 0 else match.operator
    bare = nb.InexactMatch(match.variance, operator, mask=match.mask)
    unnormalised = nb.InexactMatch(match.variance, operator, match.space, False, mask=match.mask)
    told = datum(match, L)

    @jax.jit
    def everything(x):
        h = message(match, nb.LinearSDE(-0.5, 0.4), told, x)
        values = [message(m, mesh, told, x).log_value(x) for m in (bare, unnormalised)]
        return h.log_value(x), h.score(x), *values, match.at(told).reference(mesh, x)

    log_value, score, by_the_sde, unscaled, reference = everything(x)
    close(log_value, truth, 1e-10)
    close(score, L.T @ np.linalg.solve(noise, v - L @ x), 1e-9)
    close(by_the_sde, truth, 1e-10)
    close(unscaled, kernel, 1e-10)
    close(L @ reference, v)
    close(reference - x, np.linalg.pinv(L) @ (v - L @ x))


@pytest.mark.parametrize("name", ["number", "operator-matrix", "weights", "weights-matrix"])
def test_what_an_inexact_match_draws(name):
    match, L, noise = MATCHES[name]
    count, sde = 20000, nb.LinearSDE(-0.5, 0.4)
    draw = jax.jit(jax.vmap(lambda key: match.sample(key, sde, jnp.asarray(CURVE))))
    r = np.asarray(draw(jr.split(jr.key(0), count))) - L @ CURVE
    r = np.concatenate([r[..., 0], r[..., 1]])  # columns are independent and alike
    error = np.sqrt((np.outer(np.diag(noise), np.diag(noise)) + noise**2) / (2 * count))
    assert np.max(error / np.sqrt(np.outer(np.diag(noise), np.diag(noise)))) < 0.01
    assert np.all(np.abs(r.T @ r / len(r) - noise) < 4.5 * error)
    assert np.all(np.abs(r.mean(0)) < 4.5 * np.sqrt(np.diag(noise) / len(r)))


def test_exact_match():
    sde, x = nb.LinearSDE(-0.5, 0.4), jnp.asarray(CURVE)
    for match, L in (
        (nb.ExactMatch(), EYE),
        (nb.ExactMatch(PAIR), PAIR),
        (nb.ExactMatch(mask=SEEN), EYE[SEEN]),
    ):
        close(match.sample(jr.key(0), sde, x), L @ CURVE)
        condition = match.at(L @ VALUE)
        condition.check(sde, x)
        seen = condition.observation(sde, x)
        assert condition.exact and seen.factor is None and seen.log_scale == 0
        close(as_matrix(seen.operator, 3), L)
        reference = np.asarray(condition.reference(sde, x))
        close(reference, CURVE + np.linalg.pinv(L) @ (L @ VALUE - L @ CURVE))
        mean, S = L @ CURVE + 0.1, L @ Q @ L.T
        truth = sum(
            scipy.stats.multivariate_normal(mean[:, c], S).logpdf((L @ VALUE)[:, c]) for c in (0, 1)
        )
        close(condition.log_value(jnp.asarray(mean), jnp.asarray(np.linalg.cholesky(S))), truth)


def test_a_masked_row_leaves_no_trace():
    """Whatever stands in the hidden row; and a mask that is traced."""
    sde, x = nb.LinearSDE(-0.5, 0.4), jnp.asarray(CURVE)

    @jax.jit
    def log_h(mask, v):
        return message(nb.InexactMatch(0.05, mask=mask), sde, v, x).log_value(x)

    truth = scipy.stats.norm.logpdf(VALUE[SEEN], CURVE[SEEN], np.sqrt(0.05)).sum()
    for hidden in (0.0, 1e6, np.nan):
        close(log_h(SEEN, np.where(SEEN[:, None], VALUE, hidden)), truth)
    close(
        log_h(np.ones(3, bool), VALUE), scipy.stats.norm.logpdf(VALUE, CURVE, np.sqrt(0.05)).sum()
    )
    close(log_h(np.zeros(3, bool), VALUE), 0.0)


def test_the_h_norm_does_not_depend_on_the_mesh():
    """Brownian motion of curves, T = 1: log E exp(−‖X_1 − v‖²/2σ) by a dense determinant, at
    reference values.
    """
    alpha, ell, variance = 0.2, 0.5, 0.01
    for n, value in ((8, -5.714164), (16, -5.716044)):
        s = 2 * np.pi * np.arange(n) / n
        x0 = np.stack([np.cos(s), np.sin(s)], 1)
        v = np.stack([1.3 * np.cos(s) + 0.1 + 0.05 * np.cos(3 * s), 0.8 * np.sin(s) - 0.2], 1)
        K = (
            alpha**2
            * np.pi
            * ell**2
            * np.exp(-np.sum((x0[:, None] - x0[None]) ** 2, -1) / (4 * ell**2))
        )
        total = np.eye(n) + K / n / variance
        truth = (
            -np.linalg.slogdet(total)[1]
            - 0.5 * np.sum((v - x0) * np.linalg.solve(total.T, v - x0)) / n / variance
        )
        match = nb.InexactMatch(variance, space=nb.Landmarks(n, 2), normalised=False)

        def log_h(x0, match=match, K=K, v=v):
            return nb.GuidedBridge(
                nb.BrownianMotion(K), match.at(v), x0=x0, t1=1.0, num_steps=1
            ).log_h(0.0, x0)

        found = jax.jit(log_h)(x0)
        close(found, truth, 1e-8)
        close(found, value, 2e-6)


# Messages.


@pytest.mark.parametrize(
    "operator", [1.3, np.array([0.5, -0.2, 1.1]), PAIR], ids=["scalar", "diagonal", "matrix"]
)
def test_a_message_is_bayes_rule(operator, key):
    """Prior N(m, S) and message: the posterior from H, F, c and the evidence are those of the dense
    joint Gaussian.
    """
    m = 2 if np.ndim(operator) == 2 else 3
    L, x = as_matrix(operator, 3), np.asarray(jr.normal(key, (3, 2)))
    factor = np.linalg.cholesky(Q[:m, :m]) if np.ndim(operator) else 0.7
    P = as_matrix(factor, m)
    shift, v, prior_mean, S = L @ VALUE + 0.1, 0.5 * (L @ CURVE), 0.2 * CURVE, 2 * Q
    h = GaussianMessage(*map(jnp.asarray, (operator, shift, factor, v, 0.3)))
    log_h, score, (H, F, c) = jax.jit(lambda h, x: (h.log_value(x), h.score(x), h.information(3)))(
        h, x
    )
    truth = 0.3 + sum(
        scipy.stats.multivariate_normal((L @ x + shift)[:, i], P @ P.T).logpdf(v[:, i])
        for i in (0, 1)
    )
    close(log_h, truth)
    close(c + np.sum(F * x) - 0.5 * np.sum(x * (H @ x)), truth, 1e-10)
    close(score, F - H @ x, 1e-10)

    precision = np.linalg.inv(S) + H
    posterior_mean = np.linalg.solve(precision, np.linalg.solve(S, prior_mean) + F)
    total = L @ S @ L.T + P @ P.T
    gain = S @ L.T @ np.linalg.inv(total)
    close(posterior_mean, prior_mean + gain @ (v - shift - L @ prior_mean), 1e-10)
    close(np.linalg.inv(precision), S - gain @ L @ S, 1e-10)
    quadratic = np.sum(posterior_mean * (precision @ posterior_mean)) - np.sum(
        prior_mean * np.linalg.solve(S, prior_mean)
    )
    log_evidence = c + 0.5 * quadratic - np.linalg.slogdet(S @ precision)[1]
    dense = sum(
        scipy.stats.multivariate_normal((L @ prior_mean + shift)[:, i], total).logpdf(v[:, i])
        for i in (0, 1)
    )
    close(log_evidence, 0.3 + dense, 1e-9)


# Sets.

LOW, HIGH = np.array([-0.2, -np.inf, 0.1]), np.array([0.7, 0.3, np.inf])
COVARIANCE = np.array([[0.5, 0.3, 0.1], [0.3, 0.6, -0.2], [0.1, -0.2, 0.4]])
MEAN = np.array([0.4, -0.1, 0.3])


def test_cylinder_set():
    """The probability of a box under a dense normal: the mean weight of draws against SciPy's cdf,
    the SE below 1 %.
    """
    box, factor, count = (
        nb.CylinderSet(LOW, HIGH),
        jnp.asarray(np.linalg.cholesky(COVARIANCE)),
        4000,
    )
    sde, x = nb.LinearSDE(-0.5, 0.4), jnp.asarray(MEAN)
    box.check(sde, x)
    assert box.exact and box.rows == (0, 1, 2) and box.observation(sde, x).factor is None
    close(box.reference(sde, jnp.array([1.0, 0.0, 0.0])), [0.7, 0.0, 0.1])

    @jax.jit
    @jax.vmap
    def draw(z):
        target = box.target(x, factor, z[None])
        return target.value, target.log_weight, box.noise_from_target(x, factor, target.value)[0]

    z = jr.normal(jr.key(0), (count, 3))
    value, log_weight, back = map(np.asarray, draw(z))
    assert np.all((value >= LOW) & (value <= HIGH))
    close(back, z, 1e-6)
    law = scipy.stats.multivariate_normal(MEAN, COVARIANCE)
    weight = np.exp(log_weight + law.logpdf(value))
    truth = scipy.stats.multivariate_normal.cdf(
        HIGH, MEAN, COVARIANCE, abseps=1e-7, releps=1e-7, lower_limit=LOW
    )
    error = weight.std() / np.sqrt(count)
    assert error < 0.01 * truth
    assert abs(weight.mean() - truth) < 3.5 * error


def test_sets_of_independent_coordinates():
    """log_value is the sum of log interval probabilities, a log density where pinned; the weight is
    constant.
    """
    low, high = np.array([[-0.2, 0.5], [0.3, -np.inf]]), np.array([[0.7, np.inf], [0.3, 0.1]])
    mean, sd = np.array([[0.1, 0.2], [0.0, -0.4]]), np.array([0.5, 0.8])
    box = nb.CylinderSet(low, high)
    p = scipy.stats.norm(mean, sd[:, None])
    pinned = low == high
    truth = np.where(
        pinned, p.logpdf(np.where(pinned, low, 0)), np.log(p.cdf(high) - p.cdf(low) + pinned)
    ).sum()
    a, b = (low - mean) / sd[:, None], (high - mean) / sd[:, None]
    z = np.asarray(jr.normal(jr.key(0), (5, 1, 2, 2)))

    @jax.jit
    def everything(mean, sd, z):
        return box.log_value(mean, sd), jax.vmap(lambda z: box.target(mean, sd, z))(z)

    log_value, targets = everything(mean, sd, z)
    close(log_value, truth)
    for value, log_weight, noise in zip(targets.value, targets.log_weight, z, strict=True):
        close(log_weight + p.logpdf(value).sum(), truth, 1e-9)
        drawn = scipy.stats.truncnorm.ppf(scipy.stats.norm.cdf(noise[0]), a, b + pinned)
        close(value, np.where(pinned, low, mean + sd[:, None] * drawn), 1e-9)


def test_free_rows_are_left_out():
    box = nb.CylinderSet([-np.inf, 0.1, -np.inf], [np.inf, 0.2, 0.5])
    assert box.rows == (1, 2)
    sde = nb.LinearSDE(-0.5, 0.4)
    close(box.observation(sde, jnp.asarray(MEAN)).operator, EYE[1:])
    close(box.reference(sde, jnp.array([5.0, 5.0, 5.0])), [5.0, 0.2, 0.5])


def test_interval_censored():
    """Bins between cuts: probabilities from `norm.cdf`, which sum to one; draws are bin numbers."""
    cuts = np.array([-0.5, 0.2, 1.0])
    match, mean, sd = nb.IntervalCensored(cuts), np.array([0.3, -0.4]), np.array([0.6, 0.9])
    edges = np.concatenate([[-np.inf], cuts, [np.inf]])
    log_value = jax.jit(lambda bins: match.at(bins).log_value(jnp.asarray(mean), jnp.asarray(sd)))
    for bins in ((0, 3), (1, 2), (2, 1), (3, 0)):
        p = scipy.stats.norm.cdf(edges[np.add(bins, 1)], mean, sd) - scipy.stats.norm.cdf(
            edges[list(bins)], mean, sd
        )
        close(log_value(np.array(bins, float)), np.log(p).sum())
        assert match.at(np.array(bins)).rows == (0, 1)
    close(sum(np.exp(log_value(np.array([i, j], float))) for i in range(4) for j in range(4)), 1.0)
    x = np.array([-0.7, -0.5, 0.1, 0.5, 3.0])
    sampled = match.sample(jr.key(0), nb.LinearSDE(-0.5, 0.4), jnp.asarray(x))
    assert np.array_equal(sampled, [0.0, 0.0, 1.0, 2.0, 3.0]) and sampled.dtype == x.dtype


# Normal tails.


def log_probability(a, b):
    """log ∫_a^b φ by Gauss–Legendre quadrature of exp(−a t − t²/2), mirrored to a ≥ 0 unless the
    interval holds 0.
    """
    if b < 0 or (a < 0 and -a > b):
        a, b = -b, -a
    if a < 0:
        return np.log(scipy.special.ndtr(b) - scipy.special.ndtr(a))
    width = min(b - a, 45 / (1 + a))
    t, w = np.polynomial.legendre.leggauss(80)
    t, w = width * (1 + t) / 2, width * w / 2
    return -0.5 * a * a - 0.5 * np.log(2 * np.pi) + np.log(np.sum(w * np.exp(-a * t - 0.5 * t * t)))


INTERVALS = [
    (-1.0, 0.5), (0.2, 0.3), (-np.inf, 0.0), (-np.inf, np.inf), (1.0, np.inf), (5.0, 5.5), (9.0, np.inf), (30.0, 31.0),
    (-np.inf, -40.0), (-100.0, -99.9), (150.0, np.inf), (6.0, 6.0 + 1e-7), (-3.0 - 1e-7, -3.0), (-0.5, 40.0),
]  # fmt: skip


@pytest.mark.parametrize("a, b", INTERVALS)
def test_log_interval_probability(a, b):
    """Value and derivatives ∓φ/P, deep in the tails and for narrow intervals."""
    value, (da, db) = VALUE_AND_GRADIENT(a, b)
    truth = log_probability(a, b)
    rtol = 1e-11 if b - a > 1e-3 else 1e-6
    np.testing.assert_allclose(value, truth, rtol=rtol, atol=rtol)
    for found, bound, sign in ((da, a, -1), (db, b, 1)):
        density = 0.0 if np.isinf(bound) else np.exp(scipy.stats.norm.logpdf(bound) - truth)
        np.testing.assert_allclose(found, sign * density, rtol=max(10 * rtol, 1e-9), atol=1e-12)


@jax.jit
def VALUE_AND_GRADIENT(a, b):
    return jax.value_and_grad(log_interval_probability, argnums=(0, 1))(a, b)


def test_empty_interval():
    assert VALUE_AND_GRADIENT(1.0, 1.0)[0] == -np.inf


def test_quantile_of_a_logarithm():
    """Against `scipy.special.ndtri_exp`, to log p = −10⁵; the derivative is P/φ."""
    log_p = np.array(
        [-1e-8, -1e-3, -0.1, -0.6931, -2.0, -4.99, -5.01, -20.0, -700.0, -800.0, -1e4, -1e5]
    )
    found, slope = jax.jit(jax.vmap(jax.value_and_grad(log_ndtri)))(log_p)
    truth = scipy.special.ndtri_exp(log_p)
    np.testing.assert_allclose(found, truth, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(slope, np.exp(log_p - scipy.stats.norm.logpdf(truth)), rtol=1e-6)


@pytest.mark.parametrize("a, b", [*INTERVALS[:11], (-0.5, 40.0)])
def test_truncated_quantile(a, b):
    """P(a ≤ w' ≤ w) = Φ(z) P(a ≤ w' ≤ b), by quadrature; monotone, inside, inverted; finite
    gradients.
    """
    z = np.array([-2.5, -1.0, 0.0, 0.7, 2.0])
    w, slopes, back = map(np.asarray, QUANTILES(z, a, b))
    assert np.all((w >= a) & (w <= b)) and np.all(np.diff(w) > 0)
    share = [log_probability(a, x) - log_probability(a, b) for x in w]
    close(share, scipy.special.log_ndtr(z), 1e-7)
    close(back, z, 1e-6)
    assert np.all(np.isfinite(slopes))
    total = log_probability(a, b)
    # φ(w) dw = P φ(z) dz
    dz = np.exp(scipy.stats.norm.logpdf(z) + total - scipy.stats.norm.logpdf(w))
    np.testing.assert_allclose(slopes[0], dz, rtol=1e-5)


@jax.jit
def QUANTILES(z, a, b):
    gradient = jax.vmap(jax.grad(truncated_quantile, argnums=(0, 1, 2)), in_axes=(0, None, None))
    w = truncated_quantile(z, jnp.full(z.shape, a), jnp.full(z.shape, b))
    back = truncated_quantile_inverse(w, jnp.full(z.shape, a), jnp.full(z.shape, b))
    return w, jnp.stack(gradient(z, a, b)), back


NEAR_ENDS = np.array([-5.0, -0.7, 0.0, 1e-3, 0.4, 1.0, 3.0, 11.9, 12.1, 40.0, 1e3, 1e6])
WIDTHS = np.array([1e-30, 1e-16, 1e-9, 1e-5, 1e-3, 0.1, 0.49, 0.51, 2.0, 11.0, np.inf])
SCORES = np.array([-2.5, -0.3, 0.0, 1.1, 2.8])


def near_end_and_width(s, d):
    """log of ∫_0^d exp(−s v − v²/2) dv, and that of φ(s); the first by quadrature, or by a
    difference around 0.
    """
    width = min(d, 45 / (1 + s)) if s >= 0 else d
    if s < 0 and d > 0.1:
        upper = scipy.special.ndtr(s + d) if np.isfinite(d) else 1.0
        return np.log(upper - scipy.special.ndtr(s)) - scipy.stats.norm.logpdf(
            s
        ), scipy.stats.norm.logpdf(s)
    t, w = np.polynomial.legendre.leggauss(80)
    v, w = width * (1 + t) / 2, width * w / 2
    return np.log(np.sum(w * np.exp(-v * (s + 0.5 * v)))), scipy.stats.norm.logpdf(s)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_width_by_distance(dtype):
    """Intervals of every width at every distance, in units of the SD, to either side, in both
    precisions.

    One end is 0 and the mean moves, so that the width keeps its digits however far out: value,
    derivatives by mean and far end, and the noise of a draw.
    """
    grid = np.meshgrid(NEAR_ENDS, WIDTHS, [1.0, -1.0], indexing="ij")
    s, d, side = (a.ravel().astype(dtype) for a in grid)

    @jax.jit
    @jax.vmap
    def found(s, d, sign):
        def ends(d):
            return jnp.where(sign < 0, -d, 0.0), jnp.where(sign < 0, 0.0, d)

        def log_p(mean, d):
            return log_interval_probability(*ends(d), mean)

        value, slopes = jax.value_and_grad(log_p, argnums=(0, 1))(-sign * s, d)
        z = sign * jnp.asarray(SCORES, s.dtype)
        draw = jax.vmap(lambda z: truncated_quantile(z, *ends(d), -sign * s))(z)
        back = jax.vmap(lambda x: truncated_quantile_inverse(x, *ends(d), -sign * s))(draw)
        return value, sign * slopes[0], slopes[1], sign * draw, sign * back

    answers = found(s, d, side)
    s, d, value, by_mean, by_far_end, draw, back = (np.asarray(a, float) for a in (s, d, *answers))
    log_integral, log_phi = np.transpose(
        [near_end_and_width(*pair) for pair in zip(s, d, strict=True)]
    )
    rtol = {np.float64: 1e-9, np.float32: 3e-4}[dtype]
    np.testing.assert_allclose(value, log_integral + log_phi, rtol=rtol / 100, atol=rtol)
    finite = np.where(np.isinf(d), 1.0, d)
    gap = np.where(np.isinf(d), np.inf, finite * (s + 0.5 * finite))
    at_near, at_far = np.exp(-log_integral), np.exp(-gap - log_integral)
    np.testing.assert_allclose(by_mean, -np.expm1(-gap) * at_near, rtol=10 * rtol, atol=rtol)
    np.testing.assert_allclose(by_far_end, at_far, rtol=10 * rtol, atol=rtol * 1e-3)
    assert np.all((draw >= 0) & (draw <= d[:, None]))
    np.testing.assert_allclose(back, np.broadcast_to(SCORES, back.shape), rtol=0, atol=10 * rtol)
    share = [
        [np.exp(near_end_and_width(a, x)[0] - whole) for x in row]
        for a, row, whole in zip(s, draw, log_integral, strict=True)
    ]
    np.testing.assert_allclose(
        share, np.broadcast_to(scipy.stats.norm.cdf(SCORES), back.shape), atol=10 * rtol
    )


def test_columns_of_a_vector_condition():
    """A vector state is one column: the same density."""
    h = message(
        nb.InexactMatch(0.05), nb.LinearSDE(-0.5, 0.4), VALUE[:, 0], jnp.asarray(CURVE[:, 0])
    )
    truth = scipy.stats.norm.logpdf(VALUE[:, 0], CURVE[:, 0], np.sqrt(0.05)).sum()
    close(h.log_value(jnp.asarray(CURVE[:, 0])), truth)
    assert columns(h.score(jnp.asarray(CURVE[:, 0]))).shape == (3, 1)
