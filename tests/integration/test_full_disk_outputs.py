"""Every command that writes a file, on a full disk: exit 1 in one line, and the old file stays.

RLIMIT_FSIZE makes writes fail in the middle, as a full disk does; a small file system in memory
is a full disk, where this user may mount one.
"""

import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.commands import PROGRAM, Commands
from tests.support.envelopes import detection, envelope
from tests.support.logs import write_log
from tests.support.thorough import mostly_slow

LIMITED = 'ulimit -f 1; exec "$0" "$@"'
COMMANDS = {
    "--csv": ("export", "log", "--csv", "out"),
    "--rerun": ("export", "log", "--rerun", "out/m.rrd"),
    "--foxglove": ("export", "log", "--foxglove", "out/m.mcap"),
    "--geojson": ("export", "log", "--geojson", "out/m.json"),
    "--layout": ("foxglove", "log", "--layout", "out/layout.json"),
    "draw png": ("draw", "log", "--out", "out/m.png"),
    "draw pdf": ("draw", "log", "--out", "out/m.pdf"),
    "whatif": ("whatif", "log", "--set", "eps_m=1", "--picture", "out/m.svg"),
    "simulate": ("simulate", "--out", "out/run.jsonl"),
}
OLD = b"what was there before\n"


@pytest.fixture
def mapfold(tmp_path: Path) -> Commands:
    frames = [
        envelope(k, 0.3 * (k % 7), 0.2 * (k // 7), detections=[detection(f"cup {k}", [1.0, k])])
        for k in range(60)
    ]
    write_log(tmp_path / "log", frames)
    return Commands.in_folder(tmp_path)


def written_on_full_disk(mapfold: Commands, arguments: tuple[str, ...]) -> str:
    """Runs the command with as little space as ``LIMITED`` leaves; what it says."""
    done = subprocess.run(
        ["bash", "-c", LIMITED, PROGRAM, *arguments],
        env=mapfold.env,
        cwd=mapfold.folder,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 1, done.stderr
    return done.stderr


@pytest.mark.seconds
@pytest.mark.parametrize("name", mostly_slow([*COMMANDS]))
def test_a_limit_of_size(mapfold: Commands, name: str) -> None:
    arguments, out = COMMANDS[name], mapfold.folder / "out"
    out.mkdir()
    if name not in ("--csv", "simulate"):
        (mapfold.folder / arguments[-1]).write_bytes(OLD)
    said = written_on_full_disk(mapfold, arguments)
    failure = [line for line in said.splitlines() if "could not be written" in line]
    assert [line for line in failure if line.endswith("free space there and run this again")]
    assert len(failure) == 1, said
    assert "Traceback" not in said
    for path in out.iterdir():
        assert path.read_bytes() == OLD


@pytest.fixture
def small_disk(mapfold: Commands) -> Iterator[Path]:
    """A file system of 64 KiB."""
    folder = mapfold.folder / "out"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(folder)]
    try:
        done = subprocess.run(mount, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        pytest.skip("no mount command")
    if done.returncode:
        pytest.skip(f"no file system can be mounted: {done.stderr.strip()}")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in COMMANDS if name != "--layout"])
def test_a_full_file_system(mapfold: Commands, small_disk: Path, name: str) -> None:
    fill = small_disk / "fill"
    with fill.open("wb", buffering=0) as file:
        file.write(b"\0" * (56 * 1024))
    said = mapfold(*COMMANDS[name], code=1).err
    assert said.count("could not be written: No space left on device") == 1, said
    assert {path.name for path in small_disk.iterdir()} == {"fill"}
