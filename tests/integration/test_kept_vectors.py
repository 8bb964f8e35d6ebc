"""The vectors kept beside a log are those of its fold: of a log that grows, for a moment before its
end, after any damage, and where there are too many to keep."""

from collections.abc import Iterator
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from numpy.typing import NDArray

from eventsrc.envelope.model import FIRST_OFFSET, Offset
from eventsrc.log import LogReader
from projections.fold.corrections import NO_CORRECTIONS
from projections.fold.settings import Settings
from projections.map.fold import fold_log
from projections.store.columns import Stripe
from projections.store.history_recorder import map_after
from projections.store.timeline_cache import TimelineCache
from projections.store.vectors import RecordedVectors
from tests.property.test_timeline_cache import kept_early
from tests.support.envelopes import detection, envelope
from tests.support.thorough import rounds
from tests.support.walks import write_log

EVENTS, DIMENSION = 60, 5
VECTORS = np.random.default_rng(7).normal(size=(200, DIMENSION)).astype("<f4")


def drive(log: Path, first: int, last: int) -> None:
    """Of three keyframes one sees nothing, one two cups, and one two cups and two unembedded."""
    documents = [
        envelope(
            n,
            0.1 * n,
            0.0,
            detections=[
                detection("cup", VECTORS[n] + cup if cup < 2 else None, det_id=f"{n}-{cup}")
                for cup in range(n % 3 * 2)
            ],
        )
        for n in range(first, last)
    ]
    write_log(log, documents)


@pytest.fixture
def log(tmp_path: Path) -> Iterator[Path]:
    log = tmp_path / "log"
    drive(log, 0, EVENTS)
    with kept_early(), patch("projections.store.vectors._STRIPE_EVENTS", 8):
        yield log


def check(log: Path, end: int = EVENTS, notes: list[str] | None = None) -> None:
    """A new process's vectors: it asks for one, then some, then all."""
    with LogReader(log) as reader:
        folded = fold_log(reader, Settings(), Offset(end))[1]
        note = (notes if notes is not None else []).append
        view = map_after(reader, Settings(), Offset(end), note=note, embeddings=True)
    embedded = folded.embedded()
    assert np.array_equal(view.embedded(), embedded)
    for asked in (embedded[:1], embedded[5::7], embedded[::-1], embedded):
        assert np.array_equal(view.vectors(asked), folded.vectors(asked))


def check_unread(log: Path, end: int = EVENTS) -> None:
    """The same, from what is kept alone."""

    def refuse(_: RecordedVectors, rows: NDArray[np.int64]) -> NDArray[np.int32]:
        raise AssertionError(f"{len(rows)} vectors are read from the log")

    with patch.object(RecordedVectors, "_from_log", refuse):
        check(log, end)


def parts(log: Path) -> list[Path]:
    return sorted(log.with_name("log.history").glob("*.vectors"))


def ends(log: Path) -> list[int]:
    """The ends of the parts, of which each begins where another ends."""
    spans = [[int(each) for each in path.stem.split("-")[1:]] for path in parts(log)]
    assert [start for start, _ in spans] == [0, *(end for _, end in spans)][: len(spans)]
    return [end for _, end in spans]


def test_a_log_that_grows(log: Path) -> None:
    before = EVENTS
    for end in (60, 70, 75, 140, 145):
        drive(log, before, end)
        before = end
        notes: list[str] = []
        check(log, end, notes)
        assert notes == []
        check_unread(log, end)
        check_unread(log, 33)
    assert ends(log) == [140, 145]


def test_a_moment_before_the_end(log: Path) -> None:
    check(log, 33)
    assert ends(log) == [33]
    check_unread(log, 33)
    check(log)
    check_unread(log)


def places(content: bytes, count: int) -> range:
    return range(0, len(content), len(content) // count)


def test_no_damage_gives_a_wrong_vector(log: Path) -> None:
    check(log)
    (path,) = parts(log)
    content = path.read_bytes()
    spoiled = [
        content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :]
        for at in places(content, rounds(150, 8))
    ]
    cut = [content[:end] for end in places(content, rounds(40, 3))]
    for number, damaged in enumerate([*spoiled, *cut]):
        path.write_bytes(damaged)
        notes: list[str] = []
        check(log, notes=notes)
        said = [" is not used: " in n or "vectors are read from the log again" in n for n in notes]
        assert said in ([True], []), notes
        assert said or number < len(spoiled)
        check_unread(log)


def test_vectors_of_other_observations_are_not_used(log: Path) -> None:
    notes: list[str] = []
    with LogReader(log) as reader:
        map_after(reader, Settings())
        cache = TimelineCache(reader, Settings(), NO_CORRECTIONS, notes.append)
        arrays = {"crc": np.arange(40), "unit": np.zeros(40 * DIMENSION, np.int32)}
        cache.keep_vectors([Stripe(FIRST_OFFSET, Offset(EVENTS), {}, arrays)], FIRST_OFFSET)
    assert notes == []
    assert ends(log) == [EVENTS]
    check(log, notes=notes)
    assert [note for note in notes if "are of other events" in note] == notes != []
    check_unread(log)


def test_those_beyond_the_limit_are_read_from_the_log(log: Path) -> None:
    with patch("projections.store.vectors.MOST_VECTOR_BYTES", 30 * 4 * DIMENSION):
        check(log)
        assert ends(log) == [16]
        made = parts(log)[0].stat()
        check(log)
        check_unread(log, 16)
        assert parts(log)[0].stat().st_ino == made.st_ino
