"""Forces of grips that the shipped policy makes do not hang on the physics step: the default against 1 ms."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dexsim
from dexsim.core.compilation import jit
from dexsim.env.motors import JointCommand, Motors
from dexsim.physics.config import PhysicsConfig
from dexsim.physics.physics import Physics
from dexsim.tasks.grasp.config import GraspConfig
from dexsim_ppo import load_policy

WORLDS, CLOSING, HOLDING = 16, 40, 8  # control ticks


@pytest.mark.slow
def test_forces_at_the_default_step_are_those_at_1_ms():
    config = GraspConfig(release_delay=(0.0, 0.0))  # objects settle while hands close
    env, policy = dexsim.make("grasp", config, backend="c"), load_policy("grasp")
    act, step = jax.vmap(policy.act), jax.vmap(env.step)

    def close(state, carry):
        def body(both, _):
            carry, action = act(both[1], both[0].obs["actor"])
            return (step(both[0], action), carry), None

        return jax.lax.scan(body, (state, carry), length=CLOSING)[0][0]

    state = jit(jax.vmap(env.reset), once=True)(jax.random.split(jax.random.key(3), WORLDS))
    state = jit(close, once=True)(state, policy.initial_carry(WORLDS))

    def forces(timestep):
        config, task = PhysicsConfig(timestep=timestep, substeps=round(env.control_period / timestep)), env.task
        physics = Physics(env.hand, task.slots, task.largest, config, gravity=task.gravity, backend="c")
        motors = Motors(physics)

        def tick(state, world):
            target = state.joint_target
            command = JointCommand(action=0 * target, target=target, previous=target, valid=jnp.array(True))
            # Latency is in sub-steps, and the target stands still.
            law = motors.law(dataclasses.replace(state.episode.hand, latency=jnp.zeros(len(target))), command)
            pads = state.episode.hand.pad_thickness_delta
            return physics.advance(law, state.episode.object, world, jnp.zeros(3), state.tip_stiffness, pads)

        run, world, rows = jit(jax.vmap(tick), once=True), state.physics, []
        for _ in range(HOLDING):
            world, force = run(state, world)
            rows.append(np.asarray(force))
        return np.stack(rows[2:])  # [T, B, F, 3] N

    coarse, fine = forces(PhysicsConfig().timestep), forces(0.001)
    strength = np.linalg.norm(fine, axis=-1).max(-1)
    assert np.mean(strength > 1.0) > 0.7, "hardly a hand holds anything"
    error = np.linalg.norm(coarse - fine, axis=-1).max(-1)
    assert np.median(error) < 0.05 and np.percentile(error, 90) < 0.2, np.percentile(error, (50, 90, 100))
