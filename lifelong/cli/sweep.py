"""`libero sweep status`: how far a sweep is."""

from pathlib import Path

from libero_env.cli.options import FilePath, Positional
from lifelong.errors import ConfigError


def status(folders: Positional[tuple[FilePath, ...]] = (Path("runs"),)) -> None:
    """Print what runs, what failed, and what is left of each sweep.

    Args:
        folders: Folders of sweeps, or of runs, for all of their sweeps.
    """
    from lifelong.sweeps import find_sweeps, read_sweep, status_lines

    for folder in folders:
        sweeps = find_sweeps(folder)
        if not sweeps:
            raise ConfigError(f"{folder} holds no sweep; `libero train -m KEY=A,B` starts one")
        for one in sweeps:
            print(*status_lines(read_sweep(one)), sep="\n")
