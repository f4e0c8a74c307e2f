"""An object is what it is wherever it is built: eagerly, under `jit` or `vmap`, in a NumPyro model,
to 1e-12.

Every public class that a user builds, and every argument of it, is in the table: a new one must be
added. An argument is a constant, or `Of` a parameter that is traced where the object is built.
"""

import importlib
import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from models import CURVE, Q, R, W
from numpyro.infer.util import log_density

import numpyro_bridges as nb
from numpyro_bridges.guiding import Standard

pytestmark = [pytest.mark.numpyro, pytest.mark.usefixtures("compile_quickly")]


@dataclass(frozen=True)
class Of:
    """A value computed from the parameter."""

    value: Callable[[Any], Any]


def times(value):
    """The parameter times a constant."""
    return Of(lambda t: t * np.asarray(value))


TS = np.array([0.0, 0.4, 1.0])
X0, SEEN = CURVE, 0.7 * CURVE[::-1] + 0.1
POINTS = nb.Landmarks(3, 2, weights=W)
PICK, PAIR = np.eye(3)[[2, 0]], np.array([[1.0, 0.5, 0.0], [0.0, 1.0, -0.3]])
MASK = np.array([True, False, True])
HIDDEN = np.where(MASK[:, None], SEEN, np.nan)
INF = np.inf
KERNEL = nb.GaussianKernel(0.3, 0.7)
GBM = nb.SDE(lambda t, x, args: -x, lambda t, x, args: 0.5 + 0.2 * jnp.sin(x[:, 0]), space=POINTS)
PLAIN = nb.LinearSDE(-0.3, np.array([0.4, 0.3, 0.5]), space=POINTS)
ACTUAL = nb.InexactMatch(0.05).at(SEEN)
TREE = nb.Tree.from_newick("((a:0.5,b:0):0.3,c:1);")
SEVERAL = np.stack([SEEN, X0, 0.5 * SEEN])
ERRORS = np.array([0.05, 0.1, 0.07])
ROWS = jax.vmap(nb.InexactMatch)(ERRORS)


def noise(shape):
    return np.random.default_rng(0).normal(size=shape)


def weight_of(bridge):
    return bridge.log_weight(noise(bridge.noise_shape))


def weight(sde=GBM, condition=ACTUAL, x0=X0, **settings):
    return weight_of(nb.GuidedBridge(sde, condition, x0=x0, ts=TS, **settings))


def seen_by(datum):
    """Of a match: the weight of a bridge."""
    return lambda match: weight(PLAIN, match.at(datum))


def quartic(x, observed, args):
    """A log density that is none of a normal law."""
    square = jnp.sum((x - observed) ** 2)
    return -square / args - square**2


def site_of(datum):
    """Of a match: the law of an observation, so that a model has it as a site."""
    return lambda match: observed(nb.DiffusionEndpoint(PLAIN, X0, match, ts=TS), datum)


def observed(law, datum):
    return Site(law, noise(law.noise_prior().shape()), datum)


@dataclass(frozen=True)
class Site:
    law: Any
    noise: np.ndarray
    datum: Any


def factor_of(flow, x=X0):
    """Of a flow: a sum of the factor of its covariance."""
    sigma = flow.diffusion(0.0, x)
    return jnp.sum(sigma * noise(sigma.shape))


def stepped(sde):
    """Of a linear SDE: a sum of its exact step."""
    step = sde.exact_step(0.0, 0.4, X0)
    return jnp.sum(step.operator @ X0 + step.shift) + jnp.sum(step.covariance * noise((3, 3)))


def driven_by(field):
    """Of a noise field."""
    return factor_of(nb.KunitaFlow(POINTS, KERNEL, noise=field))


def spread_by(kernel):
    """Of a covariance."""
    return factor_of(nb.KunitaFlow(POINTS, covariance=kernel))


def among(space):
    """Of a space: that of a flow, of a match, and of a curve."""
    x = start(space)
    flow = nb.KunitaFlow(space, KERNEL, noise=nb.GridNoise(-9.0, 9.0, 9))
    condition = nb.InexactMatch(0.05, space=space).at(
        space.from_points(space.evaluate(2 * x, space.grid))
    )
    return factor_of(flow, x) + weight(nb.LinearSDE(-0.3, 0.4), condition, x)


def start(space):
    return np.linspace(-0.5, 0.9, 2 * space.size).reshape(space.size, 2)


def led_by(guide):
    return weight(guide=guide)


def network(t, x, v, theta):
    return theta[0] * jnp.cos(x + t) - 0.4 * v


STANDARD = Standard(
    *(jnp.asarray(a) for a in (0.9, 0.8, 0.1, 0.7, np.array([0.2]), np.array([0.5])))
)
LEARNED = {
    "guide": nb.Unguided(),
    "network": network,
    "standard": STANDARD,
    "context": lambda sde: jnp.ones(1),
}
MEET = {"sde": PLAIN, "condition": ACTUAL, "x0": X0}
LAW = {"sde": PLAIN, "x0": X0, "match": nb.InexactMatch(0.05), "ts": TS}
BATCH = np.stack([X0, X0 + 0.1])


# name: class, arguments, what is computed of it
TABLE: dict[str, tuple[type, dict[str, Any], Callable]] = {
    "SDE": (
        nb.SDE,
        {
            "drift": lambda t, x, args: -args * x,
            "diffusion": lambda t, x, args: args + 0.1 * x[:, 0],
            "args": times(0.6),
            "space": POINTS,
        },
        weight,
    ),
    "LinearSDE": (
        nb.LinearSDE,
        {"drift": times(np.array([-0.5, 0.0, 0.3])), "diffusion": times(0.4), "shift": times(0.1), "space": POINTS},
        weight,
    ),
    "LinearSDE, matrices": (nb.LinearSDE, {"drift": times(Q), "diffusion": times(R), "shift": times(X0)}, stepped),
    "LinearSDE, constants": (nb.LinearSDE, {"drift": Q, "diffusion": [0.4, 0.2, 0.3], "shift": times(0.1)}, stepped),
    "SemilinearSDE": (
        nb.SemilinearSDE,
        {"linear": times([-0.5, 0.0, 0.3]), "nonlinearity": lambda t, x, args: args * jnp.sin(x), "args": times(0.6)}
        | {"diffusion": times(0.4), "space": POINTS, "scheme": "midpoint"},
        weight,
    ),
    "Flattened": (
        nb.sdes.Flattened,
        {"sde": Of(lambda t: nb.LinearSDE([-0.5 * t, 0.0, 0.3], 0.4)), "dim": 2},
        lambda sde: weight(sde, nb.InexactMatch(0.05).at(np.ravel(SEEN)), np.ravel(X0)),
    ),
    "BrownianMotion": (nb.BrownianMotion, {"covariance": times(Q @ Q.T), "space": POINTS}, weight),
    "BrownianMotion, factor": (nb.BrownianMotion, {"factor": times(R), "space": POINTS}, weight),
    "KunitaFlow": (
        nb.KunitaFlow,
        {"space": POINTS, "kernel": Of(lambda t: nb.GaussianKernel(0.3 * t, 0.7)), "noise": "spectral"},
        factor_of,
    ),
    "KunitaFlow, covariance": (
        nb.KunitaFlow,
        {"space": Of(lambda t: nb.Landmarks(3, 2, t)), "covariance": nb.MaternKernel(0.4, 0.6)},
        lambda flow: factor_of(flow) + jnp.sum(flow.space.weights),
    ),
    "LandmarkNoise": (nb.LandmarkNoise, {"jitter": times(1e-3)}, driven_by),
    "ControlNoise": (nb.ControlNoise, {"num_points": 3, "points": None, "jitter": times(1e-3)}, driven_by),
    "ControlNoise, points": (nb.ControlNoise, {"points": [2, 0, 1], "jitter": times(1e-3)}, driven_by),
    "SpectralNoise": (nb.SpectralNoise, {"num_modes": 2, "period": times(4.0), "diameter": times(2.0)}, driven_by),
    "SpectralNoise, period": (nb.SpectralNoise, {"num_modes": 2, "diameter": times(2.0)}, driven_by),
    "GridNoise": (nb.GridNoise, {"lower": times(-1.5), "upper": times([1.2, 1.5]), "num_cells": 3}, driven_by),
    "GaussianKernel": (nb.GaussianKernel, {"amplitude": times(0.3), "length_scale": times(0.5)}, spread_by),
    "MaternKernel": (nb.MaternKernel, {"amplitude": times(0.3), "length_scale": times(0.5), "order": 2}, spread_by),
    "KernelCombination": (
        nb.kernels.KernelCombination,
        {"coefficients": Of(lambda t: (t, jnp.ones(()))), "kernels": (KERNEL, nb.MaternKernel(0.2, 0.4))},
        spread_by,
    ),
    "QuadratureCovariance": (
        nb.kernels.QuadratureCovariance,
        {"kernel": KERNEL, "lower": times([-1.0, -1.2]), "upper": times([1.0, 1.1]), "num_cells": (3, 4)},
        spread_by,
    ),
    "Landmarks": (nb.Landmarks, {"num_points": 3, "dim": 2, "weights": times(W)}, among),
    "FourierBasis": (nb.FourierBasis, {"num_modes": 1, "dim": 2, "num_quadrature": 5}, among),
    "SineBasis": (nb.SineBasis, {"num_modes": 3, "dim": 2, "length": 2.0, "num_quadrature": 5}, among),
    "CosineBasis": (nb.CosineBasis, {"num_modes": 2, "dim": 2, "length": 2.0, "num_quadrature": 5}, among),
    "FourierSquare": (nb.FourierSquare, {"num_modes": 1, "dim": 2, "num_quadrature": 4}, among),
    "ExactMatch": (nb.ExactMatch, {"operator": times(PAIR)}, seen_by(PAIR @ SEEN)),
    "ExactMatch, constant": (nb.ExactMatch, {"operator": PICK}, seen_by(PICK @ SEEN)),
    "ExactMatch, mask": (nb.ExactMatch, {"mask": MASK}, site_of(SEEN[MASK])),
    "ExactMatch, list": (nb.ExactMatch, {"mask": MASK.tolist()}, seen_by(SEEN[MASK])),
    "ExactMatch, JAX array": (nb.ExactMatch, {"mask": jnp.asarray(MASK)}, seen_by(SEEN[MASK])),
    "InexactMatch": (nb.InexactMatch, {"variance": times(0.05), "space": POINTS}, seen_by(SEEN)),
    "InexactMatch, vector": (nb.InexactMatch, {"variance": times([0.1, 0.2, 0.3])}, seen_by(SEEN)),
    "InexactMatch, matrix": (nb.InexactMatch, {"variance": times(Q @ Q.T), "space": POINTS}, seen_by(SEEN)),
    "InexactMatch, points": (nb.InexactMatch, {"variance": times(0.05), "operator": PICK}, site_of(PICK @ SEEN)),
    "InexactMatch, list of points": (
        nb.InexactMatch,
        {"variance": times(0.05), "operator": PICK.tolist(), "space": POINTS},
        seen_by(PICK @ SEEN),
    ),
    "InexactMatch, points by lineax": (
        nb.InexactMatch,
        {"variance": times(0.05), "operator": lx.MatrixLinearOperator(jnp.asarray(PICK))},
        seen_by(PICK @ SEEN),
    ),
    "InexactMatch, traced points": (
        nb.InexactMatch,
        {"variance": 0.05, "operator": Of(lambda t: PICK * (t > 0))},
        seen_by(PICK @ SEEN),
    ),
    "InexactMatch, operator": (
        nb.InexactMatch,
        {"variance": times(0.05), "operator": times(PAIR)},
        seen_by(PAIR @ SEEN),
    ),
    "InexactMatch, weights of rows": (
        nb.InexactMatch,
        {"variance": times(0.05), "operator": PAIR, "space": nb.Landmarks(2, 2, [0.3, 0.8])},
        seen_by(PAIR @ SEEN),
    ),
    "InexactMatch, mask": (nb.InexactMatch, {"variance": times(0.05), "mask": MASK.tolist()}, seen_by(HIDDEN)),
    "InexactMatch, traced mask": (
        nb.InexactMatch,
        {"variance": 0.05, "mask": Of(lambda t: jnp.asarray(MASK) & (t > 0)), "space": POINTS},
        seen_by(SEEN),
    ),
    "InexactMatch, kernel": (
        nb.InexactMatch,
        {"variance": times(0.05), "operator": PICK, "normalised": False},
        seen_by(PICK @ SEEN),
    ),
    "DensityMatch": (
        nb.DensityMatch,
        {"log_density": quartic, "args": times(0.4), "sample": None, "spread": times(0.3)},
        seen_by(SEEN),
    ),
    "StudentMatch": (nb.StudentMatch, {"variance": times(0.05), "degrees_of_freedom": times(4.0)}, seen_by(SEEN)),
    "HuberMatch": (nb.HuberMatch, {"variance": times(0.05), "threshold": times(2.0)}, seen_by(SEEN)),
    "ProcrustesMatch": (nb.ProcrustesMatch, {"variance": times(0.05), "up_to": "rigid"}, seen_by(SEEN)),
    "CurrentMatch": (
        nb.CurrentMatch,
        {"variance": times(0.05), "length_scale": times(0.8), "closed_curve": False, "num_points": None},
        seen_by(SEEN),
    ),
    "VarifoldMatch": (
        nb.VarifoldMatch,
        {"variance": times(0.05), "length_scale": times(0.8), "angle_scale": times(1.1)}
        | {"closed_curve": True, "num_points": 4},
        site_of(np.concatenate([SEEN, SEEN[:1] + 0.3])),
    ),
    "IntervalCensored": (
        nb.IntervalCensored,
        {"cuts": times([-0.2, 0.3])},
        seen_by(np.array([[0, 1], [2, 1], [1, 0]])),
    ),
    "IntervalCensored, constant": (nb.IntervalCensored, {"cuts": [0.2]}, site_of(np.array([[0, 1], [1, 1], [1, 0]]))),
    "CylinderSet": (
        nb.CylinderSet,
        {"lower": times(np.stack([X0[0] - 0.2, [0.1, -INF]])), "upper": times(np.stack([X0[0], [INF, 0.4]]))},
        lambda box: weight(condition=box),
    ),
    "CylinderSet, a free row": (
        nb.CylinderSet,
        {"lower": [[-INF, -INF], [0.1, 0.3]], "upper": [[INF, INF], [0.2, 0.3]]},
        lambda box: weight(condition=box),
    ),
    "FrozenGuide": (nb.FrozenGuide, {"auxiliary": Of(lambda t: nb.LinearSDE(-0.3 * t, 0.4)), "rounds": 0}, led_by),
    "RecedingGuide": (nb.RecedingGuide, {"end_weight": times(0.3), "rounds": 1}, led_by),
    "GeodesicGuide": (nb.GeodesicGuide, {"correction": times(0.6), "end_weight": times(0.3)}, led_by),
    "DriftGuide": (nb.DriftGuide, {"guide": Of(lambda t: nb.RecedingGuide(0.3 * t))}, led_by),
    "ScoreGuide": (nb.ScoreGuide, LEARNED | {"history": {}, "held": network}, led_by),
    "Unguided": (nb.Unguided, {}, led_by),
    "GuidedBridge": (
        nb.GuidedBridge,
        MEET | {"t0": times(0.1), "t1": times(1.0), "num_steps": 2, "guide": nb.RecedingGuide(0.1)},
        weight_of,
    ),
    "GuidedBridge, grid": (nb.GuidedBridge, MEET | {"ts": times(TS), "solver": None}, weight_of),
    "GuidedBridge, solver": (
        nb.GuidedBridge,
        MEET | {"x0": times(X0), "ts": TS, "solver": diffrax.Euler(), "guide": nb.FrozenGuide()},
        weight_of,
    ),
    "DiffusionEndpoint": (
        nb.DiffusionEndpoint,
        LAW | {"ts": None, "t0": times(0.1), "t1": times(1.0), "num_steps": 2, "guide": nb.FrozenGuide()},
        lambda law: observed(law, SEEN),
    ),
    "DiffusionEndpoint, batch": (
        nb.DiffusionEndpoint,
        LAW | {"x0": times(BATCH), "batch_shape": (2,), "batched": ("x0",)},
        lambda law: observed(law, BATCH),
    ),
    "Tree": (
        nb.Tree,
        {"lengths": times([0.5, 1.0, 0.7]), "parents": (-1, 0, 1, 1), "names": list("rabc"), "observed": [1, 2, 3]},
        lambda tree: jnp.sum(tree.depths),
    ),
    "DiffusionTree": (
        nb.DiffusionTree,
        {"sde": GBM, "x0": times(X0), "match": ROWS, "tree": Of(lambda t: TREE.scaled(t)), "num_steps": 2}
        | {"t0": times(0.1), "guide": nb.RecedingGuide(0.1), "per_row": ("match",)},
        lambda law: observed(law, SEVERAL),
    ),
    "DiffusionTree, specimens": (
        nb.DiffusionTree,
        {"sde": PLAIN, "x0": times(X0), "match": Of(lambda t: jax.vmap(nb.InexactMatch)(t * ERRORS))}
        | {"tree": TREE.observing(list("aab")), "per_row": ("match",)},
        lambda law: observed(law, SEVERAL),
    ),
    "DiffusionTree, regimes": (
        nb.DiffusionTree,
        {"sde": Of(lambda t: jax.vmap(nb.BrownianMotion)(t * np.array([0.5, 1.0, 0.7, 0.3]))), "x0": X0}
        | {"match": nb.InexactMatch(0.05), "tree": TREE, "per_edge": ("sde",)},
        lambda law: observed(law, SEVERAL),
    ),
    "DiffusionTree, batch": (
        nb.DiffusionTree,
        {"sde": PLAIN, "x0": times(BATCH), "match": nb.InexactMatch(0.05), "tree": TREE, "num_steps": 1}
        | {"root_covariance": times([0.5, 0.2]), "batch_shape": (2,), "batched": ("x0", "root_covariance")},
        lambda law: observed(law, np.stack([SEVERAL, SEVERAL])),
    ),
}  # fmt: skip

LEFT_OUT = {
    "Comparison": "made by `compare`",
    "EvidenceEstimate": "made by `estimate_evidence`",
    "TemperedEvidence": "made by `estimate_tree_evidence`",
    "NoiseBlocks": "made by laws, of integers",
    "NoiseReparam": "a handler",
    "DrivingNoise": "made by laws, from shapes",
    "GuidedStep": "a solver, without arguments",
    "GaussianMessage": "made by guides",
    "Observation": "made by conditions",
    "Target": "made by conditions",
    "AffineStep": "made by SDEs",
    "Displaced": "made by bridges",
    "Frame": "made by SDEs",
    "TimeGrid": "made by bridges",
    "Transition": "made by SDEs",
}
ARGUMENTS_LEFT_OUT = {"validate_args"}
MODULES = ("", ".conditioning", ".distributions", ".kernels", ".sdes", ".spaces")


def public_classes():
    for module in map(importlib.import_module, (nb.__name__ + name for name in MODULES)):
        for name, value in vars(module).items():
            ours = inspect.isclass(value) and value.__module__.startswith(nb.__name__)
            if ours and not name.startswith(("_", "Abstract")):
                yield value


def test_the_table_is_complete():
    given = {}
    for cls, arguments, _ in TABLE.values():
        given.setdefault(cls, set()).update(arguments)
    for cls in set(public_classes()):
        assert (cls in given) != (cls.__name__ in LEFT_OUT), (
            f"{cls.__name__} needs a row of the table"
        )
        if cls in given:
            missing = set(inspect.signature(cls).parameters) - given[cls] - ARGUMENTS_LEFT_OUT
            assert not missing, f"no row of {cls.__name__} gives {sorted(missing)}"


def made(name, t):
    cls, arguments, _ = TABLE[name]
    return cls(**{k: v.value(t) if isinstance(v, Of) else v for k, v in arguments.items()})


def computed(name, thing):
    out = TABLE[name][2](thing)
    return jnp.sum(out.law.given(out.noise).log_prob(out.datum)) if isinstance(out, Site) else out


def value(name, t):
    return computed(name, made(name, t))


PRIOR = dist.LogNormal(0.0, 0.5)


def model(name):
    out = TABLE[name][2](made(name, numpyro.sample("t", PRIOR)))
    if not isinstance(out, Site):
        numpyro.factor("weight", out)
        return
    with numpyro.handlers.substitute(data={"y_noise": out.noise}):
        if out.law.batch_shape:
            with numpyro.plate("data", len(out.datum)):
                nb.sample("y", out.law, obs=out.datum)
        else:
            nb.sample("y", out.law, obs=out.datum)


def log_likelihood(name, t):
    """Of the model: its density, less the prior and that of the noise."""
    density, trace = log_density(model, (name,), {}, {"t": t})
    if "y_noise" in trace:
        density = density - jnp.sum(trace["y_noise"]["fn"].log_prob(trace["y_noise"]["value"]))
    return density - PRIOR.log_prob(t)


@pytest.mark.parametrize("name", TABLE)
def test_built_anywhere(name):
    """One program: of the object built outside, and of those built inside from the traced
    parameter.
    """
    parameters = np.array([1.3, 0.8])
    thing = made(name, parameters[0])

    @jax.jit
    def values(parameters):
        t = parameters[0]
        mapped = jax.vmap(lambda t: value(name, t))(parameters)
        return computed(name, thing), value(name, t), log_likelihood(name, t), mapped

    eager, one, modelled, mapped = values(parameters)
    _, other, _, exchanged = values(parameters[::-1])
    assert np.isfinite(eager)
    for found, truth in (
        (one, eager),
        (modelled, eager),
        (mapped, [eager, other]),
        (exchanged, [other, eager]),
    ):
        np.testing.assert_allclose(found, truth, rtol=1e-12, atol=1e-12)
