"""Integrators that break what they can, unless a file "behave" lies in the folder they work in."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from nlights_core.algorithms import Integrator
from nlights_core.fields import HeightMap
from nlights_core.registry import hookimpl
from nlights_plugins.integrators import Simchony


class Rascal(Integrator):
    def integrate(self, normals):
        good = Simchony().integrate(normals)
        if Path("behave").exists():
            return good
        return HeightMap(np.asarray(self.spoil(normals.normals, good.height), np.float32), normals.grid)


class Hangs(Rascal):
    name = "hangs"

    def spoil(self, normals, height):
        print("this must not be taken for an answer")
        child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
        Path("child.pid").write_text(str(child.pid))
        while True:
            time.sleep(1)


class Crashes(Rascal):
    name = "crashes"

    def spoil(self, normals, height):
        os.kill(os.getpid(), signal.SIGSEGV)


class Leaves(Rascal):
    name = "leaves"

    def spoil(self, normals, height):
        os._exit(3)


class Hoards(Rascal):
    name = "hoards"

    def spoil(self, normals, height):
        return np.ones(1 << 40)


class Raises(Rascal):
    name = "raises"

    def spoil(self, normals, height):
        return height / {}["missing"]


class Scribbles(Rascal):
    name = "scribbles"

    def spoil(self, normals, height):
        normals[0] = 0
        return height


class Peeks(Rascal):
    name = "peeks"

    def spoil(self, normals, height):
        Path("environment.txt").write_text("\n".join(f"{name}={value}" for name, value in os.environ.items()))
        return height


class Microns(Rascal):
    name = "microns"

    def spoil(self, normals, height):
        return 1000 * height


@hookimpl
def nlights_algorithms():
    return [Hangs, Crashes, Leaves, Hoards, Raises, Scribbles, Peeks, Microns]
