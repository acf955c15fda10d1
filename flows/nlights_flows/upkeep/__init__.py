"""Upkeep: whether products and artefacts are still what was written, and what nobody needs any more."""
