"""Makes the figures of docs/comparison.md: one simulated painting, three recipes.

Run: python benchmarks/comparison.py [--width N]
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
import tifffile
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from nlights_core.configurations import load_stand
from nlights_core.frames import Array
from nlights_core.manifest import load_capture
from nlights_core.recipe import load_recipe
from nlights_core.simulation.captures import simulate
from nlights_core.simulation.evaluation import evaluate
from nlights_flows.tiles.run_options import RunOptions
from nlights_flows.tiles.running import run_directly

PLACE = Path(__file__).parents[1] / "docs" / "comparison"
RECIPES = ("default", "paper", "psbox")


def heights(found: dict[str, Array], width_mm: float) -> Figure:
    """Heights of the truth and of every recipe, each with its own colour bar."""
    figure = Figure(figsize=(11, 7.2), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, (name, height) in zip(figure.subplots(2, 2).flat, found.items(), strict=True):
        reach = (-width_mm / 2, width_mm / 2, -0.375 * width_mm, 0.375 * width_mm)
        low, high = np.nanpercentile(height, [0.5, 99.5])
        picture = axes.imshow(height, extent=reach, vmin=low, vmax=high, cmap="viridis")
        axes.set(
            title=f"{name}: {np.nanmax(height) - np.nanmin(height):.1f} mm from lowest to highest",
            xlabel="mm",
            ylabel="mm",
        )
        figure.colorbar(picture, ax=axes, label="height in mm", shrink=0.85)
    return figure


def profile(found: dict[str, Array], width_mm: float) -> Figure:
    """The middle row of all heights."""
    figure = Figure(figsize=(11, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for (name, height), style in zip(found.items(), ("k-", "C0--", "C2-", "C3-"), strict=True):
        row = height[height.shape[0] // 2]
        axes.plot(np.linspace(-0.5, 0.5, row.size) * width_mm, row - np.nanmedian(row), style, label=name)
    axes.set(xlabel="x in mm, along the middle row", ylabel="height in mm")
    axes.grid(alpha=0.3)
    axes.legend()
    return figure


def main() -> None:
    """Simulate, digitise with every recipe, write pictures and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--width", type=int, default=1000)
    width = parser.parse_args().width
    PLACE.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        capture = place / "capture"
        simulate(capture, load_stand("horizontal"), scene="painting", width=width, seed=1)
        found = {"truth": tifffile.imread(capture / "truth" / "height.tif")}
        print("| recipe | normals mean, median, degrees | height rms, largest, mm |\n|---|---|---|")
        for name in RECIPES:
            tile = load_capture(capture)[0]
            outcome = run_directly(
                tile, load_recipe(name), RunOptions(out=place / name, store=place / "store"), lambda *_: None
            )
            assert outcome.folder is not None, outcome.message
            found[name] = tifffile.imread(outcome.folder / "height.tif")
            error = evaluate(outcome.folder, capture / "truth")
            print(
                f"| `{name}` | {error['angle_mean_deg']:.3f}, {error['angle_median_deg']:.3f} | "
                f"{error['height_rms_mm']:.3f}, {error['height_max_mm']:.3f} |"
            )
    heights(found, 500.0).savefig(PLACE / "heights.png", dpi=80, metadata={"Software": None})
    profile(found, 500.0).savefig(PLACE / "profile.png", dpi=80, metadata={"Software": None})


if __name__ == "__main__":
    main()
