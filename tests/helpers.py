"""Referees in plain NumPy: processes, conditions, guides and guided paths, written again from their
formulas.

Every state is `(n, dim)` here and every linear map a dense matrix; nothing is structured, and
nothing is shared with the package.
"""

import contextlib
import itertools
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.random as jr
import numpy as np
import scipy.linalg
import scipy.stats


@dataclass(frozen=True)
class Process:
    """dX = b dt + σ dW. `linear` = (B, β, σ) where the process is stepped by its exact law."""

    drift: Callable
    diffusion: Callable
    linear: tuple | None = None

    def step(self, s, t, x):
        """Mean and factor of one step of the model."""
        dt = t - s
        if self.linear is None:
            return x + dt * self.drift(s, x), np.sqrt(dt) * self.diffusion(s, x)
        phi, shift, C = exact_affine(*self.linear, dt)
        B, _, sigma = self.linear
        if np.ndim(B) == 0:
            return phi @ x + shift, np.sqrt(C[0, 0] / (sigma @ sigma.T)[0, 0]) * sigma
        return phi @ x + shift, np.linalg.cholesky(C)

    def affine(self, s, t, x):
        """The step of the process linearised at x: Φ, φ, C."""
        if self.linear is not None:
            return exact_affine(*self.linear, t - s)
        dt, n = t - s, x.shape[0]
        B = jacobian(lambda y: self.drift(s, y), x)
        beta = self.drift(s, x) - B @ x
        return np.eye(n) + dt * B, dt * beta, dt * self.covariance(s, x)

    def covariance(self, t, x):
        sigma = self.diffusion(t, x)
        return sigma @ sigma.T


def linear_process(B, sigma, beta, n, dim=1, exact=True):
    """dX = (B X + β) dt + σ dW; B and σ scalar, diagonal or matrix."""
    dense, beta = as_matrix(B, n), np.broadcast_to(np.asarray(beta, float).reshape(-1, 1), (n, dim))
    sigma = as_matrix(sigma, n)
    small = B if np.ndim(B) == 0 else dense
    return Process(
        lambda t, x: dense @ x + beta, lambda t, x: sigma, (small, beta, sigma) if exact else None
    )


def as_matrix(a, n):
    a = np.asarray(a, float)
    return a * np.eye(n) if a.ndim == 0 else np.diag(a) if a.ndim == 1 else a


def exact_affine(B, beta, sigma, dt, nodes=40):
    """e^{B dt}, ∫ e^{Bu} β du, ∫ e^{Bu} σσᵀ e^{Bᵀu} du by Gauss–Legendre quadrature."""
    n = beta.shape[0]
    B = as_matrix(B, n)
    u, w = np.polynomial.legendre.leggauss(nodes)
    flows = [scipy.linalg.expm(B * dt * (1 + s) / 2) for s in u]
    a = sigma @ sigma.T
    shift = sum(0.5 * dt * wi * E @ beta for wi, E in zip(w, flows, strict=True))
    C = sum(0.5 * dt * wi * E @ a @ E.T for wi, E in zip(w, flows, strict=True))
    return scipy.linalg.expm(B * dt), shift, C


def jacobian(f, x, h=1e-30):
    """By complex steps, exact to rounding; averaged over the diagonal blocks of the columns."""
    n, dim = x.shape
    J = np.zeros((n, n))
    for j, c in itertools.product(range(n), range(dim)):
        y = x.astype(complex)
        y[j, c] += 1j * h
        J[:, j] += np.imag(f(y))[:, c] / h / dim
    return J


def log_normal(x, mean, covariance):
    """log N(x; mean, covariance ⊗ I) by a dense solve, columns independent."""
    r = x - mean
    sign, log_det = np.linalg.slogdet(covariance)
    assert sign > 0
    return -0.5 * (
        np.sum(r * np.linalg.solve(covariance, r))
        + r.shape[1] * (log_det + len(r) * np.log(2 * np.pi))
    )


@dataclass(frozen=True)
class Condition:
    """v = L x + N(0, Σ), Σ None if exact; or lower ≤ L x ≤ upper."""

    L: np.ndarray
    v: np.ndarray | None = None
    noise: np.ndarray | None = None
    log_scale: float = 0.0
    bounds: tuple | None = None

    def reference(self, x):
        """The state nearest to x that meets the condition."""
        v = np.clip(self.L @ x, *self.bounds) if self.v is None else self.v
        return x + np.linalg.pinv(self.L) @ (v - self.L @ x)

    def target(self, mean, covariance, z):
        """v and the log density with which it was chosen: 0 for a datum."""
        if self.v is not None:
            return self.v, 0.0
        N = np.linalg.cholesky(covariance)
        w, log_r = np.zeros_like(mean), 0.0
        low, high = self.bounds
        for i, c in np.ndindex(mean.shape):
            center, scale = mean[i, c] + N[i] @ w[:, c], N[i, i]
            a, b = (low[i, c] - center) / scale, (high[i, c] - center) / scale
            if a == b:
                w[i, c] = a
                continue
            w[i, c] = scipy.stats.truncnorm.ppf(scipy.stats.norm.cdf(z[i, c]), a, b)
            log_r += scipy.stats.truncnorm.logpdf(w[i, c], a, b) - np.log(scale)
        return mean + N @ w, log_r


@dataclass(frozen=True)
class Guide:
    """`auxiliary` None: linearised at the reference. `receding`: the weight of the end, or None if
    frozen.

    `geodesic`: the part of the correction. `learned(t, x, reference, ts)` is what a network adds to
    the score.
    """

    auxiliary: Process | None = None
    receding: float | None = None
    geodesic: float = 0.0
    euler: bool = False
    dense: bool = True
    unguided: bool = False
    learned: Callable | None = None


@dataclass(frozen=True)
class Problem:
    """A guided bridge in NumPy."""

    process: Process
    condition: Condition
    guide: Guide
    x0: np.ndarray
    ts: np.ndarray

    def reference(self):
        x = self.x0
        for s, t in itertools.pairwise(self.ts):
            x = x + (t - s) * self.process.drift(s, x)
        return self.condition.reference(x)

    def forecast(self, k, x_now, k_now):
        """Λ, s, M: what the guide, at x_now at step k_now, forecasts of v from the state at step k."""
        reference, L = self.reference(), self.condition.L
        n = L.shape[1]
        if self.guide.unguided:
            return 0 * L, np.zeros((L.shape[0], self.x0.shape[1])), np.eye(len(L))
        Lam, s = L, np.zeros((L.shape[0], self.x0.shape[1]))
        M = np.zeros((len(L), len(L))) if self.condition.noise is None else self.condition.noise
        weight = self.guide.receding
        a = None
        if weight is not None:
            a = (1 - weight) * self.process.covariance(self.ts[k_now], x_now)
            a = a + weight * self.process.covariance(self.ts[-1], reference)
        for j in reversed(range(k, len(self.ts) - 1)):
            now, then = self.ts[j], self.ts[j + 1]
            auxiliary = self.process if self.guide.auxiliary is None else self.guide.auxiliary
            phi, shift, C = auxiliary.affine(now, then, reference)
            if not self.guide.dense:
                kept = np.diag(np.diag(phi))
                phi, shift = kept, shift + (phi - kept) @ reference
            C = C if a is None else (then - now) * a
            s, M, Lam = s + Lam @ shift, M + Lam @ C @ Lam.T, Lam @ phi
        assert Lam.shape == (len(L), n)
        return Lam, s, M

    def miss(self, k, x, v):
        """By how much the Hamiltonian path of the receding momentum misses v: one midpoint step to
        the end.
        """
        Lam, s, M = self.forecast(k + 1, x, k)
        t, left, L = self.ts[k], self.ts[-1] - self.ts[k], self.condition.L
        # its momentum is that of the step's own forecast
        m, sigma = self.process.step(t, self.ts[k + 1], x)
        S = M + Lam @ sigma @ sigma.T @ Lam.T
        r = v - Lam @ m - s
        momentum = np.linalg.solve(S, r)

        def energy(x, p):
            return np.sum(p * self.process.drift(t, x)) + 0.5 * np.sum(
                p * (self.process.covariance(t, x) @ p)
            )

        def slopes(x, p):
            dx, h = np.zeros_like(x), 1e-3
            for i in np.ndindex(*x.shape):
                e = np.zeros_like(x)
                e[i] = h
                near, far = (energy(x + m * e, p) - energy(x - m * e, p) for m in (1, 2))
                dx[i] = (8 * near - far) / (12 * h)
            return dx, self.process.drift(t, x) + self.process.covariance(t, x) @ p

        p = Lam.T @ momentum
        dp, dx = slopes(x, p)
        dp, dx = slopes(x + left / 2 * dx, p - left / 2 * dp)
        x, p = x + left * dx, p - left * dp
        places = [int(np.argmax(row)) for row in L]
        # points, not combinations
        if np.array_equal(L, np.eye(L.shape[1])[places]) and places == sorted(places):
            momentum = L @ p
        noise = 0.0 if self.condition.noise is None else self.condition.noise @ momentum
        miss = v - L @ x - noise
        excess = np.sum(miss * np.linalg.solve(S, miss)) / np.sum(r * np.linalg.solve(S, r))
        return miss / (1 + (excess / 2) ** 2)

    def replay(self, z):
        """The path and its log weight, Σ log p(u)/q(u) + log p(v | ...), every law dense."""
        condition, x, ts = self.condition, self.x0, self.ts
        K = len(ts) - 1
        extra = len(z) - K
        Lam, s, M = self.forecast(0, x, 0)
        v, log_r = condition.target(Lam @ x + s, M, z[0, : len(condition.L)] if extra else None)
        log_weight, path = condition.log_scale - log_r, [x]
        for k in range(K):
            m, sigma = self.process.step(ts[k], ts[k + 1], x)
            last = k == K - 1
            if last:
                Lam, s = condition.L, np.zeros_like(v)
                M = np.zeros((len(v), len(v))) if condition.noise is None else condition.noise
            else:
                Lam, s, M = self.forecast(k + 1, x, k)
            target = (
                v
                if last or not self.guide.geodesic
                else v + self.guide.geodesic * self.miss(k, x, v)
            )
            mu, cov, B, total = conditional(
                sigma, m, Lam, s, M, target, exact=last and condition.noise is None
            )
            if self.guide.euler and not last:
                B, cov = np.eye(len(B)), np.eye(len(B))
            if self.guide.learned is not None and not last:
                mu = mu + B @ sigma.T @ self.guide.learned(ts[k], x, self.reference(), ts)
            u = mu + B @ z[extra + k]
            x = m + sigma @ u
            path.append(x)
            zero, one = np.zeros_like(u), np.eye(len(u))
            if last:
                log_weight += log_normal(v, Lam @ m + s, total)
                if condition.noise is not None:
                    bayes = (
                        log_normal(u, zero, one)
                        + log_normal(v, Lam @ x, M)
                        - log_normal(u, mu, cov)
                    )
                    np.testing.assert_allclose(bayes, log_normal(v, Lam @ m, total), atol=1e-8)
            else:
                log_weight += log_normal(u, zero, one) - log_normal(u, mu, cov)
                # the same in state space
                if len(sigma) == sigma.shape[1] and np.linalg.cond(sigma) < 1e3:
                    p = log_normal(x, m, sigma @ sigma.T)
                    q = log_normal(x, m + sigma @ mu, sigma @ cov @ sigma.T)
                    ratio = log_normal(u, zero, one) - log_normal(u, mu, cov)
                    np.testing.assert_allclose(p - q, ratio, atol=1e-8)
        return np.stack(path), log_weight


def conditional(sigma, m, Lam, s, M, v, exact=False):
    """The law N(μ, cov) of u ~ N(0, I) given v ~ N(Λ(m + σu) + s, M), a root B of cov, and the
    covariance of v.
    """
    A = Lam @ sigma
    total = M + A @ A.T
    gain = np.linalg.solve(total, A).T
    mu, cov = gain @ (v - s - Lam @ m), np.eye(A.shape[1]) - gain @ A
    N = np.linalg.cholesky(total)
    P = np.zeros_like(N) if exact else np.linalg.cholesky(M)
    B = np.eye(A.shape[1]) - A.T @ np.linalg.inv(N).T @ np.linalg.inv(N + P) @ A
    np.testing.assert_allclose(B @ B.T, cov, atol=1e-7)
    return mu, cov, B, total


def columns(x):
    """A state as `(n, dim)`."""
    x = np.asarray(x, float)
    return x[:, None] if x.ndim == 1 else x


def check_bridge(bridge, problem: Problem, key, *, inverse=True, compiled=False, atol=1e-10):
    """Path, log weight and inverse of a bridge against the dense replay.

    Not `compiled`, operation by operation: on a few steps that is several times faster than
    compiling.
    """
    key_noise, key_free = jr.split(key)
    z = jr.normal(key_noise, bridge.noise_shape)
    condition = problem.condition
    with contextlib.nullcontext() if compiled else jax.disable_jit():
        path, log_weight = bridge.path_and_log_weight(z)
        truth, log_truth = problem.replay(np.asarray(z))
        np.testing.assert_allclose(columns_of_path(path), truth, rtol=0, atol=atol)
        np.testing.assert_allclose(log_weight, log_truth, rtol=atol, atol=atol)
        end = condition.L @ columns(path[-1])
        if condition.bounds is not None:
            low, high = condition.bounds
            assert np.all((end >= low - 1e-12) & (end <= high + 1e-12))
        elif condition.noise is None:
            np.testing.assert_allclose(end, condition.v, rtol=0, atol=1e-12)
        if not inverse:
            return
        found = bridge.noise_from_path(path, key_free)
        if len(bridge.x0) == bridge.noise_shape[1] and condition.noise is not None:
            np.testing.assert_allclose(found, z, rtol=0, atol=1e-7)
        else:
            np.testing.assert_allclose(bridge.path(found), path, rtol=0, atol=1e-9)


def columns_of_path(path) -> Any:
    path = np.asarray(path)
    return path[..., None] if path.ndim == 2 else path


def killed_and_ended(
    file, *arguments, progress: Callable[[], int], num_kills: int, within: float
) -> list[int]:
    """Runs a script, kills it by SIGKILL each time at a random moment after it made progress, then
    lets it end.

    `progress()`: of what it has written, 0 at first. `within`: seconds after new progress. Returns
    the progress at each kill.
    """
    seed = random.SystemRandom().randrange(2**31)
    print(f"seed {seed}")
    rng, done = random.Random(seed), [0]
    settings = {
        "JAX_ENABLE_X64": "1",
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
        "PYTHONPATH": str(Path(__file__).parents[1]),
    }

    def start():
        return subprocess.Popen(
            [sys.executable, file, *map(str, arguments)], env=os.environ | settings
        )

    for _ in range(num_kills):
        process = start()
        while progress() <= done[-1]:
            assert process.poll() is None, f"it ended before it made progress, after {done}"
            time.sleep(0.01)
        time.sleep(rng.uniform(0, within))
        process.send_signal(signal.SIGKILL)
        assert process.wait(10) == -signal.SIGKILL, f"it ended before it was killed, after {done}"
        done.append(progress())
    assert start().wait(120) == 0
    return done[1:]
