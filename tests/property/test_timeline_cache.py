"""Every answer of a timeline is that of a fold into memory: with the kept history, without it,
after it was extended at any points, and whatever became of its files."""

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st

from eventsrc.envelope.commands import Command
from eventsrc.log import LogWriter, parse_fsync
from eventsrc.record.append import append_payload
from projections.fold.settings import Settings
from projections.history import LogTimeline
from tests.support.envelopes import envelope, payload
from tests.support.evidence_drives import drives
from tests.support.histories import expected, told
from tests.support.logs import append_to
from tests.support.thorough import examples
from tests.support.walks import corrected_walks, walks

RULES = Settings(eps_m=0.7, min_samples=3, fusion_radius_m=2.0)
EVIDENCE = Settings(fusion="evidence", eps_m=0.7, min_samples=3)
Items = list[dict[str, Any] | Command]


def quick(number: int) -> settings:
    return settings(
        deadline=None,
        max_examples=examples(number),
        suppress_health_check=[HealthCheck.too_slow],
    )


@contextmanager
def kept_early(stripe: int = 7) -> Iterator[None]:
    """Keep the history of a log of any length, in stripes of a few events."""
    store = "projections.store"
    with (
        patch(f"{store}.timeline_cache.MIN_EVENTS", 1),
        patch(f"{store}.tables.STRIPE_EVENTS", stripe),
        patch(f"{store}.history_recorder.STRIPE_EVENTS", 2 * stripe),
        patch(f"{store}.columns.STRIPE_EVENTS", 4 * stripe),
    ):
        yield


def append(log: Path, items: Items) -> None:
    with LogWriter(log, fsync=parse_fsync("never")) as writer:
        for item in items:
            if isinstance(item, dict):
                append_payload(writer, "tb/detections", payload(item))
            else:
                append_to(writer, item)


@contextmanager
def empty_log() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder, kept_early():
        log = Path(folder) / "log"
        append(log, [])
        yield log


def check(log: Path, rules: Any, ends: list[int], notes: list[str] | None = None) -> None:
    """A new process's answers, given the files that there are."""
    noted = [] if notes is None else notes
    with LogTimeline(log, rules, note=noted.append) as timeline:
        asked = [min(end, timeline.end) for end in ends]
        assert told(timeline, asked) == expected(timeline, asked)


def files(log: Path) -> list[Path]:
    return sorted(log.with_name("log.history").glob("*"))


ENDS = st.lists(st.integers(0, 40), min_size=1, max_size=4)


@quick(30)
@given(walks(), ENDS, st.lists(st.integers(0, 40), max_size=3))
def test_a_history_extended_at_any_points(
    documents: list[dict[str, Any]], ends: list[int], cuts: list[int]
) -> None:
    bounds = sorted({0, *(min(cut, len(documents)) for cut in cuts), len(documents)})
    with empty_log() as log:
        for first, last in pairwise(bounds):
            append(log, list(documents[first:last]))
            check(log, RULES, ends)
        check(log, RULES, ends)  # from what is kept alone
        assert bool(files(log)) == bool(documents)
        event(f"{len([each for each in files(log) if each.suffix == '.npz'])} parts")


@quick(15)
@given(drives(), ENDS, st.integers(0, 30))
def test_the_same_under_fusion_by_evidence(
    documents: list[dict[str, Any]], ends: list[int], cut: int
) -> None:
    with empty_log() as log:
        for items in (documents[:cut], documents[cut:]):
            append(log, list(items))
            check(log, EVIDENCE, ends)
        check(log, EVIDENCE, ends)


@quick(20)
@given(corrected_walks(), ENDS, st.integers(0, 40))
def test_the_same_under_commands_in_the_log(items: Items, ends: list[int], cut: int) -> None:
    def chosen(corrections: Any) -> Settings:
        return corrections.settings or RULES

    with empty_log() as log:
        for some in (items[:cut], items[cut:]):
            append(log, some)
            check(log, chosen, ends)
        check(log, chosen, ends)


@quick(40)
@given(walks(most=24), ENDS, st.data())
def test_no_damage_gives_a_wrong_answer(
    documents: list[dict[str, Any]], ends: list[int], data: st.DataObject
) -> None:
    """Bytes changed, files cut off, deleted, exchanged, or filled with anything, at any time."""
    with empty_log() as log:
        append(log, list(documents[:10]))
        check(log, RULES, ends)
        append(log, list(documents[10:]))
        check(log, RULES, ends)
        notes: list[str] = []
        for path in files(log):
            spoil(path, data)
        check(log, RULES, ends, notes)
        assert all("is not used" in note or "is folded again" in note for note in notes)
        event("noted" if notes else "nothing noted")
        mended: list[str] = []
        check(log, RULES, ends, mended)
        check(log, RULES, ends, mended)


def spoil(path: Path, data: st.DataObject) -> None:
    """Change a file, at places drawn as parts of its length: a log's id and times are random."""
    content = bytearray(path.read_bytes())
    places = st.integers(0, 2**24 - 1).map(lambda part: part * len(content) >> 24)
    match data.draw(st.sampled_from(["kept", "flip", "flip", "flips", "cut", "gone", "garbage"])):
        case "flip":
            content[data.draw(places)] ^= data.draw(st.integers(1, 255))
        case "flips":
            for at in data.draw(st.lists(places, max_size=30)):
                content[at] ^= data.draw(st.integers(1, 255))
        case "cut":
            del content[data.draw(places) :]
        case "garbage":
            content = bytearray(data.draw(st.binary(max_size=300)))
        case "gone":
            path.unlink()
            return
    path.write_bytes(content)


@quick(25)
@given(walks(most=16), st.data())
def test_bytes_that_change_while_a_timeline_is_open(
    documents: list[dict[str, Any]], data: st.DataObject
) -> None:
    """A part is opened whole and found damaged in the middle of an answer: it is made again."""
    with empty_log() as log:
        append(log, list(documents))
        check(log, RULES, [5])
        ends = [0, len(documents) // 2, len(documents)]
        for path in files(log):
            content = bytearray(path.read_bytes())
            # Before the manifest: no opening looks there.
            end = content.find(b"manifest.json") if path.suffix == ".npz" else len(content)
            content[data.draw(st.integers(0, 2**24 - 1)) * end >> 24] ^= 0x40
            path.write_bytes(content)
        check(log, RULES, ends)


def test_another_log_in_the_same_place(tmp_path: Path) -> None:
    log = tmp_path / "log"
    with kept_early():
        for turn in range(2):
            shutil.rmtree(log, ignore_errors=True)
            documents = [{**_envelope(n), "map_x": float(n % (5 + turn))} for n in range(20)]
            append(log, list(documents))
            check(log, RULES, [3, 20])
    assert len([path for path in files(log) if path.suffix == ".npz"]) == 2


def test_a_log_that_lost_its_end_and_was_recorded_on(tmp_path: Path) -> None:
    """The same log id, the same segments, as many events, and others at the end."""
    log, before = tmp_path / "log", tmp_path / "before"
    with kept_early():
        append(log, [_envelope(n) for n in range(12)])
        shutil.copytree(log, before)
        check(log, RULES, [12])
        append(log, [_envelope(n) for n in range(12, 30)])
        check(log, RULES, [12, 30])
        shutil.rmtree(log)
        shutil.copytree(before, log)
        check(log, RULES, [12])
        append(log, [_envelope(n, 0.2) for n in range(12, 30)])
        notes: list[str] = []
        check(log, RULES, [5, 12, 30], notes)
        assert any("the log has lost events since it was made" in note for note in notes)


def test_a_log_that_lost_its_end_of_which_the_same_came_again(tmp_path: Path) -> None:
    """Sent again by two robots, in another order: the same log id, segments and last message."""
    log, before = tmp_path / "log", tmp_path / "before"
    with kept_early():
        append(log, [_envelope(n) for n in range(12)])
        shutil.copytree(log, before)
        with LogWriter(log, fsync=parse_fsync("never")) as writer:
            for number in range(12, 30):
                append_payload(writer, "tb/detections", payload(_envelope(number)))
            writer.sync()
            check(log, RULES, [12, 30])
        shutil.rmtree(log)
        shutil.copytree(before, log)
        with LogWriter(log, fsync=parse_fsync("never")) as writer:
            for number in (13, 12, *range(14, 30)):
                append_payload(writer, "tb/detections", payload(_envelope(number)))
            writer.sync()
            notes: list[str] = []
            check(log, RULES, [5, 13, 30], notes)
        assert any("the log has lost events since it was made" in note for note in notes)


def _envelope(number: int, step: float = 0.5) -> dict[str, Any]:
    return envelope(number, step * number, 0.0)


@pytest.mark.parametrize("version", [1, 999])
def test_a_history_of_another_version_is_not_used(tmp_path: Path, version: int) -> None:
    log = tmp_path / "log"
    with kept_early():
        append(log, [_envelope(n) for n in range(12)])
        with patch("projections.store.kept_files.FORMAT", version):
            check(log, RULES, [12])
        notes: list[str] = []
        check(log, RULES, [12], notes)
    assert [note for note in notes if "as a history of this version does" in note]
