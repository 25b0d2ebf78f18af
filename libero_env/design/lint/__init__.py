"""Checks of task files: what they say, whether the scene can be built, whether the instruction fits the goal."""
