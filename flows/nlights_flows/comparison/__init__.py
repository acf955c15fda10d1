"""Comparison: variants of recipes on the same captures, side by side."""
