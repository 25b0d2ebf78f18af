"""What demonstration files state of how they were made, compared with what they are used for and with each other."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from libero_env.assets.pack import Pack, select_pack
from libero_env.demos.contents import demo_names, json_attribute, read_header
from libero_env.demos.hdf5 import open_demo_file
from libero_env.demos.read import Labels
from libero_env.errors import DemoError
from libero_env.storage import read_yaml
from libero_env.text import shown
from libero_env.timing import CONTROL_HZ, FREQUENCIES

FACTS = ("models", "expert", "labels")  # in which the files of one use agree, unless a difference is allowed
UNSTATED = "not stated"
EXPERT = "scripted-expert"  # begins the generator of the expert's files
# keys of robosuite's controllers that have no effect with the values of `original_env.yaml`, or describe the robot
_WITHOUT_EFFECT = {
    *("kp_limits", "damping_ratio_limits", "ramp_ratio", "robot_name", "sim", "eef_name", "eef_rot_offset"),
    *("joint_indexes", "actuator_range", "policy_freq", "ndim"),
}


def recorded_frequency(file: Path) -> int:
    """Return the control steps per second that were recorded, [Hz]; files that do not state it have 20.

    Raises:
        DemoError: It is not a demonstration file, or was recorded at a frequency that no environment has.
    """
    stated = _made_with(file).get("control_freq", CONTROL_HZ)
    if stated not in FREQUENCIES:
        valid = ", ".join(map(str, FREQUENCIES))
        raise DemoError(
            f"{file}: attribute env_args: control_freq is {shown(stated)}; expected one of {valid}"
        )
    return int(stated)


def other_control(file: Path) -> str:
    """Return what a file states of its actions that the controller `osc_pose` with relative actions does not do.

    Kind, limits and gains are robosuite's of the original's recordings, which files that state nothing are taken to
    have.

    Returns:
        Key, value, and what is expected; "" where the actions are those of this controller.

    Raises:
        DemoError: It is not a demonstration file.
    """
    made_with = _made_with(file)
    stated = made_with.get("controller_configs") or {}
    stated = stated[0] if isinstance(stated, list) and len(stated) == 1 else stated
    stated = stated if isinstance(stated, Mapping) else {"type": stated}
    standard = read_yaml("demos/original_env.yaml")["controller_configs"]
    standard = {**standard, **dict.fromkeys(("position_limits", "orientation_limits"))}
    for key, value in stated.items():
        if key in _WITHOUT_EFFECT or (key in standard and _equal(value, standard[key])):
            continue
        expected = shown(standard[key]) if key in standard else "no such key"
        return f"{key} {shown(value, 40)} of the controller; expected {expected}"
    robots = made_with.get("robots", "Panda")
    if not all(str(one).endswith("Panda") for one in (robots if isinstance(robots, list) else [robots])):
        return f"the robots {shown(robots, 40)}; expected ['Panda']"
    return ""


def require_default_control(file: Path, use: str, *, any_frequency: bool = False) -> None:
    """Check that a file's actions are of `osc_pose`, relative, with the original's limits and gains, at 20 Hz.

    Args:
        use: What needs it, for the message.
        any_frequency: Whether other control frequencies are obeyed.

    Raises:
        DemoError: The file states something else.
    """
    if not any_frequency and (hz := recorded_frequency(file)) != CONTROL_HZ:
        raise DemoError(f"{file} was recorded at {hz} Hz; {use} is for {CONTROL_HZ} Hz")
    if other := other_control(file):
        raise DemoError(f"{file} states {other}: {use} is for relative actions of OSC_POSE")


def stated_facts(file: Path, labels: Labels = "expert") -> dict[str, str]:
    """Return the facts of a file that `require_alike` compares, by `FACTS`.

    Args:
        labels: Which actions are read, as for `read_demos`.

    Raises:
        DemoError: It is not a demonstration file.
    """
    header = read_header(file)
    stated = json_attribute(header, "models", file)
    models = " ".join(str(stated[key]) for key in ("pack", "digest") if key in stated)
    expert = str(header.get("generator", "")) or UNSTATED
    return {"models": models or UNSTATED, "expert": expert, "labels": _labels(file, header, labels)}


def models_here(pack: Pack | None = None) -> str:
    """Return today's models as `stated_facts` names those of a file."""
    pack = pack or select_pack()
    return f"{pack.name} {pack.digest}"


def noisy_labels(file: Path) -> str:
    """Return why the actions that were intended cannot be read from a file of the expert; "" where they can."""
    header = read_header(file)
    intended = _has_intended(file)
    if len(intended) > 1:
        name = next(iter(intended[False]))
        return f"has no expert_actions in {name}, which others have"
    disturbed = str(header.get("generator", "")).startswith(EXPERT) and header.get("disturbed", True)
    if False in intended and disturbed:
        return "has no expert_actions, and noise in actions"
    return ""


def differing(facts: Mapping[Any, Mapping[str, str]], despite: Sequence[str] = ()) -> list[str]:
    """Return in what files or tasks differ, a text for each fact with its values and the first of each.

    Args:
        facts: File or task -> facts of `stated_facts`. Models that are not stated are not compared.
        despite: Facts that are not compared.
    """
    lines = []
    for name in FACTS:
        values: dict[str, list[str]] = {}
        for of, stated in facts.items():
            if stated.get(name) and not (name == "models" and stated[name] == UNSTATED):
                values.setdefault(stated[name], []).append(str(of))
        if name not in despite and len(values) > 1:
            texts = (
                f"{value} of {of[0]}{f' and {len(of) - 1} more' if of[1:] else ''}"
                for value, of in values.items()
            )
            lines.append(f"{name}: {', '.join(texts)}")
    return lines


def require_alike(facts: Mapping[Any, Mapping[str, str]], despite: Sequence[str], allow: str) -> None:
    """Check that files agree in `FACTS`.

    Args:
        facts: As for `differing`.
        despite: Facts in which they may differ.
        allow: Option that allows a difference, such as `--despite {}`.

    Raises:
        DemoError: They do not; the message names each value, and how to allow it.
    """
    if lines := differing(facts, despite):
        names = [line.partition(":")[0] for line in lines]
        raise DemoError(
            f"the demonstrations differ in {'; '.join(lines)}. To use them all the same: "
            f"{allow.format(' '.join(names), ','.join([*despite, *names]))}"
        )


def _made_with(file: Path) -> dict[str, Any]:
    """Return the arguments of the environment in which a file was recorded; empty where it states none."""
    made_with = json_attribute(read_header(file), "env_args", file).get("env_kwargs")
    return made_with if isinstance(made_with, dict) else {}


def _equal(stated: Any, expected: Any) -> bool:
    """Return whether values of a controller's key are equal; one number stands for one of each axis."""
    if isinstance(expected, str):
        return str(stated).casefold() == expected.casefold()
    if expected is None or isinstance(expected, bool):
        return stated is expected
    try:
        first, second = np.asarray(stated, np.float64), np.asarray(expected, np.float64)
        return {first.shape, second.shape} <= {(), (6,)} and bool((first == second).all())
    except (TypeError, ValueError):
        return False


def _labels(file: Path, header: Mapping[str, Any], labels: Labels) -> str:
    """Return whether labels are intended actions, or executed ones that may have noise."""
    if labels == "executed":
        return "executed"
    intended = _has_intended(file)
    return "intended" if False not in intended or not header.get("disturbed", True) else "executed"


def _has_intended(file: Path) -> dict[bool, list[str]]:
    """Return the names of the demonstrations with intended actions beside the executed ones, and without."""
    found: dict[bool, list[str]] = {}
    with open_demo_file(file) as handle:
        for name in demo_names(handle, file):
            group = handle["data"][name]
            found.setdefault(isinstance(group, h5py.Group) and "expert_actions" in group, []).append(name)
    return found
