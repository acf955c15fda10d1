"""Tiles: the chain of stages, run here, in children, as Prefect tasks or on other machines."""
