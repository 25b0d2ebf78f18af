"""Draw a contact sheet of one demonstration for each task of LIBERO-Object: `episodes.png` beside this file.

python experiments/expert/episodes.py
"""

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

from libero_env.demos.config import DemoConfig
from libero_env.demos.record import DemoRecorder
from libero_env.tasks import get_suite

MOMENTS = (0.0, 0.2, 0.4, 0.55, 0.8, 1.0)


def main() -> None:
    argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    columns = []
    for task in get_suite("libero_object").tasks:
        recorder = DemoRecorder(DemoConfig(task.id, (96, 96)))
        attempts = [attempt for _, attempt in recorder.attempt([(0, 0)])]
        obs = recorder.episode(attempts[0]).obs
        recorder.close()
        moments = [round(m * (len(attempts[0]) - 1)) for m in MOMENTS]
        views = [np.concatenate([obs[k][t] for k in ("agentview_rgb", "eye_in_hand_rgb")]) for t in moments]
        columns.append(np.concatenate(views))
        print(task.name, len(attempts[0]), attempts[0].reason or "success")
    half = len(columns) // 2
    sheet = np.concatenate(
        [np.concatenate(columns[:half], axis=1), np.concatenate(columns[half:], axis=1)], axis=1
    )
    Image.fromarray(sheet).quantize(128).save(Path(__file__).with_name("episodes.png"))


if __name__ == "__main__":
    main()
