"""The original's learning side under its own names: adapters over the package `lifelong`."""
