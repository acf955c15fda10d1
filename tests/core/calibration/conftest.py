"""Small simulated captures with one trouble each, their calibration and their products."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
import tifffile

from nlights_core import stages
from nlights_core.calibration.fitting import Calibration, calibrate
from nlights_core.calibration.uncertainty import SmoothErrors, smooth_errors
from nlights_core.calibration.unknowns import groups
from nlights_core.capture import Tile
from nlights_core.configurations import load_stand
from nlights_core.fields import LightField
from nlights_core.frames import Array
from nlights_core.manifest import load_capture
from nlights_core.near_light.overview import ReducedRoom, reduced_room
from nlights_core.photographs.development import darkroom
from nlights_core.photographs.flat_fields import FlatField, read_flat_field
from nlights_core.photographs.noise import read_noise
from nlights_core.recipe import Recipe, load_recipe
from nlights_core.simulation import captures
from nlights_core.simulation.captures import BLACK_LEVEL, FLAT_ALBEDO, simulate
from nlights_core.simulation.illumination import LampGroup
from nlights_core.simulation.scenes import SCENES, Scene
from nlights_core.simulation.surfaces import plane
from nlights_core.stages.inputs import read_lights
from nlights_core.store import ArtefactRef, Store, Work
from nlights_flows.tiles.chain import digitise_tile

GROUPS = tuple(group.name for group in groups(8))


@dataclass(frozen=True)
class Capture:
    """A simulated capture on disk, and a store for what is made of it."""

    folder: Path
    store: Store

    @property
    def tile(self) -> Tile:
        return load_capture(self.folder)[0]

    @property
    def height(self) -> Array:
        """True height, mm."""
        return np.asarray(tifffile.imread(self.folder / "truth/height.tif"), np.float64)

    def change(self, spoil: Callable[[Array, int], Array], *folders: str) -> "Capture":
        """Change light (black level taken off) of lamp 0 to 7, in frames (``""``) or flats (``"flat/"``)."""
        for folder in folders:
            for k in range(8):
                path = self.folder / f"{folder}light_{k + 1}.tif"
                light = spoil(tifffile.imread(path).astype(np.float64) - BLACK_LEVEL, k) + BLACK_LEVEL
                numbers = np.clip(np.rint(light), 0, 65535).astype(np.uint16)
                tifffile.imwrite(path, numbers, photometric="rgb")
        return self

    def call(self, stage: Callable[..., Work], *arguments: Any) -> ArtefactRef:
        work = stage(self.store, *arguments)
        self.store.ensure(work)
        return work.ref

    def products(self, recipe: Recipe) -> Path:
        """Folder of the maps that a recipe makes of it."""
        return self.store.path(digitise_tile(self.tile, recipe, self.call)["maps"])


@dataclass(frozen=True)
class Calibrated:
    """A capture read and reduced: what a calibration is given, and what it found."""

    room: ReducedRoom
    lights: LightField
    flat_field: FlatField
    found: Calibration
    errors: SmoothErrors
    height: Array

    @property
    def deviations(self) -> Array:
        """Error of the coarse height after the best constant, mm."""
        apart = self.found.height - self.height
        return np.asarray(apart - apart.mean())


def read(capture: Capture, scratch: Path) -> tuple[ReducedRoom, LightField, FlatField]:
    """Reduced photographs of a capture, its lamps and its flat field."""
    recipe = load_recipe("default")
    lights = capture.call(stages.lights, capture.tile, recipe.light_model)
    flat = capture.call(stages.flat_field, capture.tile, recipe.detrend.images, lights)
    path = capture.store.path(flat)
    with darkroom(capture.tile, scratch) as room:
        room.noise = read_noise(path) or room.noise
        small = reduced_room(room, lambda _: None)
    return small, read_lights(capture.store, lights), read_flat_field(path)


@pytest.fixture(scope="session")
def calibrated() -> Callable[..., Calibrated]:
    """What a calibration finds in a capture."""

    def find(capture: Capture, chosen: tuple[str, ...] = ("level", *GROUPS)) -> Calibrated:
        with TemporaryDirectory() as scratch:
            room, lights, flat_field = read(capture, Path(scratch))
        # As the chain does: positions are as uncertain as the stand's file says.
        found = calibrate(room, lights, flat_field, chosen, capture.tile.stand.uncertainty_mm)
        return Calibrated(
            room, lights, flat_field, found, smooth_errors(found, lights, room.grid), capture.height
        )

    return find


@pytest.fixture(scope="session")
def simulated(tmp_path_factory) -> Callable[..., Capture]:
    """A capture 200 px wide; ``level`` mm above the flat, its paint or its flat perhaps not matt."""

    def make(
        scene: str = "painting",
        stand: str = "horizontal",
        *,
        level: float = 0.0,
        paint: Callable[..., Array] | None = None,
        flat: Callable[..., Array] | None = None,
        **options: Any,
    ) -> Capture:
        folder = tmp_path_factory.mktemp("calibration")
        with pytest.MonkeyPatch.context() as patch:
            patch.setitem(captures.SCENES, scene, _raised(SCENES[scene], level))
            if paint or flat:
                patch.setattr(captures, "shine", _shine(load_stand(stand).camera_position, paint, flat))
            simulate(
                folder / "capture",
                load_stand(stand),
                scene=scene,
                **{"width": 200, "seed": 4, **options},
            )
        return Capture(folder / "capture", Store(folder / "store"))

    return make


def _raised(make: Callable[..., Scene], level: float) -> Callable[..., Scene]:
    def raised(*arguments: Any) -> Scene:
        scene = make(*arguments)
        return replace(scene, surface=scene.surface + plane(level=level)) if level else scene

    return raised


def _shine(
    camera: Array, paint: Callable[..., Array] | None, flat: Callable[..., Array] | None
) -> Callable[..., tuple[Array, Array]]:
    """The simulator's light, lamp by lamp, with other reflectances than its own."""
    real = captures.shine

    def shine(group: LampGroup, points: Array, normals: Array, shadows: Any, _: Any = None) -> Any:
        view = _unit(np.asarray(camera, float) - np.moveaxis(points, 0, -1))
        matt, gloss = np.zeros((2, *points.shape[1:]))
        for position, axis, power in zip(group.positions, group.axes, group.powers, strict=True):
            one = replace(group, positions=position[None], axes=axis[None], powers=np.array([power]))
            incident, _ = real(one, points, normals, shadows)
            light = _unit(position - np.moveaxis(points, 0, -1))
            if shadows is None and flat is not None:
                # The flat's albedo is put on what is returned for it.
                incident = incident * (1 + flat(normals, light, view)[1] / FLAT_ALBEDO)
            elif shadows is not None and paint is not None:
                body, shine_of = paint(normals, light, view)
                gloss += incident * shine_of
                incident = incident * body
            matt += incident
        return matt.astype(np.float32), gloss.astype(np.float32)

    return shine


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.sum(a * b, axis=-1))


@pytest.fixture(scope="session")
def satin() -> Callable[[float, float], Callable[..., Any]]:
    """Paint with a white highlight of GGX: reflectance at normal incidence, roughness.

    Returns its body and its highlight, each relative to the light that falls on it.
    """

    def make(reflectance: float, roughness: float) -> Callable[..., Any]:
        def paint(normals: Array, light: Array, view: Array) -> tuple[float, Array]:
            half = _unit(light + view)
            lit, seen = np.maximum(_dot(normals, light), 1e-6), np.maximum(_dot(normals, view), 1e-6)
            tangent = np.tan(np.arccos(np.clip(_dot(normals, half), -1, 1))) / roughness
            cosine = np.maximum(_dot(normals, half), 1e-6)
            facets = 1 / (np.pi * roughness**2 * cosine**4 * (1 + tangent**2) ** 2)
            masking = np.ones_like(lit)
            for one in (lit, seen):
                masking *= 2 / (1 + np.sqrt(1 + (roughness * np.tan(np.arccos(np.minimum(one, 1)))) ** 2))
            fresnel = reflectance + (1 - reflectance) * (1 - _dot(half, view)) ** 5
            # Light on matt paint of albedo 1 leaves it as light / pi, which counts as light.
            return 1.0, np.pi * facets * fresnel * masking / (4 * lit * seen)

        return paint

    return make


@pytest.fixture(scope="session")
def rough() -> Callable[[float], Callable[..., Any]]:
    """Paint of Oren and Nayar's qualitative model, in angles as they wrote it: sigma, rad."""

    def make(sigma: float) -> Callable[..., Any]:
        def paint(normals: Array, light: Array, view: Array) -> tuple[Array, Array]:
            angles = [np.arccos(np.clip(_dot(normals, one), -1, 1)) for one in (light, view)]
            flat = [one - _dot(normals, one)[..., None] * normals for one in (light, view)]
            sizes = np.maximum(np.linalg.norm(flat[0], axis=-1) * np.linalg.norm(flat[1], axis=-1), 1e-12)
            azimuth = _dot(*flat) / sizes
            a = 1 - 0.5 * sigma**2 / (sigma**2 + 0.33)
            b = 0.45 * sigma**2 / (sigma**2 + 0.09)
            steep, shallow = np.maximum(*angles), np.minimum(*angles)
            body = a + b * np.maximum(azimuth, 0) * np.sin(steep) * np.tan(shallow)
            return body, np.zeros_like(body)

        return paint

    return make


@pytest.fixture(scope="session")
def matt(simulated, calibrated) -> tuple[Capture, Calibrated]:
    """The sound painting, and its calibration."""
    capture = simulated()
    return capture, calibrated(capture)


@pytest.fixture(scope="session")
def varnished(simulated, calibrated) -> tuple[Capture, Calibrated]:
    """The varnished painting of the simulator (Blinn and Phong), and its calibration."""
    capture = simulated(varnish=True)
    return capture, calibrated(capture)


@pytest.fixture
def without_calibration() -> Recipe:
    """The default recipe with `calibration: none`, near light in two passes."""
    return load_recipe(
        {**load_recipe("default").record(), "calibration": "none", "passes": 2, "name": "none"}
    )
