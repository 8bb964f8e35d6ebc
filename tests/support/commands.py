"""Run ``mapfold`` as a person would: a program of its own, with its own exit code and streams."""

import json
import os
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.support import prefork

PROGRAM = Path(sys.executable).with_name("mapfold")
TIMEOUT_S = 120


@dataclass(frozen=True)
class Said:
    """What a command said: its exit code, stdout for programs, stderr for people."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        """Stdout as one JSON document."""
        return json.loads(self.out)

    @property
    def lines(self) -> list[Any]:
        """Stdout as JSON lines."""
        return [json.loads(line) for line in self.out.splitlines()]


@dataclass(frozen=True)
class Commands:
    """Runs commands in one folder, whose ``.mapfold`` holds the embedded server."""

    folder: Path
    env: Mapping[str, str]

    @classmethod
    def in_folder(cls, folder: Path, **env: str) -> "Commands":
        """Commands that see no database of the caller's."""
        clean = {k: v for k, v in os.environ.items() if not k.startswith("MAPFOLD_")}
        clean |= {"MAPFOLD_HOME": str(folder / "home"), "COLUMNS": "100", **env}
        return cls(folder, clean)

    @property
    def home(self) -> Path:
        """The home of the embedded server."""
        return Path(self.env["MAPFOLD_HOME"])

    def start(
        self, *args: str | Path, stdout: int | None = None, stderr: int | None = None
    ) -> prefork.Process:
        """Start ``mapfold *args`` with these file descriptors, or nothing, for its streams."""
        return prefork.start(
            prefork.MAPFOLD,
            [str(PROGRAM), *map(str, args)],
            env=self.env,
            cwd=self.folder,
            stdout=stdout,
            stderr=stderr,
        )

    def seconds(self, *args: str | Path) -> float:
        """How long ``mapfold *args`` takes here and now."""
        started = time.monotonic()
        self(*args)
        return time.monotonic() - started

    def __call__(self, *args: str | Path, stdin: bytes | None = None, code: int | None = 0) -> Said:
        """Run ``mapfold *args``; with ``code`` given, anything else it exits with is a failure."""
        done = prefork.run(
            prefork.MAPFOLD,
            [str(PROGRAM), *map(str, args)],
            env=self.env,
            cwd=self.folder,
            stdin=stdin,
            timeout=TIMEOUT_S,
        )
        said = Said(done.returncode, done.stdout.decode(), done.stderr.decode())
        assert "Traceback" not in said.err, said.err
        assert code is None or said.code == code, f"exit {said.code}: {said.err or said.out}"
        return said
