"""The kept history under attack: a full disk, a kill in the middle of writing, many processes at
once, garbage in its folder, and a log that grows while it is read."""

import errno
import os
import shutil
import signal
import subprocess
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest

from eventsrc.base.errors import LogError
from eventsrc.envelope.model import Offset
from eventsrc.log import LogReader
from projections.fold.corrections import NO_CORRECTIONS
from projections.history import LogTimeline
from projections.map.fold import fold_log
from projections.store.history_recorder import map_after
from projections.store.timeline_cache import TimelineCache
from tests.property.test_timeline_cache import kept_early
from tests.support import prefork
from tests.support.envelopes import detection, envelope
from tests.support.histories import RULES, answers, expected, told
from tests.support.thorough import rounds
from tests.support.walks import VECTORS, write_log

EVENTS = 240


def drive(first: int, last: int) -> list[dict[str, Any]]:
    """To and fro along a corridor, seeing cups."""
    return [
        envelope(
            n,
            0.6 * (n * 7 % 31),
            0.1 * (n % 3),
            detections=[detection("cup", VECTORS["cup"], det_id=f"d{n}")] if n % 2 else [],
        )
        for n in range(first, last)
    ]


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return write_log(tmp_path / "log", drive(0, EVENTS))


@pytest.fixture
def right(log: Path) -> str:
    """The answers of the log, without files."""
    with LogTimeline(log, RULES, cache=False) as timeline:
        assert len(timeline.merges()) > 1
    copy = log.with_name("copy")
    copy.symlink_to(log)
    return answers(copy, [])


def kept(log: Path) -> list[Path]:
    return sorted(log.with_name("log.history").glob("*"))


def run(log: Path, *how: str) -> "subprocess.CompletedProcess[bytes]":
    return prefork.run(
        "tests.support.histories:main",
        ["history", str(log), *how],
        env=os.environ,
        cwd=Path.cwd(),
        timeout=60.0,
    )


def test_a_full_disk_costs_the_cache_alone(log: Path, right: str) -> None:
    done = run(log, "full")
    assert done.stdout.decode() == right
    assert "no history was kept: File too large" in done.stderr.decode()
    assert {path.suffix for path in kept(log)} <= {".fold", ".digest"}  # these may be small enough
    assert answers(log, []) == right


def test_a_kill_while_writing_leaves_nothing_that_is_used(log: Path, right: str) -> None:
    for number in (1, 30, 60)[: rounds(3, 1) + 1]:
        assert run(log, "killed", str(number)).returncode == -signal.SIGKILL
        assert [path.suffix for path in kept(log)].count(".npz") == 0
    assert any(path.suffix == ".new" for path in kept(log))
    notes: list[str] = []
    assert answers(log, notes) == right
    assert answers(log, notes) == right
    assert notes == []


@pytest.mark.slow
@pytest.mark.seconds
def test_many_processes_at_once(log: Path, right: str) -> None:
    count = rounds(20, 10)
    with ThreadPoolExecutor(count) as pool:
        for _ in range(rounds(3, 1)):
            done = list(pool.map(lambda _: run(log, "plain"), range(count)))
            assert [(each.returncode, each.stderr, each.stdout.decode()) for each in done] == [
                (0, b"", right)
            ] * count
            files = [path.name.replace(".", "-").split("-") for path in kept(log)]
            parts = sorted((int(f[1]), int(f[2])) for f in files if f[-1] == "npz")
            folds = [int(f[1]) for f in files if f[-1] == "fold"]  # of earlier ends, too
            assert [0, *(end for _, end in parts)] == [*(start for start, _ in parts), max(folds)]
            assert len(parts) + len(folds) == sum(f[-1] != "digest" for f in files)
            write_log(log, drive(EVENTS, EVENTS + 40))
            right = answers(write_log_copy(log), [])


def write_log_copy(log: Path) -> Path:
    """The same log under a name that has no history."""
    number = len(list(log.parent.glob("other*")))
    copy = log.with_name(f"other{number}")
    copy.symlink_to(log)
    return copy


def test_garbage_in_the_folder(log: Path, right: str) -> None:
    assert answers(log, []) == right
    part, fold = (next(p for p in kept(log) if p.suffix == s) for s in (".npz", ".fold"))
    for path in (part, fold):
        path.unlink()
        os.mkfifo(path)
    (part.parent / "notes.txt").write_text("mine")
    (part.parent / part.name.replace("0-", "1-")).mkdir()
    (part.parent / f"{part.stem[:37]}-{'9' * 20}.npz").symlink_to("/dev/zero")
    notes: list[str] = []
    assert answers(log, notes) == right
    assert notes
    assert answers(log, []) == right
    assert (part.parent / "notes.txt").read_text() == "mine"


def test_a_folder_that_cannot_be_made(log: Path, right: str) -> None:
    log.with_name("log.history").write_text("a file")
    notes: list[str] = []
    assert answers(log, notes) == right
    why = "no history was kept: File exists; --no-cache goes without one"
    assert notes == [f"{log}.history: {why}"]


@pytest.mark.parametrize("number", [errno.EMFILE, errno.EACCES, errno.EIO, errno.ENOMEM])
def test_a_part_that_cannot_be_opened_now_stays(log: Path, right: str, number: int) -> None:
    assert answers(log, []) == right
    before = [(path, path.stat().st_ino) for path in kept(log)]
    why = os.strerror(number)
    notes: list[str] = []
    with kept_early(), LogTimeline(log, RULES, note=notes.append) as timeline:
        cache = TimelineCache(timeline.reader, RULES, NO_CORRECTIONS, notes.append)
        with patch("projections.store.timeline_cache.PartFile", side_effect=OSError(number, why)):
            assert not cache.stripes(timeline.end)
        assert [(path, path.stat().st_ino) for path in kept(log)] == before
        assert notes
        assert all(note.endswith(f"is not used: {why}") for note in notes)
        assert cache.stripes(timeline.end)[-1].end == timeline.end


@pytest.mark.slow
def test_a_log_that_grows_while_it_is_looked_at(log: Path) -> None:
    with kept_early(), LogTimeline(log, RULES) as timeline:
        for first in range(EVENTS, EVENTS + rounds(40, 20), 10):
            view = timeline.at(EVENTS // 2)
            write_log(log, drive(first, first + 10))
            timeline.refresh()
            ends = [0, EVENTS // 2, first, first + 10]
            assert told(timeline, ends) == expected(timeline, ends)
            assert view.counts() == timeline.at(EVENTS // 2).counts()


def test_damage_in_the_log_behind_the_events_asked_for(tmp_path: Path) -> None:
    """The last event that is kept has rotted; those before it are read, with the cache as without.
    The kept history is not deleted: the segment may come back from a copy."""
    log = tmp_path / "log"
    for first in (0, 20):
        write_log(log, drive(first, first + 20))
    with kept_early():
        assert answers(log, [])
        write_log(log, drive(40, 43))
        _, rotten, _ = sorted(log.glob("*.mcap"))
        sound = rotten.read_bytes()
        with rotten.open("r+b") as file:
            file.seek(len(sound) // 8)
            file.write(bytes(each ^ 1 for each in sound[len(sound) // 8 :][:30]))
        was, notes = kept(log), list[str]()
        with LogReader(log) as reader:
            view = map_after(
                reader, RULES, Offset(5), corrections=NO_CORRECTIONS, note=notes.append
            )
            assert view.counts() == fold_log(reader, RULES, Offset(5))[1].counts()
        assert ["is not used" in note and "cannot be read" in note for note in notes] == [True]
        assert set(was) <= set(kept(log))


@pytest.mark.slow
def test_histories_are_few_and_small(log: Path) -> None:
    """Four choices of settings are kept: those used last."""
    from projections.store.timeline_cache import MOST_KEPT

    with kept_early():
        for number in range(MOST_KEPT + 3):
            rules = RULES.with_assignments([f"eps_m={0.5 + number / 10}"])
            with LogTimeline(log, rules) as timeline:
                assert timeline.history.keyframes
    assert len({path.name.split("-")[0].split(".")[0] for path in kept(log)}) == MOST_KEPT
    assert len(kept(log)) == 2 * MOST_KEPT


def test_without_a_cache_nothing_is_written(log: Path) -> None:
    with kept_early(), LogTimeline(log, RULES, cache=False) as timeline:
        assert timeline.merges()
    assert kept(log) == []


def test_numpy_reads_a_part(log: Path, right: str) -> None:
    """It is a plain archive of arrays."""
    import numpy as np

    assert answers(log, []) == right
    (part,) = (path for path in kept(log) if path.suffix == ".npz")
    with np.load(part) as archive:
        assert archive["0/keyframe.keyframe_id"].tolist() == list(range(EVENTS))


@pytest.mark.parametrize("cache", [True, pytest.param(False, marks=pytest.mark.slow)])
@pytest.mark.parametrize("change", ["other log", "no log", "no history", "grown"])
def test_an_open_timeline_whose_log_changes(log: Path, change: str, cache: bool) -> None:
    with kept_early(), LogTimeline(log, RULES, cache=cache) as timeline:
        before = told(timeline, [EVENTS, 100])
        if change == "grown":
            write_log(log, drive(EVENTS, EVENTS + 40))
        elif change == "no history":
            shutil.rmtree(log.with_name("log.history"), ignore_errors=True)
        else:
            shutil.rmtree(log)
            if change == "other log":
                write_log(log, drive(7, EVENTS + 80))
        timeline.refresh()
        with LogTimeline(log, RULES, cache=False) if change == "grown" else nullcontext() as fresh:
            expected = before if fresh is None else told(fresh, [EVENTS, 100])
        assert told(timeline, [EVENTS, 100]) == expected


def test_damage_is_not_repaired_from_another_log(log: Path) -> None:
    answers(log, [])
    with kept_early(), LogTimeline(log, RULES) as timeline:
        shown = timeline.at()  # which reads the keyframes later
        for path in (path for path in kept(log) if path.suffix == ".npz"):
            data = path.read_bytes()
            manifest = data.index(b'{"about"')
            with path.open("r+b") as file:  # the same file, as it is mapped
                file.write(bytes(byte ^ 0x55 for byte in data[:manifest]))
        shutil.rmtree(log)
        write_log(log, drive(7, EVENTS + 80))
        with pytest.raises(LogError, match="is another one now or has lost events; open it again"):
            _ = [keyframe.timestamp for keyframe in shown.keyframes]
