"""Time steps of simulation and control."""

from typing import Annotated

from pydantic import AfterValidator

TIMESTEP = 0.002  # [s] of one physics step
SUBSTEPS = 25  # physics steps per control step
CONTROL_PERIOD = SUBSTEPS * TIMESTEP  # 0.05 [s]
CONTROL_HZ = round(1.0 / CONTROL_PERIOD)  # 20 [Hz]
PHYSICS_HZ = round(1.0 / TIMESTEP)  # 500 [Hz]
FREQUENCIES = tuple(hz for hz in range(1, PHYSICS_HZ + 1) if PHYSICS_HZ % hz == 0)  # [Hz] of control


def _check_frequency(hz: int) -> int:
    if hz not in FREQUENCIES:
        valid = ", ".join(map(str, FREQUENCIES))
        raise ValueError(
            f"{hz} Hz does not divide the {PHYSICS_HZ} Hz of the physics; expected one of {valid}"
        )
    return hz


ControlFreq = Annotated[int, AfterValidator(_check_frequency)]
