"""The door of each package: its names are known to type checkers, and importing it is cheap."""

import importlib
import subprocess
import sys

import pytest
from paths import ROOT


@pytest.mark.parametrize("package", ["dexsim", "dexsim_ppo", "dexsim_real"])
def test_every_public_name_is_imported_from_where_type_checkers_find_it(package):
    module = importlib.import_module(package)
    block = (ROOT / package / "__init__.py").read_text().partition("if TYPE_CHECKING:")[2]
    for name in module.__all__:
        assert getattr(module, name).__name__ == name and name in block.partition("__all__")[0]


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
