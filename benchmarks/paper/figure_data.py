"""What the figures without a policy's score show: calibration, skin, and one motion felt in both worlds."""

import dataclasses
import io
from pathlib import Path
from typing import Any

import numpy as np

from paper.data import Budget, Row


def calibration(row: Row, seed: int, budget: Budget, work: Path) -> dict[str, Any]:
    """Press one fingertip of the emulated hand, and fit current and torque over force."""
    from rich.console import Console

    from dexsim import load_hand
    from dexsim.calibration.plot import plot_calibration
    from dexsim_real.calibrate.__main__ import record
    from dexsim_real.calibrate.hand_loop import Operator
    from dexsim_real.calibrate.options import CalibrateArguments, PressConfig
    from dexsim_real.calibrate.press_fit import fit
    from dexsim_real.calibrate.read import read_logs
    from dexsim_real.calibrate.report import report
    from dexsim_real.twin.press import PressBench, VirtualPort

    work.mkdir(parents=True, exist_ok=True)
    hand, log = load_hand(), work / "press.log"
    log.unlink(missing_ok=True)
    plant = PressBench(hand, seed, kind="inside")
    port = VirtualPort(plant)
    arguments = CalibrateArguments(
        port="virtual",
        output=work / "hand.toml",
        force=True,
        log=log,
        yes=True,
        realtime=False,
        fingers=(row.name,),
        sides=False,
        press=PressConfig() if budget.minutes else PressConfig(seconds=2.0),
    )
    operator = Operator(Console(file=io.StringIO()), assume_yes=True)
    record(arguments, hand, operator, port=port, clock=port.clock, sleep=port.sleep)
    found = fit(read_logs([log], hand), hand)
    figure = work / "calibration.svg"
    plot_calibration(figure, found.calibration, found.real, found.sim)
    joints = {name: entry for name, entry in report(found)["joints"].items() if name in found.real}
    truth = plant.truth()
    rows = [
        {
            "joint": name,
            "force_max_n": entry["force_max_n"],
            "current_max_a": entry["current_max_a"],
            "torque_max_nm": float(found.calibration.sim.value_max[hand.joint_names.index(name)]),
            **{f"{way}_r_squared": entry[way]["r_squared"] for way in ("loading", "unloading")},
            **{f"{way}_a_per_n": entry[way]["a_per_n"] for way in ("loading", "unloading")},
            "nm_per_a": float(np.mean([entry[way]["nm_per_a"] for way in ("loading", "unloading")])),
            "true_nm_per_a": -float(
                np.mean([truth[f"{way}_nm_per_a"][hand.joint_names.index(name)] for way in ("loading", "unloading")])
            ),
        }
        for name, entry in joints.items()
    ]
    return {"joints": rows, "files": [str(figure)]}


def skin(row: Row, seed: int, budget: Budget, work: Path) -> dict[str, Any]:
    """Stress over compression: taxels under a flat face, the law in closed form, and named silicones."""
    del row, seed, budget, work
    import jax.numpy as jnp

    from dexsim import load_hand
    from dexsim.geometry import sdf
    from dexsim.hand.kinematics import forward_kinematics, taxel_positions
    from dexsim.touch.feel import feel
    from dexsim.touch.materials import MATERIALS
    from dexsim.touch.skin import Skin

    hand, law = load_hand(), Skin()
    pose = forward_kinematics(hand, jnp.zeros(hand.num_joints))
    taxels = np.asarray(taxel_positions(hand, pose))
    face = sdf.Shape(("box",), jnp.full((1, 3), 0.1), jnp.zeros((1, 3)), jnp.eye(3)[None], jnp.ones(1, bool))
    felt = []
    area = np.broadcast_to(np.asarray(hand.taxel_area, np.float32), taxels.shape[:2])
    for depth in np.linspace(0.0001, 0.69, 24) * law.thickness:
        # The face's plane is `depth` into the rubber over the foremost taxel of the index finger.
        height = taxels[1, :, 0].max() + law.margin - depth + 0.1
        touch = feel(
            jnp.asarray(taxels),
            jnp.asarray(area),
            face,
            jnp.array([height, *taxels[1, :, 1:].mean(0)], jnp.float32),
            jnp.eye(3),
            jnp.ones(hand.num_fingers),
            law,
        )
        foremost = int(np.argmax(taxels[1, :, 0]))
        felt.append(
            {
                "compression": float(touch.depth[1, foremost] / law.thickness),
                "stress_pa": float(touch.skin_force[1, foremost] / area[1, foremost]),
            }
        )
    strain = np.linspace(0.0, law.max_compression, 36)
    curves = {"skin": mooney_rivlin(strain, law.c10, law.c01), "linear": 6 * (law.c10 + law.c01) * strain}
    silicones = {
        name: mooney_rivlin(strain, *material) for name, material in MATERIALS.items() if not name.endswith("_tension")
    }
    worst = max(abs(p["stress_pa"] / mooney_rivlin(np.array(p["compression"]), law.c10, law.c01) - 1) for p in felt)
    return {
        "felt": felt,
        "compression": strain.tolist(),
        "curves_pa": {name: values.tolist() for name, values in (curves | silicones).items()},
        "worst_deviation": float(worst),
        "c10_pa": law.c10,
        "c01_pa": law.c01,
    }


def mooney_rivlin(compression: np.ndarray, c10: float, c01: float) -> np.ndarray:
    """Size of the uniaxial stress Pa: |2 (l - l^-2)(C10 + C01 / l)| at l = 1 - compression."""
    stretch = 1.0 - np.asarray(compression, float)
    return np.abs(2 * (stretch - stretch**-2) * (c10 + c01 / stretch))


def contacts(row: Row, seed: int, budget: Budget, work: Path) -> dict[str, Any]:
    """One grasp on the emulated hand at nominal parameters, and the same actions from the same start in simulation."""
    import zero_shot

    from dexsim_real.control.controller import Controller
    from dexsim_real.twin.plant.emulated_hand import EmulatedHand
    from dexsim_real.twin.virtual import RunOptions, VirtualRun

    class Recorder(Controller):
        """Keeps what the object did at every tick."""

        def tick(self, measured, seen, goal_quat, command):
            place, quat, _ = plant.measure_object()
            done = super().tick(measured, seen, goal_quat, command)
            kept.append((np.array(measured.joint_position), place, quat, done.action, done.readings.taxel_force))
            return done

    hand, controller, gains = zero_shot.load(row.policy, False)
    kept: list[tuple] = []
    exact = {"camera_noise": 0.0, "camera_delay": 0.0, "imu_noise": 0.0, "push_rate": 0.0, "gravity_tilt": 0.0}
    plant = EmulatedHand(
        hand,
        "grasp",
        seed,
        kind="nominal",
        overrides=exact,
        seconds=budget.seconds.get("grasp", 4.0),
        trials=1,
        shape="sphere",
    )
    command, radius, mass = 0.75, plant.shape.parts[0].size[0], float(plant.parameters.mass)
    recorder = Recorder(controller.policy, hand)
    recorder.warm()
    kept.clear()
    run = VirtualRun(plant, recorder, gains, RunOptions(command))
    outcome = run.run()
    joints, place, quat, action, felt = (np.array(column) for column in zip(*kept, strict=True))
    start = (joints[0], place[0], quat[0])
    there = _replay(controller.policy, hand, start, radius, mass, action, budget)
    period = controller.period
    times = period * np.arange(len(felt))
    return {
        "held": outcome["held"],
        "command": command,
        "object": f"sphere of {2e3 * radius:.0f} mm",
        "times": times.tolist(),
        "hand": _summed(felt, hand),
        "simulation": _summed(there, hand),
        **_agreement(there, felt, hand),
    }


def _replay(
    policy: Any, hand: Any, start: tuple, radius: float, mass: float, actions: np.ndarray, budget: Budget
) -> np.ndarray:
    """Taxel forces [T, F, N] of a nominal hand in simulation under given actions [T, J] from a given start."""
    import jax
    import jax.numpy as jnp

    import dexsim
    from dexsim.core.compilation import jit
    from dexsim.core.config import from_dict, override
    from dexsim.env.state import Start
    from dexsim.tasks.grasp.config import GraspConfig

    settings = (
        "randomization.scale=0",
        "push_probability=0",
        "objects.scale=0",
        'objects.shapes=["sphere"]',
        f"objects.sphere_radius=[{radius},{radius}]",
        f"objects.mass=[{mass},{mass}]",
        "pool_size=8",
    )
    config = from_dict(GraspConfig, override(policy.env_config, settings))
    env = dexsim.make("grasp", config, backend=budget.backend, num_envs=1)
    joints, place, quat = start
    row = jax.tree.map(lambda x: jnp.asarray(x)[0], env.pool)
    row = dataclasses.replace(
        row, qpos=jnp.asarray(np.concatenate([joints, place, quat]), jnp.float32), qvel=jnp.zeros_like(row.qvel)
    )
    assert isinstance(row, Start)

    def roll(actions: jax.Array) -> jax.Array:
        def step(state, action):
            state = jax.vmap(env.step)(state, action[None])
            return state, state.readings.taxel_force[0]

        first = jax.vmap(env.reset_from)(jax.random.split(jax.random.key(0), 1), jax.tree.map(lambda x: x[None], row))
        return jax.lax.scan(step, first, actions)[1]

    return np.asarray(jit(roll, backend=env.backend)(jnp.asarray(actions, jnp.float32)))


def _summed(force: np.ndarray, hand: Any) -> dict[str, list]:
    """Force [T, F] N and centre [T, F, 2] on the lattice (column, row; None without touch) of taxel forces."""

    pairs = [lattice_centre(np.asarray(force[:, finger], float), hand.taxel_grid) for finger in range(hand.num_fingers)]
    centre = np.stack([pair[1] for pair in pairs], 1)
    return {
        "force_n": np.round(np.stack([pair[0] for pair in pairs], 1), 2).tolist(),
        "centre": [[None if np.isnan(c).any() else np.round(c, 2).tolist() for c in row] for row in centre],
    }


def _agreement(first: np.ndarray, second: np.ndarray, hand: Any) -> dict[str, Any]:
    """Mean distance of the centres in taxels where both feel, and root mean square difference of the forces."""
    a, b = (_summed(force, hand) for force in (first, second))
    both = [
        np.hypot(*np.subtract(p, q))
        for row, other in zip(a["centre"], b["centre"], strict=True)
        for p, q in zip(row, other, strict=True)
        if p and q
    ]
    off = np.subtract(a["force_n"], b["force_n"])
    return {
        "centre_distance_taxels": float(np.mean(both)) if both else None,
        "force_difference_rms_n": float(np.sqrt(np.mean(off**2))),
        "force_rms_n": float(np.sqrt(np.mean(np.square(b["force_n"])))),
    }


def lattice_centre(force: np.ndarray, grid: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Total [T] N and force-weighted centre [T, 2] in (column, row) of one finger [T, N]; NaN without force."""
    place = np.stack(np.divmod(np.arange(grid[0] * grid[1]), grid[1]), -1)
    total = force.sum(-1)
    centre = force @ place / np.where(total > 0, total, 1.0)[:, None]
    return total, np.where(total[:, None] > 0, centre, np.nan)
