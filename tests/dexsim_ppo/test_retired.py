"""Files of older versions: their fields under today's names and values, and what is said about it."""

import dataclasses
import warnings

import pytest

from dexsim.core.config import from_dict, to_dict
from dexsim.core.errors import CheckpointError, ConfigError, OldFileWarning
from dexsim.task_spec import TaskSpec, TurnSpec
from dexsim.tasks.grasp.config import GraspConfig
from dexsim.tasks.grasp.task import Grasp
from dexsim.tasks.rotate.config import RotateConfig
from dexsim.tasks.rotate.task import Rotate
from dexsim_ppo.retired import migrate_arguments, migrate_config, migrate_leaves, old_spec, read_spec

ARRAY = {
    "scale": 0.0,
    "hysteresis": [0.0, 0.3],
    "hysteresis_time": [0.03, 0.2],
    "crosstalk": [0.0, 0.1],
    "gain": [0.85, 1.15],
    "bias": [-0.03, 0.03],
    "drift": [0.0, 0.005],
    "noise": [0.005, 0.02],
    "dead": [0.0, 0.05],
    "threshold": [0.03, 0.1],
    "counts": "uint8",
    "resolution": 0.1,
    "rate": None,
}


def old_config(**array):
    """The defaults in the form of a file from before touch methods and one model of the taxels."""
    config = to_dict(GraspConfig())
    del config["touch_method"]
    config["objects"]["mesh_touch"] = "boxes"
    config["physics"] |= {"condim": 3, "cone": "elliptic", "tips": "skin", "palm": "auto"}
    config["sensing"]["taxel"] = {
        name: config["sensing"]["taxel"][name] for name in ("noise", "threshold", "resolution", "saturation")
    }
    config["sensing"]["array"] = ARRAY | array
    return config


def test_what_was_the_default_is_the_default():
    """The array of taxels was off, so its ranges are dropped; nothing is said of fields that changed nothing."""
    with pytest.warns(OldFileWarning) as caught:
        config = migrate_config(old_config(), "a file")
    assert from_dict(GraspConfig, config) == GraspConfig()
    assert str(caught[0].message).endswith(
        "objects.mesh_touch is now touch_method, touch_method = 'boxes' is now 'closed_form'"
    )


def test_effects_of_the_taxels_that_were_on_stay_on():
    with pytest.warns(OldFileWarning, match=r"sensing\.array\.noise = \[0\.005, 0\.02\] dropped"):
        config = from_dict(GraspConfig, migrate_config(old_config(scale=1.0, rate=[20, 30], bias=None), "a file"))
    taxel = config.sensing.taxel
    assert (taxel.gain, taxel.bias, taxel.rate, taxel.noise) == ((0.85, 1.15), None, (20.0, 30.0), 0.02)


def test_a_physics_that_is_gone_is_named():
    old = old_config()
    old["physics"] |= {"cone": "pyramidal", "tips": "constant"}
    old["skin"]["total"] = "skin"
    with pytest.warns(OldFileWarning) as caught:
        config = from_dict(GraspConfig, migrate_config(old, "a file"))
    message = str(caught[0].message)
    for words in (
        "physics.cone = 'pyramidal' dropped",
        "physics.tips = 'constant'",
        "skin.total = 'skin' is now 'press",
    ):
        assert words in message
    assert "condim" not in message and config.skin.total == "pressing"


def test_a_command_of_the_sum_over_the_fingers_is_named_and_one_of_each_finger_is_not(hand):
    """The choice between them is gone from configurations and specifications."""
    config = GraspConfig()
    spec = TaskSpec.of(Grasp(config, hand))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert from_dict(GraspConfig, migrate_config(to_dict(config) | {"force_command": "finger"}, "a file")) == config
        assert read_spec(to_dict(spec) | {"force_command": "finger"}, "a file") == spec
    with pytest.warns(OldFileWarning, match="a file: .*force_command = 'squeeze' dropped"):
        read_spec(to_dict(spec) | {"force_command": "squeeze"}, "a file")
    for forged in (3, [], {"skin": {"total": []}}):
        with pytest.raises(ConfigError):
            read_spec(forged, "a file")


def test_arguments_of_a_run_hold_the_same_fields():
    with pytest.warns(OldFileWarning, match="env.objects.mesh_touch"):
        arguments = migrate_arguments({"env": old_config(), "corners": 0.3, "backend": "auto"}, "a file")
    assert from_dict(GraspConfig, arguments["env"]) == GraspConfig() and arguments["extremes"] == 0.3
    assert arguments["backend"] == "jax"


def test_todays_files_are_left_alone():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert migrate_config(to_dict(GraspConfig()), "a file") == to_dict(GraspConfig())


def test_arrays_of_an_older_environment_go_where_todays_are():
    """Groups that were renamed move, what repeated others is dropped, and like-named arrays of others stay."""
    old = {
        ".env_state.draw.tilt": [1.0],
        ".env_state.array.late": [2.0],
        ".env_state.array_params.gain": [3.0],
        ".env_state.array_params.noise": [0.0],
        ".env_state.sample.joint_position": [4.0],
        ".env_state.object_velocity": [5.0],
        ".env_state.target.bare_friction": [9.0],
        ".env_state.target.mass": [10.0],
        ".env_state.targets": [6.0],
        ".env_state.goal.dwell": [7.0],
        ".env_state.metrics['target']": [8.0],
    }
    wanted = {
        ".env_state.episode.hand.tilt": [1.0],
        ".env_state.taxel_memory.late": [2.0],
        ".env_state.episode.taxels.gain": [3.0],
        ".env_state.sensor_input.joint_position": [4.0],
        ".env_state.episode.object.link_friction": [9.0],
        ".env_state.episode.object.mass": [10.0],
        ".env_state.targets": [6.0],
        ".env_state.metrics['target']": [8.0],
    }
    assert migrate_leaves(old, wanted) == wanted
    # A task of one's own may use a name that is gone elsewhere.
    own = wanted | {".env_state.goal.dwell": [7.0]}
    assert migrate_leaves(old, own) == own


@pytest.mark.parametrize(
    ("task", "config"),
    [
        (Grasp, GraspConfig()),
        (Rotate, RotateConfig()),
        (
            Rotate,
            RotateConfig(tilt=0.3, roll=-0.2, turn=TurnSpec(axis=(0.6, 0.0, -0.8), step=-0.7, angle=0.2)),
        ),
    ],
)
def test_a_policy_without_a_specification_gets_the_one_that_its_task_has(task, config, hand):
    """Today's task of the same configuration says the same, but for what those tasks could not have."""
    control = dataclasses.replace(config.control, force=dataclasses.replace(config.control.force, gain=0.0))
    # Files from before a hand's TOML gave them name posture and reference themselves.
    config = dataclasses.replace(task(config, hand).config, control=control)
    today = TaskSpec.of(task(config, hand))
    old = old_spec(task.name, to_dict(config))
    for field in dataclasses.fields(TaskSpec):
        if field.name in ("name", "fields", "posture", "control", "object_axes", "velocity_filter"):
            assert getattr(old, field.name) == getattr(today, field.name), field.name
    assert old.gravity == pytest.approx(today.gravity) and old.reference == pytest.approx(today.reference)
    assert old.turn == today.turn and old.observation == today.observation
    with pytest.raises(CheckpointError, match="of the task 'juggle' without a task specification"):
        old_spec("juggle", {})
