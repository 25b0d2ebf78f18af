"""Comparisons of evaluated policies: paired tests, intervals, sample sizes."""
