"""Read a data set with TensorFlow Datasets: the steps of each episode, as JSON.

python read_rlds.py FOLDER
"""

import json
import sys

import tensorflow_datasets

builder = tensorflow_datasets.builder_from_directory(sys.argv[1])
episodes = []
for episode in tensorflow_datasets.as_numpy(builder.as_dataset(split="train")):
    steps = list(episode["steps"])
    episodes.append(
        {
            "file": episode["episode_metadata"]["file_path"].decode(),
            "language": sorted({step["language_instruction"].decode() for step in steps}),
            "actions": [step["action"].tolist() for step in steps],
            "images": [step["observation"]["image"].tolist() for step in steps],
            "ends": [bool(step["is_last"]) for step in steps],
            "rewards": [float(step["reward"]) for step in steps],
        }
    )
found = {"name": builder.info.full_name, "episodes": builder.info.splits["train"].num_examples}
print("RESULT " + json.dumps(found | {"read": episodes}))
