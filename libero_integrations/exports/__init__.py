"""Demonstrations and results of libero-lifelong in the formats of other tools."""
