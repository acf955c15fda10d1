"""The kit for plugin authors: a template, and the contracts held to what is installed."""
