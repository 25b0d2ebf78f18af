"""Compares `preset=paper compat=libero` with LIBERO's code: the same weights, the same batches, side by side.

    export LIBERO_ORIGINAL_SOURCE=~/LIBERO LIBERO_ORIGINAL_PYTHON=~/original-training/bin/python
    PYTHONPATH=. python experiments/paper/compare_original.py [--quick] [--record tests/lifelong/data/original.npz]

Prints a table of relative differences. `--quick` takes pictures of 64 and windows of 4 frames; `--record` keeps
LIBERO's numbers of these, with which tests compare where its code is not at hand.
"""

import argparse
from collections.abc import Iterator

import numpy as np
import torch

from tests.harness import original, original_results
from tests.harness.original_results import relative, update_difference, where_owners_agree, worst

PARTS: dict[
    str, dict[str, tuple[str, ...]]
] = {  # by policy: functions of original_results and the batches they take
    "bc_transformer": {
        "learn": ("first", "episode"),
        "with_dropout": ("first",),
        "ewc": ("first", "second"),
        "packnet": ("first", "second"),
    },
    "bc_rnn": {"learn": ("first", "episode")},
    "bc_vilt": {"learn": ("first", "episode")},
}


RECORDED = {
    "gradient",
    "dropout_gradient",
    "fisher",
    "ewc_clipped",
    "owner",
}  # tensors of which something is kept


def compared(name: str, part: str, spec: original.PolicySpec, kept: dict) -> Iterator[tuple[str, float, str]]:
    """Yield what is compared, the largest relative difference, and where it is."""
    given = {label: original.smooth_batch(spec, k) for k, label in enumerate(("first", "second"))}
    given["episode"] = original.smooth_batch(spec, 2, steps=spec.seq_len + 2)
    policy = original.our_policy(name, spec, dropout=part == "with_dropout")
    theirs = original.run_original(policy, name, part, given)
    before = original_results.weights(policy)
    ours = getattr(original_results, part)(policy, *(given[label] for label in PARTS[name][part]))
    found = {
        k: original.in_our_names(policy, name, theirs, k) for k, v in ours.items() if isinstance(v, dict)
    }
    for key, value in ours.items():
        if key == "stepped":
            yield "update", update_difference(before, value, found[key], ours["clipped"]), ""
        elif key == "owner":
            apart, where = max(((value[n] != found[key][n]).float().mean().item(), n) for n in value)
            yield "share of weights with another owner", apart, where
        elif key.startswith("packnet"):
            alike = [where_owners_agree(side, ours["owner"], found["owner"]) for side in (value, found[key])]
            yield f"{key}, owners alike", *worst(*alike)
        elif key in found:
            yield key, *worst(value, found[key])
        else:
            yield key, relative(value, torch.from_numpy(np.asarray(theirs[key]))), ""
    kept |= {f"{name}/{key}": theirs[key] for key, value in ours.items() if not isinstance(value, dict)}
    for key in RECORDED & ours.keys():
        recorded = original_results.kept_of(found[key])
        kept |= {f"{name}/{key}/{what}": values for what, values in recorded.items()}


def main() -> None:
    """Print the table, a row as soon as it is known."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--record")
    args = parser.parse_args()
    torch.set_num_threads(1)
    spec, kept = original.QUICK if args.quick or args.record else original.SPEC, {}
    print("| policy | part | what | largest relative difference | where |\n|---|---|---|---:|---|")
    for name, parts in PARTS.items():
        for part in parts:
            for what, difference, where in compared(name, part, spec, kept):
                print(f"| {name} | {part} | {what} | {difference:.1e} | {where} |", flush=True)
    if args.record:
        np.savez_compressed(args.record, **kept)


if __name__ == "__main__":
    main()
