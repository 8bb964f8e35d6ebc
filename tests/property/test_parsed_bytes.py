"""Parsed events through shared memory: what comes out is what parsing in this process gives."""

from collections.abc import Iterable
from itertools import chain, islice
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from eventsrc.envelope.ingest import Accepted, Rejected
from eventsrc.envelope.occupancy_map import OccupancyMap
from eventsrc.log import Event, LogReader
from projections.fold.folded_ids import content_digest
from projections.map.parsed_log import NoRoom, pack, unpack
from projections.map.parsing import READ_AHEAD, ParsedEvent, parsed_stretches
from tests.support.envelopes import fields_of
from tests.support.logs import write_random_log
from tests.support.thorough import examples

ROOM = 1 << 20


def comparable(event: ParsedEvent) -> Any:
    """All that a fold may look at, as values and bytes; not the base64 of embeddings."""
    offset, logged_ns, parsed, units = event
    if not isinstance(parsed, Accepted):
        assert units == []
        if isinstance(parsed, OccupancyMap):
            return offset, logged_ns, parsed.digest(), parsed.cells.tobytes()
        return offset, logged_ns, parsed
    envelope = fields_of(parsed.envelope)
    for detection in envelope["detections"]:
        del detection["embedding"]
    return (
        offset,
        logged_ns,
        envelope,
        parsed.det_ids,
        content_digest(parsed),
        [v if v is None else (v.dtype.str, v.tobytes()) for v in parsed.vectors],
        [
            u
            if u is None
            else (u[0].dtype.str, u[0].tobytes(), u[1].dtype.str, u[1].tobytes(), u[2])
            for u in units
        ],
    )


def flat(stretches: Iterable[list[ParsedEvent]]) -> list[Any]:
    return [comparable(event) for event in chain.from_iterable(stretches)]


@settings(max_examples=examples(60))
@given(seed=st.integers(0, 2**32))
@example(seed=9767)  # a component of -0.0
@pytest.mark.seconds
def test_what_was_packed_is_unpacked(seed: int, tmp_path_factory: pytest.TempPathFactory) -> None:
    with LogReader(write_random_log(tmp_path_factory.mktemp("logs") / "log", seed)) as reader:
        events = list(reader.read())
    memory = memoryview(bytearray(ROOM))
    coming = iter(events)
    packed = pack(iter(lambda: list(islice(coming, READ_AHEAD)), []), memory)
    stretches = list(unpack(packed, memory))
    memory[:] = b"\xff" * ROOM  # nothing may refer to it any more
    assert [len(stretch) for stretch in stretches[:-1]] == [READ_AHEAD] * (len(stretches) - 1)
    assert flat(stretches) == flat(parsed_stretches(events))


def test_random_logs_have_all_kinds_of_events(tmp_path: Path) -> None:
    with LogReader(write_random_log(tmp_path / "log", 1)) as reader:
        events = list(reader.read())
        parsed = [event.parsed for event in chain.from_iterable(parsed_stretches(events))]
    assert {type(each) for each in parsed} >= {Accepted, OccupancyMap, type(None)}
    assert {event.version for event in events} >= {1, 5}
    accepted = [each for each in parsed if isinstance(each, Accepted)]
    assert any(each.envelope.camera for each in accepted)
    assert any(v is None for each in accepted for v in each.vectors)
    assert len({len(v) for each in accepted for v in each.vectors if v is not None}) == 2


def test_refusals_and_bad_maps_keep_their_reasons() -> None:
    events = [
        Event(3, "tb/detections", 1, 2, b'{"run_id": 1}'),  # type: ignore[arg-type]
        Event(4, "mapfold/map", 3, 4, b"{}"),  # type: ignore[arg-type]
    ]
    memory = memoryview(bytearray(ROOM))
    (found,) = unpack(pack([events], memory), memory)
    assert flat([found]) == flat(parsed_stretches(events))
    assert [type(each.parsed) for each in found] == [Rejected, Rejected]


@pytest.mark.parametrize("missing", [1, 8, 1000])
def test_too_little_room_is_said_and_not_exceeded(tmp_path: Path, missing: int) -> None:
    with LogReader(write_random_log(tmp_path / "log", 2, 40)) as reader:
        events = list(reader.read())
    memory = bytearray(ROOM)
    packed = pack([events], memoryview(memory))
    size = packed.at + packed.length - missing
    with pytest.raises(NoRoom):
        pack([events], memoryview(bytearray(ROOM))[:size])
    assert pack([events], memoryview(bytearray(size + missing)))[0] == packed.at
