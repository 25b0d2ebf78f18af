"""Algorithms that stand on no number of a paper and not on the study; docs/algorithms.md has what differs."""
