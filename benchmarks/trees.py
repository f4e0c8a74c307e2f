"""What does the likelihood of a tree cost?

    python benchmarks/trees.py [--quick] [--parts linear flow species rate paths large learned]

`linear`: processes of two traits on random binary trees, value, gradient and compile time, beside
prunings in NumPy that take all nodes of one height at once. `flow`: Kunita flows of 16 landmarks,
20 steps a branch. `species`: wings of 30 species of butterflies at 20 points, 6 steps a branch,
then steps no longer than the longest of those, then half as long, with the spread of the log
weight; they are read from the folder of data sets, `NUMPYRO_BRIDGES_DATA` or `../shared/data`.
`rate`: how well the rate of Brownian motion is known from trees of 4 to 256 tips of 40 numbers, by
the tree and by a dense normal law. If asked for, minutes each: `paths`, how many of 10 000 paths of
the default guide fail, on a tree of simulated tips, from wing to wing, and on the tree of
butterflies; `large`, 425 tips of 118 landmarks, 25 steps a branch; `learned`, what a network for
all branches of the simulated tips brings to the weights, and to chains over their noise.

One JSON line each, double precision, run times the minimum of several, memory the peak of the
process.
"""

import argparse
import json
import os
import resource
import sys
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

import numpyro_bridges as nb

FOLDER = Path(os.environ.get("NUMPYRO_BRIDGES_DATA", Path(__file__).parents[2] / "shared" / "data"))

VARIANCE = 0.1
COVARIANCE = np.array([[1.0, 0.3], [0.3, 0.5]])


def random_tree(num_tips: int) -> nb.Tree:
    """A pure birth process: a tip at random splits, until there are enough."""
    rng = np.random.default_rng(0)
    parents, tips = [-1], [0]
    while len(tips) < num_tips:
        parent = tips.pop(rng.integers(len(tips)))
        tips += [len(parents), len(parents) + 1]
        parents += [parent, parent]
    return nb.Tree.from_parents(parents, rng.exponential(size=len(parents)))


def numpy_pruning(tree: nb.Tree, data, B=None):
    """dX = B X dt + dW from 0: messages (H, F, c), a height at a time, from precomputed indices."""
    parents, lengths = np.array(tree.parents), np.concatenate([[0.0], tree.lengths])
    height = np.zeros(len(parents), int)
    for node in range(len(parents) - 1, 0, -1):
        height[parents[node]] = max(height[parents[node]], height[node] + 1)
    levels = [np.flatnonzero(height == k) for k in range(height[0])]
    rows = np.array(tree.observed)

    def steps():
        """e^{Bt} and the covariance for every branch, by the eigenvectors of B."""
        if B is None:
            return np.broadcast_to(np.eye(2), (len(parents), 2, 2)), lengths[
                :, None, None
            ] * COVARIANCE
        rates, V = np.linalg.eig(B)
        W = np.linalg.inv(V)
        both = rates[:, None] + rates[None]
        inside = np.expm1(both * lengths[:, None, None]) / both * (W @ COVARIANCE @ W.T)
        return V * np.exp(rates * lengths[:, None])[:, None] @ W, V @ inside @ V.T

    def value():
        H, F, c = np.zeros((len(parents), 2, 2)), np.zeros((len(parents), 2)), 0.0
        flow, covariance = steps()
        H[rows] = np.eye(2) / VARIANCE
        F[rows] = data / VARIANCE
        c -= len(rows) * np.log(2 * np.pi * VARIANCE) + 0.5 * np.sum(data**2) / VARIANCE
        for nodes in levels:
            C, E = covariance[nodes], flow[nodes]
            S = np.eye(2) + H[nodes] @ C
            G = np.linalg.solve(S, np.concatenate([H[nodes], F[nodes][..., None]], axis=2))
            c += 0.5 * np.einsum("ni,nij,nj->", F[nodes], C, G[..., 2]) - 0.5 * np.sum(
                np.log(np.linalg.det(S))
            )
            G = E.transpose(0, 2, 1) @ G
            np.add.at(H, parents[nodes], G[..., :2] @ E)
            np.add.at(F, parents[nodes], G[..., 2])
        return c

    return value


def seconds(f, repeats: int) -> float:
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(f())
        times.append(time.perf_counter() - start)
    return min(times)


def compiled(f, *args):
    start = time.perf_counter()
    program = jax.jit(f).lower(*args).compile()
    return program, round(time.perf_counter() - start, 2)


def linear(num_tips: int, repeats: int):
    tree = random_tree(num_tips)
    data = np.random.default_rng(1).normal(size=(num_tips, 2))
    B = np.array([[-1.0, 0.1], [0.1, -0.5]])
    for name, sde, plain in (
        ("Brownian", nb.BrownianMotion(COVARIANCE), numpy_pruning(tree, data)),
        (
            "Ornstein-Uhlenbeck",
            nb.LinearSDE(B, np.linalg.cholesky(COVARIANCE)),
            numpy_pruning(tree, data, B),
        ),
    ):
        reference = seconds(plain, repeats)

        def log_likelihood(sde, tree):
            law = nb.DiffusionTree(sde, np.zeros(2), nb.InexactMatch(VARIANCE), tree=tree)
            return law.given(jnp.zeros(law.noise_prior().shape())).log_prob(data)

        value, value_compile = compiled(log_likelihood, sde, tree)
        gradient, gradient_compile = compiled(
            jax.value_and_grad(log_likelihood, argnums=(0, 1)), sde, tree
        )
        own = seconds(lambda program=value, sde=sde: program(sde, tree), repeats)
        line = {
            "process": name,
            "tips": num_tips,
            "value_ms": 1e3 * own,
            "numpy_ms": 1e3 * reference,
        }
        line |= {
            "ratio": own / reference,
            "value_compile_s": value_compile,
            "gradient_compile_s": gradient_compile,
        }
        line["gradient_ms"] = 1e3 * seconds(
            lambda program=gradient, sde=sde: program(sde, tree), repeats
        )
        line["difference"] = abs(float(value(sde, tree)) - plain())
        show(line)


def flow(num_tips: int, repeats: int):
    tree, angles = random_tree(num_tips).scaled(0.2), 2 * np.pi * np.arange(16) / 16
    circle = np.stack([np.cos(angles), np.sin(angles)], 1)
    data = circle + 0.05 * np.random.default_rng(1).normal(size=(num_tips, 1, 2))

    def log_weight(kernel, noise):
        sde = nb.KunitaFlow(nb.Landmarks(16, 2), kernel)
        law = nb.DiffusionTree(sde, circle, nb.InexactMatch(1e-4), tree=tree, num_steps=20)
        return law.given(noise).log_prob(data)

    kernel, noise = nb.GaussianKernel(0.1, 0.4), np.zeros((20 * (tree.num_nodes - 1), 16, 2))
    value, compile_s = compiled(log_weight, kernel, noise)
    line = {"process": "Kunita, 16 landmarks, 20 steps", "tips": num_tips, "compile_s": compile_s}
    show(line | {"value_ms": 1e3 * seconds(lambda: value(kernel, noise), repeats)})


def butterflies():
    """Means of species and their tree, or `None` where they are not."""
    file = FOLDER / "morpho" / "forewing_means_20.csv"
    if not file.is_file():
        show({"process": "species", "skipped": f"no {file}: set NUMPYRO_BRIDGES_DATA"})
        return None
    sys.path.append(str(Path(__file__).parents[1] / "examples"))
    from phylogeny import prepare

    specimens = nb.io.read_csv(file)
    shapes = np.stack([specimen.landmarks for specimen in specimens])
    names = [specimen.id for specimen in specimens]
    return prepare(shapes, names, nb.Tree.from_newick(file.parent / "tree.nwk"))


def law_of_butterflies(data, amplitude, num_steps):
    """At the posterior mean of the length scale."""
    space = nb.Landmarks(20, 2)
    flow = nb.KunitaFlow(space, nb.GaussianKernel(amplitude, 0.1836))
    match = nb.InexactMatch.from_point_sd(0.005, space)
    return nb.DiffusionTree(flow, data.start, match, tree=data.tree, num_steps=num_steps)


def species(repeats: int, num_draws: int):
    data = butterflies()
    if data is None:
        return
    tree, amplitude = data.tree, np.array(0.0982)
    longest = float(max(tree.lengths)) / 6
    for steps, num_steps in (
        ("6 a branch", 6),
        (f"at most {longest:.3f}", tree.num_steps(longest)),
        (f"at most {longest / 2:.3f}", tree.num_steps(longest / 2)),
    ):

        def log_weight(amplitude, noise, num_steps=num_steps):
            return law_of_butterflies(data, amplitude, num_steps).given(noise).log_prob(data.rows)

        shape = law_of_butterflies(data, amplitude, num_steps).noise_prior().shape()
        noise = jr.normal(jr.key(0), (num_draws, *shape))
        value, compile_s = compiled(log_weight, amplitude, noise[0])
        gradient, gradient_compile_s = compiled(
            jax.value_and_grad(log_weight, (0, 1)), amplitude, noise[0]
        )
        found = np.array([value(amplitude, one) for one in noise])
        line = {
            "process": "Kunita, 30 species, 20 landmarks",
            "steps": steps,
            "rows": noise.shape[1],
        }
        line |= {"mean": found.mean(), "sd": found.std(), "compile_s": compile_s}
        line["value_ms"] = 1e3 * seconds(lambda run=value, z=noise[0]: run(amplitude, z), repeats)
        line["gradient_compile_s"] = gradient_compile_s
        show(
            line
            | {
                "gradient_ms": 1e3
                * seconds(lambda run=gradient, z=noise[0]: run(amplitude, z), repeats)
            }
        )


def rate(num_tips: int):
    """Posterior SD of the log of a variance per time, a flat prior: by the tree, and by a dense
    normal law.
    """
    tree, variance = random_tree(num_tips), 1e-3
    tree = tree.scaled(1 / tree.height)
    start = np.zeros((20, 2))
    data = nb.DiffusionTree(
        nb.BrownianMotion(1.0), start, nb.InexactMatch(variance), tree=tree
    ).sample(jr.key(0))

    def log_likelihood(log_rate):
        law = nb.DiffusionTree(
            nb.BrownianMotion(jnp.exp(log_rate)), start, nb.InexactMatch(variance), tree=tree
        )
        return law.given(jnp.zeros(law.noise_prior().shape())).log_prob(data)

    log_rates = np.linspace(-0.8, 0.8, 401)
    above = np.eye(tree.num_nodes, dtype=bool)
    for node, parent in enumerate(tree.parents[1:], 1):
        above[node] |= above[parent]
    rows = np.array(tree.observed)
    shared = above[rows][:, 1:] * np.array(tree.lengths) @ above[rows][:, 1:].T
    times, vectors = np.linalg.eigh(shared)
    squares = np.sum((vectors.T @ np.asarray(data).reshape(num_tips, -1)) ** 2, axis=1)
    variances = np.exp(log_rates)[:, None] * times + variance
    dense = -0.5 * np.sum(40 * np.log(2 * np.pi * variances) + squares / variances, axis=1)
    own = np.array(jax.jit(lambda x: jax.lax.map(log_likelihood, x))(log_rates))

    def sd(values):
        weights = np.exp(values - values.max())
        mean = np.average(log_rates, weights=weights)
        return np.sqrt(np.average((log_rates - mean) ** 2, weights=weights))

    line = {"process": "Brownian, 40 numbers a tip", "tips": num_tips, "sd_of_log_rate": sd(own)}
    line |= {"dense": sd(dense), "root_2_over_numbers": np.sqrt(2 / (40 * num_tips))}
    show(line | {"difference": np.ptp(own - dense)})


def paths(num_paths: int):
    """Log weights of the default guide that are not finite."""
    from tree_evidence import simulated

    cases = {}
    kunita = simulated(20)
    if kunita is not None:
        law, tips = kunita
        cases["9 simulated tips, 20 steps a branch"] = law, tips
    wings = nb.datasets.mosquito_wings(32, "CX").points
    space = nb.Landmarks(32, 2)
    match = nb.InexactMatch.from_point_sd(0.005, space)
    flow = nb.KunitaFlow(space, nb.GaussianKernel(0.1, 0.4))
    cases["from wing to wing"] = (
        nb.DiffusionEndpoint(flow, wings[0], match, t1=1.0, num_steps=50),
        wings[1],
    )
    data = butterflies()
    if data is not None:
        cases["30 species"] = law_of_butterflies(data, 0.0982, 6), data.rows
    for name, (law, seen) in cases.items():

        def log_weight(key, law=law, seen=seen):
            noise = jr.normal(key, law.noise_prior().shape())
            return law.given(noise).log_prob(seen)

        start = time.perf_counter()
        run = jax.jit(lambda keys, f=log_weight: jax.lax.map(f, keys, batch_size=20))
        found = np.array(run(jr.split(jr.key(0), num_paths)))
        finite = np.isfinite(found)
        line = {"paths": name, "number": num_paths, "not_finite": int(np.sum(~finite))}
        line |= {
            "mean": found[finite].mean(),
            "sd": found[finite].std(),
            "least": found[finite].min(),
        }
        show(line | {"seconds": time.perf_counter() - start})


def large(quick: bool):
    num_tips, num_points, num_steps = (16, 20, 4) if quick else (425, 118, 25)
    tree, angles = random_tree(num_tips), 2 * np.pi * np.arange(num_points) / num_points
    tree = tree.scaled(1 / tree.height)
    circle = np.stack([np.cos(angles), np.sin(angles)], 1)
    space = nb.Landmarks(num_points, 2)

    def law(kernel):
        match = nb.InexactMatch.from_point_sd(0.01, space)
        return nb.DiffusionTree(
            nb.KunitaFlow(space, kernel), circle, match, tree=tree, num_steps=num_steps
        )

    kernel = nb.GaussianKernel(0.1, 0.3)
    data = jax.jit(lambda key: law(kernel).sample(key))(jr.key(0))
    noise = jr.normal(jr.key(1), law(kernel).noise_prior().shape())

    def log_weight(kernel, noise):
        return law(kernel).given(noise).log_prob(data)

    line = {"process": f"Kunita, {num_points} landmarks, {num_steps} steps", "tips": num_tips}
    for name, f in (("value", log_weight), ("gradient", jax.value_and_grad(log_weight, (0, 1)))):
        program, line[f"{name}_compile_s"] = compiled(f, kernel, noise)
        line[f"{name}_s"] = seconds(lambda run=program: run(kernel, noise), 1)
        line[f"{name}_peak_GiB"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    show(line)


def learned(quick: bool):
    """The bound and the SD of Σ log w, and effective draws of the ancestors a second."""
    import arviz
    from mcmc import seconds_of_a_draw
    from numpyro.infer import MCMC
    from tree_evidence import simulated

    num_steps = 4 if quick else 20
    case = simulated(num_steps)
    if case is None:
        return
    law, tips = case
    num_updates = 20 if quick else 600
    guide = nb.scores.fit_tree(
        law,
        tips,
        key=jr.key(0),
        network=nb.scores.MLP((16, 2), key=jr.key(1), width=128),
        training=nb.scores.Training(num_updates, 16, held_out=128),
        progress=False,
    )
    of_training = float(guide.history["seconds"][-1])
    for name, by in (("geodesic", None), ("learned", guide)):
        law, _ = simulated(num_steps, by)

        def log_weight(z, law=law):
            return law.given(z).log_prob(tips)

        noise = jr.normal(jr.key(2), (1024, *law.noise_prior().shape()))
        run = jax.jit(lambda noise, f=log_weight: jax.lax.map(f, noise, batch_size=16))
        found = run(noise)
        line = {"guide": name, "mean": np.mean(found), "sd": np.std(found)}
        line |= {"path_s": seconds(lambda run=run, z=noise: run(z), 2) / len(noise)}
        show(line | ({} if by is None else {"training_s": of_training}))

        def model(law=law):
            nb.sample("tips", law, obs=tips)

        kernel = nb.infer.FunctionSpaceHMC(model)
        num_draws = 20 if quick else 100
        mcmc = MCMC(
            kernel,
            num_warmup=num_draws // 2,
            num_samples=num_draws,
            num_chains=4,
            chain_method="vectorized",
            progress_bar=False,
        )
        mcmc.run(jr.key(3), extra_fields=nb.infer.fields(kernel))
        (draws,) = mcmc.get_samples().values()
        nodes = jax.jit(
            lambda draws, law=law: jax.lax.map(
                lambda z: law.given(z).nodes(tips)[jnp.array(law.tree.parents[1:])], draws
            )
        )(draws)
        inner = np.asarray(nodes).reshape(4, num_draws, -1)
        inner = inner[..., np.std(inner, axis=(0, 1)) > 0]
        ess = min(float(arviz.ess(inner[..., i])) for i in range(inner.shape[2]))
        a_draw = seconds_of_a_draw(kernel, mcmc.last_state)
        line = {"guide": name, "draws": 4 * num_draws, "draw_of_all_s": a_draw}
        line |= {"least_ess_of_ancestors": ess, "ess_per_s": ess / num_draws / a_draw}
        show(line | {"accept": np.mean(mcmc.get_extra_fields()["accept_prob"])})


def show(line):
    rounded = {
        key: x if isinstance(x, (str, int)) else float(f"{x:.4g}") for key, x in line.items()
    }
    print(json.dumps(rounded), flush=True)


def main():
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small trees only")
    parts = ("linear", "flow", "species", "rate", "paths", "large", "learned")
    parser.add_argument("--parts", nargs="+", choices=parts, default=parts[:4])
    arguments = parser.parse_args()
    quick = arguments.quick
    if "linear" in arguments.parts:
        for num_tips in (100,) if quick else (100, 1000):
            linear(num_tips, 5 if quick else 20)
    if "flow" in arguments.parts:
        for num_tips in (16,) if quick else (16, 64, 256, 1024):
            flow(num_tips, 3)
    if "species" in arguments.parts:
        species(5 if quick else 20, 5 if quick else 200)
    if "rate" in arguments.parts:
        for num_tips in (4, 16, 64, 256):
            rate(num_tips)
    if "paths" in arguments.parts:
        paths(100 if quick else 10_000)
    if "large" in arguments.parts:
        large(quick)
    if "learned" in arguments.parts:
        learned(quick)


if __name__ == "__main__":
    main()
