"""Accuracy on simulated captures with one trouble each, and how far the stated uncertainties cover it."""

from __future__ import annotations

import json
import tempfile
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tifffile
from glossy_paint import Gloss, Paint
from tables import Cell, Table
from troubled_captures import Trouble, simulate_troubled

from nlights_core.capture_warnings import read_warnings
from nlights_core.configurations import load_stand
from nlights_core.manifest import load_capture
from nlights_core.recipe import Recipe, load_recipe
from nlights_core.simulation.evaluation import evaluate
from nlights_flows.tiles.run_options import RunOptions
from nlights_flows.tiles.running import run_directly

KEPT = Path("accuracy-captures.jsonl")
"""Figures of each capture, written as it ends, in the current folder.  A run that was cut off goes on from there;
delete the file to measure anew, as after a change of the code."""
WORKERS = 2
"""Captures measured at a time."""
SCENES = (
    ("painting", "horizontal"),
    ("drawing", "vertical-dark"),
    ("relief", "horizontal"),
    ("painting", "vertical-dark"),
)
"""Scene and stand of a seed for the coverage: the remainder of the seed by 4 chooses."""
SEEDS = range(121, 141)
"""Of the coverage; the first eight were seen before the factor of caution was chosen, the others were not."""
Figures = dict[str, Any]


class Case(NamedTuple):
    """A trouble, and how it is met."""

    title: str
    trouble: Trouble
    stand: str = "horizontal"
    align: bool = False


class Capture(NamedTuple):
    """What is simulated and with which recipe it is digitised: ``default``, ``aligned`` or ``without``."""

    case: Case
    scene: str
    stand: str
    width: int
    seed: int
    recipe: str

    def key(self) -> str:
        """What it is called among the kept figures; another trouble of the same title has another key."""
        return repr(self)


def painted(lobe: str, reflectance: float, roughness: float) -> Trouble:
    """A glossy artwork."""
    return Trouble(paint=Paint(Gloss(lobe, reflectance, roughness)))


MATT = Case("none: matt", Trouble())
VARNISH = Paint(Gloss("ggx", 0.04, 0.35))
# A drift that mostly looks like a tilt of the artwork under eight lamps, which is the hardest to find.
LIKE_A_TILT = (0.9924, 0.9736, 1.0081, 1.0182, 1.004, 0.997, 1.002, 0.998)
TROUBLES = (
    MATT,
    Case("varnish, F0 0.04, alpha 0.35 (GGX)", Trouble(paint=VARNISH)),
    Case("satin, alpha 0.6", painted("ggx", 0.04, 0.6)),
    Case("gloss of Ward, F0 0.04, alpha 0.35", painted("ward", 0.04, 0.35)),
    Case("gloss of Beckmann", painted("beckmann", 0.04, 0.35)),
    Case("gloss of Blinn", painted("blinn", 0.04, 0.35)),
    Case("rough paint (Oren and Nayar, 0.5)", Trouble(paint=Paint(spread_rad=0.5))),
    Case("varnish, and one lamp missing", Trouble(paint=VARNISH, missing=True)),
    Case("3 % of light that the dark frame lacks", Trouble(additive=0.03)),
    Case("2 % of light of the room", Trouble(room=0.02)),
    Case("glossy flat", Trouble(flat_paint=Paint(Gloss("ggx", 0.04, 0.36)))),
    Case("lamps drifted by 2 %", Trouble(drift=0.02)),
    Case(
        "lamps drifted as if the artwork were tilted (vertical stand)",
        Trouble(factors=LIKE_A_TILT),
        "vertical-dark",
    ),
    Case("one lamp 15 % brighter than when the flats were taken", Trouble(brighter=1.15)),
    Case("canvas 10 mm above the flats", Trouble(level_mm=10)),
    Case("canvas 20 mm above the flats", Trouble(level_mm=20)),
    Case("gold leaf on a quarter (the height of the paint)", Trouble(gilded=0.25)),
    Case("every lamp turned by 0.5 degree since the flats", Trouble(aim_deg=0.5)),
    Case("two photographs exchanged", Trouble(exchanged=True)),
    Case("photographs moved by up to 1 px, with `align: true`", Trouble(moved_px=1), align=True),
    Case("a flat bowed by 0.3 mm", Trouble(flat_sag_mm=0.3)),
)
COVERED = (
    MATT,
    Case("varnish, F0 0.05, alpha 0.3", painted("ggx", 0.05, 0.3)),
    Case("satin, alpha 0.6", painted("ggx", 0.04, 0.6)),
    Case("rough paint (Oren and Nayar, 0.4)", Trouble(paint=Paint(spread_rad=0.4))),
    Case("lamps drifted by 1.5 %", Trouble(drift=0.015)),
    Case("a lamp missing", Trouble(missing=True)),
    Case("1 % of light that the dark frame lacks", Trouble(additive=0.01)),
    Case("flats averaged of 16, as stated", Trouble(averaged_stated=True)),
    Case("photographs moved by up to 0.7 px, `align: true`", Trouble(moved_px=0.7), align=True),
)
TROUBLE_COLUMNS = (
    "trouble",
    "height rms without calibration, mm",
    "with it, mm",
    "heights covered",
    "warned of as",
)
COVERAGE_COLUMNS = (
    "trouble",
    "captures",
    "normals covered",
    "heights covered",
    "least and most of a capture",
    "height rms, median, mm",
    "levels within 2 sigma",
    "confidently wrong",
)


def troubles(quick: bool) -> list[Table]:
    """Table ``troubles``: a painting with one trouble each, without and with the calibration."""
    width, cases = (120, TROUBLES[:2]) if quick else (400, TROUBLES)
    captures = [
        Capture(case, "painting", case.stand, width, 11, recipe)
        for case in cases
        for recipe in ("without", _recipe_of(case))
    ]
    found = figures(captures, quick)
    rows: list[tuple[Cell, ...]] = []
    for case, without, now in zip(cases, found[::2], found[1::2], strict=True):
        codes = ", ".join(f"`{code}`" for code in dict.fromkeys(now["codes"]))
        rows.append(
            (case.title, without["height_rms_mm"], now["height_rms_mm"], now["height_coverage"], codes)
        )
    return [Table("troubles", TROUBLE_COLUMNS, rows)]


def coverage(quick: bool) -> list[Table]:
    """Table ``coverage``: how many of the errors are within their uncertainty, over scenes, stands and seeds."""
    width, seeds, cases = (120, SEEDS[:1], COVERED[:2]) if quick else (360, SEEDS, COVERED)
    captures = [
        Capture(case, *SCENES[seed % len(SCENES)], width, seed, _recipe_of(case))
        for seed in seeds
        for case in cases
    ]
    found = figures(captures, quick)
    # One seed after the other, so that each trouble has every so many-th capture.
    rows = [_pooled(case.title, found[k :: len(cases)]) for k, case in enumerate(cases)]
    return [Table("coverage", COVERAGE_COLUMNS, rows)]


def _recipe_of(case: Case) -> str:
    return "aligned" if case.align else "default"


def _pooled(title: str, found: list[Figures]) -> tuple[Cell, ...]:
    """A row; every pixel counts once."""
    pixels = [one["pixels"] for one in found]
    shares = [one["height_coverage"] for one in found]
    levels = [one["level_error_mm"] / one["level_sd_mm"] for one in found if one["level_sd_mm"]]
    return (
        title,
        str(len(found)),
        float(np.average([one["normals_coverage"] for one in found], weights=pixels)),
        float(np.average(shares, weights=pixels)),
        f"{min(shares):.2f} to {max(shares):.2f}",
        float(np.median([one["height_rms_mm"] for one in found])),
        f"{sum(abs(level) < 2 for level in levels)} of {len(levels)}",
        str(sum(map(confidently_wrong, found))),
    )


def confidently_wrong(found: Figures) -> bool:
    """Whether a capture is wrong and no warning says so.

    Less than half of its normals or heights are within their uncertainty, or its level is beyond 5 of its own.

    Examples
    --------
    >>> found = {"codes": [], "height_coverage": 0.4, "normals_coverage": 0.7, "level_sd_mm": None}
    >>> confidently_wrong(found), confidently_wrong(found | {"codes": ["drift"]})
    (True, False)
    """
    covers = found["normals_coverage"] >= 0.5 and found["height_coverage"] >= 0.5
    level = found["level_sd_mm"] is None or abs(found["level_error_mm"]) <= 5 * found["level_sd_mm"]
    return not found["codes"] and not (covers and level)


def figures(captures: list[Capture], quick: bool) -> list[Figures]:
    """Figures of captures, measured some at a time or as they were kept; see `KEPT`."""
    found = {} if quick else _kept()
    missing = [capture for capture in captures if capture.key() not in found]
    print(
        f"  {len(captures) - len(missing)} captures are kept in {KEPT}, {len(missing)} to measure", flush=True
    )
    # Processes of their own, not forks: a fork of a process whose kernels have threads may hang.
    with ProcessPoolExecutor(WORKERS, get_context("spawn")) as pool:
        for capture, new in zip(missing, pool.map(measured, missing), strict=True):
            found[capture.key()] = new
            said = f"{new['normals_coverage']:.2f} {new['height_coverage']:.2f} {' '.join(new['codes'])}"
            print(f"  {capture.case.title}, seed {capture.seed}, {capture.recipe}:", end=" ")
            print(f"{new['height_rms_mm']:.4f} mm, covered {said}", flush=True)
            if not quick:
                with KEPT.open("a", encoding="utf-8") as file:
                    file.write(json.dumps({"capture": capture.key(), "figures": new}) + "\n")
    return [found[capture.key()] for capture in captures]


def _kept() -> dict[str, Figures]:
    """Figures by their capture's key."""
    lines = KEPT.read_text(encoding="utf-8").splitlines() if KEPT.exists() else []
    return {record["capture"]: record["figures"] for record in map(json.loads, lines)}


def measured(capture: Capture) -> Figures:
    """Simulate and digitise a capture.

    Returns
    -------
    dict
        What `evaluate` measures, and ``pixels`` that the products know; ``level_error_mm``;
        ``level_sd_mm``, None where the level was not measured; ``codes`` of the warnings.
    """
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "capture"
        simulate_troubled(
            folder,
            load_stand(capture.stand),
            scene=capture.scene,
            width=capture.width,
            seed=capture.seed,
            trouble=capture.case.trouble,
        )
        options = RunOptions(store=Path(place) / "store", out=Path(place) / "out")
        outcome = run_directly(load_capture(folder)[0], recipe(capture.recipe), options, lambda *_: None)
        if outcome.folder is None:
            raise SystemExit(f"{capture.case.title}, seed {capture.seed}: {outcome.message}")
        numbers = json.loads((outcome.folder / "quality.json").read_text(encoding="utf-8"))
        deviation = np.asarray(tifffile.imread(outcome.folder / "height.tif"), np.float64)
        deviation = deviation - tifffile.imread(folder / "truth" / "height.tif")
        return {
            **evaluate(outcome.folder, folder / "truth"),
            "pixels": int(np.isfinite(deviation).sum()),
            "level_error_mm": float(np.nanmean(deviation)),
            "level_sd_mm": next(
                (n["value"] for n in numbers if n["name"] == "Uncertainty of the level"), None
            ),
            "codes": [warning.code for warning in read_warnings(outcome.folder)],
        }


def recipe(name: str) -> Recipe:
    """The default recipe; ``aligned``: with shifts; ``without``: no calibration, near light by three passes."""
    default = load_recipe("default")
    assert default.calibration is not None
    changes: dict[str, dict[str, Any]] = {
        "default": {},
        "aligned": {"calibration": default.calibration.model_copy(update={"align": True})},
        "without": {"calibration": None, "passes": 3},
    }
    return default.model_copy(update={"name": name, **changes[name]})
