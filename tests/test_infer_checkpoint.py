"""`run_checkpointed`: a chain that is killed and started again is the chain that never was."""

import io
import shutil
import sys
import warnings

import jax
import jax.random as jr
import numpy as np
import numpyro
import numpyro.distributions as dist
import pytest
from helpers import killed_and_ended
from numpyro.infer import HMC, MCMC, NUTS, BarkerMH, Gibbs

import numpyro_bridges as nb
from numpyro_bridges.infer import PCN, FunctionSpaceHMC, _checkpoint, noise_sites, run_checkpointed

pytestmark = pytest.mark.usefixtures("compile_quickly")

DATUM, KEY = np.array([0.4]), jr.key(1)
# one interval crosses the end of the warm-up, and the last is short
WARMUP, SAMPLES, INTERVAL = 20, 30, 8


def model(datum=None, spread=2.0):
    mean = numpyro.sample("mean", dist.Normal(0.0, spread))
    numpyro.deterministic("twice", 2 * mean)
    law = nb.DiffusionEndpoint(
        nb.LinearSDE(-1.0, 0.6, mean), np.zeros(1), nb.InexactMatch(0.1), t1=1.0, num_steps=1
    )
    nb.sample("wing", law, obs=datum)


class Counted(NUTS):
    traces = 0

    def sample(self, *args):
        Counted.traces += 1
        return super().sample(*args)


def hmc(model, **settings):
    return HMC(model, trajectory_length=None, num_steps=2, **settings)  # compiles fast


def gibbs(model):
    return Gibbs([(PCN(model), noise_sites), (NUTS(model), None)])


def sampler(kernel=hmc, num_chains=1, chain_method="sequential", **settings):
    sizes = {"num_warmup": WARMUP, "num_samples": SAMPLES} | settings
    return MCMC(
        kernel(model), num_chains=num_chains, chain_method=chain_method, progress_bar=False, **sizes
    )


def assert_same(mcmc, other):
    """Bit for bit."""
    for get in (lambda m: m.get_samples(), lambda m: m.get_extra_fields(), lambda m: m.last_state):
        found, expected = _checkpoint._plain(get(mcmc)), _checkpoint._plain(get(other))
        assert jax.tree.structure(found) == jax.tree.structure(expected)
        jax.tree.map(lambda a, b: np.testing.assert_array_equal(a, b, strict=True), found, expected)


def at_each_write(monkeypatch, act):
    """Calls `act(number, file, arrays)` before each file is written."""
    write, number = _checkpoint._write, iter(range(10**6))

    def acting(file, arrays):
        act(next(number), file, arrays)
        write(file, arrays)

    monkeypatch.setattr(_checkpoint, "_write", acting)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run, and its directory."""
    folder = tmp_path_factory.mktemp("whole")
    mcmc = sampler()
    run_checkpointed(mcmc, folder, KEY, DATUM, interval=INTERVAL)
    return mcmc, folder


RUNS = {
    "HMC, in the warm-up": (FunctionSpaceHMC, 2, "vectorized", KEY, 1),
    "NUTS, during the write of draws": (Counted, 2, "sequential", KEY, 4),
    "Gibbs, between draws and state": (gibbs, 1, "sequential", jr.PRNGKey(1), 5),
}


@pytest.mark.parametrize("kernel, num_chains, method, key, cut", RUNS.values(), ids=RUNS.keys())
def test_cut_off_run_goes_on(kernel, num_chains, method, key, cut, tmp_path, monkeypatch):
    """From a copy of the directory as a kill during a write leaves it, with half of the file under
    its other name.
    """

    def snapshot(number, file, arrays):
        if number == cut:
            shutil.copytree(tmp_path / "whole", tmp_path / "cut")
            np.savez(half := io.BytesIO(), **arrays)
            (tmp_path / "cut" / file.with_suffix(".tmp").name).write_bytes(
                half.getvalue()[: len(half.getvalue()) // 2]
            )

    Counted.traces = 0
    with monkeypatch.context() as patch:
        at_each_write(patch, snapshot)
        expected = sampler(kernel, num_chains, method)
        run_checkpointed(expected, tmp_path / "whole", key, DATUM, interval=INTERVAL)
    assert Counted.traces in (0, 1), "one program for all intervals and chains"
    before = {file.name: file.stat().st_mtime_ns for file in (tmp_path / "cut").glob("draws*.npz")}
    assert len(before) == {1: 0, 4: 1, 5: 2}[cut]
    mcmc = sampler(kernel, num_chains, method)
    run_checkpointed(mcmc, tmp_path / "cut", key, DATUM, interval=INTERVAL)
    assert mcmc.get_samples()["mean"].shape == (num_chains * SAMPLES,)
    assert_same(mcmc, expected)
    kept = [name for name, t in before.items() if (tmp_path / "cut" / name).stat().st_mtime_ns == t]
    assert kept == sorted(before)[:1]
    assert not list((tmp_path / "cut").glob("*.tmp"))


def test_as_after_run(tmp_path, capsys):
    """The chain of `MCMC.run`, with draws and noise thinned."""
    plain = sampler(thinning=3)
    plain.run(KEY, DATUM, extra_fields=("potential_energy",))
    mcmc = sampler(thinning=3)
    run_checkpointed(
        mcmc,
        tmp_path,
        KEY,
        DATUM,
        interval=INTERVAL,
        keep_noise=2,
        extra_fields=("potential_energy",),
    )
    expected, found = plain.get_samples(group_by_chain=True), mcmc.get_samples(group_by_chain=True)
    assert set(found) == {"mean", "twice"} and found["mean"].shape == (1, SAMPLES // 3)
    for name in found:
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-9)
    fields = mcmc.get_extra_fields(group_by_chain=True)
    np.testing.assert_allclose(
        fields["noise"]["wing_noise"], expected["wing_noise"][:, 1::2], rtol=1e-9
    )
    np.testing.assert_allclose(
        fields["potential_energy"], plain.get_extra_fields(True)["potential_energy"], rtol=1e-9
    )
    assert mcmc.get_extra_fields()["noise"]["wing_noise"].shape[0] == SAMPLES // 6
    np.testing.assert_allclose(
        mcmc.last_state.z["wing_noise"], plain.last_state.z["wing_noise"], rtol=1e-9
    )
    assert mcmc.last_state.rng_key == plain.last_state.rng_key
    mcmc.print_summary()
    assert "mean" in capsys.readouterr().out
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # ArviZ 0.x announces 1.x when it is imported
        data, all_paths = nb.to_arviz(mcmc, paths=9), nb.to_arviz(plain, paths=SAMPLES)
    paths, expected_paths = data["posterior_paths"]["wing"], all_paths["posterior_paths"]["wing"]
    np.testing.assert_array_equal(paths["draw"], range(1, SAMPLES // 3, 2))
    np.testing.assert_allclose(paths, expected_paths.sel(draw=paths["draw"]), rtol=1e-9)
    np.testing.assert_array_equal(data.posterior["mean"], found["mean"])
    np.testing.assert_allclose(  # of a linear SDE: noise that was dropped makes no difference
        data.log_likelihood["wing"], all_paths.log_likelihood["wing"], rtol=1e-9
    )


def test_files_are_without_the_noise(whole):
    mcmc, folder = whole
    assert set(mcmc.get_samples()) == {"mean", "twice"}
    assert "wing_noise" in mcmc.last_state.z
    with np.load(folder / "draws_000000016.npz") as draws:
        assert {k: draws[k].shape for k in draws} == {
            "z/mean": (1, 4),
            "z/twice": (1, 4),
            "diverging": (1, 4),
        }
    starts = [int(file.stem[6:]) for file in sorted(folder.glob("draws*.npz"))]
    assert starts == [16, 24, 32, 40, 48]


def test_longer_chain(whole, tmp_path):
    """A finished chain is made longer, and read without being run."""
    mcmc, folder = whole
    shutil.copytree(folder, tmp_path / "long")
    longer, fresh = sampler(num_samples=SAMPLES + 10), sampler(num_samples=SAMPLES + 10)
    run_checkpointed(longer, tmp_path / "long", KEY, DATUM, interval=INTERVAL)
    run_checkpointed(fresh, tmp_path / "fresh", KEY, DATUM, interval=INTERVAL)
    assert_same(longer, fresh)
    np.testing.assert_array_equal(
        longer.get_samples()["mean"][:SAMPLES], mcmc.get_samples()["mean"]
    )
    again = sampler()
    run_checkpointed(again, folder, KEY, DATUM, interval=INTERVAL)
    assert_same(again, mcmc)


@pytest.mark.parametrize("num_chains, write, done, kept", [(1, 1, 8, 0), (2, 5, 24, 4)])
def test_interrupt(num_chains, write, done, kept, tmp_path, monkeypatch, capsys):
    """In the warm-up, and later at a state whose draws are written; the same object goes on."""
    mcmc = sampler(hmc, num_chains, "vectorized")
    mcmc.progress_bar = True

    def interrupt(number, *_):
        if number == write:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        at_each_write(patch, interrupt)
        run_checkpointed(mcmc, tmp_path, KEY, DATUM, interval=INTERVAL)
    text = capsys.readouterr().err
    assert f"of 50 iterations {done} are in {tmp_path}, and of 30 draws {kept} " in text
    assert ("sample" if kept else "warmup") in text and "0 divergences" in text
    assert "steps of size" in text and "acc. prob" in text
    early = mcmc.get_samples(True)["mean"] if kept else np.zeros((num_chains, 0))
    run_checkpointed(mcmc, tmp_path, KEY, DATUM, interval=INTERVAL)
    late = mcmc.get_samples(True)["mean"]
    assert early.shape == (num_chains, kept) and late.shape == (num_chains, SAMPLES)
    np.testing.assert_array_equal(late[:, :kept], early)


OTHER = {
    "num_warmup: 20 there, 21 in": lambda: (sampler(num_warmup=21), KEY, (DATUM,), {}),
    "num_chains: 1 there, 2 in": lambda: (sampler(num_chains=2), KEY, (DATUM,), {}),
    "thinning: 1 there, 2 in": lambda: (sampler(thinning=2), KEY, (DATUM,), {}),
    "interval: 8 there, 9 in": lambda: (sampler(), KEY, (DATUM,), {"interval": 9}),
    "keep_noise: None there, 1 in": lambda: (sampler(), KEY, (DATUM,), {"keep_noise": 1}),
    r"rng_key: key<fry>\[\] \[0, 1\] there, key<fry>\[\] \[0, 2\] in": lambda: (
        sampler(),
        jr.key(2),
        (DATUM,),
        {},
    ),
    r"args/0: float64\[1\] \[0.4\] there, float64\[1\] \[0.5\] in": lambda: (
        sampler(),
        KEY,
        (DATUM + 0.1,),
        {},
    ),
    "args/1: None there, 3.0 in": lambda: (sampler(), KEY, (DATUM, 3.0), {}),
    "kwargs/spread: None there, 3.0 in": lambda: (sampler(), KEY, (DATUM,), {"spread": 3.0}),
    "init_params/mean: None there": lambda: (
        sampler(),
        KEY,
        (DATUM,),
        {"init_params": {"mean": 0.0, "wing_noise": np.zeros((1, 1, 1))}},
    ),
    r"extra_fields: \[\] there, \['energy'\] in": lambda: (
        sampler(),
        KEY,
        (DATUM,),
        {"extra_fields": ("energy",)},
    ),
    "`extra_fields` must be names of fields, .*; got 'i.x'": lambda: (
        sampler(),
        KEY,
        (DATUM,),
        {"extra_fields": ("i.x",)},
    ),
    "kernel: HMC there, Counted in": lambda: (sampler(Counted), KEY, (DATUM,), {}),
    "kernel.target_accept_prob: 0.8 there, 0.9 in": lambda: (
        sampler(lambda model: hmc(model, target_accept_prob=0.9)),
        KEY,
        (DATUM,),
        {},
    ),
    "`num_samples` must be 30 or more, .*; got 29": lambda: (
        sampler(num_samples=29),
        KEY,
        (DATUM,),
        {},
    ),
}


@pytest.mark.parametrize("message", OTHER)
def test_other_settings_are_refused(message, whole):
    mcmc, key, args, settings = OTHER[message]()
    with pytest.raises(ValueError, match=message):
        run_checkpointed(mcmc, whole[1], key, *args, **{"interval": INTERVAL} | settings)


def test_other_shapes_are_refused(whole):
    def another(datum):
        mean = numpyro.sample("mean", dist.Normal(np.zeros(2), 2.0))
        numpyro.sample("v", dist.Normal(mean, 1.0), obs=datum)

    mcmc = MCMC(hmc(another), num_warmup=WARMUP, num_samples=SAMPLES, progress_bar=False)
    with pytest.raises(
        ValueError, match=r"the shape of draw/z/mean: float64\[\] there, float64\[2\] in this call"
    ):
        run_checkpointed(mcmc, whole[1], KEY, DATUM, interval=INTERVAL)


def test_another_model_is_noticed(whole):
    """One with the same sites and arguments: by where its chains start."""
    mcmc = MCMC(
        hmc(lambda datum: model(datum, spread=2.1)),
        num_warmup=WARMUP,
        num_samples=SAMPLES,
        progress_bar=False,
    )
    with pytest.warns(UserWarning, match="started elsewhere"):
        run_checkpointed(mcmc, whole[1], KEY, DATUM, interval=INTERVAL)


def test_other_files_are_refused(whole, tmp_path):
    def run(path):
        run_checkpointed(sampler(), path, KEY, DATUM, interval=INTERVAL)

    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="`path` must be a directory"):
        run(tmp_path / "file")
    state = tmp_path / "state.npz"
    for content in (b"", b"no archive", (whole[1] / "state.npz").read_bytes()[:-100]):
        state.write_bytes(content)
        with pytest.raises(
            ValueError, match=r"state.npz that cannot be read, .* Choose another path"
        ):
            run(tmp_path)
    np.savez(state, x=np.zeros(2))
    with pytest.raises(ValueError, match="of another program. Choose another `path`"):
        run(tmp_path)
    shutil.copytree(whole[1], tmp_path / "less")
    (tmp_path / "less" / "draws_000000024.npz").unlink()
    with pytest.raises(ValueError, match="lacks draws: 22 of 30 are there"):
        run(tmp_path / "less")


def test_arguments():
    with pytest.raises(ValueError, match="`interval` must be a positive integer; got 0"):
        run_checkpointed(sampler(), "unused", KEY, interval=0)
    with pytest.raises(ValueError, match="`keep_noise` must be a positive integer; got 0"):
        run_checkpointed(sampler(), "unused", KEY, keep_noise=0)
    mcmc = sampler()
    mcmc.post_warmup_state = 1
    with pytest.raises(ValueError, match="`mcmc` must do its own warm-up"):
        run_checkpointed(mcmc, "unused", KEY)


def long_run(folder):
    mcmc = sampler(BarkerMH, num_warmup=500, num_samples=1500)
    run_checkpointed(mcmc, folder, KEY, DATUM, interval=10)
    return mcmc


@pytest.mark.parametrize("num_kills", [2, pytest.param(10, marks=pytest.mark.slow)])
def test_kills(num_kills, tmp_path):
    """By SIGKILL, at random moments of a run that writes all the time."""
    folder = tmp_path / "run"

    def iterations():
        try:
            with np.load(folder / "state.npz") as state:
                return int(state["iterations"])
        except FileNotFoundError:
            return 0

    settings = {"progress": iterations, "num_kills": num_kills, "within": 0.3 / num_kills}
    done = killed_and_ended(__file__, folder, **settings)
    assert iterations() == 2000 and done == sorted(set(done))
    assert_same(long_run(folder), long_run(tmp_path / "whole"))


if __name__ == "__main__":
    long_run(sys.argv[1])
