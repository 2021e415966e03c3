"""A run whose environment gives NaN: it is shown, replayed from a file, and told the truth about."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import pytest
import tiny_train
from tiny_env import SMALL, TinyConfig, TinyEnv

from dexsim.core.errors import DexsimError
from dexsim_ppo import checkpoint, reproduce, train
from dexsim_ppo.learner.ppo import make_train
from dexsim_ppo.training.display import Display
from dexsim_ppo.training.runlog import RunFolder, read_metrics

QUICK = [*tiny_train.QUICK, *"--ppo.minibatches 2 --ppo.epochs 1 --seed 3 --log-every 1".split()]
GOOD_ITERATIONS = 3


class Breaks(TinyEnv):
    """From its 24th step on, the actors of environments that started on the right side observe NaN."""

    share = 0.0

    def _start(self, key):
        state = super()._start(key)
        return dataclasses.replace(state, metrics=state.metrics | {"age": jnp.float32(0)})

    def stagger(self, state, key):
        return state

    def step(self, state, action):
        age = state.metrics["age"] + 1
        state = super().step(state, action)
        broken = (age >= 8 * GOOD_ITERATIONS) & (state.target > self.share)
        actor = state.obs["actor"].at[1].set(jnp.where(broken, jnp.nan, state.obs["actor"][1]))
        return dataclasses.replace(
            state,
            obs=state.obs | {"actor": actor},
            truncated=jnp.bool_(False),
            terminated=jnp.bool_(False),
            metrics=state.metrics | {"age": age},
        )


def install(patch, env_class):
    def make(task, config=None, *, backend="auto", num_envs=1, **_):
        return env_class(config or TinyConfig(), backend=backend, num_envs=num_envs)

    tiny_train.install(patch)
    patch.setattr("dexsim.registry.make", make)
    patch.setattr("dexsim.make", make, raising=False)


@pytest.fixture
def diverged(tmp_path, monkeypatch, capsys):
    """Folder, error and output of a run that diverges."""
    install(monkeypatch, Breaks)
    folder = RunFolder(tmp_path / "run")
    with pytest.raises(DexsimError) as error:
        train.main([*QUICK, "--minutes", "5", "--run-dir", str(folder.path), "--checkpoint-every", "1"])
    return folder, str(error.value), capsys.readouterr().out


@pytest.mark.slow
def test_skipped_updates_are_shown_as_they_happen(diverged):
    folder, _, shown = diverged
    rows = read_metrics(folder.metrics)
    assert [row["skipped_updates"] for row in rows[:GOOD_ITERATIONS]] == [0] * GOOD_ITERATIONS
    last = rows[-1]
    assert last["skipped_updates"] > 0 and last["updates"] == 2 * last["iteration"]
    assert f"skipped updates {last['skipped_updates']:.0f} of {last['updates']:.0f}" in shown
    assert shown.count("updates skipped, their gradient is not finite") == 1, "said once, not at each iteration"
    quiet = Display("x")._cells({name: value for name, value in rows[0].items() if value is not None})
    assert not any("skipped" in name or "rewards" in name for name in quiet)


def test_the_error_names_a_checkpoint_that_is_from_before(diverged):
    """By then the newest checkpoints hold the fault: only those up to the last sound iteration are named."""
    folder, error, _ = diverged
    kept = [int(path.stem) for path in folder.existing_checkpoints()]
    assert min(kept) > GOOD_ITERATIONS, "this run has kept no sound checkpoint"
    assert "no checkpoint is from before" in error and "\n" not in error
    assert f"after iteration {GOOD_ITERATIONS}" in error


def test_a_sound_checkpoint_is_named(tmp_path, monkeypatch):
    install(monkeypatch, Breaks)
    path = tmp_path / "run"
    with pytest.raises(DexsimError) as error:
        train.main([*QUICK, "--minutes", "5", "--run-dir", str(path), "--checkpoint-every", "3"])
    assert f"the newest checkpoint from before is {path}/checkpoints/00000003.msgpack" in str(error.value)


@pytest.mark.slow
def test_the_fault_can_be_replayed(diverged, capsys):
    folder, error, shown = diverged
    (file,) = folder.path.glob("reproduce-*.msgpack")
    command = f"python -m dexsim_ppo.reproduce {file}"
    assert command in error and command in shown.replace("\n", "")
    saved = checkpoint.load(file, kind="reproducer", task="tiny")
    assert int(saved.leaves[".iteration"]) == GOOD_ITERATIONS and saved.content["arguments"]["seed"] == 3
    assert reproduce.main([str(file)]) == 0
    out = capsys.readouterr().out
    assert re.search(rf"iteration {GOOD_ITERATIONS}: {saved.content['lost']} of 2 gradients are not finite", out)
    assert re.search(r"actor observation 'target': \d+ of 16 environments \([\d, ]+\), first at step 0", out)
    # What follows from it comes later: the integrator takes the NaN action that the policy makes of it.
    assert re.search(r"critic observation 'position': .* first at step 1", out)
    assert "critic observation 'target'" not in out


@pytest.mark.slow
def test_a_fault_that_is_gone_is_not_reproduced(diverged, monkeypatch, capsys):
    folder, *_ = diverged
    (file,) = folder.path.glob("reproduce-*.msgpack")
    mended = type("Mended", (Breaks,), {"share": 9.0})
    install(monkeypatch, mended)
    reproduced = reproduce.main([str(file)])
    out = capsys.readouterr().out
    # The state itself already holds the first NaN observation.
    assert reproduced == 0 and "before it: state.env_state.obs['actor']" in out


class Unpaid(TinyEnv):
    """The reward of every move to the right is NaN."""

    def step(self, state, action):
        state = super().step(state, action)
        return dataclasses.replace(state, reward=jnp.where(action[0] > 0, jnp.nan, state.reward))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_replay_takes_the_actions_of_the_training(seed):
    """Which rewards are NaN depends on the actions, so on the random numbers: training counts as many."""
    env = Unpaid()
    training = make_train(env, SMALL)
    state = training.init(jax.random.key(seed))
    found = list(reproduce.findings(env, SMALL, state))
    (count,) = map(int, training.step(state)[1]["nonfinite_rewards"])
    assert 0 < count < SMALL.steps_per_iteration
    assert found == [f"rewards: {count} of {SMALL.steps_per_iteration} (taken as 0)"]


def test_totals_of_faulty_rewards_are_shown():
    row = {"iteration": 3, "env_steps": 10, "env_steps_per_s": 1.0, "seconds_left": 1.0}
    cells = Display("x")._cells(row | {"total/bounded_rewards": 2.0, "total/nonfinite_rewards": 0.0})
    assert cells["bounded rewards"] == "2" and "nonfinite rewards" not in cells
