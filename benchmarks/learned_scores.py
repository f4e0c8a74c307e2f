"""How good are learned guides, and do they agree with guided bridges?

Parts, each JSON lines (seconds of training hold the compilation):

- `ou`: dX = −X dt + dW in dimension d over time T, guided by Brownian motion: mean squared and
  relative error of ∇log h against the closed form, on exact bridges.
- `evidence`: log evidence of guided and learned bridges: do they agree within 3 joint standard
  errors (null where that cannot be known), and what is the ESS?
- `kunita`: 8 landmarks: error of ∇log h against nested simulation of the unconditioned flow.
- `points`: trained at 32 landmarks, used at 128: error of the score against nested guided bridges
  at both.
- `amortised`: one guide for all parameters inside MCMC on a real wing: the same posterior,
  effective draws a second.

    python benchmarks/learned_scores.py                      # an hour
    python benchmarks/learned_scores.py --parts ou --quick
"""

import argparse
import json
import os
import time

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import numpyro
import numpyro.distributions as dist
from mcmc import seconds_of_a_draw

import numpyro_bridges as nb
from numpyro_bridges.scores import Training, fit

METHODS = ("residual", "adjoint", "reversal")


def show(**row):
    print(
        json.dumps({k: round(v, 6) if isinstance(v, float) else v for k, v in row.items()}),
        flush=True,
    )


def trained(bridge, method, training, **settings):
    """The bridge with a learned guide, and the seconds of its training."""
    begin = time.perf_counter()
    guide = fit(
        bridge.sde,
        bridge.condition,
        x0=bridge.x0,
        ts=bridge.ts,
        guide=bridge.guide,
        key=jr.key(1),
        method=method,
        training=training,
        progress=False,
        **settings,
    )
    return bridge.with_guide(guide), time.perf_counter() - begin


def paths_of(bridge, key, num):
    """Paths by the guide, and normalised weights."""
    noise = jr.normal(key, (num, *bridge.noise_shape), bridge.x0.dtype)
    paths, log_weights = jax.jit(jax.vmap(bridge.path_and_log_weight))(noise)
    return paths, jax.nn.softmax(log_weights)


def score_errors(bridge, truth, paths, weights):
    """Mean squared error of a coordinate, and relative error in the norm of a, over paths and grid
    times.
    """
    times = bridge.ts[:-1]

    def one(t, x):
        true, a = truth(t, x), bridge.sde.covariance(t, x)
        gap, a = bridge.score(t, x) - true, a * jnp.eye(x.shape[0]) if a.ndim < 2 else a
        return jnp.mean(gap**2), jnp.sum(gap * (a @ gap)), jnp.sum(true * (a @ true))

    squares = jax.jit(jax.vmap(lambda p: jax.vmap(one)(times, p[:-1])))(paths)
    mse, error, size = (float(jnp.sum(weights[:, None] * s) / times.shape[0]) for s in squares)
    return mse, error / size


def ou(arguments):
    for d in [1] if arguments.quick else [1, 8, 32]:
        for T in [1.0] if arguments.quick else [1.0, 4.0, 16.0]:
            sde = nb.LinearSDE(-1.0, 1.0)
            condition = nb.ExactMatch().at(jnp.full(d, 0.5))
            exact = nb.GuidedBridge(sde, condition, x0=jnp.ones(d), t1=T, num_steps=100)
            paths, weights = paths_of(exact, jr.key(0), 256)

            def truth(t, x, T=T):
                left = T - t
                return jnp.exp(-left) * (0.5 - jnp.exp(-left) * x) / (-0.5 * jnp.expm1(-2 * left))

            start = exact.with_guide(nb.FrozenGuide(nb.BrownianMotion(1.0)))
            mse, relative = score_errors(start, truth, paths, weights)
            show(part="ou", d=d, T=T, method="none", mse=mse, relative=relative)
            for method in arguments.methods:
                learned, seconds = trained(start, method, arguments.training)
                mse, relative = score_errors(learned, truth, paths, weights)
                show(
                    part="ou", d=d, T=T, method=method, mse=mse, relative=relative, seconds=seconds
                )


def hill(x):
    return x**4 / (1 / 16 + x**4)


def cases(quick):
    """Bridges, and the methods that suit them."""

    def cell(t, x, a):
        u = hill(x)
        return jnp.stack([u[0] + 1 - u[1] - x[0], u[1] + 1 - u[0] - x[1]])

    def fitzhugh_nagumo(t, x, a):
        return jnp.stack([(x[0] - x[1] - x[0] ** 3) / 0.1, 1.5 * x[0] - x[1] + 0.8])

    def build(sde, condition, x0, t1, num_steps, guide=None):
        return nb.GuidedBridge(
            sde, condition, x0=jnp.asarray(x0), t1=t1, num_steps=num_steps, guide=guide
        )

    cells = nb.SDE(cell, lambda t, x, a: 0.1)
    aux = nb.FrozenGuide(nb.LinearSDE(-1.0, 0.1, jnp.array([2.0, 0.0])))
    rare = nb.FrozenGuide(nb.LinearSDE(-1.0, 0.1, jnp.array([1.0, 0.0])))
    first = nb.InexactMatch(0.1**2, jnp.array([[1.0, 0.0]]))
    wait_and_jump = nb.SDE(lambda t, x, a: 2 - 2 * jnp.sin(8 * x), lambda t, x, a: 0.5)
    level = nb.ExactMatch().at(jnp.array([np.pi / 2]))
    brownian = nb.FrozenGuide(nb.BrownianMotion(0.25))
    yield "sine, Brownian guide", METHODS, build(wait_and_jump, level, [0.0], 1.0, 100, brownian)
    if quick:
        return
    yield "sine", METHODS, build(wait_and_jump, level, [0.0], 1.0, 100)
    yield (
        "cell",
        METHODS,
        build(cells, nb.ExactMatch().at(jnp.array([2.0, -0.1])), [0.1, -0.1], 4.0, 400, aux),
    )
    yield (
        "cell, rare",
        METHODS,
        build(cells, nb.ExactMatch().at(jnp.array([1.0, -0.1])), [0.1, -0.1], 4.0, 400, rare),
    )
    yield (
        "FitzHugh-Nagumo",
        ("residual",),
        build(
            nb.SDE(fitzhugh_nagumo, lambda t, x, a: jnp.array([[0.0], [0.3]])),
            first.at(jnp.array([-1.0])),
            [-0.5, -0.6],
            2.0,
            400,
        ),
    )
    for n in (2, 32):
        s = 2 * np.pi * np.arange(n) / n
        start = np.stack([np.cos(s), np.sin(s)], 1)
        end = np.stack([1.3 * np.cos(s) + 0.1 + 0.05 * np.cos(3 * s), 0.8 * np.sin(s) - 0.2], 1)
        flow = nb.KunitaFlow(nb.Landmarks(n, 2), nb.GaussianKernel(0.3, 0.5))
        yield f"Kunita {n}", METHODS, build(flow, nb.InexactMatch(0.01 / n).at(end), start, 1.0, 50)


def evidence(arguments):
    for name, methods, bridge in cases(arguments.quick):
        if arguments.cases and name not in arguments.cases:
            continue
        guided = nb.estimate_evidence(bridge, jr.key(2), num_particles=arguments.particles)
        report(name, "guided", guided, guided)
        for method in (m for m in methods if m in arguments.methods):
            batch = (
                16
                if name == "Kunita 32" and method == "residual"
                else arguments.training.batch_size
            )
            training = Training(arguments.updates, batch)
            learned, seconds = trained(bridge, method, training)
            found = nb.estimate_evidence(learned, jr.key(3), num_particles=arguments.particles)
            report(name, method, found, guided, seconds=seconds)


def report(name, method, found, guided, **more):
    both = nb.Comparison.of({"guided": guided, "learned": found})
    n = found.log_weights.shape[0]
    show(
        part="evidence",
        case=name,
        method=method,
        log_evidence=float(found.log_evidence),
        standard_error=float(found.standard_error),
        ess_percent=100 * float(found.ess) / n,
        pareto_k=float(found.pareto_k),
        trusted=found.trusted,
        agrees=both.agree("guided", "learned"),
        **more,
    )


def simulated_score(bridge, num, key):
    """(t, x) ↦ ∇log h by unconditioned paths from x: ∇ log of the mean density of what is seen,
    pathwise.
    """
    seen, _ = bridge.end()
    observed, ts = bridge.observed(), bridge.ts

    def log_h(x, k, key):
        def one(key):
            z = jr.normal(key, bridge.noise_shape, x.dtype)

            def step(x, inputs):
                t0, t1, z, on = inputs
                law = bridge.sde.transition(t0, t1, x)
                return jnp.where(on, law.mean + law.factor @ z, x), None

            x_end, _ = jax.lax.scan(
                step, x, (ts[:-1], ts[1:], z, jnp.arange(bridge.num_steps) >= k)
            )
            factor = seen.factor if seen.factor.ndim == 0 else seen.factor[:, None]
            gap = (observed - x_end) / factor
            return -0.5 * jnp.sum(gap**2)

        return jax.nn.logsumexp(jax.vmap(one)(jr.split(key, num)))

    return jax.jit(jax.grad(log_h)), key


def kunita(arguments):
    """At states of guided bridges, early, half-way and late."""
    n, num = 8, 2000 if arguments.quick else 60000
    s = 2 * np.pi * np.arange(n) / n
    start = np.stack([np.cos(s), np.sin(s)], 1)
    end = np.stack([1.1 * np.cos(s) + 0.1, 0.9 * np.sin(s) - 0.1], 1)
    flow = nb.KunitaFlow(nb.Landmarks(n, 2), nb.GaussianKernel(0.3, 0.5))
    bridge = nb.GuidedBridge(
        flow, nb.InexactMatch(0.1 / n).at(end), x0=jnp.asarray(start), t1=1.0, num_steps=25
    )
    gradient, key = simulated_score(bridge, num, jr.key(7))
    paths, _ = paths_of(bridge, jr.key(0), 8)
    where = [(k, paths[i, k]) for i in range(2 if arguments.quick else 8) for k in (0, 12, 20)]
    halves = [
        [gradient(x, k, jr.fold_in(key, 2 * i + j)) for j in (0, 1)]
        for i, (k, x) in enumerate(where)
    ]

    def relative(score):
        """Products of the errors to two independent referees: unbiased for the squared error."""
        error = size = 0.0
        for (k, x), (u, w) in zip(where, halves, strict=True):
            a, s = flow.covariance(0.0, x), score(k, x)
            error += float(jnp.sum((s - u) * (a @ (s - w))))
            size += float(jnp.sum(u * (a @ w)))
        return error / size

    for method in ("guided", *arguments.methods):
        learned, seconds = (
            (bridge, 0.0) if method == "guided" else trained(bridge, method, arguments.training)
        )
        score = jax.jit(learned.score)
        error = relative(lambda k, x, score=score: score(bridge.ts[k], x))
        show(part="kunita", method=method, relative=error, seconds=seconds)
    noise = np.mean([float(jnp.sum((u - w) ** 2) / jnp.sum((u + w) ** 2)) for u, w in halves])
    show(part="kunita", method="referee", relative_noise=float(noise))


def points(arguments):
    """The score of a fine guided bridge is the gradient of its estimated log evidence, from each
    state.
    """

    def bridge_at(n, guide=None):
        s = 2 * np.pi * np.arange(n) / n
        start = np.stack([np.cos(s), np.sin(s)], 1)
        end = np.stack([1.3 * np.cos(s) + 0.1 + 0.05 * np.cos(3 * s), 0.8 * np.sin(s) - 0.2], 1)
        flow = nb.KunitaFlow(nb.Landmarks(n, 2), nb.GaussianKernel(0.3, 0.5))
        condition = nb.InexactMatch(3e-4).at(end)
        return nb.GuidedBridge(
            flow, condition, x0=jnp.asarray(start), t1=1.0, num_steps=25, guide=guide
        )

    sizes = (8, 16) if arguments.quick else (32, 128)
    learned, seconds = trained(bridge_at(sizes[0]), "residual", Training(arguments.updates, 16))
    num = 64 if arguments.quick else 1024
    for n in sizes:
        base = bridge_at(n)
        with_network = base.with_guide(learned.guide)
        path = with_network.path(jnp.zeros(with_network.noise_shape))

        def log_h(x, k, key, base=base):
            """Of the rest of the grid, each state its own start."""
            rest = nb.GuidedBridge(base.sde, base.condition, x0=x, ts=base.ts[k:], guide=base.guide)
            z = jr.normal(key, (num, *rest.noise_shape), x.dtype)
            return jax.nn.logsumexp(jax.vmap(rest.log_weight)(z))

        errors, sizes_of = {"guided": 0.0, "residual": 0.0}, 0.0
        for k in (0, 8, 16):
            gradient = jax.jit(jax.grad(lambda x, key, k=k, log_h=log_h: log_h(x, k, key)))
            u, w = gradient(path[k], jr.key(10 + k)), gradient(path[k], jr.key(50 + k))
            a = base.sde.covariance(0.0, path[k])
            for name, b in (("guided", base), ("residual", with_network)):
                s = b.score(base.ts[k], path[k])
                errors[name] += float(jnp.sum((s - u) * (a @ (s - w))))
            sizes_of += float(jnp.sum(u * (a @ w)))
        ess = {}
        for name, b in (("guided", base), ("residual", with_network)):
            e = nb.estimate_evidence(b, jr.key(4), num_particles=512)
            ess[name] = 100 * float(e.ess) / 512
        show(
            part="points",
            points=n,
            guided=errors["guided"] / sizes_of,
            residual=errors["residual"] / sizes_of,
            ess_guided=ess["guided"],
            ess_residual=ess["residual"],
            seconds=seconds,
        )


def amortised(arguments):
    """FunctionSpaceHMC on one real wing, amplitude and length scale unknown, by a guide and by a
    learned one.
    """
    n, num_steps = (8, 10) if arguments.quick else (32, 50)
    wings = nb.datasets.mosquito_wings(num_points=n, genus="CX")
    space, seen = nb.Landmarks(n, 2), nb.InexactMatch.from_point_sd(0.005, nb.Landmarks(n, 2))

    def flow(amplitude, length_scale):
        return nb.KunitaFlow(space, nb.GaussianKernel(amplitude, length_scale))

    def draw(key):
        key_amplitude, key_length, key_datum = jr.split(key, 3)
        amplitude = 0.036 * jnp.exp(0.5 * jr.normal(key_amplitude))
        length_scale = 0.44 * jnp.exp(0.3 * jr.normal(key_length))
        datum = jnp.asarray(wings.points)[jr.randint(key_datum, (), 0, len(wings.points))]
        return flow(amplitude, length_scale), seen.at(datum), jnp.asarray(wings.mean)

    def context(sde):
        return jnp.log(jnp.stack([sde.kernel.amplitude, sde.kernel.length_scale]))

    bridge = nb.GuidedBridge(
        *draw(jr.key(0))[:2], x0=jnp.asarray(wings.mean), t1=1.0, num_steps=num_steps
    )
    training = Training(arguments.updates, 16)
    learned, seconds = trained(bridge, "residual", training, draw=draw, context=context)
    show(
        part="amortised",
        training_seconds=seconds,
        ess=[float(v) for v in learned.guide.history["ess"]],
    )
    posterior = {}
    for name, guide in (("guided", None), ("amortised", learned.guide)):

        def model(observed, guide=guide):
            amplitude = numpyro.sample("amplitude", dist.LogNormal(-2.0, 1.0))
            length_scale = numpyro.sample("length_scale", dist.LogNormal(-1.0, 0.5))
            law = nb.DiffusionEndpoint(
                flow(amplitude, length_scale),
                wings.mean,
                seen,
                t1=1.0,
                num_steps=num_steps,
                guide=guide,
            )
            nb.sample("wing", law, obs=observed)

        draws = 50 if arguments.quick else 500
        kernel = nb.infer.FunctionSpaceHMC(model)
        settings = {"num_chains": 2, "chain_method": "vectorized", "progress_bar": False}
        mcmc = numpyro.infer.MCMC(kernel, num_warmup=200, num_samples=draws, **settings)
        mcmc.run(jr.key(3), wings.points[0])
        run = draws * seconds_of_a_draw(kernel, mcmc.last_state, wings.points[0])
        samples = mcmc.get_samples(group_by_chain=True)
        for site in ("amplitude", "length_scale"):
            x = np.log(np.asarray(samples[site], float))
            ess = float(numpyro.diagnostics.effective_sample_size(x))
            posterior[name, site] = (x.mean(), x.std() / np.sqrt(ess))
            row = {
                "mean_log": float(x.mean()),
                "sd_log": float(x.std()),
                "ess": ess,
                "ess_per_s": ess / run,
            }
            r_hat = float(numpyro.diagnostics.split_gelman_rubin(x))
            show(part="amortised", guide=name, site=site, **row, r_hat=r_hat, seconds=run)
    for site in ("amplitude", "length_scale"):
        (m1, e1), (m2, e2) = posterior["guided", site], posterior["amortised", site]
        show(part="amortised", site=site, difference_in_se=float(abs(m1 - m2) / np.hypot(e1, e2)))


PARTS = {"ou": ou, "evidence": evidence, "kunita": kunita, "points": points, "amortised": amortised}

if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--parts", nargs="+", default=list(PARTS), choices=list(PARTS))
    parser.add_argument("--cases", nargs="+", help="of `evidence`; all by default")
    parser.add_argument(
        "--methods", nargs="+", default=list(METHODS), choices=METHODS, help="of all but two parts"
    )
    parser.add_argument("--updates", type=int, default=1500)
    parser.add_argument("--particles", type=int, default=8192)
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.updates, arguments.particles = 20, 256
    arguments.training = Training(arguments.updates, 64)
    for part in arguments.parts:
        PARTS[part](arguments)
    show(jax=jax.__version__, equinox=eqx.__version__, device=str(jax.devices()[0]))
