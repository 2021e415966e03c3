"""The door of each package: its names are known to type checkers, and importing it is cheap."""

import importlib
import subprocess
import sys

import pytest
from paths import ROOT

NAMES = {
    "dexsim": """
        Env EnvConfig Evaluation GraspConfig GraspReward GroundTruth Hand ObjectConfig Readings RotateConfig
        RotateReward Start State Task TaskSpec draw_taxels enable_caches load_hand make observe register
        render_episode render_frame take_snapshot
    """,
    "dexsim_ppo": """
        CurriculumConfig PPOConfig Policy TrainResult TrainState act evaluate_policy load_policy make_train train_policy
    """,
    "dexsim_real": """
        Controller DriverState HandDriver HandError JointTargets LinkConfig RunResult Safety SafetyConfig SerialHand
        open_port run_policy
    """,
}


@pytest.mark.parametrize("package", ["dexsim", "dexsim_ppo", "dexsim_real"])
def test_a_name_that_is_imported_late_is_known_to_type_checkers(package):
    """Every late name stands in the block for type checkers, with the module that it comes from."""
    source = (ROOT / package / "__init__.py").read_text()
    block = source.partition("if TYPE_CHECKING:")[2].partition("\n__")[0]
    homes = dict(
        (name.strip(), line.split()[1])
        for line in block.splitlines()
        if line.strip().startswith("from")
        for name in line.partition(" import ")[2].split(",")
    )
    for name, module in homes.items():
        assert getattr(importlib.import_module(module), name) is getattr(importlib.import_module(package), name)
    eager = source.partition("if TYPE_CHECKING:")[0]
    assert all(name in homes or name in eager for name in importlib.import_module(package).__all__)


@pytest.mark.parametrize("package", ["dexsim", "dexsim_ppo", "dexsim_real"])
def test_a_door_is_light(package):
    """Importing a package loads none of its rooms but `core`, no engine and no optional library."""
    code = f"import {package}, sys; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    loaded = set(done.stdout.split())
    ours = {name for name in loaded if name.startswith("dexsim") and not name.startswith("dexsim.core")}
    assert ours <= {"dexsim", package}
    assert not loaded & {"mujoco", "mujoco.mjx", "optax", "flax", "orbax", "brax", "serial", "cv2"}
