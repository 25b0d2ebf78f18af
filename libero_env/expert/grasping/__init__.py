"""Grasps of objects, from above or from a side, and of handles and knobs."""
