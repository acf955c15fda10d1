"""Calibration of a tile: what all its pixels share, found in its own photographs, with its covariance."""
