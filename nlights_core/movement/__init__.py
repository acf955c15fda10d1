"""Movement: photographs that do not lie on each other, in details at full resolution."""
