"""The two commands on the tiny task: what they write, how they resume and refuse, and how a diverging run ends."""

import dataclasses
import json
import os
import shutil
import signal
import threading
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny_train
from tiny_env import TinyConfig, TinyEnv, make_env, make_evaluator
from tiny_train import PER_ITERATION

from dexsim.core import cli
from dexsim.errors import ConfigError, DexsimError, OtherEnvWarning
from dexsim_ppo import checkpoint, evaluate, train
from dexsim_ppo.policy import Policy, load_policy
from dexsim_ppo.training.runlog import RunFolder, policy_of, read_metrics
from dexsim_ppo.training.trainer import SELECTION_SEED

QUICK = [*tiny_train.QUICK, *"--evaluate-every 4 --evaluation-share 1 --log-every 2 --checkpoint-every 3".split()]
QUICK += "--curriculum.on --curriculum.widen-above 0 --curriculum.narrow-below 0".split()


pytestmark = pytest.mark.usefixtures("tiny_task")


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A finished run of six iterations."""
    return tiny_train.finished_run(tmp_path_factory.mktemp("runs") / "a", *QUICK, "--steps", str(6 * PER_ITERATION))


def test_a_run_leaves_its_files(finished):
    files = (finished.config, finished.metrics, finished.best, finished.last, finished.report)
    assert all(path.stat().st_size > 0 for path in (*files, finished.path / "curve.png"))
    rows = read_metrics(finished.metrics)
    assert [row["iteration"] for row in rows] == [1, 2, 4, 6], "the first, and every second"
    assert rows[-1]["env_steps"] == 6 * PER_ITERATION and rows[-1]["seconds"] > rows[0]["seconds"] > 0
    assert [row.get("evaluation/return") is not None for row in rows] == [False, False, True, False]
    assert rows[-1]["curriculum/scale"] > rows[0]["curriculum/scale"]
    assert [path.name for path in finished.existing_checkpoints()] == ["00000003.msgpack", "00000006.msgpack"]
    assert [load_policy(policy_of(path)).training["iteration"] for path in finished.existing_checkpoints()] == [3, 6]
    config = json.loads(finished.config.read_text())
    assert config["arguments"]["ppo"]["num_envs"] == 16 and config["arguments"]["env"]["gain"] == 0.25
    report = json.loads(finished.report.read_text())
    for name in ("trained", "do_nothing"):
        held = report[name]["held"]
        assert held["low"] <= held["value"] <= held["high"]
        assert report[name]["episodes"] == 16 and report[name]["seed"] == 0
    assert report["timing"]["env_steps_per_s"] > 5 * PER_ITERATION / report["timing"]["training_s"]
    assert report["hardware"]["cpu_cores"] and report["versions"]["jax"] and "dexsim_ppo.train" in report["command"]
    policy, rows = load_policy(finished.best, task="tiny"), [row for row in rows if row.get("evaluation/return")]
    measured, _ = make_evaluator(make_env(TinyEnv, TinyConfig()), 16)(policy.params, episodes=16, seed=SELECTION_SEED)
    assert measured["return"]["value"] >= max(row["evaluation/return"] for row in rows) - 1e-4


def test_resumed_run_equals_an_uninterrupted_one(finished, tmp_path):
    path = tmp_path / "b"
    assert train.main([*QUICK, "--steps", str(3 * PER_ITERATION), "--run-dir", str(path)]) == 0
    assert train.main(["--resume", str(path), "--steps", str(6 * PER_ITERATION)]) == 0
    a, b = load_policy(finished.last), load_policy(RunFolder(path).last)
    jax.tree.map(np.testing.assert_array_equal, a.params, b.params)
    assert [r["iteration"] for r in read_metrics(RunFolder(path).metrics)] == [1, 2, 4, 6]


@pytest.fixture
def copied(finished, tmp_path):
    """The finished run, in a folder that may be changed."""
    return RunFolder(shutil.copytree(finished.path, tmp_path / "a"))


def test_a_resumed_run_may_change_its_budget_and_keeps_every_report(copied):
    """Its best policy may be newer than its checkpoint, of a process that was killed: another one takes its place."""
    first = json.loads(copied.report.read_text())
    dataclasses.replace(load_policy(copied.best), training={"iteration": 7}).save(copied.best)
    same = ["--seed", "0", "--ppo.learning-rate", "5e-4"]
    looks_on = ["--steps", str(7 * PER_ITERATION), "--evaluation-episodes", "32", "--log-every", "3"]
    assert train.main(["--resume", str(copied.path), *same, *looks_on]) == 0
    assert json.loads((copied.path / "report-1.json").read_text()) == first
    report = json.loads(copied.report.read_text())
    assert (report["policy"], report["seed"], report["trained"]["episodes"]) == ("best.msgpack", 0, 32)
    assert load_policy(copied.last).training["iteration"] == 7
    saved = checkpoint.load(copied.latest_checkpoint(), kind="train").content["arguments"]
    assert (saved["seed"], saved["log_every"], saved["evaluation_episodes"]) == (0, 3, 32)


def test_an_older_checkpoint_is_resumed_for_good(copied):
    """The later ones are of another course: kept under another name, so that the next resume does not go back to it."""
    first, later = copied.existing_checkpoints()
    assert later == copied.latest_checkpoint() == copied.checkpoint(6)
    content = later.read_bytes()
    assert train.main(["--resume", str(first), "--steps", str(4 * PER_ITERATION), "--keep-checkpoints", "1"]) == 0
    assert copied.latest_checkpoint() == copied.checkpoint(4)
    aside = copied.checkpoints / "00000006.aside1.msgpack"
    assert aside.read_bytes() == content
    assert train.main(["--resume", str(aside)]) == 0, "back again"
    assert [load_policy(path).training["iteration"] for path in sorted(copied.path.glob("best*"))] == [6, 4, 6]


def contents(folder):
    return {path: path.read_bytes() for path in folder.path.rglob("*") if path.is_file()}


def test_a_run_that_is_being_trained_is_left_alone(finished):
    before, further = contents(finished), ["--resume", str(finished.path), "--steps", str(7 * PER_ITERATION)]
    with finished.lock(), pytest.raises(ConfigError, match=r"/a: another process is training this run$"):
        train.main(further)
    assert contents(finished) == before


def test_evaluate_command(finished, tmp_path, capsys):
    arguments = [str(finished.best), "--episodes", "16", "--output", str(tmp_path / "report.json")]
    assert evaluate.main(arguments) == 0
    first = json.loads((tmp_path / "report.json").read_text())
    assert evaluate.main(arguments) == 0
    second = json.loads((tmp_path / "report.json").read_text())
    assert first["return"] == second["return"] and first["episodes"] == 16
    report = json.loads(finished.report.read_text())
    assert first["return"]["value"] == pytest.approx(report["trained"]["return"]["value"], rel=1e-5)
    shown = capsys.readouterr().out
    assert "doing nothing" in shown and "error" in shown and "return" in shown and first["do_nothing"]["episodes"] == 16


def test_a_saved_configuration_begins_a_new_run(finished, tmp_path):
    """Its options are the defaults; what is typed beside it holds. Beside a policy it is fine-tuned: the steps of
    training from scratch would make it forget."""
    for given in (finished.path, finished.config):
        again, source = train.parse_arguments(["--config", str(given), "--seed", "9", "--env.gain", "0.5"])
        saved = train.saved_arguments(Path(given), None)
        assert source is None and again.seed == 9 and again.env.gain == 0.5 and again.run_dir is None
        assert again.ppo == saved.ppo and again.evaluation_chunk == 16 and again.steps == 6 * PER_ITERATION
    tuned, source = train.parse_arguments(["--config", str(finished.path), "--policy", str(finished.best)])
    plain, _ = train.parse_arguments(["--policy", str(finished.best), "--preset", "cpu"])
    assert isinstance(source, Policy) and tuned.evaluation_chunk == 16
    for name in ("learning_rate", "kl_target", "critic_first", "initial_std"):
        assert getattr(tuned.ppo, name) == getattr(plain.ppo, name), name


TRAIN_ERRORS = {
    "out of range": (["--ppo.discount", "1.5"], "discount = 1.5: must be between 0 and 1"),
    "nothing to resume": (["--resume", "/nonexistent/run"], "no checkpoint to resume from"),
    "folder of a run": (["--run-dir", "RUN"], "exists already"),
    "another task": (["--task", "grasp", "--resume", "RUN"], "of the task 'tiny', not 'grasp'"),
    "another seed": (["--resume", "RUN", "--seed", "9"], "--seed 9: a resumed run keeps its 0"),
}
EVALUATE_ERRORS = {
    "cut short": (["broken.msgpack"], "cut short"),
    "unknown policy": (["no-such-policy"], "no shipped policy has that name"),
    "unknown field": (["BEST", "--ablate", "colour"], "does not observe colour"),
    "output that is a folder": (["BEST", "--output", "."], "Is a directory"),
}
ERRORS = {f"train: {what}": (train.main, *case) for what, case in TRAIN_ERRORS.items()}
ERRORS |= {f"evaluate: {what}": (evaluate.main, *case) for what, case in EVALUATE_ERRORS.items()}


@pytest.mark.parametrize("what", ERRORS)
def test_a_mistake_is_one_line_and_nothing_is_written(what, finished, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    main, arguments, words = ERRORS[what]
    (tmp_path / "broken.msgpack").write_bytes(finished.best.read_bytes()[:-9])
    before = contents(finished)
    names = {"RUN": str(finished.path), "BEST": str(finished.best)}
    arguments = [names.get(argument, argument) for argument in arguments]
    if main is train.main and "--task" not in arguments:
        arguments = ["--task", "tiny", *arguments]
    assert exit_code(main, arguments) == 2
    error = capsys.readouterr().err
    assert words.lower() in error.lower(), error
    assert error.count("\n") == 1 and error.startswith("error: "), error
    assert before == contents(finished)
    assert [p.name for p in tmp_path.iterdir()] == ["broken.msgpack"]


def test_another_environment_than_the_policys_is_warned_of(finished, monkeypatch):
    monkeypatch.setattr(evaluate, "_measure", lambda *_, **__: ({}, None))
    with pytest.warns(OtherEnvWarning, match=r"gain = 0\.5 \(trained: 0\.25\)"):
        evaluate.evaluate_policy(finished.best, env=TinyEnv(TinyConfig(gain=0.5)))


def exit_code(main, arguments):
    with pytest.raises(SystemExit) as stop:
        cli.run(lambda _: main(arguments))
    return stop.value.code


def test_a_signal_saves_and_says_how_to_go_on(tmp_path, capsys):
    folder, over = RunFolder(tmp_path / "a"), threading.Event()

    def stop():
        while not over.wait(0.02):
            if folder.metrics.exists() and folder.metrics.stat().st_size:
                os.kill(os.getpid(), signal.SIGTERM)
                return

    threading.Thread(target=stop, daemon=True).start()
    try:
        code = train.main([*QUICK, "--minutes", "5", "--run-dir", str(folder.path)])
    finally:
        over.set()
    assert code == 128 + signal.SIGTERM
    assert f"--resume {folder.path}" in capsys.readouterr().out.splitlines()[-1]
    assert folder.latest_checkpoint().exists()


FAULTY = [*tiny_train.QUICK, *"--seed 3 --log-every 1 --env.horizon 9999 --env.wall 9999".split()]  # no episode ends
GOOD_ITERATIONS = 3


class Breaks(TinyEnv):
    """From its 24th step on, the actors of environments that started on the right side observe NaN."""

    def randomize_episode_time(self, state, key):
        return state

    def step(self, state, action):
        state = super().step(state, action)
        broken = (state.metrics["length"] >= 8 * GOOD_ITERATIONS) & (state.target > 0.0)
        actor = state.obs["actor"].at[1].set(jnp.where(broken, jnp.nan, state.obs["actor"][1]))
        return dataclasses.replace(state, obs=state.obs | {"actor": actor})


def test_a_run_that_diverges_ends_and_names_what_is_from_before(tmp_path, monkeypatch):
    """By then the newest checkpoints hold the fault: only those up to the last sound iteration are named."""
    tiny_train.install(monkeypatch, Breaks)
    folder = RunFolder(tmp_path / "run")
    options = ["--minutes", "5", "--run-dir", str(folder.path), "--checkpoint-every", "1", "--keep-checkpoints"]
    with pytest.raises(DexsimError, match=f"after iteration {GOOD_ITERATIONS}; no checkpoint is from before"):
        train.main([*FAULTY, *options, "3"])
    assert min(int(path.stem) for path in folder.existing_checkpoints()) > GOOD_ITERATIONS
    options[3] = str(tmp_path / "other")
    with pytest.raises(DexsimError, match=f"newest checkpoint from before is .*{GOOD_ITERATIONS}.msgpack"):
        train.main([*FAULTY, *options, "9"])
