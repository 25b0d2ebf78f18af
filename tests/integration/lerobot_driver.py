"""What LeRobot makes of our data sets; run by an interpreter that has LeRobot, see test_exported_sets.py beside it.

python lerobot_driver.py merge OURS SCRATCH    lerobot 0.4 or newer; prints JSON
python lerobot_driver.py read OURS             lerobot 0.3; prints JSON
python lerobot_driver.py openpi OURS FILE      the same, with openpi's libero_policy.py
"""

import importlib.util
import json
import sys
import types
from enum import Enum
from pathlib import Path

import numpy as np

AXES = ["height", "width", "channel"]
NUMBERS = {"observation.state": (8, "state"), "action": (7, "actions")}
# Features of HuggingFaceVLA/libero as its data set card lists them, without those of the indices.
CARD = {
    **{f"observation.images.{name}": {"dtype": "image", "shape": (256, 256, 3), "names": AXES,
     "fps": 10.0} for name in ("image", "image2")},
    **{key: {"dtype": "float32", "shape": (length,), "names": [name], "fps": 10.0} for key,
     (length, name) in NUMBERS.items()},
}  # fmt: skip
# What LeRobot 0.4 states of the videos that its conversion of images writes; newer versions state it in other words.
VIDEO = {
    "video.height": 256, "video.width": 256, "video.codec": "av1", "video.pix_fmt": "yuv420p",
    "video.is_depth_map": False, "video.fps": 10, "video.channels": 3, "has_audio": False
}  # fmt: skip


def merge(ours: Path, scratch: Path) -> dict:
    """Merge our set with one that LeRobot wrote with the published set's features."""
    from lerobot.datasets.aggregate import aggregate_datasets, validate_all_metadata
    from lerobot.datasets.lerobot_dataset import LeRobotDatasetMetadata

    published = _published(scratch / "published")
    metadata = [
        LeRobotDatasetMetadata("test/published", root=published),
        LeRobotDatasetMetadata("test/ours", root=ours),
    ]
    fps, robot_type, _ = validate_all_metadata(metadata)
    merged = scratch / "merged"
    aggregate_datasets(["test/published", "test/ours"], "test/merged", [published, ours], merged)
    whole = LeRobotDatasetMetadata("test/merged", root=merged)
    return {
        "fps": fps,
        "robot_type": robot_type,
        "episodes": whole.total_episodes,
        "frames": whole.total_frames,
        "tasks": list(whole.tasks.index),
        "converted": _info(_converted(scratch))["features"],
        "merged": str(merged),
    }


def _published(root: Path) -> Path:
    """Write a small set with the metadata of `lerobot/libero`."""
    videos = {key: value | {"dtype": "video"} if "images" in key else value for key, value in CARD.items()}
    info = _info(_write(videos, root))
    for key in videos:
        if "images" in key:
            info["features"][key]["info"] = VIDEO
    (root / "meta" / "info.json").write_text(json.dumps(info))
    return root


def _info(root: Path) -> dict:
    return json.loads((root / "meta" / "info.json").read_text())


def _converted(scratch: Path) -> Path:
    """Write a small set with the features of the card, and convert it as `lerobot/libero` was: images to videos."""
    from lerobot.datasets.dataset_tools import convert_image_to_video_dataset
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    source = LeRobotDataset("test/images", root=_write(CARD, scratch / "images"))
    convert_image_to_video_dataset(source, scratch / "converted", "test/converted", num_workers=1)
    return scratch / "converted"


def _write(features: dict, root: Path) -> Path:
    """Write two episodes of random numbers with LeRobot."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    rng = np.random.default_rng(0)
    dataset = LeRobotDataset.create(
        "test/random",
        fps=10,
        features=features,
        robot_type="panda",
        root=root,
        use_videos=features is not CARD,
    )
    for _ in range(2):
        for _ in range(5):
            frame = {key: rng.normal(size=length).astype(np.float32) for key, (length, _) in NUMBERS.items()}
            frame |= {
                key: rng.integers(0, 256, (256, 256, 3), np.uint8) for key in features if "images" in key
            }
            dataset.add_frame(frame | {"task": "put the bowl on the plate"})
        dataset.save_episode()
    dataset.finalize()
    return root


def read(ours: Path) -> dict:
    """Read a set of version 2.0 with LeRobot."""
    dataset = _dataset(ours)
    row = dataset[len(dataset) - 1]
    return {
        "episodes": dataset.num_episodes,
        "frames": len(dataset),
        "task": row["task"],
        "shapes": {key: list(getattr(value, "shape", ())) for key, value in row.items()},
        "largest": float(row["image"].max()),
        "actions": row["actions"].tolist(),
        "stats": sorted(dataset.meta.stats),
    }


def openpi(ours: Path, file: Path) -> dict:
    """Give a row, renamed as in openpi's LeRobotLiberoDataConfig, to its LiberoInputs."""
    row = _dataset(ours)[0]
    names = {"observation/image": "image", "observation/wrist_image": "wrist_image"}
    names |= {"observation/state": "state", "actions": "actions", "prompt": "task"}
    policy = _policy(file)
    inputs = policy.LiberoInputs(policy._model.ModelType.PI0)({new: row[old] for new, old in names.items()})
    return {
        "images": {key: [list(x.shape), str(x.dtype), int(x.max())] for key, x in inputs["image"].items()},
        "state": list(inputs["state"].shape),
        "actions": list(inputs["actions"].shape),
        "prompt": inputs["prompt"],
    }


def _dataset(ours: Path):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    return LeRobotDataset("test/ours", root=ours)


def _policy(file: Path):
    """Import openpi's file; of the package it needs the names of two modules, whose own imports are JAX."""
    model_type = Enum("ModelType", "PI0 PI0_FAST PI05")
    modules = {
        "openpi": {},
        "openpi.transforms": {"DataTransformFn": object},
        "openpi.models": {},
        "openpi.models.model": {"ModelType": model_type},
    }
    for name, content in modules.items():
        sys.modules[name] = types.ModuleType(name)
        vars(sys.modules[name]).update(content)
    sys.modules["openpi"].transforms = sys.modules["openpi.transforms"]
    sys.modules["openpi.models"].model = sys.modules["openpi.models.model"]
    spec = importlib.util.spec_from_file_location("libero_policy", file)
    module = importlib.util.module_from_spec(spec)
    sys.modules["libero_policy"] = module
    spec.loader.exec_module(module)
    return module


if __name__ == "__main__":
    command, *paths = sys.argv[1:]
    found = {"merge": merge, "read": read, "openpi": openpi}[command](*map(Path, paths))
    print("RESULT " + json.dumps(found))
