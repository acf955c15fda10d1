"""Nothing that only some systems have is needed to import nLights."""

import subprocess
import sys

CODE = """
import importlib, os, pkgutil, signal, sys
for name in ("resource", "fcntl", "pwd", "grp", "termios"):
    sys.modules[name] = None  # as on Windows: an import is an error
for name in ("SIGKILL", "SIGUSR1", "SIGUSR2", "SIGHUP", "SIGPIPE"):
    delattr(signal, name)
for name in ("killpg", "getuid", "sched_getaffinity", "sysconf", "posix_fadvise"):
    delattr(os, name)
count = 0
for top in ("nlights_core", "nlights_plugins", "nlights_flows"):
    for module in pkgutil.walk_packages(importlib.import_module(top).__path__, f"{top}."):
        if module.name.startswith("nlights_core.configs"):
            continue
        text = importlib.util.find_spec(module.name).loader.get_source(module.name)
        if "import prefect" in text or "from prefect" in text or "nlights_flows.tiles.digitise" in text:
            continue  # Prefect is for servers
        importlib.import_module(module.name)
        count += 1
from nlights_core.memory import budget
from nlights_core.machine.band_threads import cores
assert budget() > 0 and cores() > 0
print(count)
"""


def test_all_modules_can_be_imported_without_what_windows_lacks():
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 120
