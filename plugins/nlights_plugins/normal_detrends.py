"""Detrends of normals: the distortion that a flat shows."""

from typing import ClassVar

import numpy as np

from nlights_core.algorithms import NormalDetrend
from nlights_core.fields import NormalField
from nlights_core.frames import Array


class FlatResidual(NormalDetrend):
    """The flat's normals minus the true normal of a flat, (0, 0, 1), where they are known.

    The paper, section 2.2 C: "Different normal values are qualified as systematic distortions
    and their value is subtracted to the normal field of the represented object."  After
    `flat-field` with the same flat only the flat's noise is left, which it adds; it serves when
    the images are divided by a computed flat field.
    """

    name: ClassVar[str] = "flat-residual"

    def bias(self, reference: NormalField) -> Array:
        out = np.array(reference.normals, np.float32)
        out[..., 2] -= 1
        out[~np.isfinite(out).all(axis=-1)] = 0
        return out
