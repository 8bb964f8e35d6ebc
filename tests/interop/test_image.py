"""docker/Dockerfile: its style, and its steps in a fresh Debian system.

No base image is fetched: a minimal Debian of the same release, made from Debian's packages, takes
the place of ``FROM``, with a virtual environment where the image has Python.
"""

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
DOCKERFILE = ROOT / "docker" / "Dockerfile"
TRUST = Path("/etc/ssl/certs/ca-certificates.crt")

pytestmark = pytest.mark.slow


def instructions() -> Iterator[tuple[str, str]]:
    """Each instruction of the Dockerfile and its argument, lines joined."""
    text = re.sub(r"^\s*#.*\n", "", DOCKERFILE.read_text("utf-8"), flags=re.MULTILINE)
    for line in text.replace("\\\n", " ").splitlines():
        if line.strip():
            name, _, rest = line.partition(" ")
            yield name, rest.strip()


@dataclass
class System:
    """A system in a folder, changed by instructions as an image is."""

    folder: Path
    user: str = "root"
    work: str = "/"
    variables: dict[str, str] = field(default_factory=dict)
    entrypoint: list[str] = field(default_factory=list)

    def run(self, command: list[str]) -> str:
        """What a command prints that runs in the folder, by the user and with the variables."""
        env = {"PATH": "/opt/python/bin:/usr/sbin:/usr/bin:/sbin:/bin", **self.variables}
        done = subprocess.run(
            ["chroot", f"--userspec={self.user}", self.folder, "/bin/sh", "-c",
             'cd "$0" && exec "$@"', self.work, *command],
            env=env, capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.returncode == 0, f"{command}: {done.stdout}{done.stderr}"
        return done.stdout

    def take(self, name: str, rest: str) -> None:
        """Follow one instruction. KeyError for one that this test does not know."""
        {
            "FROM": lambda: None,
            "VOLUME": lambda: None,
            "CMD": lambda: None,
            "ARG": lambda: self._set(rest),
            "ENV": lambda: self._set(rest),
            "RUN": lambda: self.run(["/bin/sh", "-c", rest]),
            "USER": lambda: setattr(self, "user", rest),
            "WORKDIR": lambda: self._enter(rest),
            "COPY": lambda: self._copy(*rest.split()),
            "ENTRYPOINT": lambda: setattr(self, "entrypoint", json.loads(rest)),
        }[name]()

    def _set(self, assignment: str) -> None:
        name, _, value = assignment.partition("=")
        self.variables[name] = value.strip('"')

    def _enter(self, folder: str) -> None:
        self.work = folder
        self._path(folder).mkdir(parents=True, exist_ok=True)

    def _copy(self, *paths: str) -> None:
        *sources, target = paths
        inside = self._path(str(Path(self.work) / target))
        for source in sources:
            if (ROOT / source).is_dir():
                ignored = shutil.ignore_patterns("__pycache__", "node_modules")
                shutil.copytree(ROOT / source, inside, ignore=ignored, dirs_exist_ok=True)
            else:
                inside.mkdir(parents=True, exist_ok=True)
                shutil.copy(ROOT / source, inside)

    def _path(self, inside: str) -> Path:
        return self.folder / inside.lstrip("/")


def test_hadolint_finds_nothing() -> None:
    hadolint = Path(sys.executable).with_name("hadolint")
    done = subprocess.run([hadolint, DOCKERFILE], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "")


@pytest.mark.timeout(1800)
@pytest.mark.skipif(
    not shutil.which("mmdebstrap") or os.geteuid() != 0,
    reason="making a Debian system needs mmdebstrap and root",
)
def test_its_steps_make_a_working_system(tmp_path: Path) -> None:
    base = dict(instructions())["FROM"]
    folder = tmp_path / "system"
    packages = "--include=python3,python3-venv,ca-certificates"
    subprocess.run(
        ["mmdebstrap", "--variant=minbase", "--quiet", packages, base.rsplit("-", 1)[1], folder],
        check=True,
    )
    system = System(folder)
    if TRUST.exists():  # where the way out has a certificate of its own
        shutil.copy(TRUST, folder / TRUST.relative_to("/"))
        system.variables["PIP_CERT"] = str(TRUST)
    shutil.copy("/etc/resolv.conf", folder / "etc")
    system.run(["python3", "-m", "venv", "/opt/python"])
    for name, rest in instructions():
        system.take(name, rest)
    assert system.user == "10001:10001"
    assert system.run([*system.entrypoint, "--version"]).startswith("mapfold ")
    system.work = "/logs"
    system.variables["HOME"] = "/home/mapfold"
    system.run([*system.entrypoint, "simulate", "--out", "a.jsonl"])
    system.run([*system.entrypoint, "import", "house", "a.jsonl"])
    said = json.loads(system.run([*system.entrypoint, "state", "house", "--json"]))
    assert said["counts"]["keyframes"] == 445
    assert (folder / "logs" / "house").stat().st_uid == 10001
