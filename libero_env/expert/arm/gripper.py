"""Dimensions of the Panda gripper."""

from dataclasses import dataclass


@dataclass(frozen=True)
class PandaGripper:
    """Dimensions of the Franka hand and its fingers, [m].

    The frame is that of the grip site between the fingertips: x is the direction in which the fingers open, y lies
    across them, z points from the palm to the fingertips. "Below" is towards the fingertips.

    Attributes:
        max_opening: Distance between the fingertips of the open gripper.
        max_grasp_width: Largest width that is grasped: it leaves room for errors on both sides.
        pad_below: Reach of the finger pads below the grip site.
        pad_above: Reach of the finger pads above the grip site.
        tip_below: Reach of the fingertips below the grip site.
        palm_above: Height of the palm above the grip site, with 1.5 mm to spare.
        finger_half_width: Half the width of a finger, along y.
        finger_thickness: Largest thickness of a finger, along x.
        tip_thickness: Thickness of a finger at its tip, along x.
        finger_taper: Thickness that a finger gains for each metre above its tip, [m/m].
        palm_half_length: Half the extent of the hand along x.
        palm_half_width: Half the extent of the hand along y.
        hand_length: Extent of hand and wrist above the grip site.
    """

    max_opening: float = 0.08
    max_grasp_width: float = 0.072
    pad_below: float = 0.004
    pad_above: float = 0.012
    tip_below: float = 0.0095
    palm_above: float = 0.0285
    finger_half_width: float = 0.011
    finger_thickness: float = 0.0265
    tip_thickness: float = 0.0145
    finger_taper: float = 0.41
    palm_half_length: float = 0.105
    palm_half_width: float = 0.035
    hand_length: float = 0.28

    @property
    def half_opening(self) -> float:
        """Distance of an open finger from the middle, [m]."""
        return 0.5 * self.max_opening


GRIPPER = PandaGripper()
