"""Faults, classed by what the person who meets them should do."""

from __future__ import annotations


class NlightsError(Exception):
    """A fault that nLights can explain in one sentence.

    The command line prints the sentence without a traceback.  Anything that is not an
    `NlightsError` (nor an `OSError`) is a defect of nLights or of a plugin.
    """


class RecipeError(NlightsError):
    """The recipe is at fault: correct the file; nothing has been written."""


class StandError(NlightsError):
    """The stand's file is at fault: correct it; nothing has been written."""


class CaptureError(NlightsError):
    """The capture's manifest is at fault: correct it; nothing has been written."""


class PluginError(NlightsError):
    """The installation is at fault: a distribution offers something unusable."""


class TileError(NlightsError):
    """The tile cannot be done.  A retry would not help; the other tiles go on."""
