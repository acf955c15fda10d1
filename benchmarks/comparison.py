"""Makes the figures of docs/comparison.md: one simulated painting, four recipes, two of them also without refinement.

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
from nlights_core.recipe import Recipe, load_recipe
from nlights_core.simulation.captures import simulate
from nlights_core.simulation.evaluation import evaluate
from nlights_flows.tiles.run_options import RunOptions
from nlights_flows.tiles.running import run_directly

PLACE = Path(__file__).parents[1] / "docs" / "comparison"
RECIPES = ("default", "paper", "paper-compensated", "psbox")
REFINED = ("paper", "paper-compensated")
"""Measured once more without the refinement of the lamps, for the table only."""
HEADING = (
    "| recipe | normals mean, median, degrees (S) | covered, % "
    "| height rms, median, largest, mm (S) | covered, % | known, % |\n"
    "|---|---|---|---|---|---|"
)


def heights(found: dict[str, Array], width_mm: float) -> Figure:
    """Heights of the truth and of every recipe, each with its own colour bar."""
    figure = Figure(figsize=(11, 10.4), layout="constrained")
    FigureCanvasAgg(figure)
    places = figure.subplots(3, 2).flat
    places[len(found)].set_axis_off()
    for axes, (name, height) in zip(places, found.items(), strict=False):
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
    for (name, height), style in zip(found.items(), ("k-", "C0--", "C2-", "C4-", "C3-"), strict=True):
        row = height[height.shape[0] // 2]
        axes.plot(np.linspace(-0.5, 0.5, row.size) * width_mm, row - np.nanmedian(row), style, label=name)
    axes.set(xlabel="x in mm, along the middle row", ylabel="height in mm")
    axes.grid(alpha=0.3)
    axes.legend()
    return figure


def without_refinement(name: str) -> Recipe:
    """A recipe whose lamps are taken as they were measured."""
    recipe = load_recipe(name)
    lamps = recipe.light_model.model_copy(update={"refine": False})
    return recipe.model_copy(update={"name": f"{name} without refinement", "light_model": lamps})


def row(name: str, products: Path, truth: Path) -> str:
    """A row of the table: `evaluate`'s numbers, and the median size of the height's deviation."""
    error = evaluate(products, truth)
    height = tifffile.imread(products / "height.tif").astype(float) - tifffile.imread(truth / "height.tif")
    median = np.nanmedian(np.abs(height - np.nanmean(height)))
    return (
        f"| {name} | {error['angle_mean_deg']:.3f}, {error['angle_median_deg']:.3f} | "
        f"{_percent(error['normals_coverage'])} | {error['height_rms_mm']:.3f}, {median:.3f}, "
        f"{error['height_max_mm']:.3f} | {_percent(error['height_coverage'])} | {100 * error['known_share']:.1f} |"
    )


def _percent(share: float) -> str:
    """A share in whole per cent; what no product states was not measured."""
    return "not stated" if np.isnan(share) else f"{100 * share:.0f}"


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
        print(HEADING)
        for name in RECIPES:
            variants = {f"`{name}`": load_recipe(name)}
            if name in REFINED:
                variants[f"`{name}`, lamps not refined"] = without_refinement(name)
            for title, recipe in variants.items():
                tile = load_capture(capture)[0]
                options = RunOptions(out=place / recipe.name, store=place / "store")
                outcome = run_directly(tile, recipe, options, lambda *_: None)
                assert outcome.folder is not None, outcome.message
                found.setdefault(name, tifffile.imread(outcome.folder / "height.tif"))
                print(row(title, outcome.folder, capture / "truth"), flush=True)
    heights(found, 500.0).savefig(PLACE / "heights.png", dpi=80, metadata={"Software": None})
    profile(found, 500.0).savefig(PLACE / "profile.png", dpi=80, metadata={"Software": None})


if __name__ == "__main__":
    main()
