"""Data sets of other tools as demonstration files of this package."""
