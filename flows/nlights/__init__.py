"""nLights from Python: photographs in, measured surfaces out, as arrays with a grid and a unit.

    import nlights
    tile, = nlights.digitise("capture", out="products")
    tile.height

Every name is loaded when it is first asked for, so that ``import nlights`` costs nothing, and a plugin that imports
its kind from here loads no more than that.  See docs/python.md.
"""

from __future__ import annotations

from importlib import import_module as _import_module
from typing import TYPE_CHECKING
from typing import Any as _Any

from nlights_core import __version__ as __version__

if TYPE_CHECKING:
    from nlights.arrays import Solved as Solved
    from nlights.arrays import integrate as integrate
    from nlights.arrays import solve as solve
    from nlights.comparisons import ComparisonResult as ComparisonResult
    from nlights.comparisons import compare as compare
    from nlights.maps import Map as Map
    from nlights.tiles import TileResult as TileResult
    from nlights.tiles import digitise as digitise
    from nlights.tiles import open as open
    from nlights_core.algorithms import PHOTONS as PHOTONS
    from nlights_core.algorithms import HeightDetrend as HeightDetrend
    from nlights_core.algorithms import ImageDetrend as ImageDetrend
    from nlights_core.algorithms import Integrator as Integrator
    from nlights_core.algorithms import LightModel as LightModel
    from nlights_core.algorithms import NormalDetrend as NormalDetrend
    from nlights_core.algorithms import NormalSolver as NormalSolver
    from nlights_core.algorithms import Read as Read
    from nlights_core.algorithms import Solution as Solution
    from nlights_core.capture import Tile as Tile
    from nlights_core.configurations import load_stand as load_stand
    from nlights_core.errors import CaptureError as CaptureError
    from nlights_core.errors import NlightsError as NlightsError
    from nlights_core.errors import PluginError as PluginError
    from nlights_core.errors import RecipeError as RecipeError
    from nlights_core.errors import StandError as StandError
    from nlights_core.errors import TileError as TileError
    from nlights_core.fields import HeightMap as HeightMap
    from nlights_core.fields import LightField as LightField
    from nlights_core.fields import NormalField as NormalField
    from nlights_core.frames import Array as Array
    from nlights_core.frames import PixelGrid as PixelGrid
    from nlights_core.manifest import load_capture as load_capture
    from nlights_core.recipe import Recipe as Recipe
    from nlights_core.recipe import load_recipe as load_recipe
    from nlights_core.registry import hookimpl as hookimpl
    from nlights_core.report.figures import Number as Number
    from nlights_core.simulation.captures import simulate as simulate
    from nlights_core.stands import Stand as Stand

_HOMES = {
    "nlights.arrays": "Solved integrate solve",
    "nlights.comparisons": "ComparisonResult compare",
    "nlights.maps": "Map",
    "nlights.tiles": "TileResult digitise open",
    "nlights_core.algorithms": "PHOTONS HeightDetrend ImageDetrend Integrator LightModel NormalDetrend NormalSolver "
    "Read Solution",
    "nlights_core.capture": "Tile",
    "nlights_core.configurations": "load_stand",
    "nlights_core.errors": "CaptureError NlightsError PluginError RecipeError StandError TileError",
    "nlights_core.fields": "HeightMap LightField NormalField",
    "nlights_core.frames": "Array PixelGrid",
    "nlights_core.manifest": "load_capture",
    "nlights_core.recipe": "Recipe load_recipe",
    "nlights_core.registry": "hookimpl",
    "nlights_core.report.figures": "Number",
    "nlights_core.simulation.captures": "simulate",
    "nlights_core.stands": "Stand",
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names.split()}

if not TYPE_CHECKING:  # a type checker would take every misspelt name for one that is found here

    def __getattr__(name: str) -> _Any:
        """Load a public name when it is first asked for."""
        if name not in _HOME_OF:
            raise AttributeError(f"module 'nlights' has no attribute '{name}'; see dir(nlights)")
        value = globals()[name] = getattr(_import_module(_HOME_OF[name]), name)
        return value


def __dir__() -> list[str]:
    """The public names, loaded or not."""
    return sorted([*_HOME_OF, "__version__", "__doc__", "__name__", "__file__", "__path__"])
