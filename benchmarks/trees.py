"""What does the likelihood of a tree cost?

    python benchmarks/trees.py [--quick]

Linear processes of two traits on random binary trees, value, gradient and compile time, beside prunings in NumPy that
take all nodes of one height at once; then Kunita flows of 16 landmarks, 20 steps a branch, value and compile time. One
JSON line each, double precision, run times the minimum of several.
"""

import argparse
import json
import time

import jax
import jax.numpy as jnp
import numpy as np

import numpyro_bridges as nb

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
            return np.broadcast_to(np.eye(2), (len(parents), 2, 2)), lengths[:, None, None] * COVARIANCE
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
            c += 0.5 * np.einsum("ni,nij,nj->", F[nodes], C, G[..., 2]) - 0.5 * np.sum(np.log(np.linalg.det(S)))
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
        ("Ornstein-Uhlenbeck", nb.LinearSDE(B, np.linalg.cholesky(COVARIANCE)), numpy_pruning(tree, data, B)),
    ):
        reference = seconds(plain, repeats)

        def log_likelihood(sde, tree):
            law = nb.DiffusionTree(sde, np.zeros(2), nb.InexactMatch(VARIANCE), tree=tree)
            return law.given(jnp.zeros(law.noise_prior().shape())).log_prob(data)

        value, value_compile = compiled(log_likelihood, sde, tree)
        gradient, gradient_compile = compiled(jax.value_and_grad(log_likelihood, argnums=(0, 1)), sde, tree)
        own = seconds(lambda program=value, sde=sde: program(sde, tree), repeats)
        line = {"process": name, "tips": num_tips, "value_ms": 1e3 * own, "numpy_ms": 1e3 * reference}
        line |= {"ratio": own / reference, "value_compile_s": value_compile, "gradient_compile_s": gradient_compile}
        line["gradient_ms"] = 1e3 * seconds(lambda program=gradient, sde=sde: program(sde, tree), repeats)
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


def show(line):
    rounded = {key: x if isinstance(x, (str, int)) else float(f"{x:.4g}") for key, x in line.items()}
    print(json.dumps(rounded), flush=True)


def main():
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small trees only")
    quick = parser.parse_args().quick
    for num_tips in (100,) if quick else (100, 1000):
        linear(num_tips, 5 if quick else 20)
    for num_tips in (16,) if quick else (16, 64, 256, 1024):
        flow(num_tips, 3)


if __name__ == "__main__":
    main()
