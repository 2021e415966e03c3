"""The notebooks run from top to bottom, headless and small."""

import base64
import io
import re

import numpy as np
import pytest
from paths import ROOT
from PIL import Image

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")
pytest.importorskip("ipykernel")

# Number of pictures, and what is printed.
EXPECTED = {
    "quickstart": (
        4,
        ["12 joints, 5 fingers with 120 taxels each", "environment steps per second", r"trained +\d\.\d\d"],
    ),
    "shipped_policies": (2, [r"\d+ of \d+ objects held for 8 s", r"contact force: Pearson r = 0\.[5-9]"]),
    "touch": (3, [r"N at first, 2\.0\d N after 25 steps", r"surface_points +median error +\d+\.\d um"]),
    "own_task": (2, ["level level 0.3", r"level = 1\.0 \(trained: 0\.3\)"]),
    "motors": (3, [r"12 joints pressed, torque at 0\.3 A off by [0-5]\.\d %", "2 sub-steps of 5 ms"]),
    "hand_bridge": (
        1,
        [
            "1 frame after noise and in two pieces\n0 with a flipped bit: 1 wrong",
            r"(\d+) ticks from \d+ frames: \1 readings and \1 ",
        ],
    ),
    "own_hand": (
        4,
        [r"(ok    .+\n){5}", r"FAIL  files load: my_hand/leap_like\.toml: Invalid name 'ring_tip'", "of 192 taxels"],
    ),
}


def test_all_that_they_import_is_there():
    """All but one run with the slow tests alone."""
    assert {path.stem for path in (ROOT / "notebooks").glob("*.ipynb")} == set(EXPECTED)
    found = []
    for name in EXPECTED:
        cells = nbformat.read(ROOT / "notebooks" / f"{name}.ipynb", as_version=4).cells
        text = "\n".join(cell.source for cell in cells if cell.cell_type == "code")
        found += re.findall(r"^ *(from dexsim.* import .*)", text, re.MULTILINE)
    exec("\n".join(found))
    assert len(found) > 30


@pytest.mark.parametrize(
    "name", ["hand_bridge", *(pytest.param(name, marks=pytest.mark.slow) for name in EXPECTED if name != "hand_bridge")]
)
def test_it_runs(name, monkeypatch):
    # The kernel is started with this process's environment; the inline backend is its own choice.
    monkeypatch.delenv("MPLBACKEND", raising=False)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("DEXSIM_SMALL", "1")
    notebook = nbformat.read(ROOT / "notebooks" / f"{name}.ipynb", as_version=4)
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = []
    folder = {"metadata": {"path": str(ROOT / "notebooks")}}
    nbclient.NotebookClient(notebook, timeout=600, resources=folder).execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert not [output for output in outputs if output.output_type == "error"]
    text = "".join(output["text"] for output in outputs if output.output_type == "stream" and output.name == "stdout")
    count, patterns = EXPECTED[name]
    for pattern in patterns:
        assert re.search(pattern, text), (pattern, text)
    found = [output["data"]["image/png"] for output in outputs if "image/png" in output.get("data", {})]
    pictures = [np.asarray(Image.open(io.BytesIO(base64.b64decode(png)))) for png in found]
    assert len(pictures) == count and all(picture.std() > 10 for picture in pictures)
