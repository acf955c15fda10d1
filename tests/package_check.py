"""Builds the wheel and uses it in a clean environment, as somebody else would install it."""

import os
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

ROOT = Path(__file__).parent.parent


def run(*words: object, cwd: Path | None = None) -> str:
    """Run a command; show what it printed when it fails."""
    done = subprocess.run([str(word) for word in words], cwd=cwd, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{' '.join(map(str, words))}\n{done.stdout}\n{done.stderr}")
    return done.stdout


def main() -> None:
    """Build, install, list the plugins, load what is shipped, digitise small captures, also from Python."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        run(sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", place, ROOT)
        wheel = next(place.glob("*.whl"))
        environment = place / "environment"
        venv.create(environment, with_pip=True)
        python = environment / ("Scripts" if os.name == "nt" else "bin") / "python"
        constraints = ROOT / "constraints.txt"
        run(python, "-m", "pip", "install", "-q", "-c", constraints, wheel, ROOT / "tests" / "example_plugin")
        nlights = python.parent / "nlights"
        listed = run(nlights, "plugins", cwd=place)
        for word in ("simchony", "cosine-basis"):
            if word not in listed:
                sys.exit(f"{word} is not listed by the installed package:\n{listed}")
        script = (
            "from nlights_core.configurations import load_stand, shipped_names\n"
            "from nlights_core.recipe import load_recipe\n"
            "names = shipped_names('recipes'), shipped_names('stands')\n"
            "assert all(names), names\n"
            "[load_recipe(name) for name in names[0]]; [load_stand(name) for name in names[1]]\n"
            "print('recipes:', *names[0], '; stands:', *names[1])\n"
        )
        print(run(python, "-c", script, cwd=place), end="")
        run(nlights, "simulate", "capture", "--scene", "plane", "--width", 64, cwd=place)
        print(run(nlights, "digitise", "capture", cwd=place), end="")
        page = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
        first = page.split("```python\n")[1].split("```")[0] + "assert tile.height.std() > 0\n"
        (place / "python").mkdir()
        print("from Python:", run(python, "-c", first, cwd=place / "python"), end="")
        run(python, "-m", "nlights", "--version", cwd=place)
        print(f"{wheel.name}: installs, lists its plugins and loads what it ships")


if __name__ == "__main__":
    main()
