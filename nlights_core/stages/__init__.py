"""Stages: references in, one reference out; the only place where files meet algorithms.

Each function names the work (`nlights_core.store.Work`) without doing it, so that planning,
calling directly and running as a Prefect task are the same words.  ``Work.make`` gets, runs and
puts; an algorithm never sees a file, and a stage never sees Prefect.
"""

from nlights_core.stages.agreement import agreement
from nlights_core.stages.alignment import alignment
from nlights_core.stages.bias import bias
from nlights_core.stages.calibration import calibration
from nlights_core.stages.flat_field import flat_field
from nlights_core.stages.height import height
from nlights_core.stages.level import level
from nlights_core.stages.lights import lights
from nlights_core.stages.maps import maps
from nlights_core.stages.mask import mask
from nlights_core.stages.mesh import mesh
from nlights_core.stages.normals import normals
from nlights_core.stages.overview import overview
from nlights_core.stages.report import report
from nlights_core.stages.trend import trend

__all__ = [
    "agreement",
    "alignment",
    "bias",
    "calibration",
    "flat_field",
    "height",
    "level",
    "lights",
    "maps",
    "mask",
    "mesh",
    "normals",
    "overview",
    "report",
    "trend",
]
