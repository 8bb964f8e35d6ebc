"""Any redactions of any log, one after the other: what is not chosen stays to the last bit."""

import random
import tempfile
from pathlib import Path

import pytest

from eventsrc.envelope.system_events import REDACTED_KEY, REDACTION_KEY
from eventsrc.log import Event, LogReader, LogWriter, MessageFormat, NewEvent, verify_log
from eventsrc.log.redact import Pending, Redactor, Rewritten, end_of, redactions_of
from tests.support.byte_search import holds
from tests.support.fixtures_log import KEY, MEMORY_DISK, envelope, read_log
from tests.support.thorough import rounds

FORMAT = MessageFormat("cdr", "a/msg/B", "ros2msg", b"int32 x")


def _write(log: Path, chance: random.Random) -> None:
    """A log of some segments, of envelopes and verbatim messages with marks of their own."""
    with LogWriter(log, rotate_events=chance.randint(3, 20)) as writer:
        for number in range(chance.randint(1, 60)):
            mark, times = f"<mark-{number}>", (chance.randrange(10**12), chance.randrange(10**12))
            if chance.random() < 0.7:
                payload = envelope(number, note=mark)
                writer.append_all([NewEvent(KEY, payload, *times)])
            else:
                topic = f"/topic{number % 3}"
                writer.append_all([NewEvent(topic, mark.encode(), *times, format=FORMAT)])
            writer.sync()


def _redact(log: Path, chosen: dict[int, Rewritten], name: str) -> None:
    def decide(event: Event) -> Rewritten | None:
        return chosen.get(event.offset)

    with Redactor(log) as redactor:
        changes = redactor.stage(decide, b"salt")
        if not changes:
            return
        about: dict[str, object] = {"redaction_id": name, "issued_by": "me", "selection": "any"}
        redactor.commit(redactions_of(changes, {**about, "salt": "00"}), end_of(log))
    with LogWriter(log):
        pass
    pending = Pending.of(log)
    assert pending is not None
    pending.finish()


@pytest.mark.seconds
def test_what_is_not_chosen_stays() -> None:
    chance = random.Random(37)
    for _ in range(rounds(3, 60)):
        with tempfile.TemporaryDirectory(dir=MEMORY_DISK if MEMORY_DISK.is_dir() else None) as name:
            log = Path(name) / "log"
            _write(log, chance)
            expected = {event.offset: event for event in read_log(log)}
            gone: set[int] = set()
            for number in range(chance.randint(1, 3)):
                share = chance.choice([0.0, 0.1, 0.5, 1.0])
                chosen = {
                    offset: Rewritten(f"new {number}".encode(), whole=chance.random() < 0.5)
                    for offset in expected
                    if chance.random() < share
                }
                chosen = {o: c for o, c in chosen.items() if expected[o].key != REDACTED_KEY}
                _redact(log, chosen, f"r{number}")
                gone |= chosen.keys()
                events = {event.offset: event for event in read_log(log)}
                for offset, was in expected.items():
                    now, change = events[offset], chosen.get(offset)
                    times = now.offset, now.logged_ns, now.stamp_ns
                    assert times == (was.offset, was.logged_ns, was.stamp_ns)
                    if change is None:
                        assert now == was
                    else:
                        assert now.payload == change.payload
                        assert now.key == (REDACTED_KEY if change.whole else was.key)
                expected = {o: e for o, e in events.items() if e.key != REDACTION_KEY}
                with LogReader(log) as reader:
                    for offset in chance.sample(sorted(events), min(5, len(events))):
                        assert list(reader.read(offset, offset + 1)) == [events[offset]]
            marks = [f"<mark-{offset}>".encode() for offset in gone]
            assert holds(log, marks) == []
            found = verify_log(log).findings
            assert not [each for each in found if each.kind not in ("schema", "time")], found
