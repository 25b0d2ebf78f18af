"""Small folders of files as those of LIBERO-Plus and LIBERO-PRO, made of this package's own tasks."""

import re
from pathlib import Path

import numpy as np

from libero_env.init_states.pickles import write_states
from libero_env.tasks import Task, get_suite

BASE = "put_the_bowl_on_the_plate"
ENDINGS = (
    "view_300_15_100_0_0_initstate_0", "view_0_0_100_0_0_initstate_451", "view_0_0_100_0_0_initstate_0_noise_47",
    "language_7_view_0_0_100_0_0_initstate_0", "light_1", "tb_2", "add_3", "moved_level1_sample1"
)  # fmt: skip
REWORDED = "Could you kindly put the bowl onto the plate"
PRO = {"lan": "set the bowl down on the plate", "task": "put the wine bottle on the plate"}


def base_task() -> Task:
    """Return the task that the folders vary."""
    return next(task for task in get_suite("libero_goal").tasks if task.name == BASE)


def write_plus(folder: Path, states: np.ndarray) -> Path:
    """Write a folder of LIBERO-Plus with one variant of each ending; the first state is that of the moved one."""
    text = base_task().bddl_text
    long = "Libero_Tabletop_Manipulation_tabletop_table_" + "CliffDesert006_COL_VAR2_HIRES_bg_" * 4
    moved = text.replace("(0.04 -0.03 0.060000000000000005 -0.01)", "(0.1 0.02 0.12 0.04)")
    assert moved != text
    files = {
        BASE: text,
        f"{BASE}_language_7": re.sub(r"\(:language [^)]*\)", f"(:language {REWORDED})", text),
        f"{BASE}_light_1": text.replace("LIBERO_Tabletop_Manipulation", "Libero_Tabletop_Manipulation_light_367"),
        f"{BASE}_tb_2": text.replace("LIBERO_Tabletop_Manipulation", long),
        f"{BASE}_add_3": text.replace("plate_1 - plate", "plate_1 - plate\n    can_of_soda_1 - can_of_soda__1"),
        f"{BASE}_moved_level1_sample1": moved,
    }  # fmt: skip
    _write(folder, "libero_goal", files)
    _write_map(folder, {"libero_goal": [f"{BASE}_{ending}" for ending in ENDINGS]})
    own = [Path("libero_newobj", "libero_goal", f"{BASE}_{ending}") for ending in ENDINGS[-2:]]
    for path in (Path("libero_goal", BASE), *own):
        target = folder / "init_files" / path.with_name(f"{path.name}.pruned_init")
        target.parent.mkdir(parents=True, exist_ok=True)
        write_states(target, states[0] if path in own else states)
    return folder


def write_pro(folder: Path, states: np.ndarray) -> Path:
    """Write a folder of LIBERO-PRO whose suites of LIBERO-Goal have one task each, with its initial states."""
    text = base_task().bddl_text
    other = text.replace("(On akita_black_bowl_1 plate_1)", "(On wine_bottle_1 plate_1)")
    texts = {
        "swap": _swapped(text),
        "object": text.replace("plate_1 - plate", "plate_1 - yellow_plate"),
        "lan": re.sub(r"\(:language [^)]*\)", f"(:language {PRO['lan']})", text),
        "task": re.sub(r"\(:language [^)]*\)", f"(:language {PRO['task']})", other),
    }
    for ending, content in texts.items():
        _write(folder, f"libero_goal_{ending}", {BASE: content})
        states_folder = folder / "init_files" / f"libero_goal_{ending}"
        states_folder.mkdir(parents=True)
        np.savez(states_folder / f"{BASE}.pruned_init.npz", states=states)
    _write_map(folder, {f"libero_goal_{ending}": [BASE] for ending in texts})
    return folder


def _swapped(text: str) -> str:
    """Return a task file with bowl and plate in each other's place."""
    bowl, plate = ("akita_black_bowl", "plate")
    places = {f"On {one}_1 main_table_{one}_region": other for one, other in ((bowl, plate), (plate, bowl))}
    assert all(place in text for place in places)
    turn = lambda found: found[0].replace(f"{found[1]}_region", f"{places[found[0]]}_region")  # noqa: E731
    return re.sub(rf"On ({bowl}|{plate})_1 main_table_\1_region", turn, text)


def _write(folder: Path, suite: str, files: dict[str, str]) -> None:
    (folder / "bddl_files" / suite).mkdir(parents=True)
    for name, text in files.items():
        (folder / "bddl_files" / suite / f"{name}.bddl").write_text(text)


def _write_map(folder: Path, suites: dict[str, list[str]]) -> None:
    (folder / "benchmark").mkdir(parents=True)
    (folder / "benchmark" / "libero_suite_task_map.py").write_text(f"# names\nlibero_task_map = {suites!r}\n")
