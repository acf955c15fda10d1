"""First manifests: what a folder of photographs seems to be, and an ``artwork.yaml`` that says so."""
