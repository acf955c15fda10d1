"""Report: pictures, numbers and words by which people judge a tile."""
