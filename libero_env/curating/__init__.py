"""Demonstration files made of others: filtered, rendered again, as videos."""
