"""The robot's spool: bounded, ordered, durable beyond the process."""

import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from eventsrc.base.errors import SpoolError, SpoolFull
from eventsrc.record.robot.acks import Ack, Refusal, Refusals, payload_sha256
from eventsrc.record.robot.spool import Refused, Spool, Spooled


def _ack(*payloads: bytes) -> Ack:
    digests = tuple(map(payload_sha256, payloads))
    return Ack(run_id="run-a", key="tb/detections", log_id="log", sha256=digests)


def _refusals(*payloads: bytes) -> Refusals:
    return Refusals(log_id="log", refused=tuple(Refusal.of(p, "too blue") for p in payloads))


def _payloads(spool: Spool) -> list[bytes]:
    return [spooled.payload for spooled in spool.after(0, 1_000)]


@pytest.fixture
def spool(tmp_path: Path) -> Iterator[Spool]:
    spool = Spool(tmp_path / "spool", max_bytes=100)
    yield spool
    spool.close()


def test_envelopes_keep_their_order_and_seq_grows(spool: Spool) -> None:
    for k in (3, 1, 2):
        spool.add("run-a", k, b"%d" % k)
    assert spool.after(0, 2) == [
        Spooled(1, "run-a", 3, b"3"),
        Spooled(2, "run-a", 1, b"1"),
    ]
    assert spool.after(2, 2) == [Spooled(3, "run-a", 2, b"2")]
    assert spool.waiting_up_to(2) == 2
    assert len(spool) == 3


def test_an_ack_removes_only_the_bytes_it_names(spool: Spool) -> None:
    """Not even the same keyframe of the same run, with other bytes."""
    for message in (b"a", b"b", b"A", b"a"):
        spool.add("run-a", 1, message)
    assert spool.acknowledge(_ack(b"a", b"x")) == 2
    assert _payloads(spool) == [b"b", b"A"]
    assert spool.acknowledge(_ack(b"a")) == 0
    assert spool.acknowledge(_ack(b"b", b"A")) == 2
    assert len(spool) == 0


def test_it_is_bounded_and_an_ack_makes_room(spool: Spool) -> None:
    spool.add("run-a", 1, b"x" * 60)
    with pytest.raises(SpoolFull, match="1 envelopes \\(60 bytes\\)"):
        spool.add("run-a", 2, b"x" * 41)
    spool.add("run-a", 2, b"x" * 40)
    spool.acknowledge(_ack(b"x" * 60))
    spool.add("run-a", 3, b"x" * 60)
    assert len(spool) == 2


def test_a_refused_envelope_is_quarantined_with_its_reason(spool: Spool) -> None:
    for k, message in enumerate((b"a", b"b", b"c", b"a")):
        spool.add("run-a", k, message)
    assert spool.refuse(_refusals(b"a", b"c", b"unknown"), up_to=3) == 2
    assert _payloads(spool) == [b"b", b"a"], "what came after it was not sent yet"
    assert (len(spool), spool.refused_count) == (2, 2)
    assert spool.refused(10) == [
        Refused("run-a", 0, "log", "too blue"),
        Refused("run-a", 2, "log", "too blue"),
    ]
    assert spool.refused(1) == spool.refused(10)[:1]
    assert spool.refuse(_refusals(b"a", b"c"), up_to=3) == 0
    spool.close()
    with closing(Spool(spool.path)) as again:
        assert (len(again), again.refused_count) == (2, 2)
        assert again.discard_refused() == 2
        assert again.refused(10) == []


def test_an_ack_removes_quarantined_envelopes_too(spool: Spool) -> None:
    """Of two recorders one refuses and the other does not."""
    for k in range(3):
        spool.add("run-a", k, b"%d" % k)
    spool.refuse(_refusals(b"0", b"1"), up_to=3)
    assert spool.acknowledge(_ack(b"1", b"2")) == 1, "one of them was waiting"
    assert [one.keyframe_id for one in spool.refused(10)] == [0]


def test_quarantined_bytes_are_dropped_for_new_envelopes_and_their_reason_stays(
    spool: Spool,
) -> None:
    for k in range(3):
        spool.add("run-a", k, b"%d" % k * 30)
    spool.refuse(_refusals(b"0" * 30, b"1" * 30), up_to=3)
    spool.add("run-a", 3, b"3" * 30)
    assert [one.keyframe_id for one in spool.refused(10)] == [0, 1]
    assert spool.retry_refused() == 1, "the bytes of keyframe 0 are gone here"
    assert _payloads(spool) == [b"2" * 30, b"3" * 30, b"1" * 30]
    assert [one.keyframe_id for one in spool.refused(10)] == [0]
    with pytest.raises(SpoolFull):
        spool.add("run-a", 4, b"x" * 11)
    spool.close()
    with closing(Spool(spool.path, max_bytes=100)) as again:
        assert (len(again), again.refused_count) == (3, 1)
        again.add("run-a", 4, b"x" * 10)
        with pytest.raises(SpoolFull):
            again.add("run-a", 5, b"x")


def test_it_is_full_where_a_wrong_count_promises_quarantined_bytes(spool: Spool) -> None:
    spool.add("run-a", 0, b"0" * 60)
    spool._refused_bytes = 60  # as after an error in the middle of `refuse`
    with pytest.raises(SpoolFull):
        spool.add("run-a", 1, b"1" * 30)


def test_spooled_envelopes_survive_the_process(tmp_path: Path) -> None:
    code = (
        "import os, sys; from pathlib import Path; from eventsrc.record.robot.spool import Spool\n"
        "spool = Spool(Path(sys.argv[1])); spool.add('run-a', 7, b'kept'); os._exit(9)"
    )
    path = tmp_path / "deep" / "spool"
    assert subprocess.run([sys.executable, "-c", code, path], check=False).returncode == 9
    with closing(Spool(path)) as spool:
        assert (len(spool), _payloads(spool)) == (1, [b"kept"])
        spool.add("run-a", 8, b"after")
        assert _payloads(spool) == [b"kept", b"after"]


def test_a_seq_is_never_used_twice(tmp_path: Path) -> None:
    """A cursor over the spool may outlive the row it points at."""
    spool = Spool(tmp_path / "spool")
    spool.add("run-a", 1, b"1")
    spool.acknowledge(_ack(b"1"))
    spool.close()
    with closing(Spool(tmp_path / "spool")) as again:
        again.add("run-a", 2, b"2")
        assert again.after(1, 10) == [Spooled(2, "run-a", 2, b"2")]


def test_a_second_owner_is_refused(tmp_path: Path, spool: Spool) -> None:
    spool.add("run-a", 1, b"1")
    with pytest.raises(SpoolError, match="another robot process uses it"):
        Spool(tmp_path / "spool")
    spool.close()
    Spool(tmp_path / "spool").close()


def test_a_file_that_is_no_spool_is_named(tmp_path: Path) -> None:
    path = tmp_path / "photo.jpg"
    path.write_bytes(b"not a database, but long enough to be looked at" * 100)
    with pytest.raises(SpoolError, match=r"photo\.jpg.*move the file away"):
        Spool(path)
    assert path.stat().st_size == 4_700


def test_a_place_where_no_file_can_be_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(SpoolError, match="file"):
        Spool(tmp_path / "file" / "spool")
    with pytest.raises(SpoolError, match="check the path"):
        Spool(tmp_path)


def test_using_a_closed_spool_is_an_error(spool: Spool) -> None:
    spool.close()
    with pytest.raises(SpoolError, match="closed"):
        spool.add("run-a", 1, b"1")


@pytest.mark.parametrize("keyframe_id", [-(2**63), 2**63 - 1])
def test_every_keyframe_id_fits(spool: Spool, keyframe_id: int) -> None:
    spool.add("run-a", keyframe_id, b"x")
    assert [one.keyframe_id for one in spool.after(0, 9)] == [keyframe_id]


def test_a_spool_of_a_version_that_was_never_released_is_refused_unchanged(tmp_path: Path) -> None:
    """It did not name payloads; acks name nothing else."""
    with closing(sqlite3.connect(tmp_path / "spool")) as db:
        db.executescript(
            "create table spooled (seq integer primary key, run_id text, keyframe_id integer,"
            " payload blob); insert into spooled values (4, 'run-a', 4, x'34');"
        )
    with pytest.raises(SpoolError, match="never released made it: move it away, use a new one"):
        Spool(tmp_path / "spool")
    with closing(sqlite3.connect(tmp_path / "spool")) as db:
        assert db.execute("select payload from spooled").fetchall() == [(b"4",)]
