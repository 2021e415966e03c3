"""The experiments: each table and figure as rows, with the paper's numbers; docs/results.md says what differs."""

import functools
import itertools
import json
from collections.abc import Iterator

from paper import figures, measure, tables
from paper.data import Experiment, Row
from paper.measure import points_at_twice

_PAPER = {
    "full": ("25.1 / 22.0 / 3.36 / 84.3", "8, 10, 12, 15, 19, 25, 26, 35, 46, 55"),
    "quaternion": ("2.9 / 2.5 / 5.24 / 15.2", "1, 1, 1, 1, 2, 3, 4, 5, 5, 6"),
    "unweighted": ("12.2 / 12.0 / 3.75 / 45.7", "3, 6, 8, 10, 11, 13, 13, 15, 21, 22"),
    "no_force": ("13.2 / 13.5 / 3.19 / 42.1", "2, 6, 10, 11, 13, 14, 16, 18, 21, 21"),
    "centre_alone": ("7.5 / 7.5 / 4.03 / 30.2", "1, 3, 6, 6, 7, 8, 9, 11, 11, 13"),
    "no_touch": ("1.1 / 1.0 / 2.82 / 3.10", "1, 1, 1, 1, 1, 1, 1, 1, 1, 2"),
    "no_orientation": ("11.2 / 11.5 / 2.59 / 29.0", "2, 4, 5, 8, 11, 12, 13, 16, 17, 24"),
}
"""Average, median, seconds each and seconds to fall; the successes of its ten trials."""
_UNWEIGHTED = "observation.weighting=none"
_OBSERVATIONS: dict[str, tuple[str, tuple[str, ...]]] = {
    "full": ("all, 6-D orientation", ()),
    "quaternion": ("quaternion", ("observation.orientation=quaternion",)),
    "unweighted": ("centre not force-weighted", (_UNWEIGHTED,)),
    "no_force": ("no contact force", ('observation.leave_out=["contact_force"]',)),
    "centre_alone": ("centre alone, unweighted", (_UNWEIGHTED, 'observation.leave_out=["contact_force"]')),
    "no_touch": ("no touch", ('observation.leave_out=["contact_force", "contact_centre"]',)),
    "no_orientation": ("no orientation", ('observation.leave_out=["relative_orientation"]',)),
}


def _paper(name: str) -> dict[str, str]:
    return dict(zip(("mean / median / s each / s to fall", "sorted"), _PAPER[name], strict=True))


def _observation_rows(task: str, changed: tuple[str, ...] = ()) -> tuple[Row, ...]:
    """The seven rows of the paper's table, trained on a task with these changes."""
    return tuple(
        Row(name=name, label=label, task=task, settings=(*changed, *settings), paper=_paper(name))
        for name, (label, settings) in _OBSERVATIONS.items()
    )


_SWEEPS = (
    # skills, name, label, setting, points; with a range of training its ends and those of a range twice as wide
    ("grasp rotate", "latency", "command latency [s]", "randomization.latency=[{},{}]", (0.0, 0.01, 0.02, 0.03)),
    ("grasp rotate", "torque_gain", "torque gain", "randomization.torque_gain=[{},{}]", points_at_twice(0.9, 1.1)),
    ("grasp rotate", "taxel_noise", "taxel noise [N]", "sensing.taxel.noise={}", (0.0, 0.01, 0.02, 0.04)),
    ("grasp rotate", "dead_taxels", "dead taxels [share]", "sensing.taxel.dead=[{},{}]", (0.0, 0.05, 0.1, 0.2)),
    ("grasp rotate", "lean", "mount lean, at most [rad]", "randomization.gravity_tilt={}", (0.0, 0.05, 0.1, 0.2)),
    ("grasp rotate", "friction", "finger friction", "objects.friction=[{},{}]", points_at_twice(0.4, 1.2, floor=0.02)),
    ("grasp", "link_friction", "link friction", "objects.link_friction=[{},{}]", points_at_twice(0.3, 1.2, floor=0.02)),
    ("grasp", "mass", "mass [kg]", "objects.mass=[{},{}]", points_at_twice(0.05, 0.20, floor=0.02)),
    # Below 0.1 hardly a cube stays on the palm to begin with.
    ("rotate", "link_friction", "link friction", "objects.link_friction=[{},{}]", (0.1, 0.3, 0.9, 1.2)),
    ("rotate", "mass", "mass [kg]", "objects.mass=[{},{}]", points_at_twice(0.06, 0.15, floor=0.02)),
    (
        "rotate",
        "orientation",
        "orientation error, at most [rad]",
        "sensing.orientation.bias={}",
        (0.0, 0.02, 0.04, 0.08),
    ),
    ("rotate", "edge", "cube edge [m]", "edge=[{},{}]", points_at_twice(0.050, 0.060)),
)


def _sweep_rows() -> Iterator[Row]:
    """The rows of both skills."""
    for skill in ("grasp", "rotate"):
        yield Row(name=f"{skill}_reference", label=f"{skill}: training's ranges", task=skill, policy=skill)
        for skills, name, label, setting, points in _SWEEPS:
            if skill in skills:
                # Few small cubes stay in the hand: a pool that they can fill.
                settings = (setting, "pool_size=256") if name == "edge" else (setting,)
                about = {"name": f"{skill}_{name}", "label": f"{skill}: {label}", "task": skill, "policy": skill}
                yield Row(settings=settings, points=points, **about)


_REWARDS = (
    ("both", "R_force and R_torque", (), "44.50–93.92", "1.09–1.52"),
    ("force", "R_force alone", ("reward.torque=0",), "37.29–70.02", "0.69–0.75"),
    ("torque", "R_torque alone", ("reward.force=0",), "38.45–47.12", "0.85–1.02"),
)
"""The paper's, and without either of its halves; its ranges of the contact force [N] and of the joint torque."""

_READINGS = (
    ("nothing", "nothing ablated", ()),
    ("force", "contact force ablated", ("contact_force",)),
    ("centre", "contact centre ablated", ("contact_centre",)),
    ("touch", "both ablated", measure.TOUCH),
    ("orientation", "orientation ablated", ("relative_orientation",)),
)

_ORIENTATIONS = {
    "exact": (0.0, ("sensing.orientation.bias=0", "sensing.orientation.noise=0", "sensing.orientation.drift=0")),
    "0.1 rad": (0.1, ("sensing.orientation.bias=0.1",)),
    "0.3 rad": (0.3, ("sensing.orientation.bias=0.3",)),
    "none": (0.0, ()),
}
"""Error of the emulated hand's orientation [rad], and training's settings."""
_OBJECTS = {
    "cube": ("edge=[0.055,0.055]",),
    "sizes": ("edge=[0.045,0.065]", "pool_size=1024"),  # Few small cubes stay in the hand.
    "shapes": ('objects.shapes=["box","cylinder"]', "edge=[0.045,0.065]", "proportions=[0.9,1.1]"),
}
_STEP = ("control.step=0.08",)  # with which the table and the map were trained
# Below a friction of 0.2 a sixth of the small cubes find no posture in which they stay.
_ROUGH = ("push_probability=0.01", "push_speed=0.2", "objects.friction=[0.2,1.6]", "objects.link_friction=[0.2,1.2]")


def _map_rows() -> Iterator[Row]:
    """Each world with and without touch. Of what the emulated hand draws, `plant` fixes what the world is about."""
    for orientation, object, rough, touch in itertools.product(_ORIENTATIONS, _OBJECTS, (False, True), (True, False)):
        left_out = [] if touch else [*measure.TOUCH]
        left_out += ["relative_orientation"] if orientation == "none" else []
        world = f"{orientation}, {object}, {'rough' if rough else 'as trained'}"
        error, sensing = _ORIENTATIONS[orientation]
        yield Row(
            name=f"{world}, {'touch' if touch else 'no touch'}".replace(" ", "_").replace(",", ""),
            label=world,
            task="rotate",
            settings=(
                *_STEP,
                *sensing,
                *_OBJECTS[object],
                *(_ROUGH if rough else ()),
                f"observation.leave_out={json.dumps(left_out)}",
            ),
            plant=(
                f"imu_bias={error}",
                f"push_rate={2 if rough else 1}",
                *(("edge=0.055",) if object == "cube" else ()),
                *(("gravity_tilt=0.1",) if object == "shapes" else ()),
            ),
        )


_ALL = (
    Experiment(
        name="observations",
        title="Observations of the rotation, our reward and success test",
        rows=_observation_rows("rotate", _STEP),
        measure=measure.trained,
        table=tables.rotation,
        draw=figures.successes,
        training_seeds=3,
    ),
    Experiment(
        name="exact_observations",
        title="Observations of the rotation, the paper's task exactly",
        rows=_observation_rows("rotate_paper"),
        measure=measure.trained,
        table=tables.rotation,
        draw=figures.successes,
        training_seeds=5,
    ),
    Experiment(
        name="exact_rewards",
        title="Rewards of the grasp, the paper's task exactly",
        rows=tuple(
            Row(
                name=name,
                label=label,
                task="grasp_paper",
                settings=settings,
                paper={"force range [N]": force, "torque range": torque},
            )
            for name, label, settings, force, torque in _REWARDS
        ),
        measure=measure.trained,
        table=tables.grasp,
        draw=figures.command_curves,
        training_seeds=5,
    ),
    Experiment(
        name="touch_map",
        title="Where touch pays: rotation with and without it",
        rows=tuple(_map_rows()),
        measure=measure.trained,
        table=tables.touch_map,
        draw=figures.touch_map,
        training_seeds=3,
    ),
    Experiment(
        name="readings",
        title="Readings ablated in the shipped rotation policy",
        rows=tuple(
            Row(name=name, label=label, task="rotate", policy="rotate", ablate=ablate)
            for name, label, ablate in _READINGS
        ),
        measure=functools.partial(measure.measured, worlds=("simulation",)),
        table=tables.rotation,
    ),
    Experiment(
        name="force",
        title="Force and torque over the command, shipped grasp policy",
        rows=(Row(name="grasp", label="shipped policy", task="grasp", policy="grasp"),),
        measure=functools.partial(measure.measured, worlds=("simulation", "hand")),
        table=tables.commands,
        draw=figures.command_curves,
    ),
    Experiment(
        name="successes",
        title="Sorted successes of the shipped policies on the emulated hand",
        rows=tuple(
            Row(name=name, label=label, task="rotate", policy=name, paper=_paper(paper))
            for name, label, paper in (
                ("rotate", "all, 6-D orientation", "full"),
                ("rotate_without_orientation", "no orientation", "no_orientation"),
            )
        ),
        measure=functools.partial(measure.measured, worlds=("hand",)),
        table=tables.rotation,
        draw=figures.successes,
    ),
    Experiment(
        name="objects",
        title="Objects that no training has seen",
        rows=(Row(name="grasp", label="shipped policy, 24 objects", task="grasp", policy="grasp"),),
        measure=measure.held_out,
        table=tables.held_out,
    ),
    Experiment(
        name="robustness",
        title="Success beyond the ranges of training",
        rows=tuple(_sweep_rows()),
        measure=measure.swept,
        table=tables.sweeps,
    ),
)
EXPERIMENTS: dict[str, Experiment] = {experiment.name: experiment for experiment in _ALL}
"""By the name that the command takes."""
