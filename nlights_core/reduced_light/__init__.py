"""Reduced light: photographs of a tile as small pictures, relative to flats and to one another."""
