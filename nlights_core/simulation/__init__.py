"""Simulation: captures whose truth is known, and products compared with it."""
