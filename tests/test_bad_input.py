"""Random bad input to every public callable: an error that names the argument, or the right result.

Each row of the table is a call that is right, and what its arguments are. One argument at a time is
replaced by

- an *impostor*, what no conversion may make a value of that kind (text, dates, booleans or complex
  numbers for a number, a class for its instance, an integer for a key): `ValueError` or
  `TypeError`, with the argument's name;
- the same value in other *clothes* (lists, numbers of NumPy and JAX, columns of pandas): the same
  result;
- an *odd* number (of another shape or none, negative, NaN, infinite, huge): an error with the
  argument's name, or the result of the same number in plain lists, where NaN must be seen in the
  result.

A row for a new callable, and a kind for a new argument, are asked for by the first test. The draws
are the same in every run; `--bad-inputs N` draws N others.
"""

import contextlib
import datetime
import inspect
import types
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import equinox as eqx
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import jax.random as jr
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import numpyro
import numpyro.distributions as dist
import optax
import pandas as pd
import pytest
from hypothesis import HealthCheck, given, settings
from numpyro.infer import MCMC

import numpyro_bridges as nb
from numpyro_bridges import infer, io, kernels, plot, scores, shapes, spaces, weights
from numpyro_bridges.guiding._score import Standard

matplotlib.use("agg")
pytestmark = pytest.mark.numpyro

NUM_EXAMPLES = 1000
"""In all, shared out in proportion to the number of arguments."""

KEY = jr.key(0)
SPACE = nb.Landmarks(3, 2)
BASIS = nb.FourierBasis(1, 2)
KERNEL = nb.GaussianKernel(0.5, 1.0)
SQUARE = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, -1.0]])
X = np.array([0.5, -1.0])
MATCH = nb.InexactMatch(0.5)
OU = nb.LinearSDE(-0.5, 0.5)
BRIDGE = nb.GuidedBridge(OU, MATCH.at(X), x0=X, t1=1.0, num_steps=2)
NOISE = np.array([[[0.1], [0.2]], [[-0.3], [0.4]]])
PATH = np.linspace(X, X + 1, 3)
LAW = nb.DiffusionEndpoint(OU, X, MATCH, t1=1.0, num_steps=2)
GIVEN = LAW.given(NOISE)
ONE = jnp.ones(())
STANDARD = Standard(
    ONE, jnp.ones((2, 1)), jnp.zeros((2, 1)), jnp.ones((2, 1)), jnp.zeros(0), jnp.ones(0)
)
TRAINING = scores.Training(2, 2, held_out=2)
NETWORK = scores.MLP((2, 1), key=KEY)
STATEFUL = scores.UNet.build((2, 1), (2,), 2, key=KEY)
COMPARISON = nb.Comparison(
    100,
    {
        name: dict.fromkeys(
            (
                "log_evidence",
                "standard_error",
                "rounding",
                "ess",
                "ess_fraction",
                "pareto_k",
                "seconds",
                "training_seconds",
                "seconds_per_effective_sample",
                "seconds_per_effective_sample_with_training",
                "score_error",
            ),
            0.5,
        )
        | {"trusted": True, "doubt": ""}
        for name in "ab"
    },
)
TRAINED = nb.ScoreGuide(
    nb.FrozenGuide(),
    NETWORK,
    STANDARD,
    history={k: jnp.ones(2) for k in ("update", "loss", "bound", "ess", "seconds", "kept")},
)
ESTIMATE = nb.EvidenceEstimate(ONE, ONE, ONE, 0.1, 0.1, jnp.zeros(4))
SPECIMEN = io.Specimen(SQUARE, id="a")
TREE = nb.Tree.from_newick("((a:1,b:2):1,c:3);")
TREE_LAW = nb.DiffusionTree(OU, X, MATCH, tree=TREE)


def model(observed=None):
    rate = numpyro.sample("rate", dist.LogNormal(0.0, 1.0))
    nb.sample(
        "v",
        nb.DiffusionEndpoint(nb.LinearSDE(-rate, 0.5), X, MATCH, t1=1.0, num_steps=2),
        obs=observed,
    )


def drift(t, x, args):
    return -x


def gaussian(x, observed, args):
    return -jnp.sum((x - observed) ** 2)


def constant(t, x, args):
    return 0.5


OBJECTS = {
    "sde": OU,
    "linear": nb.BrownianMotion(0.5),
    "space": SPACE,
    "kernel": KERNEL,
    "match": nb.InexactMatch(0.5),
    "condition": MATCH.at(X),
    "guide": nb.FrozenGuide(),
    "noise": nb.SpectralNoise(2),
    "bridge": BRIDGE,
    "training": TRAINING,
    "law": LAW,
    "tree law": TREE_LAW,
    "standard": STANDARD,
    "trained": TRAINED,
    "comparison": COMPARISON,
    "specimen": SPECIMEN,
    "tree": TREE,
    "optimizer": optax.sgd(0.1),
    "mesh": jax.sharding.Mesh(np.array(jax.devices()[:1]), "devices"),
}
"""One object of each kind; what is asked for is replaced by any of the others, or by its class."""

ARE_TOO = {
    "sde": {"linear"},
    "linear": {"sde"},
    "guide": {"trained"},
    "law": {"tree law"},
}


@dataclass
class Row:
    """A call that is right, the kinds of its arguments, and which part of the result is compared.

    A question mark behind a kind allows None. Rows that are `costly` are tried with impostors
    alone.
    """

    call: Callable
    right: dict[str, Any]
    kinds: dict[str, str]
    result: Callable[[Any], Any] = lambda found: found
    costly: bool = False
    names: dict[str, str] = field(default_factory=dict)


def row(call, costly=False, result=lambda found: found, names=None, /, **arguments) -> Row:
    """Arguments as (kind, value), or as a kind alone, whose default is not replaced in the right
    call.
    """
    right = {name: a[1] for name, a in arguments.items() if isinstance(a, tuple)}
    kinds = {name: a[0] if isinstance(a, tuple) else a for name, a in arguments.items()}
    return Row(call, right, kinds, result, costly, names or {})


SQUARED = np.stack([SQUARE, 1.1 * SQUARE])
GRID = np.array([0.0, 0.5, 1.0])
PATHS = np.stack([SQUARE, 1.2 * SQUARE, 1.1 * SQUARE])
LOG_WEIGHTS = np.linspace(-1.0, 1.0, 30)
INTERVAL = {"t1": ("number", 1.0), "num_steps": ("count", 2), "t0": "number?", "ts": "array?"}
GUIDED = INTERVAL | {"guide": "guide?"}
LEARNED = {
    "network": "function?",
    "training": ("training?", TRAINING),
    "draw": "function?",
    "context": "function?",
    "directory": "path?",
    "progress": ("flag", False),
    "watch": "function?",
    "mesh": "mesh?",
}
FILE = Path("never") / "never.csv"


def table() -> dict[str, Row]:
    """Rows by the name of the callable."""
    network = ("function", NETWORK)
    rows = {
        # spaces and kernels
        "Landmarks": row(
            nb.Landmarks, num_points=("count", 3), dim=("count", 2), weights=("array?", np.ones(3))
        ),
        "FourierBasis": row(
            nb.FourierBasis, num_modes=("count", 1), dim=("count", 2), num_quadrature=("count?", 8)
        ),
        **{
            kind.__name__: row(
                kind,
                num_modes=("count", 1),
                dim=("count", 2),
                num_quadrature=("count?", 8),
                **({} if kind is nb.FourierSquare else {"length": ("number", 2.0)}),
            )
            for kind in (nb.SineBasis, nb.CosineBasis, nb.FourierSquare)
        },
        "GaussianKernel": row(
            nb.GaussianKernel, amplitude=("number", 0.5), length_scale=("number", 1.0)
        ),
        "MaternKernel": row(
            nb.MaternKernel,
            amplitude=("number", 0.5),
            length_scale=("number", 1.0),
            order=("count from 0", 1),
        ),
        "kernels.QuadratureCovariance": row(
            kernels.QuadratureCovariance,
            kernel=("kernel", KERNEL),
            lower=("array", -np.ones(2)),
            upper=("array", np.ones(2)),
            num_cells=("count", 2),
        ),
        # SDEs
        "LinearSDE": row(
            nb.LinearSDE,
            drift=("array", -np.ones(2)),
            diffusion=("array", np.eye(2)),
            shift=("array", np.zeros(2)),
            space="space?",
        ),
        "BrownianMotion": row(
            nb.BrownianMotion, covariance=("array", np.eye(2)), factor="free", space="space?"
        ),
        "SDE": row(
            nb.SDE,
            drift=("function", drift),
            diffusion=("function", constant),
            args="free",
            space="space?",
        ),
        "SemilinearSDE": row(
            nb.SemilinearSDE,
            linear=("array", -np.ones(2)),
            nonlinearity=("function", drift),
            diffusion=("free", 0.5),
            args="free",
            space="space?",
            scheme=("name", "midpoint"),
        ),
        "KunitaFlow": row(
            nb.KunitaFlow,
            space=("space", SPACE),
            kernel=("kernel?", KERNEL),
            covariance="kernel?",
            noise="noise or name?",
        ),
        "LandmarkNoise": row(nb.LandmarkNoise, jitter=("number?", 1e-6)),
        "ControlNoise": row(nb.ControlNoise, num_points="count?", points="free", jitter="number?"),
        "SpectralNoise": row(
            nb.SpectralNoise,
            num_modes=("count", 2),
            period=("number?", 6.0),
            diameter=("number", 2.0),
        ),
        "GridNoise": row(
            nb.GridNoise,
            lower=("array", -np.ones(2)),
            upper=("array", np.ones(2)),
            num_cells=("count", 2),
        ),
        "simulate": row(
            nb.simulate,
            sde=("sde", OU),
            x0=("array", X),
            ts=("array", GRID),
            noise=("array", NOISE),
        ),
        # conditions
        "ExactMatch": row(nb.ExactMatch, operator=("array?", np.eye(2)), mask="mask?"),
        "InexactMatch": row(
            nb.InexactMatch,
            variance=("array", np.ones(2)),
            operator="array?",
            space="space?",
            normalised=("flag", True),
            mask="mask?",
        ),
        "CylinderSet": row(nb.CylinderSet, lower=("array", X - 1), upper=("array", X + 1)),
        "IntervalCensored": row(nb.IntervalCensored, cuts=("array", np.array([0.0, 1.0]))),
        "DensityMatch": row(
            nb.DensityMatch,
            log_density=("function", gaussian),
            args="free",
            sample="function?",
            spread=("number", 0.5),
        ),
        "StudentMatch": row(
            nb.StudentMatch, variance=("number", 0.5), degrees_of_freedom=("number", 4.0)
        ),
        "HuberMatch": row(nb.HuberMatch, variance=("number", 0.5), threshold=("number", 1.0)),
        "ProcrustesMatch": row(
            nb.ProcrustesMatch, variance=("number", 0.5), up_to=("name", "rigid")
        ),
        "CurrentMatch": row(
            nb.CurrentMatch,
            variance=("number", 0.5),
            length_scale=("number", 0.5),
            closed_curve=("flag", True),
            num_points="count? from 3",
        ),
        "VarifoldMatch": row(
            nb.VarifoldMatch,
            variance=("number", 0.5),
            length_scale=("number", 0.5),
            angle_scale=("number", 1.0),
            closed_curve=("flag", True),
            num_points="count? from 3",
        ),
        "ExactMatch.at": row(nb.ExactMatch().at, observed=("array", X)),
        "InexactMatch.at": row(MATCH.at, observed=("array", X)),
        "IntervalCensored.at": row(
            nb.IntervalCensored([0.0, 1.0]).at, observed=("array", np.array([0.0, 2.0]))
        ),
        "InexactMatch.from_point_sd": row(
            nb.InexactMatch.from_point_sd,
            False,
            lambda match: match,
            {"sd": "variance"},
            sd=("number", 0.5),
            space=("space", SPACE),
            kwargs="free",
        ),
        # guides and bridges
        "FrozenGuide": row(nb.FrozenGuide, auxiliary="linear?", rounds=("count from 0", 1)),
        "RecedingGuide": row(
            nb.RecedingGuide, end_weight=("number", 0.5), rounds=("count from 0", 1)
        ),
        "GeodesicGuide": row(
            nb.GeodesicGuide, correction=("number", 0.5), end_weight=("number", 0.5)
        ),
        "DriftGuide": row(nb.DriftGuide, guide=("guide", nb.FrozenGuide())),
        "ScoreGuide": row(
            nb.ScoreGuide,
            guide=("guide", nb.FrozenGuide()),
            network=network,
            standard=("standard", STANDARD),
            context="function?",
            history=("mapping", {}),
            held="function?",
        ),
        "GuidedBridge": row(
            nb.GuidedBridge,
            False,
            lambda bridge: bridge,
            {"x0": "observed"},
            sde=("sde", OU),
            condition=("condition", MATCH.at(X)),
            x0=("array", X),
            solver="solver?",
            **GUIDED,
        ),
        "GuidedBridge.with_guide": row(BRIDGE.with_guide, guide=("guide?", nb.FrozenGuide())),
        "GuidedBridge.path": row(BRIDGE.path, noise=("array", NOISE)),
        "GuidedBridge.log_weight": row(BRIDGE.log_weight, noise=("array", NOISE)),
        "GuidedBridge.path_and_log_weight": row(BRIDGE.path_and_log_weight, noise=("array", NOISE)),
        "GuidedBridge.noise_from_path": row(
            BRIDGE.noise_from_path, path=("array", PATH), key="key?"
        ),
        "GuidedBridge.guided_terms": row(BRIDGE.guided_terms, noise=("array", NOISE)),
        "GuidedBridge.scores": row(BRIDGE.scores, path=("array", PATH)),
        "GuidedBridge.log_h": row(BRIDGE.log_h, t=("number", 0.5), x=("array", X)),
        "GuidedBridge.score": row(BRIDGE.score, t=("number", 0.5), x=("array", X)),
        # trees
        "Tree": row(
            nb.Tree,
            parents=("array", np.array([-1.0, 0.0, 0.0])),
            lengths=("array", np.ones(2)),
            names=("names?", [None, "a", "b"]),
            observed=("array?", np.array([1.0])),
        ),
        "Tree.from_parents": row(
            nb.Tree.from_parents,
            parents=("array", np.array([2.0, 2.0, -1.0])),
            lengths=("array", np.ones(3)),
            names=("names?", ["a", "b", None]),
            observed=("array?", np.array([0.0])),
        ),
        "Tree.from_newick": row(
            nb.Tree.from_newick,
            source=("path", "(a:1,b:2);"),
            index=("count from 0?", 0),
            preserve_underscores=("flag", True),
            unit_lengths=("flag", False),
        ),
        "Tree.chain": row(nb.Tree.chain, times=("array", GRID), names=("names?", ["a", "b", "c"])),
        "Tree.star": row(nb.Tree.star, lengths=("array", GRID), names=("names?", ["a", "b", "c"])),
        "Tree.with_lengths": row(TREE.with_lengths, lengths=("array", np.ones(4))),
        "Tree.scaled": row(TREE.scaled, rates=("array", np.ones(4))),
        "Tree.num_steps": row(TREE.num_steps, longest=("setting", 0.5), multiple=("count", 2)),
        "Tree.divided": row(TREE.divided, pieces=("array", np.array([1.0, 2.0, 1.0, 3.0]))),
        "Tree.clade": row(
            lambda names, stem=True: TREE.clade(
                *(names if isinstance(names, list) else [names]), stem=stem
            ),
            names=("names", ["a", "b"]),
            stem=("flag", True),
        ),
        "Tree.observing": row(TREE.observing, names=("names", ["a", "b"])),
        "Tree.pruned": row(TREE.pruned, names=("names", ["a", "b"])),
        "Tree.rows": row(TREE.rows, data=("mapping", dict.fromkeys("abc", SQUARE)), names="names?"),
        # estimates
        "estimate_evidence": row(
            nb.estimate_evidence,
            bridge=("bridge", BRIDGE),
            key=("key", KEY),
            num_particles=("count from 2", 4),
            batch_size=("count", 4),
            mesh="mesh?",
        ),
        "spread": row(
            nb.spread,
            False,
            lambda spread: spread(X),
            fn=("function", lambda x: 2 * x),
            mesh="mesh?",
            axis="name?",
            batch_size=("count?", 1),
        ),
        "estimate_tree_evidence": row(
            nb.estimate_tree_evidence,
            True,
            law=("law", LAW),
            data=("array", X),
            key=("key", KEY),
            settings="free",
        ),
        "estimate_model_evidence": row(
            nb.estimate_model_evidence,
            True,
            model=("function", model),
            key=("key", KEY),
            model_args="free",
            model_kwargs="mapping?",
            method=("name", "smc"),
            num_particles=("count from 4", 4),
            num_islands=("count from 2", 2),
            num_moves=("count", 1),
            batch_size=("count", 4),
            progress=("flag", False),
            mesh="mesh?",
        ),
        "compare": row(
            nb.compare,
            True,
            bridges=("mapping", {"a": BRIDGE}),
            key=("key", KEY),
            num_particles=("count", 4),
            batch_size="count?",
            training_seconds="mapping?",
            score="function?",
            mesh="mesh?",
        ),
        "Comparison.of": row(
            nb.Comparison.of,
            False,
            lambda found: found.rows["a"]["ess"],
            estimates=("mapping", {"a": ESTIMATE}),
        ),
        "Comparison.agree": row(COMPARISON.agree, first=("name", "a"), second=("name", "b")),
        "Comparison.plot": row(COMPARISON.plot, True, path=("file", FILE)),
        "weights.log_mean_exp": row(
            weights.log_mean_exp, log_weights=("array", LOG_WEIGHTS), axis="axis"
        ),
        "weights.effective_sample_size": row(
            weights.effective_sample_size, log_weights=("array", LOG_WEIGHTS)
        ),
        "weights.standard_error": row(weights.standard_error, log_weights=("array", LOG_WEIGHTS)),
        "weights.pareto_k": row(weights.pareto_k, log_weights=("array", LOG_WEIGHTS)),
        "weights.quality": row(weights.quality, log_weights=("array", LOG_WEIGHTS)),
        "weights.pareto_k_threshold": row(
            weights.pareto_k_threshold, num_particles=("count from 2", 64)
        ),
        # laws
        "DiffusionEndpoint": row(
            nb.DiffusionEndpoint,
            False,
            lambda law: law.parts,
            sde=("sde", OU),
            x0=("array", X),
            match=("match", MATCH),
            batch_shape="shape",
            batched="names?",
            validate_args="free",
            **GUIDED,
        ),
        "DiffusionTree": row(
            nb.DiffusionTree,
            True,
            lambda law: law.parts,
            {"x0": "x0"},
            sde=("sde", OU),
            x0=("array", X),
            match=("match", MATCH),
            tree=("tree", TREE),
            num_steps=("count?", 1),  # of a linear SDE
            t0=("number", 0.5),
            guide="guide?",
            root_covariance=("array?", np.eye(len(X))),
            per_row="free",
            per_edge="free",
            batch_shape="shape",
            batched="names?",
            validate_args="free",
        ),
        "DiffusionEndpoint.given": row(
            LAW.given, False, lambda law: law.noise, noise=("array", NOISE)
        ),
        "DiffusionEndpoint.log_prob": row(
            GIVEN.log_prob,
            False,
            lambda found: found,
            {"value": "observed"},
            value=("array", X),
            intermediates="free",
        ),
        "DiffusionEndpoint.path": row(GIVEN.path, observed=("array", X)),
        "DiffusionEndpoint.sample": row(LAW.sample, key=("key", KEY), sample_shape="shape"),
        "DiffusionEndpoint.sample_with_noise": row(
            LAW.sample_with_noise, key=("key", KEY), sample_shape="shape"
        ),
        "NoiseReparam": row(nb.NoiseReparam),
        "sample": row(
            lambda **kwargs: numpyro.handlers.seed(nb.sample, 0)(**kwargs),
            name=("text", "v"),
            law=("law", LAW),
            obs=("array?", X),
            infer="mapping?",
        ),
        # inference
        "infer.run_checkpointed": row(
            lambda mcmc, path, rng_key, interval=100, keep_noise=None, extra_fields=(), mesh=None, **kwargs: (
                infer.run_checkpointed(
                    mcmc,
                    path,
                    rng_key,
                    interval=interval,
                    keep_noise=keep_noise,
                    extra_fields=extra_fields,
                    mesh=mesh,
                )
            ),
            True,
            mcmc=("mcmc", MCMC(infer.FunctionSpaceHMC(model), num_warmup=1, num_samples=1)),
            path=("path", FILE),
            rng_key=("key", KEY),
            args="free",
            interval=("count", 1),
            keep_noise="count?",
            extra_fields="names",
            init_params="free",
            mesh="mesh?",
            kwargs="free",
        ),
        "to_arviz": row(
            nb.to_arviz,
            True,
            mcmc=("mcmc", MCMC(infer.FunctionSpaceHMC(model), num_warmup=1, num_samples=1)),
            prior="mapping?",
            posterior_predictive="mapping?",
            coords="mapping?",
            dims="mapping?",
            noise=("flag", False),
            nodes=("flag", True),
            paths="count?",
            log_likelihood=("flag", False),
        ),
        "log_likelihood": row(
            nb.log_likelihood,
            True,
            mcmc=("mcmc", MCMC(infer.FunctionSpaceHMC(model), num_warmup=1, num_samples=1)),
            key="key?",
            num_particles=("count from 8", 8),
            draws="count?",
        ),
        "infer.integrate_noise": row(
            infer.integrate_noise, False, model=("function", model), num_particles=("count", 2)
        ),
        "infer.fields": row(infer.fields, kernel=("kernel of MCMC", infer.FunctionSpaceHMC(model))),
        "infer.init_to_guided_mean": row(
            infer.init_to_guided_mean, site="free", num_samples="free"
        ),
        "infer.noise_sites": row(infer.noise_sites, trace=("mapping", {})),
        "infer.FunctionSpaceHMC": row(
            infer.FunctionSpaceHMC,
            False,
            settings_of,
            model=("function", model),
            step_size=("setting", 0.5),
            target_accept_prob=("setting", 0.8),
            adapt_step_size=("flag", True),
            trajectory_length=("setting", 2.0),
            jitter=("setting", 0.2),
            max_num_steps=("count", 8),
            init_strategy="function",
            mesh="mesh?",
        ),
        **{
            f"infer.{kernel.__name__}": row(
                kernel,
                False,
                settings_of,
                model=("function", model),
                num_moves=("count", 2),
                num_blocks=("count", 1),
                blocks="name?",
                angle=("setting", 1.0),
                adapt_angle=("flag", True),
                target_accept_prob=("setting", 0.4),
                init_strategy="function",
                mesh="mesh?",
                **({"settings": "free"} if kernel is infer.PCNL else {}),
            )
            for kernel in (infer.PCN, infer.PCNL)
        },
        **{
            f"infer.{kernel.__name__}": row(
                kernel,
                False,
                settings_of,
                model=("function", model),
                num_particles=("count?", 2),
                correlation=("setting", 0.9),
                step_size=("setting?", 0.5),
                max_particles=("count", 8),
                init_strategy="function",
                mesh="mesh?",
            )
            for kernel in (infer.CorrelatedPseudoMarginal, infer.CorrelatedPseudoMarginalMALA)
        },
        # learned guides
        "scores.Training": row(
            scores.Training,
            num_updates=("count", 2),
            batch_size=("count", 2),
            learning_rate=("setting", 0.1),
            optimizer=("optimizer?", optax.sgd(0.1)),
            average=("setting", 0.5),
            interval=("count", 1),
            held_out=("count", 2),
            patience=("count?", 2),
            one_step=("flag", False),
        ),
        "scores.Training.published": row(
            scores.Training.published,
            False,
            lambda training: training.num_updates,
            num_epochs=("count", 2),
            learning_rate=("setting", 0.1),
        ),
        "scores.MLP": row(
            scores.MLP,
            shape=("state shape", (2, 1)),
            context=("count from 0", 0),
            key=("key", KEY),
            width=("count", 4),
            depth=("count from 0", 1),
        ),
        "scores.PointNetwork": row(
            scores.PointNetwork,
            dim=("count", 2),
            context=("count from 0", 0),
            key=("key", KEY),
            width=("count", 4),
            depth=("count from 0", 1),
            heads=("count", 1),
        ),
        "scores.Singular": row(
            scores.Singular, network=network, key=("key", KEY), softness=("setting", 0.1)
        ),
        "scores.UNet": row(
            lambda **kwargs: eqx.nn.make_with_state(scores.UNet)(**kwargs)[0],
            shape=("state shape", (2, 1)),
            widths=("widths", (4, 2)),
            embedding=("count from 2", 4),
            key=("key", KEY),
        ),
        "scores.UNet.build": row(
            scores.UNet.build,
            True,
            shape=("state shape", (2, 1)),
            widths=("widths", (4, 2)),
            embedding=("count from 2", 4),
            key=("key", KEY),
        ),
        "scores.UNet.published": row(
            scores.UNet.published,
            True,
            shape=("state shape", (2, 1)),
            num_bases=("count", 1),
            key=("key", KEY),
        ),
        "scores.WithState": row(
            scores.WithState, True, network=network, state=("state", STATEFUL.state)
        ),
        "scores.fit": row(
            scores.fit,
            True,
            sde=("sde", OU),
            condition=("condition", MATCH.at(X)),
            x0=("array", X),
            key=("key", KEY),
            method=("name", "residual"),
            **LEARNED,
            **GUIDED | {"num_steps": ("count?", 2)},
        ),
        "scores.fit_tree": row(
            scores.fit_tree,
            True,
            law=("tree law", TREE_LAW),
            data=("array", np.zeros((3, len(X)))),
            key=("key", KEY),
            **LEARNED,
        ),
        # data and drawings
        "datasets.mosquito_wings": row(
            nb.datasets.mosquito_wings, True, num_points=("count from 3", 4), genus=("name?", "UR")
        ),
        "datasets.mosquito_tree": row(nb.datasets.mosquito_tree),
        "datasets.ellipses": row(
            nb.datasets.ellipses,
            num_points=("count from 3", 4),
            aspects=("array", np.array([1.0, 2.0])),
        ),
        "shapes.resample": row(
            shapes.resample,
            points=("array", SQUARE),
            num_points=("count", 4),
            closed=("flag", True),
        ),
        "shapes.center": row(shapes.center, points=("array", SQUARE)),
        "shapes.rms_radius": row(shapes.rms_radius, points=("array", SQUARE)),
        "shapes.unit_size": row(shapes.unit_size, points=("array", SQUARE)),
        "shapes.procrustes_align": row(
            shapes.procrustes_align,
            shapes=("array", SQUARED),
            reference=("array?", SQUARE),
            scale=("flag", True),
            reflect=("name", "auto"),
            tolerance=("setting", 1e-8),
            max_iterations=("count", 50),
        ),
        "shapes.mean_shape": row(
            shapes.mean_shape, shapes=("array", SQUARED), scale=("flag", True)
        ),
        "shapes.align_start": row(
            shapes.align_start, shapes=("array", SQUARED), reference=("array", SQUARE)
        ),
        "io.Specimen": row(
            io.Specimen,
            landmarks=("array", SQUARE),
            curves=("arrays", ()),
            id="text?",
            image="text?",
            scale=("setting?", 0.5),
            notes="mapping",
        ),
        "io.read_csv": row(
            io.read_csv,
            True,
            path=("path", FILE),
            id="text?",
            point=("text", "point"),
            delimiter="text?",
            decimal="text?",
            missing="free",
            dim="count?",
            encoding=("text", "utf-8"),
        ),
        **{
            f"io.{reader.__name__}": row(
                reader, True, path=("path", FILE), encoding=("text", "utf-8"), **more
            )
            for reader, more in (
                (io.read, {"settings": "free"}),
                (io.read_slicer, {}),
                (io.read_nts, {}),
                (io.read_morphologika, {"missing": "free"}),
            )
        },
        "io.stack": row(
            io.stack, specimens=("specimens", [SPECIMEN, SPECIMEN]), points=("name", "all")
        ),
        "io.join": row(
            io.join,
            specimens=("specimens", [SPECIMEN]),
            table=("path", pd.DataFrame({"id": ["a"], "sex": ["f"]})),
            by="text?",
            of=("text", "id"),
            delimiter="text?",
            encoding=("text", "utf-8"),
        ),
        "io.write_csv": row(
            io.write_csv,
            True,
            path=("path", FILE),
            specimens=("specimens", [SPECIMEN]),
            layout=("name", "wide"),
            delimiter=("text", ","),
            encoding=("text", "utf-8"),
        ),
        "io.read_tps": row(
            io.read_tps,
            True,
            path=("path", FILE),
            negative_is_missing=("flag", False),
            encoding=("text", "utf-8"),
        ),
        "io.write_tps": row(
            io.write_tps,
            True,
            path=("path", FILE),
            specimens=("specimens", [SPECIMEN]),
            encoding=("text", "utf-8"),
        ),
        "plot.outlines": row(
            plot.outlines,
            False,
            drawn,
            shapes=("array with gaps", SQUARED),
            ax="axes?",
            mean=("array? with gaps", SQUARE),
            closed=("flag", True),
            color="free",
            linewidth=("setting", 0.5),
            kwargs="free",
        ),
        "plot.path": row(
            plot.path,
            False,
            drawn,
            path=("array with gaps", PATHS),
            ax="axes?",
            ts=("array?", GRID),
            num_outlines=("count", 2),
            closed=("flag", True),
            trajectories=("flag", True),
            cmap="free",
            kwargs="free",
        ),
        "plot.bridge_fan": row(
            plot.bridge_fan,
            False,
            drawn,
            paths=("array with gaps", PATHS[None]),
            start=("array with gaps", SQUARE),
            target=("array with gaps", SQUARE),
            ax="axes?",
            ts=("array?", GRID),
            num_frames=("count", 2),
            direction=("name", "row"),
            closed=("flag", True),
            max_outlines=("count", 2),
        ),
        "plot.score_field": row(
            plot.score_field,
            False,
            drawn,
            points=("array with gaps", SQUARE),
            arrows=("array with gaps", SQUARE),
            ax="axes?",
            length=("setting?", 0.5),
            closed=("flag", True),
            color="free",
            kwargs="free",
        ),
        "plot.deformation": row(
            plot.deformation,
            True,
            flow=("free", nb.KunitaFlow(SPACE, KERNEL)),
            path=("array", PATHS),
            ax="axes?",
            num_lines=("count", 2),
            margin=("setting", 0.1),
            closed=("flag", True),
            cmap="free",
            kwargs="free",
        ),
        "plot.score_frames": row(
            plot.score_frames,
            True,
            bridges=("bridge", BRIDGE),
            paths=("array", PATH),
            times=("array", np.zeros(1)),
            file=("file", FILE),
            scale=("setting?", 0.1),
            closed=("flag", True),
        ),
        "plot.training": row(plot.training, True, guides=("trained", TRAINED), file=("file", FILE)),
        "plot.tree": row(
            plot.tree,
            False,
            drawn,
            tree=("tree", TREE),
            ax="axes?",
            shapes=("array? with gaps", np.stack([SQUARE] * 5)),
            draws=("array? with gaps", np.stack([SQUARE] * 5)[None]),
            closed=("flag", True),
            size=("setting", 0.5),
            max_outlines=("count", 2),
        ),
        "plot.posterior": row(
            plot.posterior,
            True,
            samples=("mapping", {"a": np.arange(3.0)}),
            prior="mapping?",
            axes="free",
            truth="mapping?",
            level=("setting", 0.9),
        ),
    }
    for name, space in (("Landmarks", SPACE), ("FourierBasis", BASIS)):
        points = SQUARE if name == "Landmarks" else np.ones((len(BASIS.grid), 2))
        rows |= {
            f"{name}.basis": row(space.basis, s=("array", GRID)),
            f"{name}.to_points": row(space.to_points, x=("array", SQUARE)),
            f"{name}.from_points": row(space.from_points, values=("array", points)),
            f"{name}.inner": row(space.inner, x=("array", SQUARE), y=("array", SQUARE)),
            f"{name}.squared_norm": row(space.squared_norm, x=("array", SQUARE)),
            f"{name}.norm": row(space.norm, x=("array", SQUARE)),
            f"{name}.evaluate": row(space.evaluate, x=("array", SQUARE), s=("array", GRID)),
            f"{name}.project": row(space.project, values=("array", SQUARE), s=("array?", GRID)),
            f"{name}.refine": row(space.refine, x=("array", SQUARE), finer=("space", BASIS)),
        }
    for name, kernel in (
        ("GaussianKernel", KERNEL),
        ("MaternKernel", nb.MaternKernel(0.5, 1.0, 1)),
    ):
        rows |= {
            f"{name}.matrix": row(kernel.matrix, x=("array", SQUARE), y=("array", SQUARE)),
            f"{name}.__call__": row(kernel.__call__, x=("array", X), y=("array", X)),
            f"{name}.__mul__": row(kernel.__mul__, factor=("number", 0.5)),
            f"{name}.convolved": row(kernel.convolved, dim=("count", 1)),
            f"{name}.convolved_with": row(
                kernel.convolved_with, other=("kernel", kernel), dim=("count", 1)
            ),
            f"{name}.spectral_density": row(
                kernel.spectral_density, omega=("array", SQUARE), dim=("count", 2)
            ),
        }
    return rows


def settings_of(kernel):
    """What a kernel of MCMC has kept of its arguments."""
    return [
        value for name, value in sorted(vars(kernel).items()) if isinstance(value, (int, float))
    ]


def drawn(artists):
    """The lines of a drawing."""
    artists = artists if isinstance(artists, list) else [artists]
    return [np.asarray(path.vertices) for artist in artists for path in artist.get_paths()]


TABLE = table()

EXTENSION = {
    # what a user's own class defines, and the library calls for one state that has been checked
    *(
        "check",
        "observation",
        "reference",
        "log_value",
        "target",
        "noise_from_target",
        "closed",
        "example",
        "check_density",
        "sample",
    ),
    *(
        "plan",
        "prepared",
        "parameters",
        "functions",
        "auxiliary_process",
        "drift",
        "noise",
        "profile",
        "scales",
        "factor",
        "factor_and_covariance",
        "error",
    ),
}
MADE_BY_THE_LIBRARY = {
    "Alignment",
    "Stack",
    "EvidenceEstimate",
    "LogLikelihood",
    "TemperedEvidence",
    "Comparison",
    "Shapes",
    "KernelCombination",
    "GuidedStep",
}
MADE_BY_THE_LIBRARY |= {"Unguided", "FunctionSpaceHMCState", "PCNState", "PseudoMarginalState"}
WITH_METHODS = (
    nb.GuidedBridge,
    nb.DiffusionEndpoint,
    nb.Landmarks,
    nb.FourierBasis,
    nb.GaussianKernel,
)
WITH_METHODS += (
    nb.MaternKernel,
    nb.ExactMatch,
    nb.InexactMatch,
    nb.IntervalCensored,
    nb.Comparison,
)
WITH_METHODS += (scores.Training, scores.UNet, nb.Tree)
NOT_ASKED = {"DiffusionEndpoint.expand", "DiffusionEndpoint.mask", "DiffusionEndpoint.to_event"}
NOT_ASKED |= {
    "DiffusionEndpoint.noise_prior",
    "Comparison.to_pandas",
    "GuidedBridge.end",
    "GuidedBridge.observed",
    "GuidedBridge.problem",
    "DiffusionEndpoint.refuse_hidden_axes",
}


def public() -> dict[str, Callable]:
    """Public callables by name, and the methods of those that a user calls."""
    found: dict[str, Callable] = {}
    for module in (nb, infer, scores, io, nb.datasets, plot, weights, shapes, spaces, kernels):
        prefix = "" if module is nb else module.__name__.rpartition(".")[2] + "."
        for name, thing in vars(module).items():
            ours = str(getattr(thing, "__module__", "")).startswith(module.__name__)
            known = any(thing is other for other in found.values())
            if name.startswith(("_", "Abstract")) or isinstance(thing, types.ModuleType) or known:
                continue
            if callable(thing) and ours and name not in MADE_BY_THE_LIBRARY:
                found[prefix + name] = thing
    methods = {}
    for kind in WITH_METHODS:
        (prefix,) = [name for name, thing in found.items() if thing is kind] or [kind.__name__]
        for name in dir(kind):
            method = inspect.getattr_static(kind, name)
            if (
                isinstance(method, (staticmethod, property))
                or name.startswith(("_", "tree_"))
                or name in EXTENSION
            ):
                continue
            method = getattr(kind, name)
            if callable(method) and str(getattr(method, "__module__", "")).startswith(
                "numpyro_bridges"
            ):
                methods[f"{prefix}.{name}"] = method
    return found | {name: method for name, method in methods.items() if name not in NOT_ASKED}


def test_every_public_callable_and_argument_is_in_the_table():
    found = public()
    ours = {name for name in TABLE if not name.endswith("__")}
    found |= {
        "DiffusionEndpoint.sample": nb.DiffusionEndpoint.sample
    }  # a name that extensions use too
    assert set(found) == ours, (sorted(set(found) - ours), sorted(ours - set(found)))
    for name, thing in found.items():
        parameters = inspect.signature(thing).parameters
        arguments = {argument for argument in parameters if argument != "self"}
        passes_on = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
        more = set(TABLE[name].kinds) - arguments
        assert arguments <= set(TABLE[name].kinds) and (passes_on or not more), (
            name,
            arguments,
            more,
        )


# impostors

TEXTS = [
    "1",
    "1.0",
    "x",
    b"1",
    ["1", "2"],
    np.array(["1", "2"]),
    np.str_("1"),
    pd.Series(["a", "b"]),
]
COMPLEX = [1j, np.complex64(1), np.array([1 + 1j, 2.0]), jnp.array([1j, 2j]), [1.0, 1j]]
BOOLEANS = [True, np.bool_(True), np.array([True, False]), jnp.array([True, True]), [1.0, True]]
DAYS = np.array(["2020-01-01", "2020-01-02"], "datetime64[D]")
TIMES = [
    DAYS[0],
    DAYS,
    np.timedelta64(1, "D"),
    datetime.date(2020, 1, 1),
    datetime.timedelta(days=1),
]
TIMES += [pd.Timestamp("2020-01-01"), pd.to_timedelta([1, 2], "D")]
NONES = [[None, 1.0], np.array([None, 1.0]), np.array([object(), 1.0])]
MASKED = [np.ma.array([1.0, 2.0], mask=[False, True]), np.ma.masked]
RAGGED = [[[1.0], [1.0, 2.0]], [np.ones(2), np.ones(3)], np.array([[1.0], [1.0, 2.0]], object)]
OTHERS = [{}, {1.0, 2.0}, {"a": 1.0}, object(), ..., lambda x: x, float, np.ndarray, slice(1)]
OTHERS += [(i for i in (1.0, 2.0)), KEY, jr.split(KEY, 2), NotImplemented]
NOT_NUMBERS = TEXTS + COMPLEX + BOOLEANS + TIMES + NONES + MASKED + RAGGED + OTHERS

NO_TEXT = [1, 1.0, b"a", ["a"], {"a"}, object(), np.array(["a"]), str, True]
NO_CLASS = [0, 1.0, "a", np.ones(2), [], {}, object(), lambda x: x, True, KEY]
NO_COUNT = [0, -1, -(2**40), 2**40, 1.0, 2.5, np.nan, np.inf, np.float32(2), np.array(2.0)]
NO_COUNT += [np.array([2]), [2], "2", 1j, True, np.bool_(True), np.array(True), DAYS[0]]
NO_COUNT += [{}, object(), KEY, int]
NO_FLAG = [0, 1, 1.0, "True", "False", "", [], [True], np.array([True]), {}, object(), bool]
NO_KEY = [0, 1, 0.5, True, "a", [0, 0], np.zeros(2), np.zeros(2, int), np.zeros(3, np.uint32)]
NO_KEY += [
    jr.split(KEY),
    jr.split(jr.PRNGKey(0)),
    jr.key_data(jr.split(KEY, 1)),
    {},
    object(),
    jr.key,
]
NO_FUNCTION = [0, 1.0, "a", np.ones(2), [], {}, object(), True, KEY]
NO_MAPPING = [0, 1.0, "a", np.ones(2), [1], object(), lambda x: x, True, [("a", 1)]]
NO_PATH = [0, 1, 1.0, b"a", "", ["a"], {}, object(), np.ones(2), True, str]
NO_SHAPE = [3, 1.0, "a", "23", [1.5], (2.0, 1.0), (-1,), [None], object(), {"a"}, (True, True)]
NO_SHAPE += [[[1]], 1j]
NO_NAMES = [0, 1.0, [1], (None,), object(), [["a"]], ("never",), "never"]
NO_MASK = ["a", b"a", [0.5, 1.0], [0, 2], [2, 1], 1j, [1j, 1], np.ones((2, 2), bool), [None, True]]
NO_MASK += [[np.nan, 1.0], {}, object(), DAYS[0], ["True", "False"], [True, [True]], lambda x: x]
NO_MASK += [True, KEY]


def impostors(kind: str) -> list:
    """Values that are nothing of the kind."""
    base = kind.removesuffix(" with gaps").removesuffix("?")
    nothing = [] if "?" in kind else [None]
    if base == "array":
        return NOT_NUMBERS + nothing + list(OBJECTS.values())
    if base == "number":
        return NOT_NUMBERS + nothing
    if base == "setting":  # a finite number
        return [*NOT_NUMBERS, *nothing, SPACE, [1.0, 2.0], np.nan, np.inf, -np.inf]
    if base.startswith("count"):
        least = int(base.rpartition(" ")[2]) if "from" in base else 1
        good = [n for n in NO_COUNT if type(n) is int and least <= n < 2**31]
        return [value for value in NO_COUNT if not any(value is n for n in good)] + nothing
    if base in OBJECTS or base == "noise or name":
        base = base.split(" ")[0]
        others = [v for k, v in OBJECTS.items() if k != base and k not in ARE_TOO.get(base, ())]
        return NO_CLASS + others + [type(OBJECTS[base])] + nothing
    return (
        nothing
        + {
            "flag": NO_FLAG,
            "key": NO_KEY,
            "function": NO_FUNCTION,
            "mapping": NO_MAPPING,
            "path": NO_PATH,
            "file": NO_PATH,
            "text": NO_TEXT,
            "name": [*NO_TEXT, "never", ""],
            "shape": NO_SHAPE,
            "state shape": [*NO_SHAPE, (), (1, 2, 3), (0, 1)],
            "widths": [3, 1.0, "a", "43", [1.5], (), (0,), [None], object(), {"a"}],
            "names": NO_NAMES,
            "axis": ["a", 1.5, None, [0], object()],
            "mask": NO_MASK,
            "arrays": [0, "a", np.ones(3), [1.0], [np.ones((2, 3))], [["a", "b"]], object()],
            "specimens": [0, "a", [], [1], [SQUARE], SPECIMEN, object()],
            "axes": [0, "a", np.ones(2), object(), []],
            "solver": NO_CLASS + list(OBJECTS.values()),
            "state": NO_CLASS,
            "mcmc": [*NO_CLASS, *OBJECTS.values(), MCMC],
            "kernel of MCMC": [*NO_CLASS, *OBJECTS.values(), infer.PCN],
        }[base]
    )


# clothes


def clothes(kind: str, value: Any) -> list[Callable[[], Any]]:
    """Other forms of the same value, made when they are asked for."""
    base = kind.removesuffix(" with gaps").removesuffix("?")
    if base == "count" or base.startswith("count from"):
        return [
            lambda t=t: t(value) for t in (np.int64, np.int32, np.uint8, jnp.asarray, np.asarray)
        ]
    if base == "flag":
        return [lambda: np.bool_(value)]
    if base == "key":
        return [lambda: jr.key(0)]
    if base == "setting":
        return [lambda t=t: t(value) for t in (np.float64, np.asarray, jnp.asarray, float)]
    if base not in ("number", "array"):
        return []
    array = np.asarray(value, float)
    made = [lambda: array.tolist(), lambda: jnp.asarray(array)]
    made += [lambda: array[...], lambda: np.ma.array(array), lambda: array.astype(np.longdouble)]
    if np.all(array == array.astype(np.float16)):
        made += [lambda: array.astype(np.float16), lambda: jnp.asarray(array, jnp.bfloat16)]
        made += [lambda: jnp.asarray(array, jnp.float32)]
    if np.all(array == array.astype(int)):
        made += [
            lambda: array.astype(int),
            lambda: array.astype(np.int8),
            lambda: jnp.asarray(array, int),
        ]
    if array.ndim:
        made += [lambda: array.astype(object), lambda: np.asfortranarray(array)]
    if array.ndim == 1:
        made += [
            lambda: pd.Series(array),
            lambda: tuple(array),
            lambda: [jnp.asarray(x) for x in array],
        ]
    if array.ndim == 2:
        made += [lambda: pd.DataFrame(array), lambda: list(map(jnp.asarray, array))]
    return made


# odd numbers


@st.composite
def odd_numbers(draw, value: Any):
    """A number or array in place of a right one."""
    array = np.asarray(value, float)
    scalar = draw(
        st.sampled_from(
            [0.0, -0.0, -1.0, 1e-300, 1e300, -1e300, np.nan, np.inf, -np.inf, 2.0, 1e9, -0.5]
        )
    )
    how = draw(st.integers(0, 7))
    if how == 0:
        return np.float64(scalar)
    if how == 1:
        return np.full(array.shape, scalar)
    if how == 2 and array.size:
        other = array.copy()
        other.flat[draw(st.integers(0, array.size - 1))] = scalar
        return other
    if how == 3:
        return array[None] if draw(st.booleans()) else array[..., None]
    if how == 4:
        return np.stack([array] * draw(st.integers(1, 4)))
    if how == 5 and array.ndim:
        axis = draw(st.integers(0, array.ndim - 1))
        return np.take(array, np.arange(draw(st.integers(0, 1))), axis=axis)
    if how == 6:
        return array.T if array.ndim > 1 else np.concatenate([array.ravel(), array.ravel()])
    shape = draw(st.lists(st.integers(0, 3), max_size=4))
    return np.zeros(shape)


@contextlib.contextmanager
def tiny_programs():
    """Run operation by operation: nothing is compiled but the operations."""
    with jax.disable_jit(), warnings.catch_warnings():
        warnings.filterwarnings(
            "ignore", message=".*encountered in.*", category=RuntimeWarning
        )  # NumPy: it overflows
        warnings.filterwarnings(
            "ignore", message="Attempting to set identical low and high"
        )  # matplotlib
        yield


def leaves(found):
    """The numbers in a result."""
    plain = hasattr(found, "__dataclass_fields__") and not isinstance(found, eqx.Module)
    parts = jax.tree.leaves(vars(found) if plain else found)
    return [as_numbers(x) for x in parts if not callable(x) and not isinstance(x, (str, Path))]


def as_numbers(x):
    is_key = jnp.issubdtype(getattr(x, "dtype", int), jax.dtypes.prng_key)
    return np.asarray(jr.key_data(x) if is_key else x)


def outcome(entry: Row, arguments: dict):
    """The numbers of the result, or the error; anything but a `ValueError` or a `TypeError` is
    raised.
    """
    with tiny_programs():
        try:
            return leaves(entry.result(entry.call(**arguments)))
        except (ValueError, TypeError) as error:
            return error
        finally:
            plt.close("all")


def named(error, arguments: list[str], entry: Row) -> bool:
    """Whether one of the arguments is named, by its own name or as the row says."""
    names = arguments + [entry.names[name] for name in arguments if name in entry.names]
    return any(f"`{name}" in str(error) for name in names)


def same(found, right) -> bool:
    def near(a, b):
        single = a.dtype == np.float32
        scale = np.max(np.abs(b), initial=0.0, where=np.isfinite(b)) if single else 1e-3
        return np.allclose(a.astype(float), b.astype(float), 1e-6, 1e-6 * scale, equal_nan=True)

    return len(found) == len(right) and all(
        a.shape == b.shape and near(a, b) for a, b in zip(found, right, strict=True)
    )


RIGHT: dict[str, Any] = {}


def right_result(name: str):
    if name not in RIGHT:
        RIGHT[name] = outcome(TABLE[name], TABLE[name].right)
        assert not isinstance(RIGHT[name], Exception), RIGHT[name]
    return RIGHT[name]


def attempt(name: str, data) -> None:
    entry = TABLE[name]
    asked = sorted(argument for argument, kind in entry.kinds.items() if kind != "free")
    argument = data.draw(st.sampled_from(asked), "argument")
    kind, value = entry.kinds[argument], entry.right.get(argument)
    base = kind.removesuffix(" with gaps").removesuffix("?")
    dressed = [] if entry.costly or value is None else clothes(kind, value)
    numeric = base in ("number", "array") and value is not None and not entry.costly
    ways = ["impostor"] * 2 + ["clothes"] * bool(dressed) + ["odd"] * numeric
    way = data.draw(st.sampled_from(ways), "way")
    if way == "impostor":
        bad = impostors(kind)
        chosen = bad[data.draw(st.integers(0, len(bad) - 1), "number")]
    elif way == "clothes":
        chosen = dressed[data.draw(st.integers(0, len(dressed) - 1), "number")]()
    else:
        chosen = data.draw(odd_numbers(value), "value")
    found = outcome(entry, entry.right | {argument: chosen})
    refused = isinstance(found, Exception)
    if way == "impostor":
        good = refused and named(found, [argument], entry)
    elif way == "clothes":
        good = not refused and same(found, right_result(name))
    elif refused:  # where two arguments do not fit together, either may be named
        good = named(found, list(entry.kinds), entry)
    else:
        plainly = np.asarray(chosen).tolist() if np.size(chosen) else np.zeros(np.shape(chosen))
        plain = outcome(entry, entry.right | {argument: plainly})
        visible = not np.any(np.isnan(chosen)) or any(np.any(~np.isfinite(part)) for part in found)
        good = not isinstance(plain, Exception) and same(found, plain) and visible
    assert good, f"{name}({argument}={chosen!r}) gave {found!r}"


@pytest.mark.parametrize("name", [name for name, entry in TABLE.items() if entry.kinds])
def test_random_bad_input(name, request):
    more = request.config.getoption("--bad-inputs")
    arguments = sum(kind != "free" for kind in TABLE[name].kinds.values())
    total = sum(kind != "free" for entry in TABLE.values() for kind in entry.kinds.values())
    if not arguments:
        return
    examples = max(1, round((more or NUM_EXAMPLES) * arguments / total))
    checks = [HealthCheck.too_slow, HealthCheck.function_scoped_fixture]
    chosen = settings(
        max_examples=examples,
        derandomize=more is None,
        deadline=120_000,  # a model may have to be compiled
        database=None,
        suppress_health_check=checks,
    )

    @chosen
    @given(st.data())
    def all_examples(data):
        attempt(name, data)

    all_examples()
