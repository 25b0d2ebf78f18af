"""`libero teleop`: record demonstrations with a keyboard or a 3D mouse."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic.dataclasses import dataclass

from libero_env.cli.options import Field, FilePath, Positional, Positive, Seed, Size, TaskName
from libero_env.errors import InvalidInputError

Sensitivity = Annotated[float, Field(ge=-100, le=100)]
UsbId = Annotated[int, Field(ge=0, le=0xFFFF)]


@dataclass(frozen=True, kw_only=True)
class InputOptions:
    """How a user sees and moves the robot.

    Attributes:
        seed: Seed of the starts.
        camera: Camera shown while recording.
        screen: Where it is shown.
        device: Input device.
        pos_sensitivity: Factor on translations; keys are at full speed from 0.27 on.
        rot_sensitivity: Factor on rotations.
        vendor_id: USB vendor of the 3D mouse (default: 9583).
        product_id: USB product of the 3D mouse (default: 50741).
    """

    seed: Seed = 0
    camera: str = "agentview"
    screen: Literal["auto", "window", "terminal"] = "auto"
    device: Literal["keyboard", "spacemouse"] = "keyboard"
    pos_sensitivity: Sensitivity = 1.0
    rot_sensitivity: Sensitivity = 1.0
    vendor_id: UsbId | None = None
    product_id: UsbId | None = None


@dataclass(frozen=True, kw_only=True)
class TeleopRequest(InputOptions):
    """Record demonstrations by hand; what the file has is kept.

    Attributes:
        task: Such as libero_goal/3.
        bddl: A user-defined task file, instead of a task.
        out: Demonstration file (default: TASK_demo.hdf5 here).
        n: Demonstrations that the file shall have.
        size: Size of the images, 128 or 120x160.
    """

    task: Positional[TaskName | None] = None
    bddl: FilePath | None = None
    out: FilePath | None = None
    n: Positive = 1
    size: Size = (128, 128)


def teleop(request: TeleopRequest) -> int:
    """Record demonstrations; return 1 if the user stopped before all were recorded.

    Raises:
        InvalidInputError: Not exactly one of a task and a task file is given.
    """
    from libero_env.tasks import get_task, read_task
    from libero_env.teleop.screens import MouseReader, open_screen
    from libero_env.teleop.session import HELP, Keyboard, Teleop, record_session

    if request.task is not None and request.bddl is None:
        task = get_task(request.task)
    elif request.bddl is not None and request.task is None:
        task = read_task(request.bddl)
    else:
        raise InvalidInputError("give a task, such as libero_goal/3, or --bddl FILE")
    numbers = {"vendor_id": request.vendor_id, "product_id": request.product_id}
    mouse_ids = {name: number for name, number in numbers.items() if number is not None}
    if mouse_ids and request.device != "spacemouse":
        raise InvalidInputError("--vendor-id and --product-id name a 3D mouse; add --device spacemouse")
    out = request.out or Path(f"{task.name}_demo.hdf5")
    sensitivity = request.pos_sensitivity, request.rot_sensitivity
    with_mouse = request.device == "spacemouse"
    device = MouseReader(*sensitivity, **mouse_ids) if with_mouse else Keyboard(*sensitivity)
    print(f"{task.language}\n{HELP}")
    screen = open_screen(request.screen, device, request.camera)
    try:
        session = Teleop(task, device, screen, seed=request.seed)
        try:
            recorded = record_session(session, out, request.n, size=request.size, report=print)
        finally:
            session.close()
    finally:
        screen.close()
    print(f"{out}: {recorded} of {request.n} demonstrations")
    return int(recorded < request.n)
