"""Views: a tile's maps, reduced to the size at which the report shows them."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

from nlights_core.files.reduction import block_means
from nlights_core.frames import Array, PixelGrid
from nlights_core.report import pictures
from nlights_core.report.pictures import Tick


class Views:
    """Reduced views of a tile's maps, and the scale that goes with them."""

    def __init__(self, maps: Mapping[str, Array], grid: PixelGrid) -> None:
        self.maps, self.grid = maps, grid
        self.factor = pictures.view_factor(grid.shape)
        self.rows, self.columns = grid.rows // self.factor, grid.columns // self.factor
        step = self.factor * grid.pixel_size
        self.width, self.tall = self.columns * step, self.rows * step
        self.scale = pictures.scale_bar(self.width, grid.unit)

    def of(self, name: str) -> Array | None:
        """The reduced map, None where there is none."""
        return block_means(self.maps[name], self.factor) if name in self.maps else None

    @cached_property
    def height(self) -> Array | None:
        """The reduced height, None where there is none."""
        return self.of("height")

    @cached_property
    def height_unit(self) -> tuple[float, str]:
        """Factor that heights are multiplied by in this report, and their unit then: µm where the relief is flat."""
        if self.grid.unit == "px":
            return 1.0, "pixels"
        low, high = (0.0, 1.0) if self.height is None else pictures.robust_range(self.height)
        return (1000.0, "µm") if high - low < 1 else (1.0, self.grid.unit)

    def edges(self) -> tuple[tuple[Tick, ...], tuple[Tick, ...]]:
        """Labels along the lower and the left edge of a map, in the plane frame."""
        left = float(self.grid.x()[0]) - self.grid.pixel_size / 2
        top = float(self.grid.y(0, 1)[0]) + self.grid.pixel_size / 2
        return (
            pictures.edge_ticks(left, left + self.width),
            pictures.edge_ticks(top, top - self.tall, max(2, min(5, round(5 * self.tall / self.width)))),
        )
