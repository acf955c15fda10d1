"""The measured-poi light model: lamps at the measured points of interest of a stand."""

from __future__ import annotations

from typing import ClassVar, Self

import numpy as np
from pydantic import Field, model_validator

from nlights_core.algorithms import LightModel, Read
from nlights_core.capture import Tile
from nlights_core.errors import TileError
from nlights_core.fields import LightField


class MeasuredPoi(LightModel):
    """Near lamps where they were measured, in millimetres of the plane frame.

    Every pixel gets its own directions and irradiance.  The plane frame's origin is the centre
    of the field, so that a lamp's position is also its direction from there.
    """

    name: ClassVar[str] = "measured-poi"
    needs: ClassVar[tuple[str, ...]] = ("stand",)

    emission: bool = Field(
        default=False,
        description="let each lamp's light fall with cos(angle off its axis) ** exponent, the exponent from "
        "the stand's half_angle_deg and the axis through the field's centre; only needed where no flat field "
        "corrects the images",
    )
    distant: bool = Field(
        default=False,
        description="one direction per lamp for the whole field, seen from its centre: PSBox's baseline",
    )

    @model_validator(mode="after")
    def _emission_is_near(self) -> Self:
        if self.emission and self.distant:
            raise ValueError("emission describes near lamps: it cannot be combined with distant")
        return self

    def locate(self, tile: Tile, read: Read) -> LightField:
        """Look the tile's lamps up in its stand; no photograph is read.

        Parameters
        ----------
        tile : Tile
            Its ``stand`` names every lamp of its frames.
        read : Read
            Not used.

        Returns
        -------
        LightField
            Near, or distant where asked for; unit power.

        Raises
        ------
        TileError
            When the tile has no stand, or a lamp is not one of the stand's.
        """
        if tile.stand is None:
            raise TileError(
                f"tile {tile.name}: measured-poi needs a stand, but the capture names none; add 'stand:' or "
                "use the chrome-sphere or given-directions light model"
            )
        unknown = [lamp for lamp in tile.lamps if lamp not in tile.stand.lamps]
        if unknown:
            raise TileError(
                f"tile {tile.name}: frames: the stand '{tile.stand.name}' has no lamp {', '.join(unknown)}; "
                f"it has {', '.join(tile.stand.lamps)}"
            )
        positions = tile.stand.lamp_positions(tile.lamps)
        directions = positions / np.linalg.norm(positions, axis=1, keepdims=True)
        if self.distant:
            return LightField(lamps=tile.lamps, directions=directions)
        if not self.emission:
            return LightField(lamps=tile.lamps, positions=positions)
        exponents = np.full(len(tile.lamps), tile.stand.lamp.exponent)
        return LightField(lamps=tile.lamps, positions=positions, axes=-directions, exponents=exponents)
