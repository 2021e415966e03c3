"""`benchmarks/peers.py`: both learners see the same environment, take turns, and are judged on the same episodes."""

import json
import sys
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from paths import ROOT

from dexsim_ppo.learner.adapter import adapt

pytest.importorskip("brax")


@pytest.fixture(autouse=True)
def benchmarks(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    yield
    for name in [name for name in sys.modules if name.partition(".")[0] in ("peers", "engines", "throughput")]:
        del sys.modules[name]


def test_the_pendulum_keeps_its_energy_in_small_swings_and_pays_as_gyms():
    from peers.environments import Pendulum

    env, rng = Pendulum(), np.random.default_rng(0)
    for _ in range(20):
        angle, rate, action = rng.uniform(-3, 3), rng.uniform(-7, 7), rng.uniform(-1.5, 1.5)
        seen, after, reward, ended = env.step(jax.random.key(0), jnp.array([angle, rate]), jnp.array([action]))
        torque = 2 * min(max(action, -1), 1)
        faster = min(max(rate + (3 * 10 / 2 * np.sin(angle) + 3 * torque) * 0.05, -8), 8)
        np.testing.assert_allclose(after, [angle + 0.05 * faster, faster], rtol=1e-4, atol=1e-5)
        assert float(reward) == pytest.approx(-(angle**2 + 0.1 * rate**2 + 0.001 * torque**2), rel=1e-4)
        np.testing.assert_allclose(seen, [np.cos(after[0]), np.sin(after[0]), after[1]], rtol=1e-4, atol=1e-5)
        assert not ended


def test_brax_and_we_have_the_same_environment():
    from peers.environments import FromBrax, Pendulum, ToBrax

    ours, theirs = Pendulum(), ToBrax(Pendulum())
    back, begun = FromBrax(theirs), theirs.reset(jax.random.PRNGKey(3))
    observation, state = back.reset(jax.random.key(3))
    np.testing.assert_array_equal(observation, begun.obs)
    inner = begun.pipeline_state
    for action in (0.3, -2.0, 1.0):
        seen, inner, reward, _ = ours.step(jax.random.key(0), inner, jnp.array([action]))
        begun = theirs.step(begun, jnp.array([action]))
        observation, state, paid, ended = back.step(jax.random.key(0), state, jnp.array([action]))
        for found in (begun.obs, observation):
            np.testing.assert_allclose(found, seen, rtol=1e-5)
        assert float(begun.reward) == float(paid) == pytest.approx(float(reward), rel=1e-5)
        assert not ended and not begun.done


class Falling:
    """Pays 1 a step, and ends after as many as its action says, at most 5."""

    observation_size, action_size, max_steps = 1, 1, 5

    def reset(self, key):
        return jnp.zeros(1), jnp.float32(0)

    def step(self, key, state, action):
        return jnp.zeros(1), state + 1, jnp.float32(1), state + 1 >= 10 * action[0]


@pytest.mark.parametrize(("action", "paid"), [(0.3, 3.0), (1.0, 5.0)])
def test_an_episode_is_paid_up_to_its_end(action, paid):
    from peers.learners import evaluator

    evaluate = evaluator(adapt(Falling(), "falling"), 4)
    assert evaluate(lambda obs: jnp.full((4, 1), action)) == paid


def test_learners_take_turns():
    from peers.learners import Turns

    turns, seen = Turns(["a", "b"]), []

    def learner(name, count):
        for _ in range(count):
            turns.wait(name)
            seen.append(name)
            turns.end(name)
        turns.wait(name)
        turns.end(name, leave=True)

    threads = [threading.Thread(target=learner, args=given) for given in (("b", 4), ("a", 2))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(10)
        assert not thread.is_alive()
    assert seen == list("ababbb")


@pytest.mark.slow
@pytest.mark.parametrize("learners", [["ours"], ["ours", "brax"]])
def test_a_small_run_writes_what_it_shows(learners, tmp_path, capsys, monkeypatch):
    import runpy

    path = tmp_path / "peers.json"
    given = "--environments pendulum --seeds 0 --num-envs 8 --rollout-length 4 --layers 8 --chunks 3 --iterations 2"
    monkeypatch.setattr(sys, "argv", ["peers.py", *given.split(), "--episodes", "2", "--repeats", "0"])
    main = runpy.run_path(str(ROOT / "benchmarks" / "peers.py"))["main"]
    assert main([*sys.argv[1:], "--learners", *learners, "--output", str(path)]) == 0
    out = capsys.readouterr().out
    found = json.loads(path.read_text())["learners"]["pendulum"]
    assert list(found) == learners
    for learner in learners:
        assert learner in out
        (rate,), (compiled,), (walls,) = (found[learner][name] for name in ("steps_per_s", "compile_s", "wall_s"))
        assert rate > 0 and len(walls) == 3 and walls[0] < walls[1] < walls[2]
        assert rate == pytest.approx(2 * 8 * 4 / (walls[2] - walls[1])) and compiled < walls[1]
        assert all(-200 * 17 < value < 0 for value in found[learner]["returns"][0])
