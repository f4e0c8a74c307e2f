"""The law of an observation: its density, its batches, and what it refuses."""

import pickle

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import numpyro.distributions as dist
import pytest
from numpyro.distributions import constraints
from scipy import special, stats

import numpyro_bridges as nb
from numpyro_bridges.distributions import DrivingNoise

pytestmark = pytest.mark.usefixtures("compile_quickly")

STEPS, DRAWS = 4, 16_000
RATE, SIGMA, MEAN = 0.7, 0.5, 0.4
X0 = np.array([[0.3, -0.2], [1.0, 0.1], [-0.6, 0.8]])
SDE = nb.LinearSDE(-RATE, SIGMA, RATE * MEAN)
WRONG = nb.FrozenGuide(nb.BrownianMotion(0.35))  # so that the weight depends on the noise
OPERATOR = np.array([[1.0, 1.0, 0.0], [0.0, 0.5, -1.0]])
CIRCLE = np.stack([np.cos(2 * np.pi * np.arange(5) / 5), np.sin(2 * np.pi * np.arange(5) / 5)], 1)

MATCHES = {
    "exact": nb.ExactMatch(),
    "exact, operator": nb.ExactMatch(OPERATOR),
    "inexact": nb.InexactMatch(0.05),
    "inexact, operator": nb.InexactMatch(np.array([0.05, 0.1]), OPERATOR),
}


def endpoint(match, sde=SDE, x0=X0, guide=WRONG, **kwargs):
    return nb.DiffusionEndpoint(sde, x0, match, t1=1.0, num_steps=STEPS, guide=guide, **kwargs)


def density(match, v):
    """log p(v | x0) of the Ornstein–Uhlenbeck process in closed form, columns being independent."""
    L = np.eye(3) if match.operator.ndim == 0 else np.asarray(match.operator)
    noise = (
        np.diag(np.broadcast_to(match.variance, len(L)))
        if isinstance(match, nb.InexactMatch)
        else 0
    )
    mean = MEAN + np.exp(-RATE) * (X0 - MEAN)
    S = SIGMA**2 * (1 - np.exp(-2 * RATE)) / (2 * RATE) * L @ L.T + noise
    columns = [
        stats.multivariate_normal(m, S).logpdf(np.moveaxis(v, -1, 0)[j])
        for j, m in enumerate((L @ mean).T)
    ]
    return np.sum(columns, axis=0)


def mean_and_error(x):
    return np.mean(x), np.std(x) / np.sqrt(len(x))


def noise_for(law, seed=0, batch=()):
    """Standard normal noise; NumPy's, which compiles nothing."""
    prior = law.noise_prior().expand(batch + law.batch_shape)
    return np.random.default_rng(seed).standard_normal(prior.shape())


def datum_for(law, seed=0, batch=()):
    """Something that might be seen."""
    return np.random.default_rng(seed).standard_normal(batch + law.shape())


@pytest.mark.parametrize("name", MATCHES)
def test_average_over_noise_is_the_density(name):
    match = MATCHES[name]
    law = endpoint(match)
    v = 0.6 * datum_for(law, 5)
    log_prob = law.given(noise_for(law, 6, (DRAWS,))).log_prob(v)
    mean, error = mean_and_error(np.exp(log_prob - density(match, v)))
    assert np.std(log_prob) > 0.1, "the guide is exact: nothing is tested"
    assert error < 0.03
    assert abs(mean - 1) < 4 * error


def weighted_draws(match):
    """z and 1/(1 + r) of joint draws, z and r/(1 + r) of independent ones, r(z, v) = exp(log_prob(v
    | z))/p(v).

    Joint draws have density N(z) p(v) r(z, v), so that f(z)/(1 + r) and f(z) r/(1 + r) have the
    same mean.
    """
    law = endpoint(match)
    v, z = law.sample_with_noise(jr.key(3), (DRAWS,))
    yield z, special.expit(density(match, v) - law.given(z).log_prob(v))
    v, z = law.sample(jr.key(4), (DRAWS,)), noise_for(law, 5, (DRAWS,))
    yield z, special.expit(law.given(z).log_prob(v) - density(match, v))


@pytest.mark.parametrize(
    "name", ["inexact", pytest.param("exact, operator", marks=pytest.mark.slow)]
)
def test_joint_draws_have_the_joint_density(name):
    (z, w), (z_free, w_free) = weighted_draws(MATCHES[name])
    for f in (
        lambda z: 1.0,
        lambda z: z[:, 1, 0, 0] ** 2,
        lambda z: z[:, -1, 1, 1] ** 2,
        lambda z: abs(z[:, 0, 2, 0]),
    ):
        (joint, e1), (independent, e2) = (
            mean_and_error(f(z) * w),
            mean_and_error(f(z_free) * w_free),
        )
        assert np.hypot(e1, e2) < 0.02
        assert abs(joint - independent) < 4 * np.hypot(e1, e2)


def test_noise_drawn_before_the_datum_has_another_joint_law():
    """The statistic above sees the mistake."""
    _, (_, w) = weighted_draws(MATCHES["inexact"])
    mean, error = mean_and_error((1 - w) - w)
    assert abs(mean) > 10 * error


@pytest.mark.parametrize("name", MATCHES)
def test_samples_have_the_density(name):
    """Mahalanobis distances of draws are chi-squared, on average m · dim."""
    match = MATCHES[name]
    law = endpoint(match)
    v = np.asarray(law.sample(jr.key(8), (DRAWS,)))
    mode = density(match, np.mean(v, 0))
    mean, error = mean_and_error(2 * (mode - density(match, v)))
    assert error < 0.06
    assert abs(mean - v[0].size) < 4 * error + 0.02


def test_interval_censored_probabilities():
    """All bins together have probability 1, each its closed form."""
    cuts = np.array([0.0, 0.6])
    sde, x0 = nb.BrownianMotion(0.5), np.array([0.2])
    law = nb.DiffusionEndpoint(sde, x0, nb.IntervalCensored(cuts), t1=1.0, num_steps=2)
    # one row draws the point in the set
    assert law.event_shape == (1,) and law.noise_prior().event_shape == (3, 1, 1)
    edges = np.concatenate([[-np.inf], cuts, [np.inf]])
    expected = np.diff(stats.norm(0.2, np.sqrt(0.5)).cdf(edges))
    bins = np.arange(3.0)[:, None]
    found = law.expand((3,)).given(noise_for(law, 1, (3,))).log_prob(bins)
    np.testing.assert_allclose(np.exp(found), expected, rtol=1e-10)
    v = law.sample(jr.key(3), (4000,))
    np.testing.assert_allclose(
        [np.mean(v == b) for b in range(3)], expected, atol=4 * 0.5 / np.sqrt(4000)
    )


def test_is_the_bridge():
    flow = nb.KunitaFlow(nb.Landmarks(5, 2), nb.GaussianKernel(0.2, 0.6))
    match = nb.InexactMatch(1e-2)
    law = nb.DiffusionEndpoint(flow, CIRCLE, match, t1=1.0, num_steps=STEPS)
    v, z = law.sample_with_noise(jr.key(0))
    bridge = nb.GuidedBridge(flow, match.at(v), x0=CIRCLE, t1=1.0, num_steps=STEPS)
    assert law.noise_prior().event_shape == bridge.noise_shape == z.shape
    assert law.given(z).log_prob(v) == pytest.approx(float(bridge.log_weight(z)), abs=1e-10)
    np.testing.assert_allclose(law.given(z).path(v), bridge.path(z), atol=1e-10)


def test_graded_grid_is_the_default_for_exact_matches():
    law = endpoint(MATCHES["exact"])
    np.testing.assert_allclose(
        law.parts["ts"], nb.GuidedBridge(SDE, nb.ExactMatch().at(X0), x0=X0, t1=1.0, num_steps=4).ts
    )
    assert (
        np.ptp(np.diff(law.parts["ts"]))
        > 0.1
        > 1e-10
        > np.ptp(np.diff(endpoint(MATCHES["inexact"]).parts["ts"]))
    )


def test_shapes_and_support():
    for name, event in (("inexact", (3, 2)), ("inexact, operator", (2, 2))):
        law = endpoint(MATCHES[name])
        assert (
            law.event_shape == event
            and law.batch_shape == ()
            and law.noise_prior().event_shape == (STEPS, 3, 2)
        )
        assert jax.eval_shape(lambda key, law=law: law.sample(key, (7, 2)), jr.key(0)).shape == (
            7,
            2,
            *event,
        )
        assert law.support == constraints.independent(constraints.real, 2) and not law.has_rsample
    vector = nb.DiffusionEndpoint(SDE, X0[:, 0], nb.InexactMatch(0.1), t1=1.0, num_steps=STEPS)
    assert vector.event_shape == (3,) and vector.noise_prior().event_shape == (STEPS, 3, 1)
    # an old key too
    assert vector.given(noise_for(vector)).log_prob(vector.sample(jr.PRNGKey(0))).shape == ()


def test_single_precision():
    with jax.enable_x64(False):
        x0, sde = X0.astype(np.float32), nb.LinearSDE(-RATE, SIGMA)
        law = nb.DiffusionEndpoint(sde, x0, nb.InexactMatch(0.05), t1=1.0, num_steps=STEPS)
        v = law.sample(jr.key(0))
        assert (
            v.dtype == law.given(noise_for(law).astype(np.float32)).log_prob(v).dtype == jnp.float32
        )


# Batches


def linear(rate, shift):
    return nb.LinearSDE(-rate, 0.5, shift)


RATES, SHIFTS = jnp.linspace(0.2, 1.0, 4), jnp.linspace(-1, 1, 4)
STARTS = X0 + np.linspace(0, 1, 4)[:, None, None]
SPREADS = jnp.linspace(0.05, 0.2, 4)


@pytest.mark.parametrize(
    "own", [{"x0"}, {"sde", "x0"}, {"sde", "match"}], ids=lambda own: "+".join(sorted(own))
)
def test_a_batch_is_a_loop_of_single_laws(own):
    def parts(i):
        """Law i, or all of them for a slice."""
        build = (lambda f: f) if isinstance(i, int) else jax.vmap
        return {
            "sde": build(linear)(RATES[i], SHIFTS[i]) if "sde" in own else SDE,
            "x0": STARTS[i] if "x0" in own else X0,
            "match": build(nb.InexactMatch)(SPREADS[i]) if "match" in own else nb.InexactMatch(0.1),
        }

    law = endpoint(**parts(slice(None)), batch_shape=(4,), guide=None)
    singles = [endpoint(**parts(i), guide=None) for i in range(4)]
    z, v = noise_for(law, 1), datum_for(law, 2)
    assert law.batch_shape == (4,) and law.event_shape == (3, 2) and v.shape == (4, 3, 2)
    expected = np.array([one.given(z[i]).log_prob(v[i]) for i, one in enumerate(singles)])
    np.testing.assert_allclose(law.given(z).log_prob(v), expected, atol=1e-10)
    if own == {"sde", "x0"}:
        wide = law.expand((2, 4)).given(jnp.stack([z, z])).log_prob(jnp.stack([v, v]))
        np.testing.assert_allclose(wide, [expected, expected], atol=1e-10)


def test_many_noises_for_one_datum():
    law = endpoint(MATCHES["inexact"])
    v, z = datum_for(law), noise_for(law, 1, (2, 3))
    expected = [[law.given(z[i, j]).log_prob(v) for j in range(3)] for i in range(2)]
    np.testing.assert_allclose(law.given(z).log_prob(v), expected, atol=1e-10)


def test_expand_mask_and_to_event_keep_the_noise():
    law = endpoint(MATCHES["inexact"]).expand((2, 3))
    z, v = noise_for(law, 1), datum_for(law)
    full = law.given(z).log_prob(v)
    mask = np.array([True, False, True])
    masked = law.mask(mask)
    assert masked.noise_prior().log_prob(z).shape == (2, 3)
    np.testing.assert_allclose(masked.given(z).log_prob(v), np.where(mask, full, 0))
    paths, led = masked.given(z).path(v), law.given(z).path(v)
    np.testing.assert_array_equal(paths, np.where(mask[:, None, None, None], led, np.nan))
    joint = masked.to_event(1)
    assert (
        joint.batch_shape == (2,)
        and joint.event_shape == (3, 3, 2)
        and joint.sample(jr.key(0)).shape == (2, 3, 3, 2)
    )
    assert joint.noise_prior().batch_shape == (2,) and joint.noise_prior().log_prob(z).shape == (2,)
    np.testing.assert_allclose(joint.given(z).log_prob(v), np.where(mask, full, 0).sum(1))
    then = joint.mask(np.array([False, True])).given(z)
    np.testing.assert_allclose(then.log_prob(v), np.where(mask, full, 0).sum(1) * [0, 1])
    np.testing.assert_allclose(
        law.given(z).mask(mask).to_event().log_prob(v), np.where(mask, full, 0).sum()
    )
    assert (
        law.mask(True) is law
        and law.given(z).mask(False).log_prob(v).tolist() == np.zeros((2, 3)).tolist()
    )


def test_a_masked_datum_may_be_missing_and_has_no_gradient():
    law = endpoint(MATCHES["exact"]).expand((2,))
    z, v = noise_for(law, 1), datum_for(law)
    v[1] = np.nan

    def log_prob(rate):
        sde = nb.LinearSDE(-rate, SIGMA, RATE * MEAN)
        return (
            endpoint(MATCHES["exact"], sde)
            .expand((2,))
            .given(z)
            .mask(np.array([True, False]))
            .log_prob(v)
            .sum()
        )

    alone = jax.grad(
        lambda rate: (
            endpoint(MATCHES["exact"], nb.LinearSDE(-rate, SIGMA, RATE * MEAN))
            .given(z[0])
            .log_prob(v[0])
        )
    )
    assert jax.grad(log_prob)(RATE) == pytest.approx(float(alone(RATE)), rel=1e-10)


def test_noise_prior():
    prior = DrivingNoise((2,), (3, 4, 1))
    normal = dist.Normal().expand((2, 3, 4, 1)).to_event(3)
    z = prior.sample(jr.key(0))
    np.testing.assert_allclose(prior.log_prob(z), normal.log_prob(z), rtol=1e-12)
    assert prior.mask(np.array([True, False])) is prior
    assert prior.expand((5, 2)).mask(False).sample(jr.key(0)).shape == (5, 2, 3, 4, 1)
    np.testing.assert_allclose(prior.to_event(1).log_prob(z), normal.log_prob(z).sum())
    assert prior.mean.shape == prior.variance.shape == prior.shape() and prior.has_rsample
    with pytest.raises(ValueError, match="cannot be expanded"):
        prior.expand((3,))


ENDS = np.array([0.5, 1.0, 2.5, 0.8])


def end_density(end, v, x0=X0, rate=RATE, variance=0.05):
    """log p(v | x0) at a time, of the process and the inexact match above."""
    mean = MEAN + np.exp(-rate * end) * (x0 - MEAN)
    spread = SIGMA**2 * (1 - np.exp(-2 * rate * end)) / (2 * rate) + variance
    return stats.norm(mean, np.sqrt(spread)).logpdf(v).sum()


OWN_TIMES = {
    "t1": lambda **own: nb.DiffusionEndpoint(
        SDE, X0, MATCHES["inexact"], t1=ENDS, num_steps=2, batch_shape=(4,), **own
    ),
    "t0 and t1": lambda **own: nb.DiffusionEndpoint(
        SDE, X0, MATCHES["inexact"], t0=-ENDS, t1=np.zeros(4), num_steps=2, batch_shape=(4,), **own
    ),
    "ts": lambda **own: nb.DiffusionEndpoint(
        SDE,
        X0,
        MATCHES["inexact"],
        ts=ENDS[:, None] * np.array([0.0, 0.3, 1.0]),
        batch_shape=(4,),
        **own,
    ),
    "traced": lambda **own: jax.jit(
        lambda t: nb.DiffusionEndpoint(
            SDE, X0, MATCHES["inexact"], t1=t, num_steps=2, batch_shape=(4,), **own
        )
    )(ENDS),
    "a mapped law": lambda **own: jax.vmap(
        lambda t: nb.DiffusionEndpoint(SDE, X0, MATCHES["inexact"], t1=t, num_steps=2, **own)
    )(ENDS),
}


@pytest.mark.parametrize("name", OWN_TIMES)
def test_data_with_times_of_their_own(name):
    """The guide of a linear SDE is exact, so that the density given the noise is the density."""
    law = OWN_TIMES[name]()
    v = datum_for(law, 3)
    expected = [end_density(end, v[i]) for i, end in enumerate(ENDS)]
    assert law.batch_shape == (4,) and law.event_shape == (3, 2)
    np.testing.assert_allclose(law.given(noise_for(law)).log_prob(v), expected, atol=1e-6)
    wide = law.expand((2, 4)).mask(np.array([[True], [False]]))
    np.testing.assert_allclose(
        wide.given(noise_for(wide)).log_prob(v), [expected, np.zeros(4)], atol=1e-6
    )
    assert law.times.shape == (4, 3) and np.allclose(law.times[:, -1] - law.times[:, 0], ENDS)


def test_times_that_fit_no_batch():
    own = {"batch_shape": (2,), "num_steps": 2}
    with pytest.raises(
        ValueError, match=r"`t1` must be one time, or one for each.*need `batch_shape=\(4,\)`"
    ):
        nb.DiffusionEndpoint(SDE, X0, MATCHES["inexact"], t1=ENDS, num_steps=2)
    with pytest.raises(
        ValueError,
        match=r"`t0` must be one time.*\(2,\) with `batch_shape=\(2,\)`; got shape \(4,\)",
    ):
        nb.DiffusionEndpoint(SDE, X0, MATCHES["inexact"], t0=ENDS, t1=3.0, **own)
    with pytest.raises(
        ValueError, match=r"law \(1,\) of the batch: `t1` must be finite and later than `t0`"
    ):
        nb.DiffusionEndpoint(SDE, X0, MATCHES["inexact"], t1=np.array([1.0, -1.0]), **own)
    with pytest.raises(
        ValueError, match=r"`ts` must be one grid, or one for each.*got shape \(3, 4\)"
    ):
        nb.DiffusionEndpoint(SDE, X0, MATCHES["inexact"], ts=np.ones((3, 4)))


STACKS = {
    "a law": lambda make: jax.vmap(make)(RATES),
    "of a batch": lambda make: jax.vmap(lambda rate: make(rate, x0=STARTS[:2], batch_shape=(2,)))(
        RATES
    ),
    "expanded": lambda make: jax.vmap(lambda rate: make(rate).expand((2,)))(RATES),
    "of a batch, expanded": lambda make: jax.vmap(
        lambda rate: make(rate, x0=STARTS[:2], batch_shape=(2,)).expand((3, 2))
    )(RATES),
    "masked": lambda make: jax.vmap(lambda rate: make(rate).mask(rate < 2.0))(RATES),
    "in scan": lambda make: jax.lax.scan(lambda _, rate: (None, make(rate)), None, RATES)[1],
}


@pytest.mark.parametrize("name", STACKS)
def test_a_stack_of_laws_is_a_batch(name):
    """What a transformation stacks has its axes in front of the law's own."""

    def make(rate, **kwargs):
        return endpoint(MATCHES["inexact"], nb.LinearSDE(-rate, SIGMA), guide=None, **kwargs)

    law = STACKS[name](make)
    batch = {"of a batch": (4, 2), "expanded": (4, 2), "of a batch, expanded": (4, 3, 2)}.get(
        name, (4,)
    )
    z, v = noise_for(law), datum_for(law)
    assert (
        law.batch_shape == batch
        and v.shape == (*batch, 3, 2)
        and law.noise_prior().batch_shape == batch
    )
    variances = SIGMA**2 * (1 - np.exp(-2 * RATES)) / (2 * RATES) + 0.05
    starts = np.broadcast_to(STARTS[:2] if "of a batch" in name else X0, (*batch, 3, 2))
    shape = (4,) + (1,) * (len(batch) + 1)
    normal = dist.Normal(np.exp(-RATES).reshape(shape) * starts, np.sqrt(variances).reshape(shape))
    np.testing.assert_allclose(
        law.given(z).log_prob(v), normal.log_prob(v).sum((-1, -2)), atol=1e-6
    )
    again = jax.vmap(lambda law, z, v: law.given(z).log_prob(v))(law, z, v)
    np.testing.assert_allclose(again, law.given(z).log_prob(v), atol=1e-10)


# A pytree


def test_is_a_pytree():
    law = endpoint(MATCHES["inexact"]).expand((2,)).mask(np.array([True, False]))
    bound = law.given(noise_for(law))
    v = datum_for(law)
    jitted = jax.jit(lambda law, v: law.log_prob(v))
    np.testing.assert_allclose(jitted(bound, v), bound.log_prob(v), atol=1e-10)
    jitted(
        endpoint(MATCHES["inexact"], x0=X0 + 1)
        .expand((2,))
        .mask(np.array([True, True]))
        .given(noise_for(law)),
        v,
    )
    assert jitted._cache_size() == 1
    again = pickle.loads(pickle.dumps(endpoint(MATCHES["inexact"]).given(noise_for(law)[0])))
    np.testing.assert_allclose(again.log_prob(v[0]), bound.log_prob(v)[0], atol=1e-10)
    again = jax.tree.unflatten(*reversed(jax.tree.flatten(bound)))
    assert again.batch_shape == (2,) and again.log_prob(v).shape == (2,)


def test_vmap_over_laws():
    v, z = datum_for(endpoint(MATCHES["inexact"])), noise_for(endpoint(MATCHES["inexact"]))

    def make(rate):
        return endpoint(MATCHES["inexact"], nb.LinearSDE(-rate, SIGMA)).given(z)

    found = jax.vmap(lambda law: law.log_prob(v))(jax.vmap(make)(RATES))
    np.testing.assert_allclose(found, [make(rate).log_prob(v) for rate in RATES], atol=1e-10)


def test_gradient_with_respect_to_the_law():
    law = endpoint(MATCHES["inexact"])
    v, z = datum_for(law), noise_for(law)
    gradient = jax.grad(lambda law: law.log_prob(v))(law.given(z))
    h = 1e-5
    up, down = (nb.LinearSDE(-RATE, SIGMA + s, RATE * MEAN) for s in (h, -h))
    difference = endpoint(MATCHES["inexact"], up).given(z).log_prob(v) - endpoint(
        MATCHES["inexact"], down
    ).given(z).log_prob(v)
    assert gradient.parts["sde"].diffusion_operator == pytest.approx(
        float(difference / (2 * h)), rel=1e-5
    )


# What is refused


def kunita(n=5):
    return nb.KunitaFlow(nb.Landmarks(n, 2), nb.GaussianKernel(0.2, 0.6))


def test_missing_noise_says_so():
    law = endpoint(MATCHES["inexact"])
    with pytest.raises(
        ValueError, match="noise site is missing.*numpyro_bridges.sample.*law.given"
    ):
        law.log_prob(X0)
    with pytest.raises(ValueError, match="needs the noise"):
        law.path(X0)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_data_that_are_not_finite(bad):
    law = endpoint(MATCHES["inexact"]).expand((2,))
    bound = law.given(noise_for(law))
    v = datum_for(law)
    v[1, 2, 0] = bad
    with pytest.raises(
        ValueError, match=r"datum \(1,\).*`observed` must be finite; entry \(2, 0\)"
    ):
        bound.log_prob(v)
    with pytest.raises(ValueError, match="must be finite"):
        jax.jit(lambda z: law.given(z).log_prob(v))(noise_for(law))
    assert np.isnan(jax.jit(lambda v: bound.log_prob(v))(v)[1]), (
        "a failure must not look like a weight of 0"
    )
    mask = nb.InexactMatch(0.05, mask=np.array([True, True, False]))
    assert np.isfinite(endpoint(mask).given(noise_for(law)[0]).log_prob(v[1]))


def test_bins_that_do_not_exist():
    law = nb.DiffusionEndpoint(
        SDE, X0[:, 0], nb.IntervalCensored(np.array([0.0])), t1=1.0, num_steps=2
    )
    with pytest.raises(ValueError, match="bin numbers from 0 to 1"):
        law.given(noise_for(law)).log_prob(np.array([0.0, 2.0, 1.0]))


def test_more_data_than_noises():
    law = endpoint(MATCHES["inexact"])
    v = datum_for(law, 0, (6,))
    with pytest.raises(ValueError, match="6 observations.*One noise shared.*plate"):
        law.given(noise_for(law)).log_prob(v)
    with pytest.raises(ValueError, match="One noise shared"):
        law.given(noise_for(law)).expand((6,))
    with pytest.raises(ValueError, match="One noise shared"):
        law.given(noise_for(law)).mask(np.ones(6, bool))
    with pytest.raises(ValueError, match="one noise for each datum"):
        law.expand((6,)).given(noise_for(law))
    with pytest.raises(ValueError, match="cannot be expanded"):
        law.expand((6,)).expand((5,))
    assert law.given(noise_for(law)).expand((1, 1)).log_prob(v[:1, None]).shape == (1, 1)


def test_shapes_that_do_not_fit():
    law = endpoint(MATCHES["inexact"])
    with pytest.raises(ValueError, match=r"must have shape \(3, 2\).*got \(2, 2\)"):
        law.given(noise_for(law)).log_prob(X0[:2])
    with pytest.raises(
        ValueError, match=r"`noise` must have shape \(..., 4, 3, 2\).*got \(3, 3, 2\)"
    ):
        law.given(noise_for(law)[:3])
    with pytest.raises(
        ValueError, match="`reinterpreted_batch_ndims` must be a number from 0 to 0"
    ):
        law.to_event(1)


def test_undeclared_leading_axes():
    seen = nb.InexactMatch(0.1)
    with pytest.raises(ValueError, match=r"`x0` must be one state.*\(4, 3, 2\).*`batch_shape`"):
        endpoint(seen, x0=STARTS)
    with pytest.raises(ValueError, match=r"`x0` must be one state.*\(4, 3, 2\)"):
        endpoint(seen, x0=STARTS, batch_shape=(5,))
    with pytest.raises(ValueError, match="`drift`|`diffusion`|the parts make neither one law"):
        endpoint(seen, jax.vmap(linear)(RATES, SHIFTS))
    flows = jax.vmap(
        lambda amplitude: nb.KunitaFlow(nb.Landmarks(5, 2), nb.GaussianKernel(amplitude, 0.6))
    )(SPREADS)
    with pytest.raises(ValueError, match="must be a scalar"):
        endpoint(seen, flows, CIRCLE)
    assert endpoint(seen, flows, CIRCLE, None, batch_shape=(4,)).sample(jr.key(0)).shape == (
        4,
        5,
        2,
    )
    with pytest.raises(ValueError, match="`t1` must be one time"):
        nb.DiffusionEndpoint(SDE, X0, seen, t1=jnp.linspace(0.1, 1.0, 5), num_steps=4)


def test_shapes_that_can_be_read_in_two_ways():
    """Four vectors of three numbers, or one state of 4 rows and 3 columns, four times."""
    x0, sde = np.zeros((4, 3)), nb.BrownianMotion(0.5)
    with pytest.raises(
        ValueError,
        match=r"`batch_shape=\(4,\)`, x0 can be read.*`batched=\('x0',\)`, or `batched=\(\)`",
    ):
        endpoint(nb.InexactMatch(0.1), sde, x0, batch_shape=(4,))
    assert endpoint(
        nb.InexactMatch(0.1), sde, x0, batch_shape=(4,), batched=("x0",)
    ).event_shape == (3,)
    assert endpoint(nb.InexactMatch(0.1), sde, x0, batch_shape=(4,), batched=()).event_shape == (
        4,
        3,
    )
    with pytest.raises(ValueError, match="every array of `sde`"):
        endpoint(nb.InexactMatch(0.1), sde, x0, batch_shape=(4,), batched=("sde",))
    with pytest.raises(ValueError, match="`batched` must name parts"):
        endpoint(nb.InexactMatch(0.1), sde, x0, batch_shape=(4,), batched=("start",))


def test_a_parameter_of_the_plate_is_not_broadcast():
    """Three coordinates and three specimens: their rates would be read as a diagonal."""
    rates = jnp.array([0.1, 0.2, 0.3])

    def drift(t, x, rate):
        return -rate * x

    x0 = X0[:, 0]
    hidden = {
        "linear": nb.LinearSDE(-rates, 0.5),
        "user": nb.SDE(drift, lambda t, x, args: 0.5, rates),
        "brownian": nb.BrownianMotion(rates),
    }
    for sde in hidden.values():
        law = endpoint(nb.InexactMatch(0.1), sde, x0, None)
        with pytest.raises(
            ValueError, match="`sde` holds an array of shape.*inside the plate.*`batched"
        ):
            law.expand((3,))
        with pytest.raises(ValueError, match="inside the plate"):
            law.given(noise_for(law, 0, (3,)))
        meant = endpoint(nb.InexactMatch(0.1), sde, x0, None, batched=())
        assert meant.given(noise_for(law, 0, (3,))).batch_shape == (3,)
    with pytest.raises(ValueError, match="`match` holds an array"):
        endpoint(nb.InexactMatch(rates), SDE, x0).expand((3,))
    law = endpoint(nb.InexactMatch(0.1), kunita(), CIRCLE, None)
    assert law.expand((5,)).batch_shape == (5,), "weights of a space are no parameters"


def test_models_of_observation_only():
    with pytest.raises(ValueError, match="normalised=False"):
        endpoint(nb.InexactMatch(0.1, normalised=False))
    with pytest.raises(ValueError, match="`match` must be a model of observation.*`obs=`"):
        endpoint(nb.InexactMatch(0.1).at(X0))
    with pytest.raises(ValueError, match="`x0` must be finite"):
        endpoint(nb.InexactMatch(0.1), x0=np.full((3, 2), np.nan))


BAD = {
    "sde": (
        lambda: nb.DiffusionEndpoint("s", X0, MATCHES["inexact"], t1=1.0, num_steps=2),
        "`sde` must be an SDE",
    ),
    "t1": (
        lambda: nb.DiffusionEndpoint(SDE, X0, MATCHES["inexact"], t1="1", num_steps=2),
        "`t1` must be a number",
    ),
    "batch_shape": (
        lambda: endpoint(MATCHES["inexact"], batch_shape=3),
        "`batch_shape` must be a tuple of sizes",
    ),
    "batch sizes": (
        lambda: endpoint(MATCHES["inexact"], batch_shape=(2.0,)),
        "`batch_shape` must be a tuple of sizes",
    ),
    "batched": (
        lambda: endpoint(MATCHES["inexact"], batched="x0"),
        "`batched` must be a tuple of names",
    ),
    "key": (lambda: endpoint(MATCHES["inexact"]).sample(0), "`key` must be a random key"),
    "no key": (
        lambda: endpoint(MATCHES["inexact"]).sample_with_noise(None),
        "`key` must be a random key",
    ),
    "key of noise": (
        lambda: endpoint(MATCHES["inexact"]).noise_prior().sample(0),
        "`key` must be a random key",
    ),
    "sample_shape": (
        lambda: endpoint(MATCHES["inexact"]).sample(jr.key(0), 3),
        "`sample_shape` must be a tuple",
    ),
    "expand": (
        lambda: endpoint(MATCHES["inexact"]).expand(3),
        "`batch_shape` must be a tuple of sizes",
    ),
    "mask": (lambda: endpoint(MATCHES["inexact"]).mask(np.ones(3)), "`mask` must hold booleans"),
    "to_event": (
        lambda: endpoint(MATCHES["inexact"]).to_event("all"),
        "`reinterpreted_batch_ndims` must be a number",
    ),
    "noise": (lambda: endpoint(MATCHES["inexact"]).given("z"), "`noise` must be a number"),
    "value": (lambda: endpoint(MATCHES["inexact"]).log_prob(X0 * 1j), "`value` must be a number"),
}


@pytest.mark.parametrize("name", BAD)
def test_arguments_of_another_kind(name):
    call, message = BAD[name]
    with pytest.raises(ValueError, match=message):
        call()
