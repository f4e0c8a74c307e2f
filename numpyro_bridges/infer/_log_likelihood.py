"""The log likelihood of each datum, its noise and the effects of its unit integrated out.

With θ what all data share, z_i the driving noise of datum i and u_i the latent sites of its plate,

    p(v_i | θ) = ∫ p(u_i | θ) N(z_i; 0, I) p(v_i | θ, u_i, z_i) du_i dz_i

is the mean over k of the weights w_k = p(v_i | θ, u_k, z_k) p(u_k | θ) / q(u_k | θ), with z_k from
its prior and u_k from q, a mixture of the prior of u_i and of a Student distribution fitted to its
posterior draws.

**One of the K points is that of the chain.** Given θ it has the density
q(u) N(z) w(u, z) / p(v_i | θ), so that all K together have that of the pseudo-marginal method
[@andrieu2009], the product of all q(u_k) N(z_k) times p̂ / p(v_i | θ), p̂ being the mean of the
weights, in which

    E[1 / p̂ | θ] = ∫ q N (p̂ / p(v_i | θ)) (1 / p̂) = 1 / p(v_i | θ)

for every K. Leave-one-out asks for the posterior mean of this inverse: K does not bias it, and the
spread of the ratios, which is that of single weights at K = 1, falls with K. With fresh points
alone E[1 / p̂] is too large, by the relative variance of p̂. Where the run has not kept the noise,
fresh points are all that there is.
"""

import math
import warnings
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import numpyro.distributions as dist
from jax import Array
from numpyro.distributions import biject_to
from numpyro.distributions.util import sum_rightmost
from numpyro.infer import MCMC
from numpyro.ops.provenance import eval_provenance

from .. import weights
from .._checks import positive_integer, require_key
from .._devices import gather, spread
from ..distributions import DiffusionTree
from ._draws import is_datum, mask_of, model_of, spaced, surely_heavy, with_noise
from ._posterior import Sites, is_latent, is_noise, sites_of
from ._reference import Reference, from_moments, if_finite

_DRAWS = 200
_LEAST_PARTICLES = 8
"""Fewer have no mean to which one of them can be compared."""
_EQUAL = 0.01
"""Logarithms of weights that differ by less, from those of the others, are equal."""
_FROM_PRIOR = 0.2
"""Of the points of u: their weights are at most 5 times the likelihood, whatever the fit."""
_TAILS = 5
"""Degrees of freedom of the Student distribution."""


class LogLikelihood(NamedTuple):
    """The log likelihood of each datum, integrated. `str` of it has a line for each site.

    - `values`: by site, `(chains, draws, *data)`.
    - `standard_error`: by site, `(*data)`: of the value at one draw, in nats, from the fresh
      weights. Averages over draws have far less. 0 where nothing was integrated.
    - `pareto_k`: by site, `(*data)`: k̂ of the fresh weights of all draws, each relative to the
      mean of the others. -inf where nothing was integrated.
    - `sites`: by name, the observed sites that are left out together, mostly one.
    - `draws`: which of each chain. `num_particles`: K.
    """

    values: dict[str, np.ndarray]
    standard_error: dict[str, np.ndarray]
    pareto_k: dict[str, np.ndarray]
    sites: dict[str, tuple[str, ...]]
    draws: np.ndarray
    num_particles: int

    def __str__(self) -> str:
        lines = [
            f"{name}: {error.size} data, standard error at one draw at most {np.max(error):.2g}, "
            f"k̂ at most {np.max(self.pareto_k[name]):.2f}"
            for name, error in self.standard_error.items()
        ]
        return "\n".join(
            [f"{len(self.draws)} draws of each chain, {self.num_particles} particles", *lines]
        )


def log_likelihood(
    mcmc: MCMC, key: Array | None = None, *, num_particles: int = 16, draws: int | None = None
) -> LogLikelihood:
    """The log likelihood log p(v_i | θ) of each datum, at draws of the parameters that all share.

    The driving noise of a datum is integrated out by guided paths, and with it the latent sites in
    the same plates as the datum, such as an effect of each specimen. An ordinary site of NumPyro
    without such latent sites has its ordinary log likelihood.

        arviz.loo(nb.to_arviz(mcmc, log_likelihood=nb.log_likelihood(mcmc, num_particles=64)))

    **Arguments:**

    - `mcmc`: after `run`, with any kernel of a model.
    - `key`: of the paths; by default the same always.
    - `num_particles`: K, the points of noise and effects by which each datum is integrated at each
      draw, at least 8.
    - `draws`: how many draws of all chains together, evenly spaced. By default 200, or all where
      nothing is integrated. The cost is that of the log likelihood of all data, `draws *
      num_particles` times.

    **Returns:** a `LogLikelihood`. Sites that share an effect are left out together, under the
    names of both, `wing+leg`. Latent sites are as in the draws where they are in other plates than
    the datum, such as those of its group, or reach data in other plates. A `DiffusionTree` has one
    value for each seen node, given all other nodes: the noise of a tip's branch is integrated out,
    that of other branches is as in the draws, which is what leaving out one node asks for
    (`DiffusionTree.log_prob_by_node`). `handlers.scale` does not enter, and masked data have 0.
    Left out are sites that need what the run has not kept, other than the noise and the effects of
    data, and, with a warning, data in a `scan` that noise drives.

    **Errors:** `ValueError` for a kernel without a model. `UserWarning` where a k̂ is above
    `pareto_k_threshold` by two standard errors: of many data some k̂ are large by chance.

    **Source:** [@vehtari2016] for integrated leave-one-out; [@merkle2019] for what the conditional
    one answers.
    """
    model, replay = model_of(mcmc)
    key = jr.key(0) if key is None else key
    require_key(key)
    num_particles = positive_integer(num_particles, "num_particles", _LEAST_PARTICLES)
    draws = None if draws is None else positive_integer(draws, "draws")
    sites = sites_of(model, mcmc._args, mcmc._kwargs)
    parts = _parts(sites, replay)
    samples = mcmc.get_samples(group_by_chain=True)
    chains, length = next(iter(samples.values())).shape[:2]
    integrated = any(part.fresh or part.tips for part in parts)
    wanted = math.ceil((draws or (_DRAWS if integrated else chains * length)) / chains)
    numbers, at = _latent_draws(mcmc, sites, wanted)
    parts = [part for part in parts if part.needs <= set(at)]
    own = all(name in at for part in parts for name in part.fresh)
    proposals = _proposals(parts, samples, sites, replay)
    chosen = (np.arange(chains)[:, None] * length + numbers).ravel()
    means = {name: mean[chosen] for name, (mean, _) in proposals.items()}

    def at_draw(values, means, key):
        laws = {
            name: dist.MultivariateStudentT(_TAILS, mean, proposals[name][1])
            for name, mean in means.items()
        }

        def at_point(key, is_own):
            return _log_weights(parts, laws, replay, values, key, is_own)

        return jax.vmap(at_point)(jr.split(key, num_particles), np.arange(num_particles) < own)

    # every device takes its draws one after the other: the points of one are a batch already
    run = jax.jit(spread(at_draw, batch_size=1))
    found = gather(run(at, means, jr.split(key, len(chosen)))) if parts else {}
    values = {}
    errors = {}
    shapes = {}
    for name, log_weights in found.items():
        log_weights = np.moveaxis(np.asarray(log_weights), 1, -1)  # (draws, *data, K)
        mean = np.asarray(weights.log_mean_exp(jnp.asarray(log_weights)))
        values[name] = mean.reshape(chains, len(numbers), *mean.shape[1:])
        errors[name], shapes[name] = _quality(log_weights, int(own))
    _warn_of_tails(shapes, num_particles * len(chosen))
    together = {part.name: part.sites for part in parts}
    return LogLikelihood(values, errors, shapes, together, numbers, num_particles)


class _Part(NamedTuple):
    """Data that are left out together, and what is integrated out with them.

    `noise`, `effects`: sites that are drawn anew. `tips`: noise of trees, of which that of the tips
    is. `needs`: latent sites whose values must be known.
    """

    sites: tuple[str, ...]
    noise: tuple[str, ...]
    effects: tuple[str, ...]
    tips: tuple[str, ...]
    needs: frozenset[str]

    @property
    def name(self) -> str:
        return "+".join(self.sites)

    @property
    def fresh(self) -> tuple[str, ...]:
        return self.noise + self.effects


_NONE = {"type": "none"}


def _latent_draws(mcmc, sites, wanted):
    """Which draws of each chain, evenly spaced, and their latent sites, those of all chains one
    after the other. With their noise, unless too few have kept theirs.
    """
    samples = mcmc.get_samples(group_by_chain=True)
    length = next(iter(samples.values())).shape[1]
    numbers, driving = with_noise(mcmc)
    if len(numbers) < min(wanted, length):
        numbers = np.arange(length)
        driving = samples
    places = spaced(len(numbers), wanted)
    at = {
        name: _flat(value[:, places])
        for name, value in driving.items()
        if is_latent(sites.get(name, _NONE))
    }
    return numbers[places], at


def _flat(values):
    """Draws of all chains, one after the other."""
    return values.reshape(-1, *values.shape[2:])


def _dependences(sites, replay, data):
    """For each site the latent sites that its law or value depends on, and the reverse."""
    latent = {name: site["value"] for name, site in sites.items() if is_latent(site)}

    def log_probs(**values):
        found = replay(lambda site: values.get(site["name"]), [*data, *latent])
        return {name: law.log_prob(value) for name, (law, value) in found.items()}

    sources = eval_provenance(log_probs, **latent)
    sources = {name: set(found) - {name} for name, found in sources.items()}
    users = {name: {user for user, found in sources.items() if name in found} for name in latent}
    return sources, users


def _parts(sites, replay) -> list[_Part]:
    data = [name for name, site in sites.items() if is_datum(site)]
    sources, users = _dependences(sites, replay, data)
    noise = {name for name in users if is_noise(sites[name])}
    in_loops = {
        name for name in data if sites[name].get("_control_flow_done") and sources[name] & noise
    }
    if in_loops:
        warnings.warn(
            f"{sorted(in_loops)} are data in a `scan`, where a noise may reach later data: they "
            "get no log likelihood.",
            stacklevel=3,
        )
    local = _local(sites, data, users)
    parts = []
    remaining = [name for name in data if name not in in_loops]
    while remaining:
        together, inside = _together(remaining[0], data, local, sources, users)
        remaining = [name for name in remaining if name not in together]
        needs = {source for name in together | inside for source in sources[name]} - inside
        blocks = {
            name
            for name in needs & noise
            if users[name] == together and sites[name]["infer"].get("blocks")
        }
        parts.append(
            _Part(
                tuple(name for name in data if name in together),
                tuple(sorted(inside & noise)),
                tuple(name for name in sites if name in inside - noise),  # as the model draws them
                tuple(sorted(blocks)),
                frozenset(needs),
            )
        )
    return parts


def _together(first, data, local, sources, users) -> tuple[set[str], set[str]]:
    """Data that share local sites with the first, directly or by others, and these sites."""
    together = {first}
    inside = set()
    while True:
        found = {source for name in together | inside for source in sources[name] & local}
        joined = together | {user for name in found for user in users[name] if user in data}
        if found == inside and joined == together:
            return together, inside
        together = joined
        inside = found


def _local(sites, data, users) -> set[str]:
    """Latent sites that reach nothing but data of their own plates, directly or by such sites."""

    def may_be(name):
        site = sites[name]
        effect = bool(site["cond_indep_stack"]) and not site["fn"].support.is_discrete
        return (is_noise(site) or effect) and not site.get("_control_flow_done")

    def of_one_datum(name, user):
        """A tree is none: what is left out of it is a node."""
        one = sites[name]
        other = sites[user]
        alike = set(one["cond_indep_stack"]) == set(other["cond_indep_stack"])
        alike &= one["fn"].batch_shape == other["fn"].batch_shape
        whole = not isinstance(other["fn"], DiffusionTree) and not other.get("_control_flow_done")
        return alike and whole and (user in data or user in local)

    local = {name for name in users if may_be(name)}
    while True:
        kept = {
            name
            for name in local
            if users[name] and all(of_one_datum(name, user) for user in users[name])
        }
        if kept == local:
            return local
        local = kept


def _proposals(parts, samples, sites, replay):
    """For each part that has effects, if the run has kept them: what its draws say of them."""
    fitted = {}
    for part in parts:
        if part.effects and set(part.effects) <= set(samples):
            fitted[part.name] = _fitted(part, samples, sites, replay)
    return fitted


def _fitted(part: _Part, samples, sites, replay):
    """What the draws say of the effects of each unit: means `(draws, *data, d)`, and a factor.

    All unconstrained. The means are a linear regression on the shared parameters, where there are
    10 draws or more for each; the factor is that of the covariance of what is left.
    """
    shared = [name for name in sorted(part.needs) if not sites[name]["fn"].support.is_discrete]
    shared = [name for name in shared if not is_noise(sites[name]) and name in samples]
    draws = {
        name: _flat(value) for name, value in samples.items() if is_latent(sites.get(name, _NONE))
    }
    draws = {name: value for name, value in draws.items() if not is_noise(sites[name])}

    def unconstrained(draw):
        found = replay(lambda site: draw.get(site["name"]), [*shared, *part.effects])
        return {name: _inverse(law, value) for name, (law, value) in found.items()}

    found = jax.jit(jax.vmap(unconstrained))(draws)
    effects = jnp.concatenate([found[name] for name in part.effects], axis=-1)
    size = len(effects)
    mean = jnp.mean(effects, axis=0)
    rest = effects - mean
    g = jnp.concatenate(
        [jnp.zeros((size, 0)), *(found[name].reshape(size, -1) for name in shared)], axis=1
    )
    if 0 < 10 * g.shape[1] <= size:
        g = g - jnp.mean(g, axis=0)
        explained = g @ jnp.linalg.lstsq(g, rest.reshape(size, -1))[0]
        rest = rest - explained.reshape(rest.shape)
    squares = jnp.einsum("s...d,s...e->...de", rest, rest)

    @partial(jnp.vectorize, signature="(d),(d,d)->(d,d)")
    def factor(mean, squares):
        """1 where draws do not vary: any will do, since points have weights."""
        unit = Reference(mean, jnp.eye(mean.size))
        return if_finite(from_moments(mean, squares, size), unit).scale

    return effects - rest, factor(mean, squares)


def _inverse(law, value):
    """The unconstrained value of each datum as a vector."""
    return jnp.reshape(biject_to(law.support).inv(value), (*law.batch_shape, -1))


def _log_weights(parts, laws, replay, values: Sites, key, is_own) -> Sites:
    """Of every part at one point of noise and effects, that of the chain or a new one.

    `laws`: those from which effects are drawn, besides their prior.
    """
    names = sorted({name for part in parts for name in (*part.fresh, *part.tips)})
    key_laws, *keys = jr.split(key, 1 + len(names))
    keys = dict(zip(names, keys, strict=True))
    tips = {name for part in parts for name in part.tips}
    drawn = {effect: part.name for part in parts if part.name in laws for effect in part.effects}
    mixed = _mixed(laws, key_laws)
    # how many numbers of each point the effects that the model has drawn so far have taken
    used = dict.fromkeys(mixed, 0)

    def value_of(site):
        name = site["name"]
        if name not in keys:
            return values.get(name)
        law = site["fn"]
        new = law.sample(keys[name])
        if name in tips:
            at_tip = _rows_of_tips(site["infer"]["blocks"])[:, None, None]
            return jnp.where(at_tip & ~is_own, new, values[name])
        if name in drawn:
            choice, point = mixed[drawn[name]]
            transform = biject_to(law.support)
            shape = transform.inverse_shape(jnp.shape(new))
            start = used[drawn[name]]
            used[drawn[name]] = stop = start + math.prod(shape[len(law.batch_shape) :])
            fitted = transform(point[..., start:stop].reshape(shape))
            new = jnp.where(choice.reshape(choice.shape + (1,) * law.event_dim), new, fitted)
        return jnp.where(is_own, values[name], new) if name in values else new

    found = replay(value_of, [name for part in parts for name in (*part.sites, *part.effects)])
    return {part.name: _log_weight(part, laws.get(part.name), found) for part in parts}


def _log_weight(part: _Part, proposal, found):
    """Of the data of a part, from the laws and values of its sites."""
    total = sum((_log_prob(*found[name]) for name in part.sites), start=jnp.zeros(()))
    if proposal is None:
        return total
    return total + _correction(proposal, [found[name] for name in part.effects])


def _mixed(laws, key):
    """Of each part: a point from its Student law, and where the prior is to be drawn from."""
    found = {}
    for i, (name, law) in enumerate(laws.items()):
        key_point, key_choice = jr.split(jr.fold_in(key, i))
        point = law.sample(key_point)
        found[name] = jr.bernoulli(key_choice, _FROM_PRIOR, point.shape[:-1]), point
    return found


def _log_prob(law, value):
    return law.log_prob_by_node(value) if isinstance(law, DiffusionTree) else law.log_prob(value)


def _correction(proposal, effects):
    """log p(u | θ) / q(u | θ) of each datum."""
    prior = 0.0
    seen = jnp.ones((), bool)
    for law, value in effects:
        transform = biject_to(law.support)
        log_det = transform.log_abs_det_jacobian(transform.inv(value), value)
        inner = jnp.ndim(log_det) - len(law.batch_shape)
        prior += law.log_prob(value) + sum_rightmost(log_det, inner)
        mask = mask_of(law)
        if mask is not None:  # what is masked has no density, and no weight
            seen &= mask
    point = jnp.concatenate([_inverse(law, value) for law, value in effects], axis=-1)
    fitted = proposal.log_prob(point) + math.log(1 - _FROM_PRIOR)
    return jnp.where(seen, prior - jnp.logaddexp(prior + math.log(_FROM_PRIOR), fitted), 0.0)


def _rows_of_tips(blocks):
    """Rows of the noise of a tree that belong to branches which no other follows."""
    inner = set(blocks.above)
    return np.repeat([block not in inner for block in range(len(blocks.sizes))], blocks.sizes)


def _quality(log_weights, own):
    """Standard error at one draw, and k̂, of weights `(draws, *data, K)`; `own` are not new."""
    size = log_weights.shape[-1]
    total = np.logaddexp.reduce(log_weights, axis=-1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = np.where(total == -np.inf, 1 / size, np.exp(log_weights - total))
        # without the largest the sum is taken anew: its difference from the total may be rounding
        largest = np.arange(size) == np.argmax(log_weights, axis=-1)[..., None]
        rest = np.where(largest, -np.inf, log_weights)
        others = np.where(
            largest,
            np.logaddexp.reduce(rest, axis=-1, keepdims=True),
            total + np.log1p(-shares),
        )
        ratios = log_weights - (others - np.log(size - 1))
    ratios = np.where(log_weights == -np.inf, -np.inf, ratios)[..., own:]
    ratios = np.moveaxis(ratios, 0, -2).reshape(*log_weights.shape[1:-1], -1)
    # weights that are equal but for rounding have no tail to be judged by
    equal = np.all(np.abs(ratios) < _EQUAL, axis=-1, keepdims=True)
    shapes = weights.pareto_k(jnp.asarray(np.where(equal, 0.0, ratios)))
    variance = np.var(shares[..., own:], axis=-1, ddof=1)  # of K weights with mean 1/K
    return np.sqrt(size * np.mean(variance, axis=0)), np.asarray(shapes)


def _warn_of_tails(shapes, size):
    for name, k in shapes.items():
        places = np.argwhere(np.isnan(k) | surely_heavy(k, size))
        if len(places):
            which = ", ".join(str(tuple(map(int, place))) for place in places[:5])
            warnings.warn(
                f"`{name}`: the weights by which {len(places)} of {k.size} data are integrated "
                f"have too heavy a tail, k̂ up to {np.max(k):.2f} (data {which}). Choose a better "
                "guide.",
                stacklevel=3,
            )
