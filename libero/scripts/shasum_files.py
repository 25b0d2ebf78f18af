"""Print or check the SHA-256 of files, in the format of `sha256sum`."""

import argparse
import hashlib
from pathlib import Path

from tqdm import tqdm

from libero.libero.utils.download_utils import datasets_folder
from libero.scripts.command import option, script
from libero_env.errors import LiberoError


@script(
    option("paths", nargs="*", type=Path, help="files or folders (default: the folder of the data sets)"),
    option("--check", type=Path, metavar="LIST", help="compare with a list that was printed before"),
)
def main(args: argparse.Namespace) -> int:
    """Print the checksums, or compare them; return 1 where one differs."""
    if args.check:
        return compare(args.check)
    roots = args.paths or [datasets_folder()]
    files = [f for root in roots for f in (root, *sorted(root.rglob("*"))) if f.is_file()]
    if not files:
        raise LiberoError(f"no files in {', '.join(map(str, roots))}")
    for file in tqdm(files, unit="file", disable=None):
        tqdm.write(f"{digest(file)}  {file}")
    return 0


def compare(listing: Path) -> int:
    """Print one line for each file of a list; return 1 where one is missing or differs."""
    lines = [line.partition("  ") for line in listing.read_text(encoding="utf-8").splitlines() if line]
    if bad := [line[0] for line in lines if len(line[0]) != 64 or not line[2]]:
        raise LiberoError(f"{listing}: {bad[0]!r} is not a checksum; expected lines of `<sha256>  <file>`")
    wrong = 0
    for known, _, name in tqdm(lines, unit="file", disable=None):
        found = digest(Path(name)) if Path(name).is_file() else None
        wrong += found != known
        tqdm.write(f"{name}: {'OK' if found == known else 'FAILED' if found else 'missing'}")
    return int(wrong > 0)


def digest(file: Path) -> str:
    """Return the SHA-256 of a file, in hex."""
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
