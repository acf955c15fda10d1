"""Near light: what the finite distance of lamps asks for: height before normals, and its level."""
