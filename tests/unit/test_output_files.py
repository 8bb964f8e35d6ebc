"""A file for a user is there whole or not at all, whatever ends its writing."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from eventsrc.base.errors import MapfoldError, MisuseError
from eventsrc.base.user_files import write_files, written_whole

LIMITED = """
import resource, sys
from pathlib import Path
from eventsrc.base.errors import MapfoldError
from eventsrc.base.user_files import write_files

resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
folder = Path(sys.argv[1])
try:
    write_files({folder / "a": b"new", folder / "b": b"x" * 5000, folder / "c": b"new"})
except MapfoldError as error:
    print(error.exit_code, error)
"""
KILLED = """
import os, sys
from pathlib import Path
from eventsrc.base.user_files import written_whole

with written_whole(Path(sys.argv[1])) as file:
    file.write(b"half of it")
    print("written", flush=True)
    sys.stdin.read()
"""


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_it_replaces_a_file_and_keeps_its_permissions_and_links(tmp_path: Path) -> None:
    (tmp_path / "old").write_bytes(b"old")
    (tmp_path / "old").chmod(0o640)
    (tmp_path / "link").symlink_to("old")
    write_files({tmp_path / "link": b"new", tmp_path / "sub/new": b""})
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "old").read_bytes() == b"new"
    assert (tmp_path / "old").stat().st_mode & 0o777 == 0o640
    assert names(tmp_path) == {"old", "link", "sub"}
    assert names(tmp_path / "sub") == {"new"}


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit, ValueError, OSError])
def test_an_exception_leaves_what_was_there(tmp_path: Path, error: type[BaseException]) -> None:
    path = tmp_path / ("é" * 127)  # as long as a name may be
    path.write_bytes(b"old")
    with pytest.raises(error), written_whole(path) as file:  # noqa: PT012
        file.write(b"half")
        assert len(names(tmp_path)) == 2
        raise error
    assert path.read_bytes() == b"old"
    assert names(tmp_path) == {path.name}


def test_a_full_disk_leaves_all_files_as_they_were(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"old")
    (tmp_path / "b").write_bytes(b"old")
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, tmp_path], capture_output=True, text=True, check=True
    )
    assert done.stdout == (
        f"1 {tmp_path}/b: could not be written: File too large; a file that was there before is"
        " unchanged; free space there and run this again\n"
    )
    assert names(tmp_path) == {"a", "b"}
    assert {path.read_bytes() for path in tmp_path.iterdir()} == {b"old"}


def test_a_kill_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"old")
    with subprocess.Popen(
        [sys.executable, "-c", KILLED, path], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"written\n"
        process.send_signal(signal.SIGKILL)
    assert path.read_bytes() == b"old"
    write_files({path: b"new"})
    assert path.read_bytes() == b"new"


def test_a_pipe_and_an_open_file_are_written_to_in_place(tmp_path: Path) -> None:
    reading, writing = os.pipe()
    write_files({Path(f"/dev/fd/{writing}"): b"through a pipe"})
    os.close(writing)
    with open(reading, "rb") as pipe:  # noqa: PTH123
        assert pipe.read() == b"through a pipe"
    with (tmp_path / "redirected").open("wb") as file:
        inode = os.fstat(file.fileno()).st_ino
        write_files({Path(f"/dev/fd/{file.fileno()}"): b"into a file"})
    assert (tmp_path / "redirected").read_bytes() == b"into a file"
    assert (tmp_path / "redirected").stat().st_ino == inode
    with pytest.raises(MapfoldError, match="/dev/full: could not be written: No space left"):
        write_files({Path("/dev/full"): b"x"})


def test_where_no_file_can_be_is_misuse(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for path, reason in (
        (tmp_path, "Is a directory"),
        (tmp_path / "file/x", "File exists"),
        (tmp_path / ("x" * 256), "File name too long"),
    ):
        with pytest.raises(MisuseError, match=f"cannot be written: {reason}; choose another"):
            write_files({path: b""})
    assert names(tmp_path) == {"file"}
