"""Adapters between the original's environments and `libero_env`."""
