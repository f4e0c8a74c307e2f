"""Sites with driving noise: a primitive, and a handler that does the same for `numpyro.sample`."""

import numpyro
from numpyro import handlers
from numpyro.infer.reparam import Reparam
from numpyro.primitives import _PYRO_STACK

from .._checks import require, require_mapping, words
from ._batch import as_datum
from ._driving_noise import DrivingNoise, MissingNoise
from ._noise_driven import AbstractNoiseDriven


def sample(name: str, law: AbstractNoiseDriven, obs=None, *, infer: dict | None = None):
    """`numpyro.sample` for a law that is driven by noise: a site for the noise, then the site of
    the observation.

        noise = numpyro.sample(f"{name}_noise", law.noise_prior(), infer={"driving_noise": True})
        value = numpyro.sample(name, law.given(noise), obs=obs)

    Inside plates every datum has its own noise. Unobserved, the site simulates. The noise in
    posterior draws belongs to the data that were seen: leave it out of what `Predictive` is given
    where the number of data changes. The mark of a tree's noise also holds its branches,
    `{"driving_noise": True, "blocks": law.noise_blocks}`. `handlers.scale` multiplies both log
    densities, as minibatches of a plate need; it does not temper the likelihood, since the integral
    of a power is no power of the integral.

    **Arguments:** `law`: a `DiffusionEndpoint`. `obs`: what was seen, shaped as the law, plates in
    front. `infer`: for the observed site.

    **Returns:** the observation.
    """
    require(
        isinstance(name, str), f"`name` must be the text that names the site; got {words(name)}."
    )
    require_mapping(infer, "infer")
    law, obs = _with_noise(name, law, obs)
    return numpyro.sample(name, law, obs=obs, infer=infer)


class NoiseReparam(Reparam):
    """Lets plain `numpyro.sample(name, law, obs=...)` do what `numpyro_bridges.sample` does.

    model = numpyro.handlers.reparam(model, config={"wing": NoiseReparam()})
    """

    def __call__(self, name, fn, obs):
        return _with_noise(name, fn, obs)


def _with_noise(name, law, obs):
    """The law with its noise bound, and the datum as an array."""
    require(
        isinstance(law, AbstractNoiseDriven),
        f"site `{name}`: `law` must be driven by noise, such as `DiffusionEndpoint`; got "
        f"{type(law).__name__}. Wrap a law by its own methods, `law.expand`, `law.mask` and "
        "`law.to_event`, which keep the noise.",
    )
    site = f"{name}_noise"
    # how kernels of MCMC find the noise among the sites, and the branches within it
    mark: dict = {"driving_noise": True}
    if law.noise_blocks is not None:
        mark["blocks"] = law.noise_blocks
    try:
        # a trace of its own, since plates are known to a site only after it is sampled
        with handlers.trace() as own:
            noise = numpyro.sample(site, law.noise_prior(), infer=mark)
    except MissingNoise as e:
        raise ValueError(
            f"site `{site}` has no value, and there is no random key to draw one: the draws do "
            f"not hold the noise that drives `{name}`. Keep it in the run (no `~z.{site}` in "
            "`extra_fields`; `keep_noise` of `run_checkpointed`), or integrate it out, "
            "`numpyro_bridges.log_likelihood`."
        ) from e
    plates = next(iter(own.values()))["cond_indep_stack"]
    # enumeration puts axes to the left of all plates: a law that has some depends on such a site
    outermost = max((-plate.dim for plate in plates), default=0)
    require(
        len(law.batch_shape) <= outermost or not any(map(_enumerates, _PYRO_STACK)),
        f"site `{name}`: the law depends on a discrete site that is enumerated, and its noise "
        "cannot be: all classes share it. Sum over the classes of a bound law instead, "
        "`MixtureGeneral(Categorical(p), [law.given(noise) for law in laws])` with `noise` drawn "
        "from one `law.noise_prior()`, or draw the class in a block of `Gibbs`.",
    )
    law = law.given(noise)
    # noise from `posterior_samples` has the size of the data that it was drawn with
    for plate in plates:
        size = law.batch_shape[plate.dim] if len(law.batch_shape) >= -plate.dim else 1
        require(
            size == plate.size,
            f"site `{site}` has a value for {size} data, and the plate `{plate.name}` has "
            f"{plate.size}: noise belongs to the data that were seen. For new data leave it out "
            "of the draws that `Predictive` is given.",
        )
    # A parameter that is drawn inside the plate has its axis, and would silently be broadcast
    # into the state of every datum.
    drawn, sizes = _drawn_inside(plates)
    law.refuse_hidden_axes(sizes, drawn)
    if obs is not None:
        obs = as_datum(obs, f"obs` of site `{name}")
    seen = law.shape() if obs is None else obs.shape
    require(
        seen == law.shape(),
        f"site `{name}`: `obs` must have shape {law.shape()}, plates in front; got {seen}. Several "
        "data need a plate.",
    )
    return law, obs


def _enumerates(handler) -> bool:
    """Whether a handler is NumPyro's enumeration, imported only where funsor is installed."""
    return (
        type(handler).__module__.startswith("numpyro.contrib.funsor")
        and type(handler).__name__ == "enum"
    )


def _drawn_inside(plates) -> tuple[str, tuple[int, ...]]:
    """A site that is drawn inside some of these plates, and the sizes of those plates."""
    drawn = ""
    sizes = set()
    # a `trace` further out knows the sites before this one; every kernel has one
    for handler in _PYRO_STACK:
        for name, site in handler.trace.items() if isinstance(handler, handlers.trace) else ():
            noise = site["type"] == "sample" and isinstance(
                site["fn"], (AbstractNoiseDriven, DrivingNoise)
            )
            inside = set(site.get("cond_indep_stack", ())) & set(plates)
            if site["type"] in ("sample", "param") and not noise and inside:
                drawn = name
                sizes |= {plate.size for plate in inside}
    return drawn, tuple(sizes)
