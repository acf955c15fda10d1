"""Lamps: where they are, how they emit, and how strong they are, found in photographs."""
