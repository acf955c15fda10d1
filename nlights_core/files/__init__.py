"""Files: maps on the disk, written and read by bands of rows."""
