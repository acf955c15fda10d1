"""Tolerance: how wrong the measurement of a stand may be."""
