"""The contracts: one kind of algorithm per slot of the recipe, one verb per kind.

An algorithm is a frozen pydantic model: its fields are its options, its one method is its
work.  The YAML mapping of the recipe validates straight into the thing that runs; its
``model_dump`` is its provenance and part of its cache key; it pickles.

To add one, subclass a kind, give it a ``name``, implement the verb, and return the class from
the hook `nlights_algorithms` (see docs/writing-a-plugin.md).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, ClassVar, NamedTuple, Protocol

from pydantic import BaseModel, ConfigDict, Field

from nlights_core.fields import HeightMap, LightField, NormalField
from nlights_core.frames import Array

if TYPE_CHECKING:
    from pathlib import Path

    from nlights_core.capture import Tile


PHOTONS = 40_000.0
"""How many photons a sample of weight 1 that reads 1 has counted: a good exposure of a white surface."""


class Read(Protocol):
    """Callable by which an algorithm sees photographs without ever opening a file."""

    def __call__(self, path: Path, *, reduce: int = 1) -> Array:
        """A whole photograph, streamed and reduced by block means.

        Parameters
        ----------
        path : Path
            A photograph named by the tile.
        reduce : int
            Edge of the blocks whose mean makes one sample.

        Returns
        -------
        (h, w, C) float32 array
            Linear light as fractions of the saturation level; the dark frame is not subtracted.
        """
        ...


class Solution(NamedTuple):
    """Result of a normal solver for a band.

    Attributes
    ----------
    normals : (h, w, 3) float32
        Unit normals in the plane frame, NaN where not known.
    albedo : (h, w) float32
        Albedo of the grey images, NaN where not known.
    confidence : (h, w) float32
        Standard uncertainty of the normal, degrees: the angle that it is off by no more than in
        68 % of all cases; NaN where not known.
    weights : (L, h, w) float32
        The weights the solution was made with: 0 for a sample that was discarded.  The colour
        of the albedo, the residual and the map of used lights follow from them.
    """

    normals: Array
    albedo: Array
    confidence: Array
    weights: Array


class Algorithm(BaseModel, ABC):
    """Base of what is swappable.  Subclass one of the kinds below, not this."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    slot: ClassVar[str]
    """The slot of the recipe that this kind fills."""
    name: ClassVar[str]
    """What ``use:`` in a recipe calls it: hyphenated, as in the literature."""
    needs: ClassVar[tuple[str, ...]] = ()
    """Fields of the tile that must be there (of "stand", "flats", "spheres", "lights", "known_heights"):
    checked before anything runs."""


class LightModel(Algorithm):
    """Positions and strengths of the lamps."""

    slot: ClassVar[str] = "light_model"

    refine: bool = Field(
        default=False,
        description="fit each lamp's strength and ambient light to the photographs (Xiong's model)",
    )
    prior: float = Field(
        default=1.0,
        ge=0,
        description="how strongly the refinement is held to the given lights; 0: not at all: the "
        "strengths alone are fitted, by plain least squares, as in PSBox's step 3",
    )

    @abstractmethod
    def locate(self, tile: Tile, read: Read) -> LightField:
        """Find the lamps of a tile.

        Parameters
        ----------
        tile : Tile
            The stand, the chrome spheres and the files of given lights are among its fields.
        read : Read
            How to look at a photograph of the tile.

        Returns
        -------
        LightField
            One light per frame, in the order of ``tile.frames``.

        Raises
        ------
        TileError
            When the tile lacks what this model needs.
        """


class ImageDetrend(Algorithm):
    """The flat field: readings of a flat, a matt white board at z = 0, under each lamp."""

    slot: ClassVar[str] = "detrend.images"

    @abstractmethod
    def flat_field(self, flats: Array | None, lights: LightField, x: Array, y: Array) -> Array:
        """The flat field; the stage divides the images by it.

        It varies smoothly, so it is computed on a coarse grid.

        Parameters
        ----------
        flats : (L, h, w, C) float32 array or None
            Photographs of the flat: linear, dark subtracted, divided by the lamps' power,
            averaged over blocks; NaN where saturated.  None unless "flats" is among `needs`.
        lights : LightField
            The lamps.
        x, y : (w,) and (h,) float64 arrays
            Centres of the blocks in the plane frame, mm.

        Returns
        -------
        (L, h, w, C) or (L, h, w, 1) float32 array
            Positive; NaN where not known.
        """


class NormalSolver(Algorithm):
    """Normals from images under known lights, pixel by pixel."""

    slot: ClassVar[str] = "normals"

    @abstractmethod
    def solve(self, images: Array, lights: Array, weights: Array) -> Solution:
        """Solve a band of rows.

        Parameters
        ----------
        images : (L, h, w) float32 array
            Grey, linear, divided by the flat field where there is one.
        lights : (L, h, w, 3) float32 array, or broadcastable to it
            Direction times irradiance, relative to the flat field where there is one: the model is
            ``images = albedo * (lights . normal)``.
        weights : (L, h, w) float32 array
            Weight of each sample's squared residual, in units of `PHOTONS`: the variance of a sample
            that reads r is ``r / (w PHOTONS)``.  0 where the sample must not be used (saturated,
            masked).

        Returns
        -------
        Solution
            NaN normals where fewer than three lights are usable or they are ill conditioned:
            never a guess.
        """


class NormalDetrend(Algorithm):
    """The systematic distortion of normals that a flat shows."""

    slot: ClassVar[str] = "detrend.normals"
    needs: ClassVar[tuple[str, ...]] = ("flats",)

    @abstractmethod
    def bias(self, reference: NormalField) -> Array:
        """Bias that the stage subtracts from the artwork's normals (and then makes them unit again).

        Parameters
        ----------
        reference : NormalField
            Normals of the flat, solved like the artwork's.

        Returns
        -------
        (H, W, 3) float32 array
            Difference to the true normal of the flat; finite everywhere.
        """


class Integrator(Algorithm):
    """Height from normals."""

    slot: ClassVar[str] = "integrator"
    bytes_per_pixel: ClassVar[int] = 64
    """Working memory per pixel that any field takes, compared with the budget before a tile is begun.

    Where some fields take more, ask `nlights_core.memory.require` once that is known.
    """

    @abstractmethod
    def integrate(self, normals: NormalField) -> HeightMap:
        """Integrate a whole field.

        Parameters
        ----------
        normals : NormalField
            NaN is a mask: unknown stays NaN and does not spread.

        Returns
        -------
        HeightMap
            On the same grid, float32, mean 0 over what is known.
        """


class HeightDetrend(Algorithm):
    """The smooth deformation of a height map that is not the artwork's."""

    slot: ClassVar[str] = "detrend.height"

    @abstractmethod
    def trend(self, height: HeightMap) -> Array:
        """Trend that the stage subtracts from the height (and keeps).

        Parameters
        ----------
        height : HeightMap
            NaN where not known.  Its ``known`` is None unless "known_heights" is among `needs`.

        Returns
        -------
        (H, W) float32 array
            Trend in the height's unit, finite everywhere.
        """


KINDS: tuple[type[Algorithm], ...] = (
    LightModel,
    ImageDetrend,
    NormalSolver,
    NormalDetrend,
    Integrator,
    HeightDetrend,
)
"""Every slot of a recipe, in the order in which they run."""
