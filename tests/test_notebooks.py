"""The notebooks run from top to bottom and draw what they say."""

import base64
import io
import os
from pathlib import Path

import nbformat
import numpy as np
import pytest
from nbclient import NotebookClient
from PIL import Image

ROOT = Path(__file__).parents[1]
# pictures that each draws
PICTURES = {"1_quick_walkthrough": 6, "2_scenes_and_tasks": 2, "3_custom_objects": 3, "4_algorithms": 1}
LARGEST = 300_000  # bytes
SHORTER = {  # than for a reader
    '"data.demos=20",': '"data.demos=1", "train.epochs=1", "train.steps_per_epoch=10", "train.warmup_steps=0", '
    '"eval.horizon=20", "eval.episodes=2", "eval.curve_episodes=1",',
    "data.demos=40": "data.demos=4",
    '"train.epochs=4",': '"train.epochs=1", "train.steps_per_epoch=20", "train.warmup_steps=0",',
    '"eval.curve=none",': '"eval.curve=none", "eval.horizon=60",',
}


def test_every_notebook_is_listed():
    assert sorted(PICTURES) == sorted(path.stem for path in (ROOT / "notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("name", PICTURES)
def test_notebooks_are_small_and_sound(name):
    path = ROOT / "notebooks" / f"{name}.ipynb"
    assert path.stat().st_size < LARGEST
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert notebook.cells[0].cell_type == "markdown"
    assert all(not cell.outputs for cell in notebook.cells if cell.cell_type == "code"), "clear all outputs"


@pytest.mark.sim
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # a kernel that ends late
@pytest.mark.parametrize("name", PICTURES)
def test_notebook(name, tmp_path, monkeypatch):
    monkeypatch.setenv("LIBERO_ASSETS", "builtin")  # whatever is installed
    monkeypatch.setenv("LIBERO_DEMOS", str(tmp_path / "demos"))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setenv("JUPYTER_PLATFORM_DIRS", "1")
    notebook = nbformat.read(ROOT / "notebooks" / f"{name}.ipynb", as_version=4)
    for cell in notebook.cells:
        for long, short in SHORTER.items():
            cell.source = cell.source.replace(long, short)
    folder = {"metadata": {"path": str(ROOT / "notebooks")}}
    NotebookClient(notebook, timeout=600, kernel_name="python3", resources=folder).execute()
    if kept := os.environ.get("LIBERO_NOTEBOOKS_OUT"):
        nbformat.write(notebook, Path(kept) / f"{name}.ipynb")
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    pictures = [o.data["image/png"] for o in outputs if "image/png" in o.get("data", {})]
    assert len(pictures) == PICTURES[name]
    for picture in pictures:
        image = np.asarray(Image.open(io.BytesIO(base64.b64decode(picture))).convert("L"))
        assert min(image.shape) > 100
        assert image.std() > 10, "a picture shows nothing"
    assert not [o for o in outputs if o.output_type == "error"]
