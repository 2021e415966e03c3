"""Objects: mass properties against C MuJoCo, ranges and reach."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from shapes import bounds, integrate

from dexsim.objects.config import SHAPES, ObjectConfig
from dexsim.objects.params import extent, sample_object

BOX, CAPSULE, CYLINDER = range(3)
ACTIVE = {
    "sphere": {(0, 1, 0)},
    "box": {(1, 0, 0)},
    "cylinder": {(0, 0, 1)},
    "capsule": {(0, 1, 0)},
    "composition": {(1, 1, 0), (0, 1, 1)},
}
# As they stand: no scatter of inertia or of the centre of mass.
UNIFORM = ObjectConfig(inertia_scale=(1.0, 1.0), com_offset=0.0)


def draw(config=ObjectConfig(), name=None, seed=0):  # noqa: B008
    """200 objects. Not jitted as a whole: a config is a constant, so each would be another compilation."""
    keys = jax.random.split(jax.random.key(seed), 200)
    index = None if name is None else jnp.int32(SHAPES.index(name))
    return jax.tree.map(np.asarray, jax.vmap(lambda key: sample_object(key, config, index))(keys))


@functools.cache
def default(name=None):
    return draw(name=name)


def row(drawn, at):
    return jax.tree.map(lambda x: x[at], drawn)


@pytest.mark.parametrize("name", SHAPES)
def test_inertia_is_that_of_the_solid(name):
    drawn = draw(UNIFORM, name)
    seen = set()
    for at in range(40):
        one = row(drawn, at)
        mass, centre, inertia = integrate(one)
        np.testing.assert_allclose(one.inertia, np.diag(inertia) * one.mass / mass, rtol=2e-4)
        assert np.abs(centre).max() < 1e-6  # the object's origin is its centre of mass
        np.testing.assert_array_equal(one.position[:, :2], 0)
        seen.add(tuple(one.active.astype(int)))
    assert seen == ACTIVE[name]


def within(values, span, scale=1.0):
    values = np.asarray(values)
    low, high = (scale * s for s in span)
    width = max(high - low, 1e-9)
    assert values.min() >= low - 1e-6 and values.max() <= high + 1e-6
    assert values.min() < low + 0.1 * width and values.max() > high - 0.1 * width


def test_sizes_fill_their_ranges():
    # No two ranges alike, so that none can be taken for another.
    config = ObjectConfig(
        sphere_radius=(0.04, 0.05),
        box_half=(0.02, 0.025),
        cylinder_radius=(0.03, 0.035),
        cylinder_half=(0.06, 0.07),
        neck_radius=(0.01, 0.012),
        neck_half=(0.014, 0.018),
    )
    ball, box, cylinder, capsule, union = (draw(config, name) for name in SHAPES)
    within(ball.size[:, CAPSULE, 0], config.sphere_radius)
    assert np.all(ball.size[:, CAPSULE, 1] <= 1e-4)  # a capsule of next to no length
    within(box.size[:, BOX], config.box_half)
    for drawn, slot in ((cylinder, CYLINDER), (capsule, CAPSULE)):
        within(drawn.size[:, slot, 0], config.cylinder_radius)
        within(drawn.size[:, slot, 1], config.cylinder_half)
    within(union.size[:, CAPSULE, 0], config.neck_radius)
    within(union.size[:, CAPSULE, 1], config.neck_half)
    boxy = union.active[:, BOX]
    assert 0.3 < boxy.mean() < 0.7
    within(union.size[boxy, BOX], config.box_half, 0.8)
    within(union.size[~boxy, CYLINDER, 0], config.cylinder_radius, 0.8)
    within(union.size[~boxy, CYLINDER, 1], config.cylinder_half, 0.8)


def test_extent_is_the_bound_of_the_turned_shape():
    rng = np.random.default_rng(1)
    for at in range(20):
        one = row(default(), at)
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0].astype(np.float32)
        shape = dataclasses.replace(one.shape(), position=one.position @ turn.T, rotation=np.stack([turn] * 3))
        reach = [extent(one, sign * turn[2]) for sign in (-1, 1)]
        np.testing.assert_allclose([-reach[0], reach[1]], bounds(shape)[:, 2], atol=1e-6)
