"""Modules that the original's policies are assembled from."""
