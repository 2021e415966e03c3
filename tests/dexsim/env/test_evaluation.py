"""What episodes draw: properties of objects anew each time, evaluations from start states that training never had."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dexsim.core.compilation import jit
from dexsim.core.pytree import pytree_dataclass
from dexsim.env.evaluation import Evaluation
from dexsim.env.state import Start

MANY = 400


@pytest.fixture(scope="module")
def drawn(simple_env):
    """The objects of `MANY` episodes from each row of the pool: leaves [8, MANY, ...]."""

    def draw(key, row):
        object = jax.tree.map(lambda rows: jnp.asarray(rows)[row], simple_env.pool.object)
        return simple_env.sampler.sample(*jax.random.split(key, 3), object).object

    keys = jax.random.split(jax.random.key(5), (8, MANY))
    return jit(jax.vmap(jax.vmap(draw, (0, None))), once=True)(keys, jnp.arange(8))


def properties(object):
    """Values [..., 9] that are uniform in the ranges of `spans`."""
    return np.stack(
        [object.mass, object.friction, object.link_friction, *np.moveaxis(object.com, -1, 0), object.contact[..., 0]],
        -1,
    )


def spans(config):
    offset = (-config.com_offset, config.com_offset)
    return np.array([config.mass, config.friction, config.link_friction, offset, offset, offset, config.stiffness])


class TestProperties:
    def test_inertia_follows_mass_and_shape(self, simple_env, drawn):
        """A box's is m/3 (b^2 + c^2); every ratio to it lies in the range, the same for all three axes."""
        boxes = np.flatnonzero(np.asarray(drawn.shape_index)[:, 0] == 1)
        square = np.asarray(drawn.size)[boxes, :, 0] ** 2
        uniform = np.asarray(drawn.mass)[boxes, :, None] / 3 * (square.sum(-1, keepdims=True) - square)
        ratio = np.asarray(drawn.inertia)[boxes] / uniform
        np.testing.assert_allclose(ratio, ratio[..., :1].repeat(3, -1), rtol=1e-4)
        low, high = simple_env.config.objects.inertia_scale
        assert low - 1e-4 <= ratio.min() < low + 0.02 and high - 0.02 < ratio.max() <= high + 1e-4

    def test_extreme_objects_stay_extreme_at_ends_of_their_own(self, simple_env, drawn):
        extreme = np.asarray(simple_env.pool.object.extreme)
        assert 0 < extreme.sum() < 8
        low, high = spans(simple_env.config.objects).T
        place = (properties(drawn) - low) / (high - low)
        at_end = np.isclose(place, 0, atol=1e-4) | np.isclose(place, 1, atol=1e-4)
        assert np.all(at_end[extreme]) and np.mean(at_end[~extreme]) < 0.01
        heavy = np.mean(place[extreme][..., 0] > 0.5)
        assert 0.4 < heavy < 0.6


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


def plan_of(count, seed):
    return Evaluation(SimpleNamespace(name="rows", task=Rows())).evaluation_plan(count, seed)


class TestPlan:
    def test_no_start_is_trainings_and_no_seed_has_anothers(self):
        plans = [plan_of(8, seed).start.qpos for seed in (0, 1, 2**32 - 1)]
        pools = [rows_of(qpos) for qpos in (Rows().make_pool(jax.random.key(0)).qpos, *plans)]
        assert [len(pool) for pool in pools] == [8] * 4 and len(set.union(*pools)) == 32

    @pytest.mark.parametrize("count", [1, 8, 30])
    def test_no_start_repeats_however_many_episodes(self, count):
        plan = plan_of(count, 0)
        assert len(rows_of(plan.start.qpos)) == len(np.unique(plan.row)) == count
        assert len(np.unique(jax.random.key_data(plan.key), axis=0)) == count


def rows_of(qpos):
    return {tuple(row) for row in np.asarray(qpos)}
