"""`preset=paper compat=libero` from the command line to a report: every part of the published protocol acts."""

import importlib
import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from libero_cli.main import main
from libero_env.tasks import get_suite
from lifelong import checkpoints
from lifelong.algorithms import PackNet
from lifelong.language import encoder as language
from lifelong.nn import transformer as layers
from lifelong.nn.augmentation import SharedJitter, SharedShift
from lifelong.sequence import measuring
from tests.harness.demos import record_wander

fit = importlib.import_module("lifelong.training.fit")  # whose package has a function of that name
pytestmark = pytest.mark.sim

SMALL = (
    "preset=paper", "compat=libero", "algo=packnet", "benchmark.tasks=2", "device=cpu", "threads=1", "data.demos=2",
    "data.image_size=32", "data.seq_len=2", "train.epochs=3", "train.steps_per_epoch=1", "train.batch_size=4",
    "eval.every=1", "eval.horizon=1", "eval.episodes=1", "eval.curve_episodes=1", "eval.settle_steps=0",
    "policy.encoder.width=8", "policy.head.hidden=16", "policy.temporal.layers=1"
)  # fmt: skip
WORDS = [
    "[PAD]",
    "[UNK]",
    "[CLS]",
    "[SEP]",
    "[MASK]",
    *["pick", "up", "the", "and", "place", "it", "in", "basket"],
]


def tiny_bert(folder: Path) -> Path:
    """Save a BERT of one layer with weights from a seed, as the Hub has them."""
    transformers = pytest.importorskip("transformers")
    sizes = {"hidden_size": 8, "num_hidden_layers": 1, "num_attention_heads": 2, "intermediate_size": 16}
    config = transformers.BertConfig(vocab_size=len(WORDS), max_position_embeddings=64, **sizes)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        transformers.BertModel(config).save_pretrained(folder)
    (folder / "vocab.txt").write_text("\n".join(WORDS))
    transformers.BertTokenizer(str(folder / "vocab.txt")).save_pretrained(folder)
    return folder


def counted(monkeypatch: pytest.MonkeyPatch, calls: Counter, owner: object, name: str, when=lambda *_: True):
    """Count the calls of a function."""
    real = getattr(owner, name)

    def spied(*args, **kwargs):
        calls[f"{owner.__name__.rpartition('.')[2]}.{name}"] += bool(when(*args))
        return real(*args, **kwargs)

    monkeypatch.setattr(owner, name, spied)


def test_every_part_of_the_published_protocol_runs(tmp_path, monkeypatch):
    monkeypatch.setitem(language._HUB_NAMES, "bert", str(tiny_bert(tmp_path / "bert")))
    files = [
        str(record_wander(tmp_path / f"{task.name}.hdf5", task.id, (32, 32)))
        for task in get_suite("libero_object").tasks[:2]
    ]
    calls, real = Counter(), measuring.rollout
    for owner, name in ((SharedJitter, "images"), (SharedShift, "_corners"), (PackNet, "_prune")):
        counted(monkeypatch, calls, owner, name)
    counted(monkeypatch, calls, fit, "_adapt_statistics")
    counted(
        monkeypatch, calls, layers, "drop_samples", lambda x, chance, training: chance == 0.1 and training
    )

    def succeeds_after(*args, seed, **kwargs):
        """Succeed at the second and third of four points of a learning curve, and wherever these weights act."""
        done, (*_, epoch, _) = real(*args, seed=seed, **kwargs), seed
        return replace(done, episodes=tuple(replace(e, success=epoch in (1, 2)) for e in done.episodes))

    monkeypatch.setattr(measuring, "rollout", succeeds_after)
    folders = f"runs_dir={tmp_path / 'runs'}", f"language.cache_dir={tmp_path}"
    assert main(["train", *SMALL, *folders, f"data.files=[{','.join(files)}]"]) == 0

    (log,) = (tmp_path / "runs").rglob("results.jsonl")
    found = json.loads((log.parent / "results.json").read_text())
    assert found["finished"] and (log.parent / "report.html").is_file()
    assert found["config"]["language"]["pad_to"] == 25 and len(list(tmp_path.glob("*.npz"))) == 2
    assert found["best_epochs"] == {"0": 1, "1": 1}  # the earliest of the best
    # eq. 3 as written: 0, 1, 1, and 0 held at the best
    assert found["metrics"]["fwt"]["value"] == 0.75 and found["statistics"]["transfer"] == "published"
    assert found["metrics"]["nbt"]["value"] == 0.0 and found["success_matrix"]["rates"][1] == [1.0, 1.0]
    phases = 2 * 2  # training and retraining of each task
    steps = phases * 3
    assert calls["SharedJitter.images"] >= steps and calls["SharedShift._corners"] >= steps
    assert calls["PackNet._prune"] > 2 and calls["transformer.drop_samples"] >= steps
    assert calls["fit._adapt_statistics"] == 2

    after = checkpoints.load(log.parent / "checkpoints" / "task_1.safetensors")
    owners = after["algorithm"]["owner"]
    assert all(set(owner.unique().tolist()) <= {0, 1, 2} for owner in owners.values())
    assert sum(int((owner == 2).sum()) for owner in owners.values()) > 0
    statistics = [name for name in after["policy"] if name.endswith("running_mean")]
    # PackNet's code keeps batch norms in evaluation mode from the first task on
    assert statistics and not any(after["policy"][name].any() for name in statistics)
