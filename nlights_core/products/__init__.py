"""Products: maps and meshes that leave the system, and where people find them."""
