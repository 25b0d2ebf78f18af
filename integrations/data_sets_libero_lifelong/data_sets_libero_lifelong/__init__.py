"""Demonstrations of libero-lifelong as data sets of LeRobot, GR00T and RLDS, and for Rerun's viewer."""
