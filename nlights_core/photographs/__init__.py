"""Photographs: files become linear, dark-free images, divided by what a flat reads."""
