"""Adapters between the original's learning side and `lifelong`."""
