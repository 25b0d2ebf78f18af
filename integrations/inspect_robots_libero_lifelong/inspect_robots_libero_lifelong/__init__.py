"""LIBERO's tasks for Inspect Robots, which finds them by the entry points of this distribution."""
