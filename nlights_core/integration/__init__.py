"""Integration: normals become height."""
