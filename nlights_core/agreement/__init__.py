"""Agreement: whether the photographs of a tile agree with their flats, with one another and with the stand."""
