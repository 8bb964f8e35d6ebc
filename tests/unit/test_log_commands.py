"""Commands read from a log, and names of places given without a fold."""

from pathlib import Path

import pytest

from eventsrc.envelope.commands import Anchor, ForgetRun, NamePlace, UseSettings, encode_command
from eventsrc.envelope.model import KeyframeId, Offset, RunId
from eventsrc.envelope.system_events import COMMAND_KEY
from eventsrc.log import LogReader, LogWriter
from projections.fold.corrections import Corrections, RecordedCommand, compile_corrections
from projections.fold.deltas import PlaceNamed
from projections.fold.map_errors import FoldError
from projections.fold.settings import Settings
from projections.map.digest import map_digest
from projections.map.fold import fold_log
from projections.map.parsing import read_commands, read_corrections
from projections.postgres.live_fold import LiveFold
from projections.store.history_recorder import map_after
from tests.support.envelopes import envelope, payload
from tests.support.folds import Folded

FORGET = ForgetRun(command_id="c1", issued_by="ann@lab", run_id=RunId("b"))


def name(command_id: str, keyframe: int, text: str) -> NamePlace:
    anchor = Anchor(run_id=RunId("a"), keyframe_id=KeyframeId(keyframe))
    return NamePlace(command_id=command_id, issued_by="ann@lab", place=anchor, name=text)


def write(log: Path, *events: tuple[str, bytes]) -> Path:
    with LogWriter(log) as writer:
        for key, content in events:
            writer.append(key, content)
    return log


def keyframes(run: str, *xs: float) -> list[tuple[str, bytes]]:
    documents = (envelope(k, x, 0.0, run_id=run) for k, x in enumerate(xs))
    return [(f"{run}/detections", payload(each)) for each in documents]


def test_commands_are_read_with_their_offsets_up_to_a_point(tmp_path: Path) -> None:
    first, second = name("c2", 0, "kitchen"), FORGET
    log = write(
        tmp_path / "log",
        *keyframes("a", 0.0),
        (COMMAND_KEY, encode_command(first)),
        *keyframes("b", 0.0),
        (COMMAND_KEY, encode_command(second)),
    )
    with LogReader(log) as reader:
        assert read_commands(reader) == [RecordedCommand(1, first), RecordedCommand(3, second)]
        assert read_commands(reader, Offset(3)) == [RecordedCommand(1, first)]
        assert read_corrections(reader, Offset(1)).fingerprint() == ""
        assert read_corrections(reader).forgotten_runs == {"b"}


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b'{"kind":"sing"}', "which this version does not know"),
        (
            encode_command(UseSettings(command_id="c", issued_by="a", settings={"eps_m": -1.0})),
            "eps_m is -1.0",
        ),
    ],
)
def test_an_event_that_is_no_command_is_an_error_with_its_offset(
    tmp_path: Path, content: bytes, says: str
) -> None:
    log = write(tmp_path / "log", *keyframes("a", 0.0), (COMMAND_KEY, content))
    with LogReader(log) as reader, pytest.raises(FoldError, match=f"offset 1 .*{says}"):
        read_corrections(reader)


def test_a_log_is_folded_under_its_corrections_with_and_without_a_history(tmp_path: Path) -> None:
    log = write(tmp_path / "log", *keyframes("a", 0.0, 0.1, 0.2), *keyframes("b", 0.0, 5.0))
    corrections = compile_corrections([RecordedCommand(Offset(9), FORGET)])
    with LogReader(log) as reader:
        folded = fold_log(reader, Settings(), corrections=corrections)[1]
        kept = map_after(reader, Settings(), corrections=corrections)
    assert [k.run_id for k in folded.keyframes] == ["a", "a", "a"]
    assert folded.counts()["forgotten"] == 2
    assert map_digest(folded) == map_digest(kept)


def named(*commands: NamePlace) -> Corrections:
    return compile_corrections(RecordedCommand(Offset(50 + n), c) for n, c in enumerate(commands))


def test_the_newest_name_wins_and_survives_a_merge() -> None:
    corrections = named(name("c1", 0, "hall"), name("c2", 12, "kitchen"), name("c3", 1, "lobby"))
    folded = Folded.start(corrections=corrections)
    folded.extend(envelope(k, 0.2 * k, 0.0, run_id="a") for k in range(3))
    assert folded.view.places[0].name == "lobby"
    folded.extend(envelope(10 + k, 4.0 + 0.2 * k, 0.0, run_id="a") for k in range(3))
    assert [p.name for p in folded.view.places.values()] == ["lobby", "kitchen"]
    folded.extend(envelope(20 + k, 1.0 + 0.5 * k, 0.0, run_id="a") for k in range(6))
    (place,) = folded.view.places.values()
    assert (place.name, place.name_offset) == ("lobby", 52)
    assert [d.name for d in folded.all(PlaceNamed)] == ["lobby", "kitchen"]


def test_names_given_later_are_those_of_a_fold_that_knew_them() -> None:
    documents = [envelope(k, 0.2 * k, 0.0, run_id="a") for k in range(4)]
    before, after = named(name("c1", 0, "hall")), named(name("c2", 3, "bath"))
    folded = Folded.start(corrections=before).extend(documents)
    for corrections, expected in ((after, "bath"), (named(), None), (before, "hall")):
        for delta in folded.map.use_names(Offset(9), corrections):
            folded.view.apply(delta)
        folded.view.corrections = corrections
        assert folded.view.places[0].name == expected
        whole = Folded.start(corrections=corrections).extend(documents)
        assert map_digest(folded.view) == map_digest(whole.view)
    forgetful = compile_corrections([RecordedCommand(Offset(9), FORGET)])
    with pytest.raises(ValueError, match="more than names"):
        folded.map.use_names(Offset(9), forgetful)


def test_a_live_fold_takes_names_over_and_reports_the_places_as_changed(tmp_path: Path) -> None:
    log = write(tmp_path / "log", *keyframes("a", 0.0, 0.1, 0.2, 9.0, 9.1, 9.2))
    fold = LiveFold(Settings())
    with LogReader(log) as reader:
        assert list(fold.feed(list(reader.read()))) == [None] * 6
    fold.tracker.drain()
    fold.skip(Offset(6))
    fold.use_names(Offset(6), named(name("c1", 4, "bath")))
    changes = fold.tracker.drain()
    assert (changes.places, changes.placed, changes.objects) == ([1], [], [])
    assert [p.name for p in fold.view.places.values()] == [None, "bath"]
    again = LiveFold(Settings(), corrections=named(name("c1", 4, "bath")))
    with LogReader(log) as reader:
        assert list(again.feed(list(reader.read()))) == [None] * 6
    assert map_digest(fold.view) == map_digest(again.view)
