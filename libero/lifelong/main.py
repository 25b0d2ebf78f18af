"""Learn a sequence of tasks: `python libero/lifelong/main.py benchmark_name=LIBERO_SPATIAL lifelong=er seed=100`."""

import sys
from pathlib import Path


def main() -> int:
    """Run the configuration of the command line, with the keys of `libero/configs`.

    Returns:
        Exit status: 0, 1 after an error, which is printed on one line, or 130 if interrupted.
    """
    import hydra
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    from libero._adapters.lifelong.config import CONFIGS
    from libero.lifelong.run import run
    from libero_env.errors import LiberoError
    from lifelong.launch import check_choices

    failed = False

    def job(config: object) -> None:
        nonlocal failed
        try:
            run(config)
        except (LiberoError, HydraException, OmegaConfBaseException, OSError) as error:
            failed = True
            print(f"error: {' '.join(str(error).split())}", file=sys.stderr)

    try:
        check_choices(sys.argv[1:], [CONFIGS])
        hydra.main(version_base="1.3", config_path=str(CONFIGS), config_name="config")(job)()
    except LiberoError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("interrupted; train.resume=true resumes after the last finished task", file=sys.stderr)
        return 130
    return int(failed)


if __name__ == "__main__":
    sys.path[0] = str(Path(__file__).resolve().parents[2])  # not this folder, whose modules have common names
    sys.exit(main())
