"""A reader's folder: demonstrations, meshes, no configuration."""

from pathlib import Path

import pytest

from libero.libero.benchmark import get_benchmark
from tests.harness.demos import generate
from tests.harness.facade_learning import write_demos
from tests.harness.scenes import write_box
from tests.walkthroughs.blocks import Block, load_blocks

SIZE, STEPS = 128, 6


@pytest.fixture(scope="session")
def texts(shared) -> dict[str, list[str]]:
    """Lines of each text."""
    folder = shared / "walkthroughs"
    if not folder.is_dir():
        pytest.skip(f"the texts are not at {folder} (set LIBERO_SHARED)")
    names = dict.fromkeys(block.text for block in load_blocks())
    return {name: (folder / name).read_text(encoding="utf-8").splitlines() for name in names}


@pytest.fixture(scope="session")
def blocks() -> list[Block]:
    return load_blocks()


@pytest.fixture(scope="session")
def demos(tmp_path_factory) -> Path:
    """A demonstration of noise for each task of libero_object."""
    root = tmp_path_factory.mktemp("demos")
    suite = get_benchmark("libero_object")()
    for i in range(suite.n_tasks):
        write_demos(root / suite.get_task_demonstration(i), (STEPS,), size=SIZE)
    return root


@pytest.fixture(scope="session")
def drawer(demos) -> Path:
    """A demonstration by the expert of the task that is looked into and replayed."""
    path = demos / get_benchmark("libero_goal")().get_task_demonstration(0)
    return generate("libero_goal/0", 1, path=path, camera_size=(64, 64), workers=1, progress=False)


@pytest.fixture
def folder(tmp_path, monkeypatch, demos) -> Path:
    """Where the reader is: `custom_assets` with meshes, demonstrations in the datasets folder, no screen."""
    from hydra.core.global_hydra import GlobalHydra

    for name, half in (("my_object", 0.02), ("libero_mug", 0.03), ("libero_mug_yellow", 0.02)):
        (tmp_path / "custom_assets" / name / "textures").mkdir(parents=True)
        write_box(tmp_path / "custom_assets" / name / f"{name}.obj", half)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("LIBERO_CONFIG_PATH", str(tmp_path / ".libero"))
    monkeypatch.setenv("LIBERO_ASSETS", "builtin")  # whatever is installed
    monkeypatch.setenv("LIBERO_DEMOS", str(demos))
    monkeypatch.setenv("MPLBACKEND", "agg")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    GlobalHydra.instance().clear()
    yield tmp_path
    GlobalHydra.instance().clear()
