"""A picture of every kind of perturbation that can be seen, at severities 0.2, 0.6 and 1, beside the plain start.

python experiments/robustness/kinds_picture.py [--task libero_goal/1] [--out docs/images/perturbations.jpg]
"""

import argparse
import os
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

os.environ.setdefault("MUJOCO_GL", "egl")
SEVERITIES = (0.2, 0.6, 1.0)
COLUMNS, BAND = 2, 14


def row(task: str, kind: str, start: int, size: int) -> Image.Image:
    """Return the pictures of a kind side by side, with a caption."""
    from libero_env import LiberoEnv

    pictures = []
    for severity in (0.0, *SEVERITIES):
        env = LiberoEnv(task, cameras=("agentview",), camera_size=(size, size), perturb=f"{kind}={severity}")
        pictures.append(env.reset(options={"init_state": start})[0]["agentview_rgb"])
        env.close()
    strip = Image.fromarray(
        np.pad(np.concatenate(pictures, axis=1), ((BAND, 0), (0, 4), (0, 0)), constant_values=255)
    )
    ImageDraw.Draw(strip).text(
        (3, 1), f"{kind}: 0, {', '.join(f'{s:g}' for s in SEVERITIES)}", fill=(0, 0, 0)
    )
    return strip


def main() -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="libero_goal/1")
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--size", type=int, default=112)
    parser.add_argument("--out", type=Path, default=Path("docs/images/perturbations.jpg"))
    args = parser.parse_args()

    from libero_env.perturbations import KINDS

    unseen = ("goal", "instruction", "latency", "dropped_frames", "proprio_bias")
    kinds = [name for name, kind in KINDS.items() if kind.layer != "action" and name not in unseen]
    rows = [np.asarray(row(args.task, kind, args.start, args.size)) for kind in kinds]
    rows += [np.full_like(rows[0], 255)] * (-len(rows) % COLUMNS)
    height = len(rows) // COLUMNS
    columns = [np.concatenate(rows[i * height : (i + 1) * height]) for i in range(COLUMNS)]
    Image.fromarray(np.concatenate(columns, axis=1)).save(args.out, quality=88)


if __name__ == "__main__":
    main()
