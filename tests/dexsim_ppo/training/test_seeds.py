"""Several seeds in one command: each is the training that it would be alone, and the report has their spread."""

import json

import jax
import matplotlib.pyplot as plt
import numpy as np
import pytest
import tiny_train

from dexsim.core.errors import ConfigError
from dexsim_ppo import checkpoint, train
from dexsim_ppo.policy import Policy
from dexsim_ppo.training import memory
from dexsim_ppo.training.runlog import RunFolder, read_metrics
from dexsim_ppo.training.seeds import band, draw_band, spread
from dexsim_ppo.training.trainer import Run

OPTIONS = "--task tiny --preset cpu --no-video --ppo.num-envs 16 --ppo.rollout-length 8 --ppo.actor-layers 8".split()
OPTIONS += "--ppo.critic-layers 8 --evaluation-chunk 16 --evaluation-episodes 16 --log-every 1 --steps 512".split()


@pytest.fixture(autouse=True)
def tiny_task(monkeypatch):
    tiny_train.install(monkeypatch)


def numbers(folder):
    """All numbers of a run's last checkpoint, by path; random keys as their data."""
    leaves = checkpoint.load(RunFolder(folder).latest_checkpoint(), kind="train").leaves
    is_key = {name: jax.numpy.issubdtype(x.dtype, jax.dtypes.prng_key) for name, x in leaves.items()}
    return {name: np.asarray(jax.random.key_data(x) if is_key[name] else x) for name, x in leaves.items()}


@pytest.mark.slow
def test_seeds_in_one_program_are_the_trainings_in_turn_and_the_report_has_their_spread(tmp_path, monkeypatch, capsys):
    at_once, in_turn = tmp_path / "at-once", tmp_path / "in-turn"
    seeds = ["--seed", "4", "--seeds", "2"]
    assert train.main([*OPTIONS, *seeds, "--run-dir", str(at_once)]) == 0
    assert "in turn" not in capsys.readouterr().out
    monkeypatch.setattr(memory, "needed", lambda program: 2**50)
    monkeypatch.setattr(memory, "check", lambda *_: None)
    assert train.main([*OPTIONS, *seeds, "--run-dir", str(in_turn)]) == 0
    assert "2 seeds in turn: at once they need" in capsys.readouterr().out
    for seed in (4, 5):
        mine, theirs = (numbers(folder / f"seed-{seed}") for folder in (at_once, in_turn))
        assert mine.keys() == theirs.keys() and int(mine[".iteration"]) == 4
        for name, leaf in mine.items():
            np.testing.assert_allclose(leaf, theirs[name], rtol=2e-3, atol=2e-4, err_msg=name)
    report = json.loads((at_once / "report.json").read_text())
    assert report["seeds"] == [4, 5] and (at_once / "curve.png").stat().st_size > 1000
    returns = report["trained"]["return"]
    assert returns["values"][0] != returns["values"][1]
    assert returns["mean"] == pytest.approx(np.mean(returns["values"]))
    assert returns["values"] == pytest.approx(
        json.loads((in_turn / "report.json").read_text())["trained"]["return"]["values"], rel=1e-2
    )
    kernels = [np.asarray(Policy.load(at_once / file).params.layers[0].kernel) for file in report["policies"].values()]
    assert not np.array_equal(*kernels)
    assert [row["iteration"] for row in read_metrics(RunFolder(at_once / "seed-5").metrics)] == [1, 2, 3, 4]
    with pytest.raises(ConfigError, match="--seeds 2: a resumed run keeps its 1"):
        train.main(["--resume", str(at_once / "seed-4"), "--seeds", "2"])


def test_a_seed_that_is_over_does_not_end_the_others(tmp_path, monkeypatch):
    """As when the patience of one runs out: all are trained until the last one is over."""
    ends = {4: 1, 5: 3}  # iterations, by seed
    monkeypatch.setattr(Run, "is_over", lambda run, iteration: iteration >= ends[run.arguments.seed])
    assert train.main([*OPTIONS, "--seed", "4", "--seeds", "2", "--run-dir", str(tmp_path / "a")]) == 0
    for seed in ends:
        folder = RunFolder(tmp_path / "a" / f"seed-{seed}")
        assert [row["iteration"] for row in read_metrics(folder.metrics)] == [1, 2, 3]


def test_options_of_seeds_keep_their_engine_and_those_that_are_refused_leave_no_folder(tmp_path, monkeypatch):
    """As `auto`, which once meant another engine, a run that begins with them would be slower."""
    monkeypatch.setattr(train, "train_together", lambda *_: False)
    monkeypatch.setattr(train, "train_run", lambda *_: 15)
    make = tiny_train.make
    monkeypatch.setattr("dexsim.make", lambda *a, **given: make(*a, **given | {"backend": "c"}))
    path = tmp_path / "a"
    assert train.main([*OPTIONS, "--seeds", "2", "--run-dir", str(path)]) == 128 + 15
    options, _ = train.parse_arguments(["--config", str(path)])
    assert (options.backend, options.seeds) == ("c", 2)
    with pytest.raises(ConfigError, match="--devices 99: there are"):
        train.main([*OPTIONS, "--seeds", "2", "--devices", "99", "--run-dir", str(tmp_path / "b")])
    assert not (tmp_path / "b").exists()


def test_python_trains_one_seed_at_a_time():
    with pytest.raises(ConfigError, match=r"train_policy\(seeds=3\)"):
        train.train_policy("tiny", preset="cpu", seeds=3)


def test_spread_and_band_in_closed_form():
    assert spread([1.0, 3.0]) == {"mean": 2.0, "std": 2**0.5, "min": 1.0, "max": 3.0, "values": [1.0, 3.0]}
    assert spread([1.0, None, 3.0]) == {"mean": 2.0, "std": 2**0.5, "min": 1.0, "max": 3.0, "values": [1.0, None, 3.0]}
    assert spread([None, 3.0]) == {"mean": 3.0, "std": None, "min": 3.0, "max": 3.0, "values": [None, 3.0]}
    assert spread([None, None])["mean"] is None, "as the return of a simulation that diverges"
    runs = [
        [{"env_steps": 10, "x": 1.0}, {"env_steps": 20, "x": 5.0}, {"env_steps": 30, "x": 5.0}],
        [{"env_steps": 10, "x": 3.0}, {"env_steps": 20, "x": None}, {"env_steps": 30, "x": float("nan")}],
    ]
    np.testing.assert_array_equal(band(runs, "x"), [[10], [1], [2], [3]])
    assert band(runs, "absent").size == 0


def test_the_band_is_from_the_lowest_to_the_highest_around_the_mean(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(plt, "close", drawn.append)
    runs = [[{"env_steps": 1e6 * k, "episode/return": value * k} for k in (1, 2)] for value in (1.0, 2.0, 6.0)]
    draw_band(runs, tmp_path / "curve.png", "tiny")
    (axes,) = drawn[0].axes
    assert axes.get_title(loc="left") == "tiny: mean and range of 3 seeds"
    np.testing.assert_allclose(axes.lines[0].get_xydata(), [[1, 3], [2, 6]])
    corners = {tuple(map(float, point)) for point in axes.collections[0].get_paths()[0].vertices}
    assert corners == {(1, 1), (1, 6), (2, 2), (2, 12)}
    draw_band([[], []], tmp_path / "none.png", "tiny")
    assert not (tmp_path / "none.png").exists()


@pytest.mark.slow
def test_a_figure_that_one_seed_lacks_ends_no_training(tmp_path, monkeypatch):
    """As the correlation of a policy that holds too few objects; the other seed's is shown."""
    real = Run.evaluate

    def evaluate(run, *inputs):
        found = real(run, *inputs)
        return found | ({"evaluation/r": 0.5} if run.arguments.seed == 5 else {})

    monkeypatch.setattr(Run, "evaluate", evaluate)
    options = [*OPTIONS, "--seed", "4", "--seeds", "2", "--evaluate-every", "1", "--evaluation-share", "1"]
    assert train.main([*options, "--run-dir", str(tmp_path / "a")]) == 0
    rows = {seed: read_metrics(RunFolder(tmp_path / "a" / f"seed-{seed}").metrics) for seed in (4, 5)}
    assert any("evaluation/r" in row for row in rows[5]) and not any("evaluation/r" in row for row in rows[4])
