"""Names that people and file systems give to things: photographs, lists of them, and artworks."""
