"""Write a data set with TensorFlow Datasets, in the features of OpenVLA's sets of LIBERO, of the episodes in a file.

python write_rlds.py EPISODES.npz FOLDER
"""

import json
import pathlib
import sys

import numpy
import tensorflow_datasets as tfds

EPISODES = numpy.load(sys.argv[1])
COUNT = int(EPISODES["count"])


class Mine(tfds.core.GeneratorBasedBuilder):
    """The data set `mine`."""

    VERSION = tfds.core.Version("1.0.0")
    pkg_dir_path = pathlib.Path(sys.argv[1]).parent  # where it looks for files of its own

    def _info(self):
        image = tfds.features.Image(shape=(32, 32, 3), dtype=numpy.uint8, encoding_format="jpeg")
        observed = {"image": image, "wrist_image": image}
        observed |= {
            key: tfds.features.Tensor(shape=(n,), dtype=numpy.float32)
            for key, n in (("state", 8), ("joint_state", 7))
        }
        step = {"observation": observed, "action": tfds.features.Tensor(shape=(7,), dtype=numpy.float32)}
        scalars = dict.fromkeys(("discount", "reward"), numpy.float32)
        scalars |= dict.fromkeys(("is_first", "is_last", "is_terminal"), numpy.bool_)
        step |= {key: tfds.features.Scalar(dtype=dtype) for key, dtype in scalars.items()}
        step |= {"language_instruction": tfds.features.Text()}
        path = tfds.features.FeaturesDict({"file_path": tfds.features.Text()})
        features = {"steps": tfds.features.Dataset(step), "episode_metadata": path}
        return self.dataset_info_from_configs(features=tfds.features.FeaturesDict(features))

    def _split_generators(self, manager):
        return {"train": self._generate_examples()}

    def _generate_examples(self):
        for k in range(COUNT):
            one = {key.partition("/")[2]: EPISODES[key] for key in EPISODES.files if key.startswith(f"{k}/")}
            last = len(one["action"]) - 1
            steps = [
                {
                    "observation": {
                        key: one[key][t] for key in ("image", "wrist_image", "state", "joint_state")
                    },
                    "action": one["action"][t],
                    "discount": 1.0,
                    "reward": float(t == last),
                    "is_first": t == 0,
                    "is_last": t == last,
                    "is_terminal": t == last,
                    "language_instruction": str(one["language"]),
                }
                for t in range(last + 1)
            ]
            yield k, {"steps": steps, "episode_metadata": {"file_path": f"{k}.hdf5"}}


Mine(data_dir=sys.argv[2]).download_and_prepare()
print("RESULT " + json.dumps({"episodes": COUNT}))
