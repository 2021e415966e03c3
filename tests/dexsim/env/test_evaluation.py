"""What episodes draw: properties of objects anew each time, evaluations from start states that training never had."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dexsim.core.compilation import jit
from dexsim.core.pytree import pytree_dataclass
from dexsim.env.env import sample_episode
from dexsim.env.evaluation import Evaluation
from dexsim.env.sensors import SensorSuite
from dexsim.env.state import Start
from dexsim.objects.config import SHAPES, ObjectConfig
from dexsim.tasks.grasp.config import GraspConfig
from dexsim.tasks.grasp.task import Grasp


@pytest.fixture(scope="module")
def drawn(hand):
    """What 400 episodes draw for each of eight boxes, of which some are extreme: the object, leaves [8, 400, ...]."""
    config, box = GraspConfig(objects=ObjectConfig(extremes=0.5)), jnp.int32(SHAPES.index("box"))
    task = Grasp(config, hand)
    sensors = SensorSuite(config, hand, task)

    def draw(key, object):
        return sample_episode(sensors, jax.random.split(key, 3), object).object

    def episodes(key, keys):
        return jax.vmap(draw, (0, None))(keys, task.sample_object(key, config, box))

    keys = jax.random.split(jax.random.key(5), (9, 400))
    return jit(jax.vmap(episodes), once=True)(keys[8, 8:16], keys[:8]), config.objects


def test_inertia_follows_mass_and_shape(drawn):
    """A box's is m/3 (b^2 + c^2); every ratio to it lies in the range, the same for all three axes."""
    object, config = drawn
    square = np.asarray(object.size)[..., 0, :] ** 2
    uniform = np.asarray(object.mass)[..., None] / 3 * (square.sum(-1, keepdims=True) - square)
    ratio = np.asarray(object.inertia) / uniform
    np.testing.assert_allclose(ratio, ratio[..., :1].repeat(3, -1), rtol=1e-4)
    low, high = config.inertia_scale
    assert low - 1e-4 <= ratio.min() < low + 0.02 and high - 0.02 < ratio.max() <= high + 1e-4


def test_extreme_objects_stay_extreme_at_ends_of_their_own(drawn):
    object, config = drawn
    offset = (-config.com_offset, config.com_offset)
    spans = config.mass, config.friction, config.link_friction, offset, offset, offset, config.stiffness
    values = object.mass, object.friction, object.link_friction, *np.moveaxis(object.com, -1, 0), object.contact[..., 0]
    low, high = np.array(spans).T
    place = (np.stack(values, -1) - low) / (high - low)
    at_end = np.isclose(place, 0, atol=1e-4) | np.isclose(place, 1, atol=1e-4)
    extreme = np.asarray(object.extreme)[:, 0]
    assert 0 < extreme.sum() < 8
    assert np.all(at_end[extreme]) and np.mean(at_end[~extreme]) < 0.01
    assert 0.4 < np.mean(place[extreme][..., 0] > 0.5) < 0.6


class Rows:
    """As much of a task as a plan needs: eight start states a pool."""

    name, evaluation, evaluation_ticks = "rows", "series", 1

    def make_pool(self, key):
        return Start(
            qpos=np.asarray(jax.random.uniform(key, (8, 19))),
            qvel=np.zeros((8, 18)),
            object=SimpleObject(np.zeros(8, int)),
        )

    def evaluation_plan(self, count, shape_index):
        return np.arange(count) % len(shape_index), np.arange(count)


@pytree_dataclass
class SimpleObject:
    shape_index: np.ndarray


def test_no_start_is_trainings_and_none_repeats():
    """However many episodes, and whatever their seeds."""
    seen = [Rows().make_pool(jax.random.key(0)).qpos]
    for count, seed in ((1, 2), (8, 2**32 - 1), (30, 0), (8, 1)):
        plan = Evaluation(SimpleNamespace(name="rows", task=Rows())).evaluation_plan(count, seed)
        assert len(np.unique(plan.row)) == len(np.unique(jax.random.key_data(plan.key), axis=0)) == count
        seen.append(plan.start.qpos)
    assert len(np.unique(np.concatenate(seen), axis=0)) == 8 + 1 + 8 + 30 + 8


@pytest.mark.parametrize(("count", "pools"), [(1, 1), (8, 2), (9, 3)])
def test_a_plan_that_repeats_starts_ends_with_twice_as_many(count, pools):
    """Where episodes are meant to share one; each pool takes minutes."""
    task, made = Rows(), []
    task.make_pool = lambda key: made.append(key) or Rows.make_pool(task, key)
    task.evaluation_plan = lambda count, shape_index: (np.zeros(count, int), np.arange(count))
    Evaluation(SimpleNamespace(name="rows", task=task)).evaluation_plan(count, 0)
    assert len(made) == pools
