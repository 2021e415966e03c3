"""The door of each package: its names are known to type checkers; what importing it, a policy or a hand loads."""

import importlib
import subprocess
import sys

import pytest
from paths import ROOT

PACKAGES = ("dexsim", "dexsim_ppo", "dexsim_real")


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_is_imported_from_where_type_checkers_find_it(package):
    module = importlib.import_module(package)
    assert module.__all__ == sorted(set(module.__all__)) == dir(module) and len(module.__all__) >= 10
    for name in module.__all__:
        assert getattr(module, name).__name__ == name


# What a fresh interpreter does, one after the other.
STEPS = (
    "import sys, dexsim, dexsim_ppo, dexsim_real",
    """
import importlib, pathlib, dexsim_ppo.policy
for path in pathlib.Path("dexsim_ppo/learner").glob("[a-z]*.py"):
    importlib.import_module(f"dexsim_ppo.learner.{path.stem}")
""",
    """
import dexsim_real.run
dexsim_real.Controller(dexsim_ppo.load_policy("grasp"), dexsim.load_hand()).warm()
""",
)


def test_nothing_is_loaded_that_is_not_used():
    """A door loads none of its rooms but `core`, and no engine; policies and learner no simulator; a policy on a hand
    of MuJoCo only what reads an MJCF."""
    code = "\nprint(*sys.modules)\n".join((*STEPS, ""))
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    doors, learner, on_hand = (set(line.split()) for line in done.stdout.splitlines()[-3:])

    def inside(loaded, *packages):
        return {name for name in loaded if any(name == p or name.startswith(f"{p}.") for p in packages)}

    assert inside(doors, *PACKAGES) - inside(doors, "dexsim.core") == set(PACKAGES)
    assert inside(doors, "jax", "mujoco", "optax", "flax", "orbax", "brax", "serial", "cv2") == set()
    simulation = ("mujoco.mjx", "brax", "dexsim.physics", "dexsim.env", "dexsim.tasks")
    assert "dexsim_ppo.learner.ppo" in learner and inside(learner, "mujoco", *simulation) == set()
    assert {"mujoco", "dexsim_real.run"} <= on_hand
    assert inside(on_hand, *simulation, "cv2", "serial", "dexsim.render", "dexsim_ppo.training") == set()
