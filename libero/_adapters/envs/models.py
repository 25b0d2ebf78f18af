"""The models that the environments of the facade are built from: the original's where they are installed."""

from pathlib import Path

from libero_env.assets.pack import ORIGINAL, Pack, facade_assets, original_folder, pack_of


def facade_pack() -> Pack:
    """Return the pack of the facade; see `libero_env.assets.pack.facade_assets`."""
    return pack_of(facade_assets())


def assets_folder() -> Path | None:
    """Return the folder of the original's models if the facade uses them; its files are not checked."""
    value = facade_assets().value
    folder = original_folder() if value == ORIGINAL else Path(value).expanduser()
    return folder if folder.is_dir() else None
