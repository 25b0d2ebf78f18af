"""Linter of task files: their content, whether the scene can be built, whether the instruction fits the goal."""
