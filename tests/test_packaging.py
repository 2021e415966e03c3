"""The distribution: names of each package's door, what importing loads, what the wheel holds."""

import importlib
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from paths import ROOT

PACKAGES = ("dexsim", "dexsim_ppo", "dexsim_real")
if not (ROOT / "pyproject.toml").exists():
    pytest.skip("needs a checkout", allow_module_level=True)


def run(*command: object, cwd: Path = ROOT) -> str:
    done = subprocess.run([sys.executable, *map(str, command)], cwd=cwd, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


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
    """A door loads none of its rooms but `core` and errors, no engine; policies and learner no simulator; a policy on
    a hand of MuJoCo only what reads an MJCF."""
    code = "\nprint(*sys.modules)\n".join((*STEPS, ""))
    doors, learner, on_hand = (set(line.split()) for line in run("-c", code).splitlines()[-3:])

    def inside(loaded, *packages):
        return {name for name in loaded if any(name == p or name.startswith(f"{p}.") for p in packages)}

    assert inside(doors, *PACKAGES) - inside(doors, "dexsim.core", "dexsim.errors") == set(PACKAGES)
    assert inside(doors, "jax", "mujoco", "optax", "flax", "orbax", "brax", "serial", "cv2") == set()
    simulation = ("mujoco.mjx", "brax", "dexsim.physics", "dexsim.env", "dexsim.tasks")
    assert "dexsim_ppo.learner.ppo" in learner and inside(learner, "mujoco", *simulation) == set()
    assert {"mujoco", "dexsim_real.run"} <= on_hand
    assert inside(on_hand, *simulation, "cv2", "serial", "dexsim.render", "dexsim_ppo.training") == set()


@pytest.mark.slow
def test_the_wheel_is_whole_and_works_from_another_directory(tmp_path):
    """Built and installed without fetching anything."""
    run("-m", "build", "--wheel", "--no-isolation", "--outdir", tmp_path, ROOT)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    shipped = {name.removeprefix("dexsim/_assets/") for name in names if name.startswith("dexsim/_assets/")}
    assets = [path for path in (ROOT / "assets").rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    assert shipped == {str(path.relative_to(ROOT / "assets")) for path in assets}
    assert all(f"{package}/py.typed" in names for package in PACKAGES)
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in names)
    assert {name.split("/")[0] for name in names if ".dist-info/" not in name} == set(PACKAGES)
    site, elsewhere = tmp_path / "site", tmp_path / "elsewhere"
    elsewhere.mkdir()
    run("-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--target", site, wheel)
    code = f"import sys; sys.path.insert(0, {str(site)!r})"
    code += """
import dexsim, dexsim_ppo, dexsim_real
from dexsim.core.assets import asset_path
from dexsim.hand.load import load_hand
load_hand()
print(*(module.__file__ for module in (dexsim, dexsim_ppo, dexsim_real)), asset_path("hand/xhand_right.xml"))
"""
    files = run("-P", "-c", code, cwd=elsewhere).split()
    assert len(files) == 4 and all(Path(name).is_relative_to(site) for name in files), files
