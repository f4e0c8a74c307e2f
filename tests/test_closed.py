"""Functions that a user writes: what they read, what they capture, when they are called, and what
they return.
"""

import functools
import pickle

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
import scipy.stats

import numpyro_bridges as nb
from numpyro_bridges import bridges
from numpyro_bridges._closed import close
from numpyro_bridges.guiding._score import Standard

pytestmark = [pytest.mark.numpyro, pytest.mark.usefixtures("compile_quickly")]

STEPS, SIGMA, VARIANCE, DATUM = 4, 0.5, 0.1, 0.2
MATCH, X0 = nb.InexactMatch(VARIANCE), np.ones(1)
NOISE = np.full((STEPS, 1, 1), 0.3)


def truth(rate):
    """log p(v | x0 = 1) of Euler steps of dX = −rate X dt + σ dW, seen with an error."""
    a = 1 - rate / STEPS
    variance = SIGMA**2 / STEPS * np.sum(a ** (2 * np.arange(STEPS))) + VARIANCE
    return scipy.stats.norm(a**STEPS, np.sqrt(variance)).logpdf(DATUM)


def diffusion(t, x, args):
    return SIGMA


def bridge(drift, diffusion=diffusion, args=None, **kwargs):
    settings = {"x0": X0, "t1": 1.0, "num_steps": STEPS} | kwargs
    return nb.GuidedBridge(nb.SDE(drift, diffusion, args), MATCH.at([DATUM]), **settings)


def weight(drift, args=None):
    return bridge(drift, args=args).log_weight(NOISE)


def log_prob(drift, args=None):
    law = nb.DiffusionEndpoint(nb.SDE(drift, diffusion, args), X0, MATCH, t1=1.0, num_steps=STEPS)
    return law.given(NOISE).log_prob(jnp.array([DATUM]))


# What a function reads.

RATE = 1.0


class Holder:
    rate = 1.0

    def drift(self, t, x, args):
        return -self.rate * x

    def __call__(self, t, x, args):
        return -self.rate * x


def reads_an_attribute():
    holder = Holder()
    return holder.drift, lambda rate: setattr(holder, "rate", rate)


def reads_a_global():
    def drift(t, x, args):
        return -RATE * x

    return drift, lambda rate: globals().update(RATE=rate)


def reads_a_closure():
    cell = [1.0]

    def drift(t, x, args):
        return -cell[0] * x

    return drift, lambda rate: cell.__setitem__(0, rate)


def reads_an_instance():
    holder = Holder()
    return holder, lambda rate: setattr(holder, "rate", rate)


def reads_through_partial():
    settings = {"rate": 1.0}
    drift = functools.partial(lambda settings, t, x, args: -settings["rate"] * x, settings)
    return drift, lambda rate: settings.update(rate=rate)


def reads_an_array():
    matrix = np.ones((1, 1))
    return lambda t, x, args: -matrix @ x, lambda rate: matrix.__setitem__(..., rate)


READERS = [reads_an_attribute, reads_a_global, reads_a_closure]
READERS += [reads_an_instance, reads_through_partial, reads_an_array]


@pytest.fixture
def counted(monkeypatch):
    """Number of times that a bridge's program is traced."""
    count, reach = [0], bridges.reach

    def counting(*args):
        count[0] += 1
        return reach(*args)

    monkeypatch.setattr(bridges, "reach", counting)
    return count


@pytest.mark.parametrize("door", [weight, log_prob])
def test_a_function_is_what_it_is_when_the_bridge_is_made(door, counted):
    """Each value that it reads gives its own density, and functions that compute the same share
    their program.
    """
    for reader in READERS if door is weight else READERS[-2:]:
        drift, change = reader()
        for rate in (1.0, 3.0, 1.0):
            change(rate)
            np.testing.assert_allclose(door(drift), truth(rate), rtol=0, atol=1e-10)
    # two rates as numbers, one program for the array, once more where it is a law's
    assert counted[0] <= 4


def test_a_bridge_keeps_what_it_was_made_of():
    """A change after that is not seen, by whatever comes first, and the SDE itself sees it."""
    for reader in READERS[:3]:
        drift, change = reader()
        made = bridge(drift)
        sde = nb.SDE(drift, diffusion)
        change(3.0)
        np.testing.assert_allclose(made.log_weight(NOISE), truth(1.0), rtol=0, atol=1e-10)
        np.testing.assert_allclose(
            made.with_guide(nb.RecedingGuide()).log_weight(NOISE), truth(1.0), atol=1e-10
        )
        assert sde.drift(0.0, jnp.ones(1)) == -3.0
        with pytest.raises(ValueError, match="`bridges` must have one estimand"):
            nb.compare({"a": made, "b": bridge(drift)}, jax.random.key(0), num_particles=2)


def test_no_call_compiles_again(counted):
    """Nor a new function of the same text, captured arrays of other values, or a guide of the same
    kind.
    """
    for value in (1.0, 2.0, 3.0):
        rate = np.full(1, value)
        made = bridge(lambda t, x, args, rate=rate: -rate * jax.nn.relu(x))
        for _ in range(2):
            made.log_weight(NOISE)
    named = Holder().drift
    for _ in range(2):
        bridge(named).log_weight(NOISE)
        bridge(lambda t, x, args: -1.0 * x).log_weight(NOISE)
    assert counted[0] <= 2  # programs of other tests may serve


def reverse_rule(bound):
    """The identity, with a clipped derivative."""
    identity = jax.custom_vjp(lambda x: x)
    identity.defvjp(lambda x: (x, None), lambda _, g: (jnp.clip(g, -bound, bound),))
    return identity


def forward_rule(bound):
    identity = jax.custom_jvp(lambda x: x)
    identity.defjvp(lambda x, dx: (x[0], min(bound, 3.0) / 3 * dx[0]))
    return identity


@pytest.mark.parametrize("rule", [reverse_rule, forward_rule])
def test_rules_of_differentiation_tell_programs_apart(rule):
    """The value is the same and the derivative is not."""
    x, found = jnp.array([2.0]), []
    for bound in (0.5, 5.0, 0.5):
        clipped = rule(bound)
        found.append(close(lambda t, x, clipped=clipped: 3 * clipped(x), 0.0, x))
        slope = jax.grad(lambda x: found[-1](0.0, x).sum())(x)  # noqa: B023
        np.testing.assert_allclose(slope, min(3.0, bound))
    assert found[0].program is found[2].program is not found[1].program
    softplus = [close(lambda t, x: jax.nn.softplus(x), 0.0, x) for _ in range(2)]
    assert softplus[0].program is softplus[1].program


def test_exact_constants_tell_programs_apart():
    """To the last bit, and by their types."""
    x = jnp.arange(3.0)
    constants = [0.1, np.nextafter(0.1, 1), 0.0, -0.0, np.nan, np.float32(0.1), 1e300]
    programs = [
        close(lambda t, x, c=c: jnp.where(x > c, x, c).astype(float), 0.0, x).program
        for c in constants
    ]
    assert len(set(programs)) == len(constants)
    matrices = [np.eye(3), 2 * np.eye(3)]
    first, second = (close(lambda t, x, A=A: jnp.asarray(A) @ x, 0.0, x) for A in matrices)
    assert first.program is second.program  # the array is a leaf
    np.testing.assert_allclose(second(0.0, x), 2 * x)


# What a function captures.


def test_captured_tracers_are_parameters():
    """Value, derivative, vmap and a nested jit."""

    def captured(rate):
        return weight(jax.jit(lambda t, x, args: -rate * x))

    h = 1e-5
    value, slope = jax.jit(jax.value_and_grad(captured))(1.5)
    np.testing.assert_allclose(value, truth(1.5), atol=1e-10)
    np.testing.assert_allclose(slope, (truth(1.5 + h) - truth(1.5 - h)) / (2 * h), atol=1e-8)
    found = jax.vmap(captured)(jnp.array([0.5, 1.5]))
    np.testing.assert_allclose(found, [truth(0.5), truth(1.5)], atol=1e-10)
    # a batch of bridges
    made = jax.vmap(lambda rate: bridge(lambda t, x, args: -rate * x))(jnp.array([0.5, 1.5]))
    found = jax.vmap(lambda b: b.log_weight(NOISE))(made)
    np.testing.assert_allclose(found, [truth(0.5), truth(1.5)], atol=1e-10)


class Rate(eqx.Module):
    rate: jax.Array

    def __call__(self, t, x, args):
        return -self.rate * x

    def drift(self, t, x, args):
        return -self.rate * x * args["one"][0]


def loop(t, x, args):
    return jax.lax.fori_loop(0, 2, lambda i, y: y + jnp.sin(t) * x, x)


def branch(t, x, args):
    return jax.lax.cond(x[0] > t, lambda y: y, lambda y: -y, x)


def drawn(t, x, args):
    return x * jax.random.normal(jax.random.key(3), x.shape)


def called_back(t, x, args):
    return jax.pure_callback(lambda x: np.sin(x), x, x)


X3 = jnp.array([0.3, -0.2, 0.9])
ARGS = {"one": [jnp.ones(())], "matrix": jnp.eye(3)}
FUNCTIONS = {
    "module": Rate(jnp.asarray(2.0)),
    "method-of-a-module": Rate(jnp.asarray(2.0)).drift,
    "partial-pytree": jax.tree_util.Partial(lambda rate, t, x, args: -rate * x, jnp.asarray(2.0)),
    "pytree-of-args": lambda t, x, args: args["matrix"] @ x * args["one"][0],
    "matrix-operator": lambda t, x, args: lx.MatrixLinearOperator(args["matrix"] * x),
    "diagonal-operator": lambda t, x, args: lx.DiagonalLinearOperator(x),
    "number": lambda t, x, args: 0.5,
    "numpy": lambda t, x, args: np.ones(3, np.float32),
    "list": lambda t, x, args: [x[0], 0.5, t],
    "loop": loop,
    "branch": branch,
    "random": drawn,
    "callback": called_back,
}


@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_a_closed_sde_is_the_sde(name, dtype):
    f, x, t = FUNCTIONS[name], X3.astype(dtype), jnp.asarray(0.4, dtype)
    constant = name in ("number", "numpy")
    sde = nb.SDE(
        lambda t, x, args: -x if constant else (f(t, x, args) if "operator" not in name else x),
        f,
        ARGS,
    )
    closed = sde.closed(t, x)
    values = [(s.drift(t, x), *s.noise(t, x)) for s in (closed, sde)]
    for found, right in zip(*values, strict=True):
        assert found.dtype == right.dtype and found.shape == right.shape
        np.testing.assert_allclose(found, right, rtol=1e-6 if dtype == jnp.float32 else 1e-14)
    assert closed.closed(t, x) is closed
    assert closed.has_constant_covariance(x) == sde.has_constant_covariance(x) == constant
    assert closed.noise_size(x) == sde.noise_size(x)
    assert name == "callback" or eqx.tree_equal(sde.closed(t, x), closed)
    with pytest.raises(ValueError, match="was traced for"):
        closed.drift(t, x[:2])


def test_leaves_of_a_module_stay_parameters():
    """A closed SDE computes with the leaves that it has."""
    made = bridge(Rate(jnp.asarray(1.0)))
    assert made.sde.drift_function.rate == 1.0
    moved = eqx.tree_at(lambda b: b.sde.drift_function.rate, made, jnp.asarray(3.0))
    np.testing.assert_allclose(moved.log_weight(NOISE), truth(3.0), atol=1e-10)


def linear(t, x, args):
    return -RATE * x


def test_pickles():
    """As long as the function is what was traced."""
    globals().update(RATE=2.0)
    made = bridge(linear)
    again = pickle.loads(pickle.dumps(made))
    np.testing.assert_allclose(again.log_weight(NOISE), truth(2.0), atol=1e-10)
    globals().update(RATE=1.0)
    with pytest.raises(pickle.PicklingError, match="what it reads has changed"):
        pickle.dumps(made)


@pytest.mark.parametrize("use", ["bridge", "law", "batch", "simulate"])
@pytest.mark.parametrize("transform", [jax.vmap, jax.jit])
def test_a_value_that_has_escaped_is_refused_with_the_cure(use, transform):
    rates = jnp.ones(3) if transform is jax.vmap else jnp.ones(())
    sde = transform(lambda rate: nb.SDE(lambda t, x, args: -rate * x, diffusion))(rates)
    with pytest.raises(
        ValueError, match="`drift` captured a value of a traced.*`args`.*`equinox.Module`"
    ):
        if use == "bridge":
            nb.GuidedBridge(sde, MATCH.at([0.2]), x0=X0, t1=1.0, num_steps=3)
        elif use == "law":
            nb.DiffusionEndpoint(sde, X0, MATCH, t1=1.0, num_steps=3)
        elif use == "batch":
            nb.DiffusionEndpoint(sde, X0, MATCH, t1=1.0, num_steps=3, batch_shape=(3,))
        else:
            nb.simulate(sde, X0, np.linspace(0, 1, 4), np.zeros((3, 1, 1)))


def test_a_batch_of_sdes():
    """Parameters in `args`, and what the functions capture shared."""
    scale = np.full((1, 1), 1.0)
    sdes = jax.vmap(lambda rate: nb.SDE(lambda t, x, args: -args * (scale @ x), diffusion, rate))(
        jnp.array([1.0, 3.0])
    )
    law = nb.DiffusionEndpoint(sdes, X0, MATCH, t1=1.0, num_steps=STEPS, batch_shape=(2,))
    found = law.given(jnp.broadcast_to(NOISE, (2, *NOISE.shape))).log_prob(jnp.full((2, 1), DATUM))
    np.testing.assert_allclose(found, [truth(1.0), truth(3.0)], atol=1e-10)


# Other functions of a user.


def guide(network, context=None):
    one = jnp.ones(())
    size = 0 if context is None else 1
    standard = Standard(
        one, one, jnp.zeros((1, 1)), jnp.ones((1, 1)), jnp.zeros(size), jnp.ones(size)
    )
    standard = eqx.tree_at(lambda s: s.scale, standard, jnp.ones((1, 1)))
    return nb.ScoreGuide(nb.FrozenGuide(), network, standard, context)


def test_networks_and_contexts_are_read_anew():
    """A learned guide that adds c to the score moves the path by what c is now, through a bridge
    and through a law.
    """
    settings = {"c": 1.0}
    by_network = guide(lambda t, x, v, theta: settings["c"] * jnp.ones_like(x))
    by_context = guide(
        lambda t, x, v, theta: theta * jnp.ones_like(x), lambda sde: settings["c"] * jnp.ones(1)
    )

    def of_bridge(guide):
        return bridge(linear, guide=guide).log_weight(NOISE)

    def of_law(guide):
        law = nb.DiffusionEndpoint(
            nb.SDE(linear, diffusion), X0, MATCH, t1=1.0, num_steps=STEPS, guide=guide
        )
        return law.given(NOISE).log_prob(jnp.array([DATUM]))

    for door in (of_bridge, of_law):
        found = {}
        for c in (1.0, 4.0):
            settings["c"] = c
            found[c] = [door(by_network), door(by_context)]
            np.testing.assert_allclose(*found[c], atol=1e-10)
        assert abs(found[1.0][0] - found[4.0][0]) > 0.1


def test_scores_to_compare_with_are_read_anew():
    """E ∫ |c s|² / ∫ |s|² of the score (1 + c) s is c² / (1 + c)² where the guide's is s: a closed
    form.
    """
    made, settings = bridge(linear), {"c": 0.0}

    def score(t, x):
        return (1 + settings["c"]) * made.score(t, x)

    for c in (0.0, 1.0):
        settings["c"] = c
        found = nb.compare({"a": made}, jax.random.key(0), num_particles=2, score=score)
        np.testing.assert_allclose(found.rows["a"]["score_error"], c**2 / (1 + c) ** 2, atol=1e-10)


# When a function is called.


def test_no_function_is_called_outside_the_interval():
    """Times that are numbers lie in [t0, t1], where the coefficients are defined."""
    seen = []

    def time(t):
        if not isinstance(t, jax.core.Tracer):
            seen.append(float(t))  # a number where nothing is traced
        return t

    def drift(t, x, args):
        return -x / time(t)

    def wide(t, x, args):
        return 0.5 / time(t) * jnp.ones((1, 2))

    t0, t1 = 1.0, 2.0
    grid = np.linspace(t0, t1, STEPS + 1)
    for match in (MATCH, nb.ExactMatch()):
        sde = nb.SDE(drift, wide)
        made = nb.GuidedBridge(sde, match.at([DATUM]), x0=X0, t0=t0, t1=t1, num_steps=STEPS)
        assert made.noise_shape == (STEPS, 2, 1) and np.all(np.isfinite(made.end()[1]))
    law = nb.DiffusionEndpoint(sde, X0, MATCH, t0=t0, t1=t1, num_steps=STEPS)
    assert law.noise_prior().event_shape == (STEPS, 2, 1)
    nb.simulate(sde, X0, grid, np.zeros((STEPS, 2, 1)))
    assert all(t0 <= t <= t1 for t in seen)
    mean, variance, dt = 1.0, 0.0, 1 / STEPS
    for t in grid[:-1]:
        mean, variance = mean * (1 - dt / t), variance * (1 - dt / t) ** 2 + dt * 2 * 0.25 / t**2
    right = scipy.stats.norm(mean, np.sqrt(variance + VARIANCE)).logpdf(DATUM)
    np.testing.assert_allclose(
        law.given(np.zeros((STEPS, 2, 1))).log_prob(jnp.array([DATUM])), right, atol=1e-10
    )


# What a function returns.

ZERO = lambda t, x, args: 0 * x  # noqa: E731
WRONG = [
    ("none", lambda t, x, a: None, None, r"`drift\(t, x, args\)` must be a number.*got None"),
    ("complex", lambda t, x, a: x * 1j, None, r"`drift\(t, x, args\)` must be.*complex"),
    ("text", lambda t, x, a: "fast", None, r"`drift\(t, x, args\)`.*got 'fast'"),
    ("boolean", lambda t, x, a: x > 0, None, r"`drift\(t, x, args\)`.*bool"),
    (
        "pair",
        lambda t, x, a: (x, x),
        None,
        r"`drift` must return an array shaped like the state, \(3,\); got \(2, 3\)",
    ),
    ("scalar", lambda t, x, a: 0.0, None, r"`drift` must return .*\(3,\); got \(\)"),
    ("column", lambda t, x, a: x[:, None], None, r"`drift` must return .*got \(3, 1\)"),
    ("no-noise", ZERO, lambda t, x, a: None, r"`diffusion\(t, x, args\)` must be.*got None"),
    ("complex-noise", ZERO, lambda t, x, a: 1j, r"`diffusion\(t, x, args\)` must be.*real part"),
    ("short-noise", ZERO, lambda t, x, a: x[:2], r"`diffusion` must be .*got \(2,\)"),
    ("no-columns", ZERO, lambda t, x, a: jnp.ones((3, 0)), r"`diffusion` must be .*got \(3, 0\)"),
    (
        "three-axes",
        ZERO,
        lambda t, x, a: jnp.ones((3, 1, 1)),
        r"`diffusion` must return .*got shape \(3, 1, 1\)",
    ),
    (
        "operator",
        ZERO,
        lambda t, x, a: lx.DiagonalLinearOperator(x[:2]),
        r"`diffusion` must be .*got \(2,\)",
    ),
]


@pytest.mark.parametrize("name, drift, diffusion, message", WRONG, ids=[row[0] for row in WRONG])
def test_wrong_values_are_refused(name, drift, diffusion, message):
    sde = nb.SDE(drift, diffusion or (lambda t, x, args: 0.5))
    for use in (
        lambda: nb.GuidedBridge(sde, MATCH.at(X3), x0=X3, t1=1.0, num_steps=2),
        lambda: nb.DiffusionEndpoint(sde, X3, MATCH, t1=1.0, num_steps=2),
        lambda: nb.simulate(sde, X3, np.linspace(0, 1, 3), np.zeros((2, 3, 1))),
    ):
        with pytest.raises(ValueError, match=message):
            use()


SPACES = {
    "BrownianMotion": lambda space: nb.BrownianMotion(0.5, space=space),
    "LinearSDE": lambda space: nb.LinearSDE(-1.0, 0.5, space=space),
    "SDE": lambda space: nb.SDE(ZERO, lambda t, x, args: 0.5, space=space),
    "SemilinearSDE": lambda space: nb.SemilinearSDE(-1.0, ZERO, 0.5, space=space),
}


@pytest.mark.parametrize("name", SPACES)
def test_wrong_spaces_are_refused(name):
    make = SPACES[name]
    for wrong in ("s", 3, nb.Landmarks):
        with pytest.raises(ValueError, match="`space` must be a space, such as"):
            make(wrong)
    for wrong in (nb.Landmarks(4, 2), nb.Landmarks(3, 1), nb.FourierBasis(2, 2)):
        assert make(wrong).space is wrong
        with pytest.raises(
            ValueError, match=r"`x0`, a state of this `space`, must have shape .*got \(3, 2\)"
        ):
            nb.GuidedBridge(
                make(wrong), MATCH.at(np.ones((3, 2))), x0=np.ones((3, 2)), t1=1.0, num_steps=2
            )
    nb.GuidedBridge(make(nb.Landmarks(3, 1)), MATCH.at(X3), x0=X3, t1=1.0, num_steps=2)
