"""A task written from `dexsim.env.task.Task` alone: balance a ball on the upturned palm."""

import dataclasses
import pydoc
import re
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from episodes import ones_of, with_episode
from shapes import solid
from simple_physics import SimplePhysics

import dexsim
from dexsim import registry
from dexsim.core.compilation import jit
from dexsim.core.config import setting
from dexsim.core.pytree import pytree_dataclass
from dexsim.env.config import EnvConfig
from dexsim.env.env import touch_geometry
from dexsim.env.state import Start
from dexsim.env.task import reward_of
from dexsim.errors import ConfigError
from dexsim.geometry import grid, surface_points
from dexsim.geometry.distance import signed_distance
from dexsim.geometry.mesh import load_mesh
from dexsim.hand.kinematics import HandPose
from dexsim.objects.params import ObjectParams
from dexsim.touch.taxel_force import Touch

WORLDS = 4


@dataclasses.dataclass(frozen=True, kw_only=True)
class BalanceConfig(EnvConfig):
    """The balance task."""

    pool_size: int = setting(6, unit="1", low=1)
    """Start states."""
    height: float = setting(0.1, unit="m", low=0.0, high=1.0)
    """Where the ball starts above the palm's centre."""
    reach: float = setting(0.15, unit="m", low=0.0, high=1.0)
    """The ball is lost when it is farther than this from there."""


@pytree_dataclass
class Goal:
    """What an episode carries."""

    ticks: jax.Array  # [] so far


class Balance(dexsim.Task):
    """The rules: nothing of another task."""

    name, evaluation, object_ranges = "balance", "series", ("objects.mass",)
    fields = {"actor": ("joint_position", "contact_force"), "critic": ("joint_position", "joint_velocity")}
    gravity, episode_ticks, evaluation_ticks = (-9.81, 0.0, 0.0), 30, 20

    def __init__(self, config: BalanceConfig, hand: dexsim.Hand):
        self.config, self.hand = config, hand
        self.slots, self.largest = config.objects.slots, config.objects.largest
        self.reference = (config.height, 0.0, 0.1)

    def make_pool(self, key):
        keys = jax.random.split(key, self.config.pool_size)
        object = jax.jit(jax.vmap(lambda key: self.sample_object(key, self.config, jnp.int32(0))))(keys)
        rest = jnp.concatenate([jnp.zeros(self.hand.num_joints), jnp.array([*self.reference, 1.0, 0.0, 0.0, 0.0])])
        qpos = jnp.tile(rest, (len(keys), 1))
        return Start(qpos=qpos, qvel=jnp.zeros((len(keys), self.hand.num_joints + 6)), object=object)

    def begin(self, key, start):
        return Goal(jnp.zeros(()))

    def update(self, key, goal, truth):
        return Goal(goal.ticks + 1)

    def dropped(self, goal, truth):
        return self._distance(truth) > self.config.reach

    def reward(self, goal, truth, dropped):
        distance = self._distance(truth)
        return jnp.where(dropped, -1.0, 1.0 - distance), {"distance": distance, "ticks": goal.ticks}

    def evaluation_plan(self, count, shape_index):
        return np.arange(count) % len(shape_index), Goal(jnp.zeros(count))

    def summarize(self, metrics, alive, control_period):
        held = float(alive[-1].mean())
        return {"held": held, "headline": {"held": held}}

    def _distance(self, truth):
        return jnp.linalg.norm(truth.object_position - jnp.asarray(self.reference) + 1e-12)


@pytest.fixture(scope="module")
def env():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("dexsim.env.env.Physics", SimplePhysics)
        patch.setattr(registry, "TASKS", dict(registry.TASKS))
        dexsim.register("balance", Balance)
        yield dexsim.make("balance", backend="c")


def test_it_runs_from_reset_to_restart(env):
    """In `SimplePhysics` an object falls freely: it is lost after sqrt(2 reach / g)."""
    state, start = ones_of(env, WORLDS), jax.tree.map(lambda rows: jnp.asarray(rows[:WORLDS]), env.pool)
    assert state.obs["actor"].shape == (WORLDS, 12 + 5) and state.obs["critic"].shape == (WORLDS, 24)
    physics = dataclasses.replace(state.physics, qpos=start.qpos, qvel=start.qvel)
    level = dataclasses.replace(state.episode.hand, tilt=jnp.zeros((WORLDS, 2)))
    state = with_episode(state, object=start.object, hand=level)
    state, step = dataclasses.replace(state, physics=physics, goal=Goal(jnp.zeros(WORLDS))), jit(jax.vmap(env.step))
    lost = int(np.ceil(np.sqrt(2 * env.config.reach / 9.81) / env.control_period))
    for tick in range(1, lost + 1):
        state = step(state, jnp.zeros((WORLDS, env.action_size)))
        np.testing.assert_array_equal(state.metrics["ticks"], tick - 1)  # of the goal that held during the tick
        np.testing.assert_array_equal(state.terminated, tick >= lost)
        np.testing.assert_allclose(state.reward, np.where(tick >= lost, -1.0, 1.0 - state.metrics["distance"]))
    again = jax.eval_shape(jax.vmap(env.restart), state, state.terminated)
    jax.tree.map(lambda new, old: (new.shape, new.dtype) == (old.shape, old.dtype) or pytest.fail(), again, state)


def test_taxels_feel_a_mesh_at_the_size_of_the_episode(monkeypatch):
    """1 mm beside each face of a cuboid that is 1.2 times as large as its file; primitives as they are."""
    half = np.float32([0.025, 0.018, 0.032])
    cuboid = SimpleNamespace(mesh=load_mesh(trimesh.creation.box(2 * half)), boxes=SimpleNamespace(size=half[None]))
    monkeypatch.setattr("dexsim.env.env.load_mesh_object", lambda config: cuboid)
    monkeypatch.setitem(grid.bake.__kwdefaults__, "nodes", 32)
    points = jnp.asarray(np.concatenate([sign * np.diag(1.2 * half + 0.001) for sign in (1, -1)]), jnp.float32)
    for method in ("grid", "surface_points"):
        geometry = touch_geometry(SimpleNamespace(mesh="cuboid.stl"), method)(SimpleNamespace(size=1.2 * half[None]))
        assert isinstance(geometry, grid.Grid) == (method == "grid")
        np.testing.assert_allclose(jax.jit(signed_distance)(points, geometry), 0.001, atol=2e-4)
    primitives, shape = SimpleNamespace(mesh=""), solid("box", *half)
    assert touch_geometry(primitives, "closed_form") is ObjectParams.shape
    found = touch_geometry(primitives, "surface_points")(SimpleNamespace(shape=lambda: shape))
    np.testing.assert_array_equal(found.position, surface_points.from_shape(shape).position)
    with pytest.raises(ConfigError, match="touch_method = 'grid': needs ObjectConfig.mesh"):
        touch_geometry(primitives, "grid")


@pytest.mark.parametrize("reward", [True, np.float64(1.0), jnp.float16(1.0)])
def test_a_reward_may_be_any_number(reward):
    """A compiled loop carries it from the float that an episode begins with, in evaluation as in training."""
    task = SimpleNamespace(name="balance", reward=lambda *_: (reward, {}))
    found, _ = reward_of(task, None, None, jnp.zeros((), bool))
    assert (found.shape, found.dtype, float(found)) == ((), jnp.float32, 1.0)
    for name, given in (("reward", (jnp.ones(3), {})), ("speed", (reward, {"speed": jnp.ones(2)}))):
        task.reward = lambda *_, given=given: given
        with pytest.raises(ConfigError, match=f"task 'balance': {name} must be a scalar; got shape"):
            reward_of(task, None, None, jnp.zeros((), bool))


READ = [dexsim.GroundTruth, dexsim.State, dexsim.Start, dexsim.Readings, dexsim.Task, dexsim.TaskSpec]


@pytest.mark.parametrize("cls", [*READ, HandPose, ObjectParams, Touch])
def test_help_shows_what_a_field_is_and_the_shape_or_unit_of_numbers(cls):
    page = pydoc.render_doc(cls, renderer=pydoc.plaintext)
    texts = dict(re.findall(r"^ \|    (\w+): (.+)$", page, re.M)) | {"kinds": "not traced"}
    for name, kind in cls.__annotations__.items():
        number = re.search(r"array|float|\bint\b", str(kind), re.I)
        assert re.search(r"\[.*\]|ticks", texts[name]) if number else texts[name], name
