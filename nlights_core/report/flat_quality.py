"""Numbers that tell a stand's state from one capture to the next: how bright each flat is, and its noise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nlights_core.frames import Array
from nlights_core.photographs.noise import Noise
from nlights_core.report.figures import Number

LEVEL = "Flat level"
NOISE = "Photon noise at saturation"


def of_flat_levels(
    flat_field: Array | None, power: Array | None, noise: Noise | None, lamps: Sequence[str], missing: str
) -> list[Number]:
    """Brightness of the flat under each lamp, and the noise that was measured on it.

    Parameters
    ----------
    flat_field : (L, h, w, C) array, optional
        What the photographed flat reads, divided by the lamps' powers.  None: no flat was photographed.
    power : (L, C) or (L, 1) array, optional
        Those powers.
    noise : Noise, optional
        Of the flat's photographs.
    lamps : sequence of str
        Their names, in the order of ``flat_field``.
    missing : str
        What is to be said without a photographed flat.

    Returns
    -------
    list of Number
        One level per lamp (one number without a name where there is no flat), and the noise.
    """
    levels: dict[str, float | None] = {LEVEL: None}
    if flat_field is not None and power is not None:
        means = (flat_field.mean(axis=(1, 2), dtype=np.float64) * power).mean(axis=1)
        levels = {f"{LEVEL}, {lamp}": 100 * float(mean) for lamp, mean in zip(lamps, means, strict=True)}
    numbers = [
        Number(
            "Flat",
            name,
            level,
            "% of saturation",
            "Mean reading of the photographed flat under this lamp: it falls when a lamp ages, is dirty or was "
            "moved, and when the exposure was changed.",
            missing,
        )
        for name, level in levels.items()
    ]
    grain = None if noise is None else 100 * float(np.sqrt(np.mean(noise.gain)))
    return [
        *numbers,
        Number(
            "Flat",
            NOISE,
            grain,
            "%",
            "Standard deviation of a sample at saturation by the photons' chance, as a share of it; it rises with "
            "the camera's ISO setting.",
            missing,
        ),
    ]
