"""Where an object can be put, on hands whose links are other primitives, or turned ones."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dexsim.core.errors import AssetError
from dexsim.hand.kinematics import forward_kinematics
from dexsim.objects.config import ObjectConfig
from dexsim.objects.params import sample_object
from dexsim.tasks.placement import clearance


def with_geoms(hand, change):
    return dataclasses.replace(hand, geoms=tuple(geom for old in hand.geoms if (geom := change(old)) is not None))


def gap(hand, joints, shape, place):
    """`clearance` of an object that is not turned."""
    return float(jax.jit(lambda place: clearance(hand, joints, shape, place, jnp.eye(3)))(place))


def test_spheres_count_and_a_hand_of_a_palm_alone_is_refused(hand):
    balls = with_geoms(hand, lambda g: dataclasses.replace(g, kind="sphere") if g.kind == "capsule" else g)
    shape = jax.jit(lambda key: sample_object(key, ObjectConfig()))(jax.random.key(0)).shape()
    joints, away = jnp.zeros(hand.num_joints), jnp.array([1.0, 0.0, 0.1])
    middle = max(float(np.linalg.norm(np.asarray(geom.position))) for geom in hand.geoms)
    assert 0.5 - middle < gap(balls, joints, shape, away) < 1.0
    with pytest.raises(AssetError, match="no capsule, sphere or box has contype"):
        gap(with_geoms(hand, lambda g: g if g.kind == "box" else None), joints, shape, away)


def test_boxes_of_links_count(hand):
    """An object in a link's box is not clear of it."""
    link, joints = hand.body_names.index("right_hand_mid_link1"), jnp.zeros(hand.num_joints)
    pose = jax.jit(forward_kinematics, static_argnums=0)(hand, joints)
    place = pose.body_position[link] + jnp.array([0.0, 0.0, 0.02])
    shape = jax.jit(lambda key: sample_object(key, ObjectConfig()))(jax.random.key(0)).shape()

    def boxed(geom):
        if geom.kind != "capsule":
            return geom
        size = np.array([0.01, 0.01, 0.03], np.float32)
        return dataclasses.replace(geom, kind="box", size=size) if geom.body == link else None

    boxes = with_geoms(hand, boxed)
    assert gap(boxes, joints, shape, place) < -0.005
    assert gap(boxes, joints, shape, place + jnp.array([0.2, 0.0, 0.0])) > 0.1
