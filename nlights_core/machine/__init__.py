"""Machine: cores, compiled loops, and how work tells how far it is."""
