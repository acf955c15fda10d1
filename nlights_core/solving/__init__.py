"""Solving: images under known lights become normals and albedo, in numpy and by compiled loops."""
