"""Contracts: algorithms of all kinds, called with care and held to what their kind promises."""
