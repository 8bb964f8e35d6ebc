"""Messages of `mapfold import`: rejections with their place, progress of an interrupted import."""

import codecs
import signal
import subprocess
from pathlib import Path

import pytest

from eventsrc.log import LogWriter
from eventsrc.record.importers.known_log import ImportReport
from eventsrc.record.importers.run import ImportInterrupted, import_files
from projections.surfaces.cli.signals import ctrl_c_between_steps
from tests.support.commands import PROGRAM, TIMEOUT_S, Commands
from tests.support.envelopes import envelope, payload
from tests.support.fixtures_log import read_log


def _lines(first: int, count: int) -> list[bytes]:
    return [payload(envelope(k)) for k in range(first, first + count)]


def test_rejections_are_printed_with_file_line_and_reason_and_the_rest_counted(
    mapfold: Commands,
) -> None:
    (mapfold.folder / "a.jsonl").write_bytes(b"\n".join([*_lines(0, 2), b"", b"junk", b"[1]"]))
    (mapfold.folder / "b.jsonl").write_bytes(b"{}\n" * 8)
    said = mapfold("import", "L", "a.jsonl", "b.jsonl", code=3).err.splitlines()
    assert said[0].startswith("a.jsonl: line 4: rejected: not JSON: ")
    assert said[1] == "a.jsonl: line 5: rejected: not a JSON object but list"
    assert [line.partition(": rejected: ")[0] for line in said[2:5]] == [
        f"b.jsonl: line {n}" for n in (1, 2, 3)
    ]
    assert said[5] == "… and 5 more rejected"
    assert said[6].startswith("L: a new log of --preset classic; with --preset full places are")
    assert said[7].startswith("imported 2 envelopes into L, offsets 0 to 11, 10 rejected; ")
    assert len(said) == 8
    said = mapfold("import", "again", "-", stdin=b"\njunk", code=3).err.splitlines()
    assert said[0].startswith("standard input: line 2: rejected: not JSON")
    assert len(said) == 3


def test_a_byte_order_mark_at_the_start_of_a_file_is_passed_over(mapfold: Commands) -> None:
    lines = b"\n".join(_lines(0, 2))
    (mapfold.folder / "a.jsonl").write_bytes(codecs.BOM_UTF8 + lines)
    mapfold("import", "L", "a.jsonl")
    assert [event.payload for event in read_log(mapfold.folder / "L")] == _lines(0, 2)


def test_log_cat_shows_the_whole_reason_of_a_rejection(mapfold: Commands) -> None:
    broken = payload(envelope(0, timestamp="k" * 90))
    (mapfold.folder / "a.jsonl").write_bytes(broken)
    said = mapfold("import", "L", "a.jsonl", code=3).err
    reason = said.splitlines()[0].partition("line 1: rejected: ")[2]
    assert len(reason) > 100
    shown = mapfold("log", "cat", "L", "--key", "mapfold/rejected").out.rstrip("\n")
    assert shown.endswith(f"  tb/detections, {len(broken)} bytes: {reason}")


def test_ctrl_c_prints_what_is_kept_and_its_last_place(mapfold: Commands) -> None:
    program = subprocess.Popen(
        [PROGRAM, "import", "L", "-"],
        cwd=mapfold.folder,
        env=dict(mapfold.env),
        stdin=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    assert program.stdin is not None
    assert program.stderr is not None
    program.stdin.write(b"\n".join([*_lines(0, 3), b"", b"junk", b"the next line is under way"]))
    program.stdin.flush()
    assert b"line 5: rejected" in program.stderr.readline()  # so the lines before it are in
    program.send_signal(signal.SIGINT)
    _, said = program.communicate(timeout=TIMEOUT_S)
    assert program.returncode == 130
    kept, ended = said.decode().splitlines()
    assert kept == (
        "L: kept 4 events, offsets 0 to 3, up to line 5 of standard input; "
        "import it again to go on: what is in the log is passed over"
    )
    assert ended == "mapfold: interrupted"
    assert len(read_log(mapfold.folder / "L")) == 4


def test_an_interruption_is_exact_also_within_a_message(tmp_path: Path) -> None:
    """Ctrl-C comes while a message that is refused is being appended."""
    files = [str(tmp_path / name) for name in ("a.jsonl", "b.jsonl")]
    Path(files[0]).write_bytes(b"\n".join(_lines(0, 100)))
    Path(files[1]).write_bytes(b"\n".join([*_lines(100, 64), b"junk", *_lines(164, 9)]))

    def interrupt(_place: str, _reason: str) -> None:
        signal.raise_signal(signal.SIGINT)

    with LogWriter(tmp_path / "L") as writer:
        with pytest.raises(ImportInterrupted) as caught, ctrl_c_between_steps() as step:
            import_files(writer, files, on_reject=interrupt, step=step)
        assert writer.durable_offset == 165
    assert caught.value.place == f"line 65 of {files[1]}"
    assert caught.value.report == ImportReport(164, 1, 0, 0, 0, 165)
    assert len(read_log(tmp_path / "L")) == 165


def test_a_key_that_nothing_can_be_published_under_is_misuse(mapfold: Commands) -> None:
    said = mapfold("import", "L", "-", "--key", "a b/*", stdin=b"", code=2)
    assert said.err.startswith("mapfold: --key 'a b/*': ")
    assert not (mapfold.folder / "L").exists()
