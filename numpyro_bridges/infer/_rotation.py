"""Moves on pytrees: the exact flow of ½ |x|² + ½ |p|², kicks, trajectories, acceptance."""

import jax
import jax.numpy as jnp
import jax.random as jr


def rotate(x, p, angle):
    """x and p after a time: one for all, or a pytree of times."""
    # x' = p, p' = −x: a rotation, which keeps N(0, I) for x and p whatever the angle
    angle = _for_every_leaf(angle, x)
    new_x = jax.tree.map(lambda x, p, a: jnp.cos(a) * x + jnp.sin(a) * p, x, p, angle)
    new_p = jax.tree.map(lambda x, p, a: jnp.cos(a) * p - jnp.sin(a) * x, x, p, angle)
    return new_x, new_p


def kick(p, force, time):
    """p after the force has acted for a time, and the change of ½ p² of each coordinate."""
    time = _for_every_leaf(time, p)
    # ½ (p + t f)² − ½ p², without the difference of two large numbers
    change = jax.tree.map(lambda p, f, t: (p + 0.5 * t * f) * t * f, p, force, time)
    return jax.tree.map(lambda p, f, t: p + t * f, p, force, time), change


def _for_every_leaf(value, x):
    """A pytree like x as it is, one value for all of x."""
    alike = jax.tree.structure(value) == jax.tree.structure(x)
    return value if alike else jax.tree.map(lambda _: value, x)


def trajectory(value_and_grad, x, p, value, gradient, angle, num_steps):
    """Steps of kick, turn by `angle`, kick, in the field of a potential Ψ: x, p, Ψ and ∇Ψ at the
    end, and the work.

    `value_and_grad(x)` gives ∇Ψ and, as `value`, whatever is wanted of the end. The change of ½
    |x|² + ½ |p|² is the work of the kicks, so that the energy's error is the change of Ψ and the
    work.
    """
    half = 0.5 * angle

    def leap(_, carry):
        x, p, gradient, _, work = carry
        # the force is −∇Ψ
        p, before = kick(p, gradient, -half)
        x, p = rotate(x, p, angle)
        value, gradient = value_and_grad(x)
        p, after = kick(p, gradient, -half)
        return x, p, gradient, value, work + total(before) + total(after)

    start = x, p, gradient, value, jnp.zeros_like(total(p))
    x, p, gradient, value, work = jax.lax.fori_loop(0, num_steps, leap, start)
    return x, p, value, gradient, work


def metropolis(key, error: jax.Array):
    """Acceptance probabilities exp(-error), 0 where it is NaN, and decisions drawn with them."""
    # NaN is an energy that could not be computed: such a point is never accepted
    error = jnp.where(jnp.isnan(error), jnp.inf, error)
    rate = jnp.exp(-jnp.maximum(error, 0.0))
    return rate, jr.uniform(key, rate.shape, rate.dtype) < rate


def choose(condition, new, old):
    """Of two pytrees, the new one where a condition holds."""
    return jax.tree.map(lambda new, old: jnp.where(condition, new, old), new, old)


def half_square(x):
    """½ |x|²."""
    return 0.5 * total(jax.tree.map(jnp.square, x))


def total(x) -> jax.Array:
    return sum((jnp.sum(leaf) for leaf in jax.tree.leaves(x)), start=jnp.zeros(()))


def normal_like(key, x, shape: tuple[int, ...] = ()):
    """Standard normal draws, with further axes in front."""
    # a key for each leaf: with one for all, leaves of one shape would be equal
    leaves, treedef = jax.tree.flatten(x)
    keys = jr.split(key, len(leaves))
    draws = [jr.normal(k, shape + a.shape, a.dtype) for k, a in zip(keys, leaves, strict=True)]
    return jax.tree.unflatten(treedef, draws)
