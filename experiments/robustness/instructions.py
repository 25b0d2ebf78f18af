"""How far rewording moves an instruction's embedding, beside the success under it.

    python experiments/robustness/instructions.py experiments/robustness/goal/robustness.json

For each severity of `instruction` and each task of a page's first policy: the cosine between the embeddings of the
reworded and the learned instruction, the learned instruction that is nearest, and the successes; then the share of
successes that is kept, by cosine. Embeddings are MiniLM's, as `preset=laptop` has them.
"""

import argparse
import json
from pathlib import Path

import numpy as np
from hydra import compose, initialize_config_dir

from libero_env.perturbations import parse_perturbations
from libero_env.perturbations.perturbation import reword_task
from libero_env.tasks import get_task
from lifelong.composition import config_folder
from lifelong.settings import Configuration, plain_data

BINS = (-1.0, 0.55, 0.65, 0.75, 0.85, 1.01)


def main() -> None:
    """Print the table and the shares."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("page", type=Path, help="robustness.json")
    policy = json.loads(parser.parse_args().page.read_text())["policies"][0]
    with initialize_config_dir(str(config_folder().resolve()), version_base="1.3"):
        language = Configuration(plain_data(compose("config", ["preset=laptop"]))).build("language")
    tasks = [get_task(name) for name in policy["tasks"]]
    learned = unit(language.embed([task.language for task in tasks]).numpy())
    plain = np.sum(policy["outcomes"]["without perturbations"], axis=1)
    rows = []
    for severity in (0.2, 0.4, 0.6, 0.8, 1.0):
        perturbations = parse_perturbations(f"instruction={severity}", 0)
        words = [reword_task(task, perturbations).language for task in tasks]
        cosines = unit(language.embed(words).numpy()) @ learned.T
        found = np.sum(policy["outcomes"][f"instruction={severity:g}"], axis=1)
        print(f"severity {severity:g}: task, successes, without perturbation, cosine, nearest task")
        for k, text in enumerate(words):
            nearest = int(cosines[k].argmax())
            print(f"  {k}  {found[k]:>2}  {plain[k]:>2}  {cosines[k, k]:.2f}  {nearest}  {text}")
            rows.append((cosines[k, k], nearest == k, found[k], plain[k]))
    cosine, own, wins, of = map(np.array, zip(*rows, strict=True))
    print("cosine: number of tasks and severities, share of the successes without perturbation")
    for low, high in zip(BINS, BINS[1:], strict=False):
        here = (cosine >= low) & (cosine < high)
        print(
            f"  {max(low, 0):.2f} to {min(high, 1):.2f}: {here.sum()}, {wins[here].sum() / of[here].sum():.2f}"
        )
    for word, here in (("its own", own), ("another task's", ~own)):
        print(f"  nearest is {word}: {here.sum()}, {wins[here].sum() / of[here].sum():.2f}")


def unit(vectors: np.ndarray) -> np.ndarray:
    """Return vectors (n, d) of length 1."""
    lengths: np.ndarray = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / lengths


if __name__ == "__main__":
    main()
