"""Nights: an inbox digitised unwatched, and one page in the morning; the weekly check of the flat."""
