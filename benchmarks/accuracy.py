"""Measures the accuracy of all installed normal solvers and integrators, and writes docs/accuracy.md.

Run: python benchmarks/accuracy.py [--quick] [--only SECTION] [--out FOLDER]
"""

import argparse
import platform
from pathlib import Path

import numpy as np
import scipy
from accuracy_integration import depths, surfaces
from accuracy_photographs import diligent, strengths
from accuracy_simulations import simulations
from accuracy_troubles import coverage, troubles
from tables import write

import nlights_core

DOCS = Path(__file__).parents[1] / "docs"
SECTIONS = {
    "simulations": simulations,
    "troubles": troubles,
    "coverage": coverage,
    "diligent": diligent,
    "strengths": strengths,
    "surfaces": surfaces,
    "depths": depths,
}
"""What can be run by itself; each makes its tables, or none where its data are absent."""


def main() -> None:
    """Run the sections one after another; each writes its tables as soon as it has them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one seed, small photographs, one object")
    parser.add_argument("--only", choices=SECTIONS, help="run this section and leave the other tables")
    parser.add_argument(
        "--out", type=Path, help="folder of accuracy.md and accuracy.json; docs, unless --quick is given"
    )
    wanted = parser.parse_args()
    out = wanted.out or (Path("accuracy-quick") if wanted.quick else DOCS)
    conditions = {
        "nlights": nlights_core.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
        "quick": wanted.quick,
        "scipy": scipy.__version__,
    }
    for name, section in SECTIONS.items():
        if wanted.only in (None, name):
            print(f"{name}:", flush=True)
            found = section(wanted.quick)
            write(out, "accuracy", found, conditions)
            for table in found:
                print(f"\n{table.markdown()}", flush=True)
    print(f"{out / 'accuracy.md'}, {out / 'accuracy.json'}")


if __name__ == "__main__":
    main()
