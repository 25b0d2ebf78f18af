"""Learn a sequence of tasks: `python libero/lifelong/main.py benchmark_name=LIBERO_SPATIAL lifelong=er seed=100`."""

import os
import sys
from pathlib import Path


def main() -> int:
    """Run the configuration of the command line, with the keys of `libero/configs`.

    Returns:
        The exit status, see `libero_env.cli.ending`.
    """
    import hydra

    from libero._adapters.config import CONFIGS
    from libero.lifelong.run import run
    from libero_env.cli import ending
    from libero_env.errors import LiberoError
    from lifelong.composition import REFUSALS, explained

    status = 0

    def job(config: object) -> None:
        nonlocal status
        try:
            run(config)
        except Exception as error:  # noqa: BLE001 - told by kind
            status = max(status, ending.report(error))

    with ending.general_options(sys.argv[1:]) as words:
        sys.argv[1:] = words  # where Hydra reads them
        os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # errors are printed below, in one line
        try:
            with ending.interruptible():
                hydra.main(version_base="1.3", config_path=str(CONFIGS), config_name="config")(job)()
        except KeyboardInterrupt as error:
            error.add_note("train.resume=true resumes after the last finished task")
            return ending.report(error)
        except LiberoError as error:
            return ending.report(error)
        except REFUSALS as error:  # of Hydra: the job keeps its own
            return ending.report(explained(error, words, [CONFIGS]))
    return status


if __name__ == "__main__":
    sys.path[0] = str(Path(__file__).resolve().parents[2])  # not this folder, whose modules have common names
    sys.exit(main())
