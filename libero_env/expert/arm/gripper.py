"""Dimensions of the Panda gripper."""

# The Panda gripper, measured from the grip site along the fingers, m.
MAX_OPENING = 0.08


WIDEST = 0.072  # what still goes between the fingers with room to spare


PAD_BELOW, PAD_ABOVE = 0.004, 0.012  # the pads reach from below to above the site


TIP_BELOW = 0.0095  # the finger tips reach that far below it


PALM_ABOVE = 0.0285  # and the palm begins there, with a little room


FINGER_HALF_WIDTH = 0.011


FINGER_THICKNESS = 0.0265


HAND_HALF_LENGTH, HAND_HALF_WIDTH = 0.105, 0.035  # of the palm, along and across the direction of the fingers


HAND_LENGTH = 0.28  # m, of hand and wrist above the grip site
