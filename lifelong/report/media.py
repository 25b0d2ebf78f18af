"""Images and videos of a run within its page, which needs no other file."""

import base64
import os
from pathlib import Path
from typing import Any

from libero_env.errors import InvalidInputError
from libero_env.storage import own_folder, read_bounded

MEDIA_TYPES = {
    ".gif": "image/gif",
    ".webp": "image/webp",
    ".png": "image/png",
    ".mp4": "video/mp4",
    ".webm": "video/webm",
}
MEDIA_LIMIT = 48 * 2**20  # [bytes] of rollout recordings in one page


def media(folder: Path, pattern: str = "*") -> dict[str, Any]:
    """Return the images and videos of a folder as data URLs, with captions from text files of the same stem."""
    items: list[dict[str, Any]] = []
    left_out: list[str] = []
    used = 0
    try:
        own_folder(folder.parent, folder.name)
    except InvalidInputError:
        return {"items": items, "left_out": [f"{folder.name} is not a folder, or is a link"]}
    for path in sorted(folder.glob(pattern)) if folder.is_dir() else []:
        kind = MEDIA_TYPES.get(path.suffix.lower())
        if kind is None:
            continue
        note, caption = path.with_suffix(".txt"), path.stem.replace("_", " ")
        try:  # a run may be somebody else's, and its page is passed on
            content = read_bounded(path, MEDIA_LIMIT - used, within=folder.parent)
            if os.path.lexists(note):
                caption = read_bounded(note, 1 << 20, within=folder.parent).decode(errors="replace").strip()
        except OSError as error:
            left_out.append(f"{path.name} ({error})")
            continue
        used += len(content)
        data = base64.b64encode(content).decode()
        items.append(
            {"url": f"data:{kind};base64,{data}", "video": kind.startswith("video"), "caption": caption}
        )
    return {"items": items, "left_out": left_out}
