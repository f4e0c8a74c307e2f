"""What is refused, and in which words: the argument in backticks, the rule, the value got, the
cure.

Under the promotion rules that a user has: what would be broadcast silently must be refused by the
library itself.
"""

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import numpyro_bridges as nb
from numpyro_bridges.guiding._score import Standard

pytestmark = [pytest.mark.numpyro, pytest.mark.usefixtures("compile_quickly")]

X = np.array([0.3, -0.9, 0.8])
CURVE = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
TWICE = CURVE[[0, 1, 2, 0]]
OU = nb.LinearSDE(-0.5, 0.4)
CURVED = nb.SDE(lambda t, x, args: -x, lambda t, x, args: 0.5 + 0.1 * jnp.sin(x))
POINTS, BASIS, KERNEL = nb.Landmarks(4, 2), nb.FourierBasis(2, 2), nb.GaussianKernel(0.3, 0.7)
EXACT, NEAR = nb.ExactMatch(), nb.InexactMatch(0.1)
CHAIN = np.array([0.0, 1.0, 1.0])
NAN = np.array([np.nan, 1.0, 1.0])


def linear(drift=-0.5, diffusion=0.4, shift=0.0):
    return bridge(nb.LinearSDE(drift, diffusion, shift))


def user(drift=lambda t, x, args: -x, diffusion=lambda t, x, args: 0.5, args=None, condition=None):
    return bridge(nb.SDE(drift, diffusion, args), condition)


def flow(kernel=KERNEL, x0=CURVE, space=POINTS, **kwargs):
    return bridge(nb.KunitaFlow(space, kernel, **kwargs), NEAR.at(x0), x0=x0)


def bridge(sde=OU, condition=None, x0=X, **kwargs):
    condition = NEAR.at(X) if condition is None else condition
    return nb.GuidedBridge(sde, condition, x0=x0, **({"t1": 1.0, "num_steps": 3} | kwargs))


def solved(solver, guide=None, match=NEAR, sde=CURVED):
    return bridge(
        sde, match.at(X), guide=nb.FrozenGuide() if guide is None else guide, solver=solver
    )


def law(match=NEAR, sde=OU, x0=X, **kwargs):
    return nb.DiffusionEndpoint(sde, x0, match, **({"t1": 1.0, "num_steps": 3} | kwargs))


def simulated(noise=np.zeros((3, 3, 1)), ts=np.linspace(0, 1, 4)):  # noqa: B008
    return nb.simulate(OU, jnp.asarray(X), ts, noise)


SDES = [
    (
        "drift-not-square",
        lambda: linear(np.ones((2, 3))),
        r"`drift` must be square; got shape \(2, 3\)",
    ),
    (
        "drift-of-another-size",
        lambda: linear(-np.eye(2)),
        r"`drift` must be .* \(3, 3\) .*got shape \(2, 2\).*vmap",
    ),
    (
        "drift-that-would-broadcast",
        lambda: linear(-np.ones(1)),
        r"`drift` must be .*diagonal \(3,\).*got shape \(1,\)",
    ),
    (
        "drift-of-three-axes",
        lambda: linear(np.ones((1, 1, 1))),
        r"`drift` must be a scalar, a vector or .*\(1, 1, 1\)",
    ),
    ("drift-nan", lambda: linear(np.nan), r"`drift` must be finite; entry \(\) is nan"),
    (
        "drift-text",
        lambda: linear("fast"),
        "`drift` must be a number or an array of numbers; got 'fast'",
    ),
    ("diffusion-infinite", lambda: linear(-1.0, np.inf), "`diffusion` must be finite; .*inf"),
    (
        "diffusion-size",
        lambda: linear(-1.0, np.ones((2, 2))),
        r"`diffusion` must be .*\(3, k\).*got shape \(2, 2\)",
    ),
    (
        "diffusion-size-diagonal",
        lambda: linear(-np.ones(3), np.ones(2)),
        r"`diffusion` must be .*got shape \(2,\)",
    ),
    (
        "shift-size",
        lambda: linear(-1.0, 1.0, np.ones(2)),
        r"`shift` must be .*\(3,\).*got shape \(2,\)",
    ),
    (
        "shift-columns",
        lambda: linear(-1.0, 1.0, np.ones((3, 5))),
        r"`shift` must be .*got shape \(3, 5\)",
    ),
    (
        "covariance-negative",
        lambda: nb.BrownianMotion(-1.0),
        "`covariance` must be positive semi-definite.*from -1 to",
    ),
    (
        "covariance-diagonal",
        lambda: nb.BrownianMotion([1.0, -2.0]),
        "`covariance` must .*semi-definite.*from -2 to 1",
    ),
    (
        "covariance-zero",
        lambda: nb.BrownianMotion(0.0),
        "`covariance` must be positive semi-definite, and not 0",
    ),
    (
        "covariance-indefinite",
        lambda: nb.BrownianMotion([[1, 2], [2, 1.0]]),
        "`covariance` must be .*from -1 to 3",
    ),
    (
        "covariance-none",
        lambda: nb.BrownianMotion(),
        "Give `covariance` or `factor`, one of the two",
    ),
    (
        "covariance-two",
        lambda: nb.BrownianMotion(1.0, factor=np.eye(2)),
        "Give `covariance` or `factor`, one of the",
    ),
    (
        "covariance-factor-shape",
        lambda: nb.BrownianMotion(factor=np.ones(3)),
        r"`factor` must be a matrix .*\(3,\)",
    ),
    (
        "covariance-factor-nan",
        lambda: nb.BrownianMotion(factor=[[np.nan]]),
        "`factor` must be finite",
    ),
    (
        "covariance-singular, exact",
        lambda: bridge(nb.BrownianMotion(np.ones((3, 3))), nb.ExactMatch().at(np.ones(3))),
        "`condition` is an exact match, which needs noise in every observed direction",
    ),
    (
        "covariance-factor",
        lambda: nb.BrownianMotion(np.eye(2) + [[0, 0.5], [0, 0]]),
        "`covariance` must be symm.*by 0.5",
    ),
    (
        "covariance-shape",
        lambda: nb.BrownianMotion(np.ones((2, 3))),
        r"`covariance` must be \(\), .*got \(2, 3\)",
    ),
    ("covariance-nan", lambda: nb.BrownianMotion(np.nan), "`covariance` must be finite"),
    (
        "covariance-size",
        lambda: bridge(nb.BrownianMotion(np.eye(2))),
        r"`diffusion` must be .*got \(2, 2\) for a state",
    ),
    (
        "user-drift-number",
        lambda: user(1.0),
        r"`drift` must be a function f\(t, x, args\); got 1.0. Wrap it",
    ),
    (
        "user-diffusion-number",
        lambda: user(diffusion=0.5),
        "`diffusion` must be a function.*got 0.5. Wrap",
    ),
    (
        "user-signature",
        lambda: user(lambda x: -x),
        "`drift` must be a function .*three arguments; got .*Add those",
    ),
    (
        "user-drift-shape",
        lambda: user(lambda t, x, a: x[:2]),
        r"`drift` must return .*\(3,\); got \(2,\).*vmap",
    ),
    (
        "user-parameter-axis",
        lambda: user(lambda t, x, a: a * x, args=np.ones((4, 3))),
        r"`drift` must .*\(4, 3\).*vmap",
    ),
    (
        "user-diffusion-shape",
        lambda: user(diffusion=lambda t, x, a: jnp.ones(2)),
        r"`diffusion` must be .*got \(2,\)",
    ),
    (
        "user-diffusion-axes",
        lambda: user(diffusion=lambda t, x, a: jnp.ones((3, 2, 2))),
        r"`diffusion`.*\(3, 2, 2\)",
    ),
    (
        "user-args-text",
        lambda: user(args="theta"),
        "`args` must hold numbers and arrays.*got 'theta'. Let the function",
    ),
    ("kernel-missing", lambda: flow(None), "either `kernel`.* or `covariance`.*got neither"),
    (
        "kernel-twice",
        lambda: flow(covariance=KERNEL),
        "either `kernel`.* or `covariance`.*got both",
    ),
    (
        "kernel-number",
        lambda: flow(0.5),
        "`kernel` must be a kernel, such as `GaussianKernel.*got 0.5",
    ),
    (
        "covariance-matrix",
        lambda: flow(None, covariance=np.eye(4)),
        "`covariance` must be a kernel, such as",
    ),
    (
        "kernel-without-convolution",
        lambda: flow(nb.MaternKernel(1.0, 1.0)),
        "`MaternKernel`.*dimension 2.*`covariance=`",
    ),
    (
        "amplitude-negative",
        lambda: nb.GaussianKernel(-1.0, 1.0),
        "`amplitude` must be positive.*got -1.*LogNormal",
    ),
    (
        "length-scale-zero",
        lambda: nb.GaussianKernel(1.0, 0.0),
        "`length_scale` must be positive.*got 0.*LogNormal",
    ),
    (
        "space-number",
        lambda: nb.KunitaFlow(8, KERNEL),
        "`space` must be a space, such as `Landmarks.*got 8",
    ),
    (
        "space-size",
        lambda: flow(x0=CURVE[:3]),
        r"`x0`, .*`space`, must have shape \(4, 2\); got \(3, 2\)",
    ),
    (
        "landmarks-twice",
        lambda: flow(x0=TWICE),
        '`x0` must have distinct landmarks; 0 and 3 coincide.*Remove.*"spectral"',
    ),
    (
        "noise-name",
        lambda: flow(noise="fourier"),
        "`noise` must be one of .*'control', 'grid', 'landmark', 'spectral'.*got 'fourier'",
    ),
    ("noise-number", lambda: flow(noise=3), "`noise` must be one of .* or a noise object; got 3"),
    (
        "noise-of-a-basis",
        lambda: flow(space=BASIS),
        '`noise="landmark"`.*`FourierBasis`.*Use `noise="spectral"` or',
    ),
    (
        "noise-object-of-a-basis",
        lambda: flow(space=BASIS, noise=nb.LandmarkNoise()),
        '`noise="landmark"`.*`FourierBasis`',
    ),
    (
        "grid-without-kernel",
        lambda: flow(None, covariance=KERNEL, noise="grid"),
        '`noise="grid"` needs .*`kernel`.*use "l',
    ),
    (
        "grid-corners",
        lambda: flow(noise=nb.GridNoise(-np.ones(3), np.ones(3), 3)),
        r"`lower` and `upper`.*\(2,\).*\(3,\)",
    ),
    (
        "grid-order",
        lambda: nb.GridNoise(1.0, -1.0),
        "`lower` must be below `upper`; got 1.0 and -1.0",
    ),
    ("grid-infinite", lambda: nb.GridNoise(-np.inf, 1.0), "`lower` must be finite"),
    (
        "grid-cells",
        lambda: nb.GridNoise(num_cells=2.5),
        "`num_cells` must be a positive integer; got 2.5",
    ),
    (
        "spectral-modes",
        lambda: nb.SpectralNoise(0),
        "`num_modes` must be a positive integer; got 0",
    ),
    (
        "spectral-period",
        lambda: nb.SpectralNoise(2, -1.0),
        "`period` must be positive and finite; got -1.*side of a box",
    ),
    (
        "spectral-periods",
        lambda: nb.SpectralNoise(2, [6.0, 6.0]),
        r"`period` must be one number.*got shape \(2,\)",
    ),
    (
        "spectral-diameter",
        lambda: nb.SpectralNoise(2, diameter=np.inf),
        "`diameter` must be positive.*inf.*largest",
    ),
    (
        "spectral-no-period",
        lambda: flow(KERNEL + KERNEL, noise="spectral"),
        "`period` must be given to SpectralNoise",
    ),
    (
        "jitter-negative",
        lambda: nb.LandmarkNoise(-1e-6),
        "`jitter` must be a number from 0 on.*got -1e-06",
    ),
    ("jitter-nan", lambda: nb.LandmarkNoise(np.nan), "`jitter` must be .*got nan"),
    (
        "simulate-noise-size",
        lambda: simulated(np.zeros((3, 2, 1))),
        r"`noise` must have shape \(3, 3, 1\).*got \(3, 2, 1\)",
    ),
    (
        "simulate-noise-batch",
        lambda: simulated(np.zeros((7, 3, 3, 1))),
        r"`noise` must .*\(7, 3, 3, 1\). Use vmap",
    ),
    (
        "simulate-grid",
        lambda: simulated(ts=np.array([0.0, 0.5, 0.2, 1.0])),
        "`ts` must increase strictly",
    ),
]

CONDITIONS = [
    (
        "variance-negative",
        lambda: nb.InexactMatch(-0.1),
        "`variance` must be positive and finite; got -0.1.*ExactMatch",
    ),
    (
        "variance-zero",
        lambda: nb.InexactMatch(0.0),
        "`variance` must be positive.*got 0.*ExactMatch",
    ),
    (
        "variance-nan",
        lambda: nb.InexactMatch(np.nan),
        "`variance` must be positive and finite; got nan",
    ),
    (
        "variance-one-negative",
        lambda: nb.InexactMatch([0.1, -0.1]),
        "`variance` must be positive.*-0.1",
    ),
    (
        "variance-singular",
        lambda: nb.InexactMatch(np.ones((2, 2))),
        "`variance` must be a symmetric, positive.*Observe few",
    ),
    (
        "variance-factor",
        lambda: nb.InexactMatch(np.eye(2) + [[0, 0.5], [0, 0]]),
        "`variance` must be a symmetric",
    ),
    (
        "variance-shape",
        lambda: nb.InexactMatch(np.ones((2, 3))),
        r"`variance` must be .*\(m, m\); got shape \(2, 3\)",
    ),
    (
        "variance-size",
        lambda: bridge(OU, nb.InexactMatch([0.1, 0.2]).at(X)),
        r"`variance` must .*3 rows.*got shape \(2,\)",
    ),
    ("variance-text", lambda: nb.InexactMatch("small"), "`variance` must be a number.*got 'small'"),
    (
        "weights-of-another-size",
        lambda: bridge(OU, nb.InexactMatch(0.1, space=POINTS).at(X)),
        r"`space` must .*3; got \(4,\)",
    ),
    (
        "weights-of-a-number",
        lambda: nb.InexactMatch(0.1, None, 0.2),
        "`space` must be a space.*got 0.2",
    ),
    (
        "weights-negative",
        lambda: nb.Landmarks(4, 2, weights=-1.0),
        "`weights` must be positive.*left out by the condition",
    ),
    (
        "sd-negative",
        lambda: nb.InexactMatch.from_point_sd(-0.1, POINTS),
        "`sd` must be positive.*got -0.1.*ExactMatch",
    ),
    (
        "sd-without-space",
        lambda: nb.InexactMatch.from_point_sd(0.1, None),
        "`space` must be a space.*got None",
    ),
    (
        "operator-vector",
        lambda: nb.ExactMatch(np.ones(3)),
        r"`operator` must be a matrix \(m, n\).*got shape \(3,\)",
    ),
    (
        "operator-rank",
        lambda: nb.ExactMatch(np.ones((2, 3))),
        "`operator` must have independent rows.*Remove repeated",
    ),
    (
        "operator-nan",
        lambda: nb.InexactMatch(0.1, np.full((1, 3), np.nan)),
        "`operator` must be finite",
    ),
    (
        "operator-columns",
        lambda: bridge(OU, nb.ExactMatch(np.eye(2)).at([1.0, 2.0])),
        r"`operator` must have 3 col.*\(2, 2\)",
    ),
    (
        "operator-and-mask",
        lambda: nb.ExactMatch(np.eye(3), mask=[1, 1, 1]),
        "`operator` or `mask`, not both",
    ),
    (
        "inexact-operator-and-mask",
        lambda: nb.InexactMatch(0.1, np.eye(3), mask=[1, 1, 1]),
        "`operator` or `mask`, not both",
    ),
    (
        "mask-of-points",
        lambda: nb.ExactMatch(mask=np.ones((3, 2), bool)),
        r"`mask` must be a vector.*\(3, 2\)",
    ),
    (
        "mask-of-numbers",
        lambda: nb.InexactMatch(0.1, mask=[0.5, 1.0, 1.0]),
        "`mask` must hold booleans, .*0.5",
    ),
    (
        "mask-of-nothing",
        lambda: nb.ExactMatch(mask=np.zeros(3, bool)),
        "`mask` must leave at least one row",
    ),
    (
        "mask-traced",
        lambda: jax.jit(lambda m: nb.ExactMatch(mask=m).operator)(np.ones(3)),
        "`mask` .*known.*InexactMatch",
    ),
    (
        "mask-size",
        lambda: nb.InexactMatch(0.1, mask=[True, False]).at(X),
        r"`observed` must have 2 rows, like `mask`.*\(3,\)",
    ),
    (
        "mask-and-matrix",
        lambda: bridge(OU, nb.InexactMatch(np.eye(3), mask=[True, False, True]).at(X)),
        "`mask` must .*independent",
    ),
    (
        "datum-nan",
        lambda: NEAR.at(NAN),
        r"`observed` must be finite; entry \(0,\) is nan. .*`mask=`.*`operator=`",
    ),
    (
        "datum-infinite",
        lambda: EXACT.at([1.0, np.inf]),
        r"`observed` must be finite; entry \(1,\) is inf",
    ),
    (
        "datum-nan-and-seen",
        lambda: nb.InexactMatch(0.1, mask=[True, False, True]).at(NAN),
        "`observed` must be finite",
    ),
    ("datum-text", lambda: NEAR.at("wing"), "`observed` must be a number.*got 'wing'"),
    (
        "datum-size",
        lambda: bridge(OU, NEAR.at(X[:2])),
        r"`observed` must have shape \(3,\).*got \(2,\).*`vmap`, or a plate",
    ),
    (
        "datum-batch",
        lambda: bridge(OU, EXACT.at(np.stack([X] * 5))),
        r"`observed` .*got \(5, 3\).*Several observations",
    ),
    (
        "set-empty",
        lambda: nb.CylinderSet([1.0, 0.0], [0.0, 1.0]),
        r"`lower` must not exceed `upper`.*\[1.\].*1 entries",
    ),
    (
        "set-nan",
        lambda: nb.CylinderSet([np.nan], [0.0]),
        "`lower` and `upper` must not be NaN; got .*nan.*±inf",
    ),
    (
        "set-beyond-infinity",
        lambda: nb.CylinderSet([np.inf], [np.inf]),
        "`lower` must not exceed `upper`, or the set is empty",
    ),
    (
        "set-scalars",
        lambda: nb.CylinderSet(0.0, 1.0),
        r"`lower` and `upper` must have one row per.*\(N,\).*got scalars",
    ),
    (
        "set-shapes",
        lambda: nb.CylinderSet(np.zeros(2), np.ones(3)),
        r"`lower` and `upper`.*got \(2,\) and \(3,\)",
    ),
    (
        "set-too-large",
        lambda: bridge(OU, nb.CylinderSet(np.zeros(4), np.ones(4))),
        "`lower` and `upper` .*at most 3.*number 3",
    ),
    (
        "set-of-points",
        lambda: bridge(OU, nb.CylinderSet(CURVE - 1, CURVE)),
        r"`lower` and `upper` .*rows of shape \(2,\)",
    ),
    (
        "cuts-order",
        lambda: nb.IntervalCensored([1.0, 0.5]),
        r"`cuts` must increase; got \[1.  0.5\]. Sort",
    ),
    (
        "cuts-infinite",
        lambda: nb.IntervalCensored([0.0, np.inf]),
        "`cuts` must be finite.*outer bins are open",
    ),
    (
        "cuts-matrix",
        lambda: nb.IntervalCensored(np.ones((2, 2))),
        r"`cuts` must be a vector.*got shape \(2, 2\)",
    ),
    (
        "bin-beyond",
        lambda: nb.IntervalCensored([0.0]).at([2]),
        r"`observed` must hold bin numbers from 0 to 1; got \[2.\]",
    ),
    (
        "bin-between",
        lambda: nb.IntervalCensored([0.0]).at([0.5]),
        "`observed` must hold bin numbers.*searchsorted",
    ),
    (
        "bin-nan",
        lambda: nb.IntervalCensored([0.0]).at([np.nan]),
        "`observed` must hold bin numbers",
    ),
]

BRIDGES = [
    ("sde-number", lambda: bridge(3.0), "`sde` must be an SDE, such as .*got 3.0"),
    (
        "match-without-datum",
        lambda: bridge(OU, NEAR),
        r"`condition` must be a condition, such as `InexactMatch.*at\(v\)`.*got",
    ),
    ("condition-array", lambda: bridge(OU, X), "`condition` must be a condition.*got ndarray"),
    ("start-nan", lambda: bridge(x0=NAN), r"`x0` must be finite; entry \(0,\) is nan"),
    (
        "start-infinite",
        lambda: bridge(x0=[1.0, np.inf, 1.0]),
        r"`x0` must be finite; entry \(1,\) is inf",
    ),
    ("start-scalar", lambda: bridge(x0=1.0), r"`x0` must be one state, .*got shape \(\)"),
    (
        "start-batch",
        lambda: bridge(x0=np.zeros((5, 3, 1))),
        r"`x0` must be one state.*got shape \(5, 3, 1\). Use vmap",
    ),
    ("start-empty", lambda: bridge(x0=[]), r"`x0` must be one state.*got shape \(0,\)"),
    ("start-text", lambda: bridge(x0="here"), "`x0` must be a number.*got 'here'"),
    (
        "time-zero",
        lambda: bridge(t1=0.0),
        "`t1` must be finite and later than `t0`; got t0 = 0.0, t1 = 0.0",
    ),
    ("time-negative", lambda: bridge(t1=-1.0), "`t1` must be finite and later than `t0`.*-1.0"),
    ("time-nan", lambda: bridge(t1=np.nan), "`t1` must be finite and later.*nan"),
    ("time-infinite", lambda: bridge(t1=np.inf), "`t1` must be finite and later.*inf"),
    (
        "time-vector",
        lambda: bridge(t1=np.ones(3)),
        r"`t0` and `t1` must be one time each.*\(3,\). Use vmap",
    ),
    (
        "time-missing",
        lambda: bridge(t1=None),
        "`t1` and `num_steps`, or a grid `ts`; got t1 = None, num_steps = 3",
    ),
    (
        "steps-missing",
        lambda: bridge(num_steps=None),
        "`t1` and `num_steps`, or a grid `ts`.*num_steps = None",
    ),
    (
        "steps-and-grid",
        lambda: bridge(ts=[0.0, 1.0]),
        "`num_steps` or `ts`, not both; got num_steps = 3",
    ),
    ("steps-zero", lambda: bridge(num_steps=0), "`num_steps` must be a positive integer; got 0"),
    (
        "steps-float",
        lambda: bridge(num_steps=2.0),
        "`num_steps` must be a positive integer; got 2.0",
    ),
    (
        "steps-boolean",
        lambda: bridge(num_steps=True),
        "`num_steps` must be a positive integer; got True",
    ),
    (
        "grid-backwards",
        lambda: bridge(ts=[0.0, 0.5, 0.4, 1.0], num_steps=None),
        "`ts` must increase strictly; .*-0.0?9.*Sort",
    ),
    (
        "grid-repeated",
        lambda: bridge(ts=[0.0, 0.5, 0.5, 1.0], num_steps=None),
        "`ts` must increase strictly; .*0.0.*Sort it",
    ),
    (
        "grid-nan",
        lambda: bridge(ts=[0.0, np.nan, 1.0], num_steps=None),
        r"`ts` must be finite; entry \(1,\)",
    ),
    (
        "grid-of-one-time",
        lambda: bridge(ts=[0.0], num_steps=None),
        r"`ts` must be a vector of at least two.*\(1,\)",
    ),
    (
        "grid-end",
        lambda: bridge(ts=[0.0, 2.0], num_steps=None),
        r"`ts` must end at `t1`; got ts\[-1\] = 2.0 and t1 = 1.0",
    ),
    (
        "grid-begin",
        lambda: bridge(ts=[0.0, 1.0], t0=0.3, num_steps=None),
        "`ts` must begin at `t0`; got .*t0 = 0.3",
    ),
    (
        "guide-class",
        lambda: bridge(guide=nb.FrozenGuide),
        r"`guide` must be a guide, such as `FrozenGuide\(\)`; got <class",
    ),
    ("guide-of-a-guide", lambda: nb.DriftGuide(OU), "`guide` must be a guide"),
    (
        "auxiliary-nonlinear",
        lambda: nb.FrozenGuide(CURVED),
        "`auxiliary` must be a LinearSDE or a BrownianMotion.*got SDE",
    ),
    (
        "auxiliary-size",
        lambda: bridge(guide=nb.FrozenGuide(nb.LinearSDE(-np.ones(2), 1.0))),
        r"`auxiliary` must.*\(3,\).*\(2,\)",
    ),
    (
        "auxiliary-size-inside",
        lambda: bridge(guide=nb.DriftGuide(nb.FrozenGuide(nb.BrownianMotion([1.0])))),
        r"`auxiliary` must",
    ),
    (
        "end-weight",
        lambda: nb.RecedingGuide(1.5),
        "`end_weight` must be a number from 0 to 1; got 1.5",
    ),
    (
        "correction",
        lambda: nb.GeodesicGuide(-0.5),
        "`correction` must be a number from 0 to 1; got -0.5",
    ),
    (
        "end-weights",
        lambda: nb.RecedingGuide([0.1, 0.2]),
        r"`end_weight` must be a number.*\[0.1, 0.2\]",
    ),
    (
        "solver-stratonovich",
        lambda: solved(diffrax.Heun()),
        "`solver` must be an Itô solver.*got Heun.*another process",
    ),
    (
        "solver-for-odes",
        lambda: solved(diffrax.Tsit5(), sde=OU),
        r"`solver` must be a diffrax solver for SDEs.*got Tsit5",
    ),
    (
        "solver-class",
        lambda: solved(diffrax.Euler, sde=OU),
        r"`solver` must be .*such as `diffrax.Euler\(\)`; got <class",
    ),
    (
        "solver-and-receding",
        lambda: solved(diffrax.Euler(), nb.RecedingGuide()),
        r"\(a diffrax `solver`\).*`guide=FrozenGuide",
    ),
    (
        "solver-mismatch",
        lambda: solved(diffrax.Euler(), nb.FrozenGuide(OU), EXACT),
        "`auxiliary` must match.*differ by 0.*defa",
    ),
    (
        "pinned-without-noise",
        lambda: user(diffusion=lambda t, x, a: jnp.asarray(CHAIN), condition=EXACT.at(X)),
        "`condition` is an exact match.*singular.*`InexactMatch` with a small variance",
    ),
    (
        "pinned-with-one-noise",
        lambda: user(diffusion=lambda t, x, a: jnp.ones((3, 1)), condition=EXACT.at(X)),
        "`condition` is an exact match.*singular",
    ),
    (
        "pinned-deterministic",
        lambda: bridge(nb.LinearSDE(-1.0, 0.0), EXACT.at(X)),
        "`condition` is an exact match.*singular",
    ),
    (
        "noise-columns",
        lambda: bridge().path(np.zeros((3, 3))),
        r"`noise` must have shape \(3, 3, 1\).*got \(3, 3\)",
    ),
    (
        "noise-batch",
        lambda: bridge().log_weight(np.zeros((7, 3, 3, 1))),
        r"`noise` must .*one path; got \(7, 3, 3, 1\). Use vmap",
    ),
    (
        "path-shape",
        lambda: bridge().noise_from_path(np.zeros((3, 3))),
        r"`path` must have shape \(4, 3\); got \(3, 3\)",
    ),
    (
        "path-and-solver",
        lambda: solved(diffrax.Euler()).noise_from_path(np.zeros((4, 3))),
        "`noise_from_path` needs .*`solver`",
    ),
    (
        "state-shape",
        lambda: bridge().log_h(0.0, X[:2]),
        r"`x` must be one state, \(3,\); got shape \(2,\). Use vmap",
    ),
    (
        "score-at-the-end",
        lambda: bridge().score(1.0, X),
        r"`t` must lie in \[0.0, 1.0\), before the end; got 1.0",
    ),
    (
        "one-particle",
        lambda: nb.estimate_evidence(bridge(), jr.key(0), 1),
        "`num_particles` must be .*at least 2; got 1",
    ),
    (
        "particles-float",
        lambda: nb.estimate_evidence(bridge(), jr.key(0), 1e3),
        "`num_particles` must be an integer.*1000.0",
    ),
    (
        "batches-of-nothing",
        lambda: nb.estimate_evidence(bridge(), jr.key(0), 9, batch_size=0),
        "`batch_size` must be .*got 0",
    ),
    (
        "evidence-of-a-number",
        lambda: nb.estimate_evidence(3, jr.key(0), 9),
        "`bridge` must be a `GuidedBridge`; got 3",
    ),
]

LAWS = [
    (
        "law-of-a-kernel",
        lambda: law(nb.InexactMatch(0.1, normalised=False)),
        "`normalised=False` is a kernel.*`normalised=True`",
    ),
    (
        "law-of-a-condition",
        lambda: law(NEAR.at(X)),
        "`match` must be a model of observation.*got .*`obs=`",
    ),
    (
        "law-of-a-set",
        lambda: law(nb.CylinderSet(X, X + 1)),
        "`match` must be a model of observation.*got CylinderSet",
    ),
    (
        "law-start-batch",
        lambda: law(x0=np.zeros((5, 3, 1))),
        r"`x0` must be one state.*\(5, 3, 1\).*`batch_shape`",
    ),
    ("law-start-nan", lambda: law(x0=NAN), "`x0` must be finite"),
    ("law-steps-and-grid", lambda: law(ts=[0.0, 1.0]), "`num_steps` or `ts`, not both"),
    ("law-time-missing", lambda: law(t1=None), "`t1` and `num_steps`, or a grid `ts`"),
    (
        "law-parameter-axis",
        lambda: law(sde=nb.LinearSDE(-np.ones(5), 0.4)),
        r"`drift` must be .*got shape \(5,\).*vmap",
    ),
    (
        "law-without-noise",
        lambda: law().log_prob(X),
        r"noise site is missing.*`numpyro_bridges.sample.*`law.given\(noise\)`",
    ),
    (
        "law-noise-shape",
        lambda: law().given(np.zeros((2, 3, 1))),
        r"`noise` must have shape .*3, 3, 1.*got \(2, 3, 1\)",
    ),
    (
        "law-one-noise",
        lambda: law().given(np.zeros((3, 3, 1))).log_prob(np.stack([X] * 6)),
        "One noise shared.*plate",
    ),
    (
        "law-datum-nan",
        lambda: law().given(np.zeros((3, 3, 1))).log_prob(NAN),
        r"`observed` must be finite; entry \(0,\)",
    ),
]


def fitted(sde=OU, condition=None, x0=X, **kwargs):
    condition = NEAR.at(X) if condition is None else condition
    options = {"t1": 1.0, "num_steps": 3, "key": jr.key(0), "progress": False} | kwargs
    return nb.scores.fit(sde, condition, x0=x0, **options)


def set_of(x):
    return nb.CylinderSet(x, x + 1)


def trained_for(shape):
    standard = Standard(*(jnp.ones(s) for s in ((), shape, shape, shape, 0, 0)))
    return nb.scores.ScoreGuide(nb.FrozenGuide(), lambda t, x, v, theta: 0 * x, standard)


HYPO = nb.LinearSDE(np.eye(3, k=1), np.array([[0.0], [0.0], [1.0]]))
PART, SET = nb.InexactMatch(0.1, np.array([[1.0, 0.0, 0.0]])).at([0.3]), set_of(X)
SCORES = [
    (
        "method",
        lambda: fitted(method="magic"),
        "`method` must be one of .*'adjoint', 'matching', 'residual'.*'magic'",
    ),
    (
        "adjoint-of-a-part",
        lambda: fitted(condition=PART, method="adjoint"),
        "'adjoint'.*whole state.*'residual'",
    ),
    (
        "adjoint-of-a-set",
        lambda: fitted(condition=SET, method="adjoint"),
        "'adjoint'.*whole state.*'residual'",
    ),
    (
        "reversal-of-a-set",
        lambda: fitted(condition=SET, method="reversal"),
        "'reversal'.*observed value.*'residual'",
    ),
    (
        "adjoint-hypoelliptic",
        lambda: fitted(HYPO, method="adjoint"),
        "'adjoint'.*every direction.*'residual'",
    ),
    (
        "reversal-hypoelliptic",
        lambda: fitted(HYPO, method="reversal"),
        "'reversal'.*every direction.*'residual'",
    ),
    (
        "matching-of-a-set",
        lambda: fitted(condition=SET, method="matching"),
        "'matching'.*observed value.*'residual'",
    ),
    (
        "drift-that-explodes",
        lambda: fitted(
            nb.SDE(lambda t, x, a: 9 * x**5, lambda t, x, a: 1.0), x0=3 + X, num_steps=30
        ),
        "`sde` must have paths that stay finite, and 64 of 64 .*drift explodes.*Increase `num_steps`",
    ),
    (
        "network-of-another-shape",
        lambda: fitted(network=lambda t, x, v, theta: x[:2]),
        r"`network` must be a function that takes .*x and v \(3, 1\) and theta \(0,\).*it returned \(2, 1\)",
    ),
    (
        "network-of-other-arguments",
        lambda: fitted(network=lambda t, x: x),
        r"`network` must be a function that takes \(t, x, v, theta\).*called so it says: .*4 were given",
    ),
    (
        "context-that-does-not-vary",
        lambda: fitted(context=lambda sde: jnp.ones(1)),
        "`context` must vary over what is drawn, .*Leave it out, or let `draw` vary it",
    ),
    (
        "guide-of-another-size",
        lambda: bridge(guide=trained_for((2, 1))),
        r"`guide` was trained for states \(2, 1\); .*3",
    ),
    (
        "guide-of-no-guide",
        lambda: nb.scores.ScoreGuide(3, abs, None),
        r"`guide` must be a guide.*got 3",
    ),
    (
        "network-of-no-function",
        lambda: nb.scores.ScoreGuide(nb.FrozenGuide(), 3, None),
        "`network` must be a func.*3",
    ),
    (
        "context-of-no-function",
        lambda: fitted(context=3),
        "`context` must be a function of the SDE; got 3",
    ),
    (
        "training-of-a-number",
        lambda: fitted(training=3),
        r"`training` must be a `Training\(...\)`; got 3",
    ),
    (
        "no-updates",
        lambda: nb.scores.Training(0),
        "`num_updates` must be a positive integer; got 0",
    ),
    (
        "half-a-batch",
        lambda: nb.scores.Training(9, 0.5),
        "`batch_size` must be a positive integer; got 0.5",
    ),
    (
        "interval",
        lambda: nb.scores.Training(9, interval=0),
        "`interval` must be a positive integer; got 0",
    ),
    (
        "held-out",
        lambda: nb.scores.Training(9, held_out=-1),
        "`held_out` must be a positive integer; got -1",
    ),
    (
        "average",
        lambda: nb.scores.Training(9, average=1.0),
        r"`average` must be in \[0, 1\); got 1.0",
    ),
    (
        "learning-rate",
        lambda: nb.scores.Training(9, learning_rate=0.0),
        "`learning_rate` must be positive; got 0.0",
    ),
]


def traced(f, value=0.5):
    """f in a program, where `value` is traced and constants are known."""
    return jax.eval_shape(f, jnp.asarray(value))


KINDS = [
    (
        "traced-complex",
        lambda: traced(nb.BrownianMotion, 1j),
        "`covariance` must be a number.*complex128.*real part",
    ),
    (
        "traced-boolean",
        lambda: traced(nb.InexactMatch, True),
        "`variance` must be a number.*of bool.*astype",
    ),
    (
        "traced-in-a-list",
        lambda: traced(lambda x: bridge(x0=[x, "a", x])),
        "`x0` must be a number.*Convert text",
    ),
    (
        "known-inside",
        lambda: traced(lambda x: nb.InexactMatch(-0.1)),
        "`variance` must be positive.*got -0.1",
    ),
    (
        "datum-known-inside",
        lambda: traced(lambda x: nb.InexactMatch(x).at(NAN)),
        "`observed` must be finite",
    ),
    (
        "too-large",
        lambda: linear(np.longdouble("1e400")),
        "`drift` must fit into float64; got 1e[+]400.*units",
    ),
    ("too-large-integer", lambda: linear(10**400), "`drift` must be a number; got 1000.*too large"),
    (
        "shapes-traced",
        lambda: traced(lambda x: nb.shapes.center(x * CURVE)),
        "`points` must be known before tracing",
    ),
    (
        "key-seed",
        lambda: nb.estimate_evidence(bridge(), 0, 9),
        "`key` must be a random key, such as `jax.random.key",
    ),
    (
        "key-batch",
        lambda: nb.estimate_evidence(bridge(), jr.split(jr.key(0)), 9),
        "`key` must be one random key.*keys",
    ),
    (
        "flag-text",
        lambda: nb.InexactMatch(0.1, normalised="False"),
        "`normalised` must be True or False; got 'False'",
    ),
    ("file-number", lambda: nb.io.read_csv(0), "`path` must be a path.*got 0"),
    (
        "diffusion-empty",
        lambda: linear(-1.0, np.zeros((3, 0))),
        r"`diffusion` must not be empty; got shape \(3, 0\)",
    ),
]

CASES = SDES + CONDITIONS + BRIDGES + LAWS + SCORES + KINDS


@pytest.mark.parametrize("make, message", [pytest.param(*case, id=name) for name, *case in CASES])
def test_refused(make, message):
    """A ValueError in one paragraph of our own words."""
    with pytest.raises(ValueError, match=f"(?s){message}") as caught:
        make()
    text = str(caught.value)
    assert "`" in text and text.endswith((".", "!", "`", ")")) and not text.startswith(" ")


def test_every_case_has_its_name():
    names = [name for name, *_ in CASES]
    assert len(names) == len(set(names))
