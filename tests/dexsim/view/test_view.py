"""The live view: what it draws, what its controls change, the recorded episodes, the page's buttons."""

import dataclasses
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from dexsim.core.assets import asset_path
from dexsim.hand.kinematics import forward_kinematics, taxel_normals, taxel_positions
from dexsim.hand.mjcf import hand_poses
from dexsim.objects.config import KINDS
from dexsim.view.__main__ import ViewArguments, open_source
from dexsim.view.scene import force_arrows
from dexsim.view.simulation import NONE, Simulation, find_policies
from dexsim.view.viewer import Viewer, frames_of
from dexsim_ppo import load_policy


class Gui(dict):
    """Controls by their names, without a page."""

    def add(self, name, options=(False,), *, initial_value=None, **limits):
        self[name] = SimpleNamespace(value=options[0] if initial_value is None else initial_value, **limits)
        return self[name]

    add_slider = add_dropdown = add_button = add


# --- what is drawn --------------------------------------------------------------------------------------


def test_an_arrow_ends_at_the_loaded_taxel_and_pushes_into_the_skin(hand):
    (pose,) = hand_poses(hand, np.full((1, hand.num_joints), 0.3))
    force = np.zeros((5, 120))
    force[2, 17] = 2.0
    ((tail, head),) = force_arrows(pose, force)
    np.testing.assert_allclose(head, pose.taxel_position[2, 17], atol=1e-7)
    np.testing.assert_allclose((head - tail) / np.linalg.norm(head - tail), -pose.taxel_normal[2, 17], atol=1e-5)
    force[2, 17] = 4.0
    ((longer, _),) = force_arrows(pose, force)
    np.testing.assert_allclose(np.linalg.norm(head - longer), 2 * np.linalg.norm(head - tail), rtol=1e-5)


# --- policies -------------------------------------------------------------------------------------------


def test_policies_are_listed_where_they_fit(tmp_path):
    grasp = load_policy("grasp")
    env = SimpleNamespace(observation_layout={"actor": grasp.observation_layout})
    for run, policy in (("mine", grasp), ("other", load_policy("rotate")), ("half", grasp)):
        (tmp_path / run).mkdir()
        policy.save(tmp_path / run / "last.msgpack")
    (tmp_path / "half" / "last.msgpack").write_bytes(b"half a file")
    policies = find_policies(env, "grasp", tmp_path)
    assert list(policies) == ["grasp", str(tmp_path / "mine" / "last.msgpack"), NONE] and policies[NONE] is None
    assert list(find_policies(env, NONE, tmp_path / "mine")) == [NONE, "grasp"], "begins with the one that is asked for"


# --- sources --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def simulation(grasp_env):
    source = Simulation(grasp_env, find_policies(grasp_env, "grasp"), seed=3)
    source.gui = Gui()
    source.add_controls(source.gui)
    return source


def start(simulation, **values):
    for name, value in ({"policy": "grasp", "object": "any", "friction factor": 1.0} | values).items():
        simulation.gui[name].value = value
    return frames_of(simulation)


def test_the_object_is_the_one_asked_for(simulation):
    for kind in ("cylinder", "sphere"):
        frame = next(start(simulation, object=kind))
        assert KINDS[int(simulation._state.episode.object.shape_index)] == kind
        assert "box" not in [frame.kinds[k] for k in np.flatnonzero(frame.snapshot.primitive_active)]


def test_a_push_moves_the_object_and_friction_is_scaled_from_what_was_drawn(simulation, monkeypatch):
    frames = start(simulation)
    for _ in range(21):  # Until the object is let go.
        next(frames)
    # Away from the hand, where no finger is in the way: the push is there in full.
    begun = simulation._state.physics
    away = begun.qpos.at[simulation.env.physics.object_qpos[0]].add(0.2)
    state = dataclasses.replace(simulation._state, physics=dataclasses.replace(begun, qpos=away))
    monkeypatch.setattr(simulation, "_random", SimpleNamespace(normal=lambda size: np.array([0.3, 0.0, 0.0])))
    before, gui, speed = state.episode.object.friction, simulation.gui, []
    gui["push [m/s]"].value, gui["friction factor"].value = 2.0, 0.5
    for push in (False, True):
        simulation._state, gui["push"].value = state, push
        next(frames)
        speed.append(np.asarray(simulation._state.physics.qvel[simulation.env.physics.object_dof[:3]]))
    np.testing.assert_allclose(speed[1] - speed[0], [2.0, 0, 0], atol=0.1)
    assert not gui["push"].value, "a click counts once"
    next(frames)
    assert float(simulation._state.episode.object.friction) == pytest.approx(0.5 * float(before), rel=1e-5)


def test_a_dropped_object_is_seen_and_then_replaced(simulation):
    coming, frames = start(simulation, policy=NONE, **{"push [m/s]": 2.0}), []
    for _ in range(121):
        simulation.gui["push"].value = True
        frames.append(next(coming))
    notes = [frame.note for frame in frames]
    first = notes.index("dropped")
    seconds = [float(frame.snapshot.seconds) for frame in frames]
    assert 20 < len([note for note in notes[first : first + 40] if note]) < 40
    assert min(seconds[first + 20 : first + 45]) < 0.1, "a new episode begins"


# Everything that the base install leaves out is absent.
WITHOUT_JAX = """
import sys
for name in ("jax", "jaxlib", "mujoco.mjx", "scipy", "matplotlib", "onnx"):
    sys.modules[name] = None
sys.argv = ["dexsim"]
"""


def test_the_demo_shows_recorded_episodes_without_jax():
    """Each episode to its end, in a scene on viser's server, as the page gets it."""
    recorded = sorted(path.stem for path in asset_path("episodes").glob("*.npz"))
    code = f"""
import itertools
from dexsim.view import __main__ as demo, viewer
class Page(viewer.Viewer):
    def __init__(self, *parts, port, **more):
        super().__init__(*parts, port=0, **more)
    def run(self):
        ticks = sum(len(episode.seconds) for episode in self.source._episodes)
        frames = list(itertools.islice(viewer.frames_of(self.source), ticks))
        for frame in frames[::100]:
            self._read_out_at = 0.0
            self._show(frame)
        touching = sum(frame.snapshot.taxel_force.max() > 0.05 for frame in frames) / len(frames)
        print(self.source.task, len(frames), touching > 0.5, "jax" in sys.modules and sys.modules["jax"])
        self.server.stop()
viewer.Viewer = Page
for name in {recorded}:
    demo.main([name])
"""
    done = subprocess.run([sys.executable, "-c", WITHOUT_JAX + code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    shown = [line.split() for line in done.stdout.splitlines() if line.startswith(("grasp ", "rotate "))]
    assert len(shown) == len(recorded) >= 3
    for camera, frames, touching, jax in shown:
        assert camera in ("grasp", "rotate") and int(frames) > 200 and (touching, jax) == ("True", "None")


def test_poses_for_pictures_are_those_of_the_kinematics(hand):
    joints = np.random.default_rng(0).uniform(hand.joint_lower, hand.joint_upper, (4, hand.num_joints))
    for angles, drawn in zip(joints, hand_poses(hand, joints), strict=True):
        links = forward_kinematics(hand, angles.astype(np.float32))
        expected = links.body_position, links.body_rotation, taxel_positions(hand, links), taxel_normals(hand, links)
        for found, wanted in zip(drawn, expected, strict=True):
            np.testing.assert_allclose(found, wanted, atol=2e-6)


# --- the page -------------------------------------------------------------------------------------------


def test_the_page_runs_pauses_steps_and_begins_anew(monkeypatch):
    """In its own time: the loop asks before each frame whether it is to stop."""
    pytest.importorskip("viser")
    source, now = open_source(ViewArguments(what=str(asset_path("episodes") / "grasp.npz"))), [5.0]
    clock = SimpleNamespace(monotonic=lambda: now[0], sleep=lambda seconds: now.append(now.pop() + seconds))
    monkeypatch.setattr("dexsim.view.viewer.time", clock)
    viewer, shown = Viewer(source, title="test", port=0), []
    viewer.scene.show = lambda frame, _: shown.append(round(float(frame.snapshot.seconds) / source.period))

    def visitor():
        yield from range(6)
        assert shown == list(range(1, 7)) and now[0] - 5.0 == pytest.approx(6 * source.period), "in real time"
        viewer.paused.value = True
        yield from range(2)
        viewer._step.value = True
        yield
        assert shown[6:] == [6, 6, 7]
        viewer._reset.value = True
        yield
        assert shown[-1] == 0

    visit = visitor()
    viewer.run(lambda: next(visit, "gone") == "gone")
    assert len(shown) == 10
