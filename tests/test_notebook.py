"""The quickstart notebook runs from top to bottom, headless."""

import base64
import io

import numpy as np
import pytest
from paths import ROOT

NOTEBOOK = ROOT / "notebooks" / "quickstart.ipynb"


@pytest.mark.slow
def test_quickstart_runs(monkeypatch):
    nbformat = pytest.importorskip("nbformat")
    nbclient = pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    from PIL import Image

    # The kernel is started with this process's environment; the inline backend is its own choice.
    monkeypatch.delenv("MPLBACKEND", raising=False)
    monkeypatch.setenv("PYTHONPATH", str(NOTEBOOK.parent.parent))
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    parameters = next(cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", []))
    assert parameters.source.startswith("train_seconds = 60") and "\nepisodes = 32" in parameters.source
    parameters.source = "train_seconds = 5\nepisodes = 8"
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = []

    nbclient.NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(NOTEBOOK.parent)}}).execute()

    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    text = "".join(output["text"] for output in outputs if output.output_type == "stream" and output.name == "stdout")
    assert "12 joints, 5 fingers with 120 taxels each" in text
    assert "environment steps per second" in text and "trained" in text.splitlines()[-1]
    pictures = [output["data"]["image/png"] for output in outputs if "image/png" in output.get("data", {})]
    assert len(pictures) == 4  # the hand, the taxel maps, the learning curve, the trained policy
    frame = np.asarray(Image.open(io.BytesIO(base64.b64decode(pictures[0]))))
    assert frame.shape[:2] == (480, 640) and frame.std() > 10
