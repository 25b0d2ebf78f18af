"""Learn a sequence of tasks: `python libero/lifelong/main.py benchmark_name=LIBERO_SPATIAL lifelong=er seed=100`.

The words of the original become those of `libero train preset=paper compat=libero`, which takes its own, too.
Runs are in `experiments`.
"""

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

FILE = Path(__file__).parents[1] / "configs" / "native.yaml"


def translated(words: Sequence[str]) -> list[str]:
    """Return the words of `libero train` for those of the original; other words stay, which it obeys or refuses.

    Raises:
        InvalidInputError: Two words ask for different values of one key.
    """
    from libero._adapters.models import facade_robot
    from libero.libero import get_path_dict
    from libero_env.assets.robot import DEFAULT_ROBOT
    from libero_env.errors import InvalidInputError
    from libero_env.paths import demos_dir
    from libero_env.storage import parse_yaml

    table = parse_yaml(FILE.read_text(encoding="utf-8"))
    options, given = [], {"runs_dir": "experiments", "language": "minilm"}
    asked: dict[str, str] = {}  # native key -> word
    if facade_robot() != DEFAULT_ROBOT:
        given["data.robot"] = facade_robot()
    if (folder := get_path_dict()["datasets"]) != str(demos_dir()) and Path(folder).is_dir():
        given["data.folder"] = folder
    for word in words:
        key, is_pair, text = word.lstrip("+").partition("=")
        if word.startswith("-") or not is_pair:
            options.append(word)
            continue
        if key in table["without_effect"]:
            print(f"[note] {word} has no effect: see docs/migrating.md", flush=True)
            continue
        native = table["keys"].get(key, key)
        values = [table["values"].get(native, {}).get(one.lower(), one) for one in text.split(",")]
        if native == "benchmark":
            values = [one.lower() for one in values]
        value = (
            ",".join(one.removesuffix("_policy") for one in values)
            if native == "policy"
            else ",".join(values)
        )
        if native in asked and given[native] != value:
            raise InvalidInputError(f"{word} and {asked[native]} are both {native}: give them one value")
        asked[native], given[native] = word, value
    if "eval.episodes" in asked:
        given["eval.curve_episodes"] = given["eval.episodes"]
    return [*options, "preset=paper", "compat=libero", *(f"{key}={value}" for key, value in given.items())]


def main() -> int:
    """Run the configuration of the command line; return the exit status, see `libero_env.cli.ending`."""
    from libero_env.cli import ending
    from libero_env.errors import LiberoError
    from lifelong.launch import main as train

    with ending.general_options(sys.argv[1:]) as words:
        try:
            words = translated(words)
        except LiberoError as error:
            return ending.report(error)
        print(f"[note] libero train {shlex.join(words)}", flush=True)
        return train(words)


if __name__ == "__main__":
    sys.path[0] = str(Path(__file__).resolve().parents[2])  # not this folder, whose modules have common names
    sys.exit(main())
