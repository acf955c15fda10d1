"""nLights core: types, contracts, physics and the store.  Knows neither Prefect nor a plugin."""

__version__ = "0.1.0"
