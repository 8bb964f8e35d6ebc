"""Maps in a space that a log's detections were given later, against logs recorded in that space."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import psycopg
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eventsrc.adapters.reembedding import Reembedding, reembed
from eventsrc.base.errors import LogBusy, LogDamaged, MisuseError
from eventsrc.envelope.commands import Reembed, UseSettings
from eventsrc.envelope.model import Offset
from eventsrc.envelope.system_events import EMBEDDINGS_KEY
from eventsrc.log import LogReader, LogWriter
from projections.fold.corrections import Corrections, map_fingerprint
from projections.fold.map_errors import FoldError
from projections.fold.settings import Settings
from projections.localize.evaluate.questions import read_keyframes
from projections.map.digest import map_digest
from projections.map.fold import fold_log
from projections.map.parsing import read_corrections
from projections.map.view import MapView
from projections.postgres import rebuild, tail
from projections.postgres.check import check
from projections.postgres.connection import Targets
from tests.support.commands import Commands
from tests.support.logs import append_command, command
from tests.support.models import Encoder, add_crop, drive, jpeg, write
from tests.support.rows import all_rows
from tests.support.thorough import mostly_slow, rounds

A, B = Encoder("A", 6), Encoder("B", 9)
IN_B = Settings(embedding_model="B")


def run(log: Path, encoder: Encoder = B, **options: Any) -> Reembedding:
    return reembed(log, encoder, issued_by="ann@lab", **options)


def fold(
    log: Path, chosen: Settings, until: int | None = None, known_at: int | None = None
) -> tuple[MapView, Corrections]:
    with LogReader(log) as reader:
        known = read_corrections(reader, None if known_at is None else Offset(known_at))
        end = None if until is None else Offset(until)
        return fold_log(reader, chosen, end, corrections=known)[1], known


def digest(log: Path, chosen: Settings = IN_B, until: int | None = None) -> str:
    return map_digest(fold(log, chosen, until)[0])


def end_of(log: Path) -> int:
    with LogReader(log) as reader:
        return reader.next_offset


@pytest.mark.parametrize("fusion", ["page", "evidence"])
@settings(max_examples=rounds(60, 3), deadline=None)
@given(seed=st.integers(0, 10**6), batch=st.integers(1, 70), until=st.floats(0.1, 1.0))
@pytest.mark.slow
def test_the_map_is_that_of_a_log_recorded_in_the_space(
    fusion: str, seed: int, batch: int, until: float, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder, made = tmp_path_factory.mktemp("logs"), drive(seed)
    other = write(folder / "other", made, A)
    first = write(folder / "first", made, B)
    plain = Settings(fusion=fusion)
    before, length = digest(other, plain), end_of(other)
    done = run(other, batch=batch)
    count = sum(len(crops) for _, crops in made)
    assert (done.detections, done.added, done.own, done.known) == (count, count, 0, 0)
    at = max(1, int(until * length))
    in_b = IN_B.model_copy(update={"fusion": fusion})
    for end in (at, length):
        assert digest(other, in_b, end) == digest(first, in_b, end)
    assert digest(first, plain) == digest(first, in_b), "the space of its first vector"
    view, known = fold(other, plain)
    assert map_digest(view) == before, "a map of the first space is as before"
    assert map_fingerprint(plain, known) == map_fingerprint(plain, Corrections())
    assert fold(other, in_b, known_at=length)[0].counts()["foreign_embeddings"] == count


def test_a_second_run_adds_nothing_and_new_detections_are_added(tmp_path: Path) -> None:
    made = drive(1)
    log = write(tmp_path / "log", made[:12], A)
    assert run(log).added
    length = end_of(log)
    again = run(log)
    assert (again.added, again.command, end_of(log)) == (0, None, length)
    assert again.known == again.detections
    write(log, made[12:], A)
    more = run(log)
    assert more.added == sum(len(crops) for _, crops in made[12:])
    with LogReader(log) as reader:
        commands = [c for _, c in read_corrections(reader).in_force]
    assert [type(c) for c in commands] == [Reembed, Reembed]
    view, _ = fold(log, IN_B)
    assert view.counts()["foreign_embeddings"] == 0
    assert {o.embedding_model for o in view.observations} == {"B"}


def test_a_detection_keeps_the_vector_that_it_was_recorded_with(tmp_path: Path) -> None:
    made = drive(2)
    log = write(tmp_path / "log", made[:8], A)
    write(log, made[8:], B)
    done = run(log)
    assert done.own == sum(len(crops) for _, crops in made[8:])
    assert done.added == sum(len(crops) for _, crops in made[:8])
    assert digest(log, until=10) == digest(write(tmp_path / "b", made, B), until=10)


KILLED = """
import os, signal, sys
from pathlib import Path
from eventsrc.adapters.reembedding import reembed
from tests.support.models import Encoder
class Dies(Encoder):
    def encode(self, jpegs):
        if self.calls == int(sys.argv[2]):
            os.kill(os.getpid(), signal.SIGKILL)
        return super().encode(jpegs)
reembed(Path(sys.argv[1]), Dies("B", 9), batch=5, issued_by="ann")
"""


@pytest.mark.seconds
@pytest.mark.parametrize("calls", mostly_slow([3, 0]))
def test_a_run_that_was_killed_is_continued(tmp_path: Path, calls: int) -> None:
    made = drive(3)
    log, whole = write(tmp_path / "log", made, A), write(tmp_path / "whole", made, A)
    before = digest(log)
    killed = subprocess.run(
        [sys.executable, "-c", KILLED, log, str(calls)],
        check=False,
        cwd=Path(__file__).resolve().parents[2],
        env=os.environ | {"PYTHONPATH": "."},
        timeout=60,
    )
    assert killed.returncode == -9
    assert digest(log) == before, "nothing is in force before all is there"
    done, at_once = run(log, batch=5), run(whole, batch=5)
    assert (done.known, done.known + done.added) == (5 * calls, at_once.added)
    assert done.command is not None
    assert digest(log) == digest(whole)


def test_a_run_that_is_stopped_is_continued(tmp_path: Path) -> None:
    made = drive(4)
    log = write(tmp_path / "log", made, A)
    before, encoder = digest(log), Encoder("B", 9)
    stopped = run(log, encoder, batch=5, stopped=lambda: encoder.calls == 2)
    assert (stopped.stopped, stopped.added, stopped.command) == (True, 10, None)
    assert digest(log) == before
    assert run(log).known == 10
    assert digest(log) == digest(write(tmp_path / "b", made, B))


def test_vectors_that_are_there_and_not_in_force_get_their_command(tmp_path: Path) -> None:
    log = write(tmp_path / "log", drive(5), A)
    encoder = Encoder("B", 9)
    run(log, encoder, batch=10_000, stopped=lambda: True)
    done = run(log, encoder)
    assert (done.added, encoder.calls) == (0, 1)
    assert done.command is not None
    assert fold(log, IN_B)[0].counts()["foreign_embeddings"] == 0


def test_missing_corrupt_and_unusable_crops_are_counted_and_named(tmp_path: Path) -> None:
    made = drive(6)
    ids = [det_id for _, crops in made for det_id in crops]
    crops = {det_id: each for _, some in made for det_id, each in some.items()}
    nan, zero = np.full(9, np.nan, np.float32), np.zeros(9, np.float32)
    broken = {crops[ids[0]]: nan, crops[ids[1]]: zero, crops[ids[2]]: "it is cut short"}
    for _, some in made:
        some.pop(ids[3], None)
    log = write(tmp_path / "log", made, A)
    with LogWriter(log) as writer:
        add_crop(writer, "of another log", jpeg(1, 1))
        writer.append("tb/crops", b"\x00\x01\x00\x00garbage", form=_format(log))
    done = run(log, Encoder("B", 9, broken))
    assert (done.unusable, done.corrupt, done.without_crop) == (2, 2, 1)
    assert done.added == done.detections - 4
    named = {fault.det_id: fault.reason for fault in done.faults}
    assert named == {
        ids[0]: "the encoder answers NaN or zero",
        ids[1]: "the encoder answers NaN or zero",
        ids[2]: "it is cut short",
        None: named[None],
    }
    view, _ = fold(log, IN_B)
    without = {o.det_id for o in view.observations if o.embedding_model != "B"}
    assert without == set(ids[:4])
    assert all(o.object is None for o in view.observations if o.det_id in without)
    better = run(log, Encoder("B", 9))
    assert (better.added, better.without_crop) == (3, 1)


def _format(log: Path) -> Any:
    with LogReader(log) as reader:
        return next(event.format for event in reader.read(keys={"tb/crops"}))  # type: ignore[attr-defined]


def test_a_space_has_one_dimension_and_one_encoder(tmp_path: Path) -> None:
    log = write(tmp_path / "log", drive(7), A)
    with pytest.raises(MisuseError, match=r"vectors of space 'A' .* have 6 values .* encoder 8"):
        run(log, Encoder("A", 8))
    run(log)
    length = end_of(log)
    with pytest.raises(MisuseError, match=r"have 9 values .*; give its space another name"):
        run(log, Encoder("B", 8))
    other = Encoder("B", 9)
    other.sha256 = "0" * 64
    with pytest.raises(MisuseError, match="by another model"):
        run(log, other)
    short = {each: np.ones(3, np.float32) for _, c in drive(7) for each in c.values()}
    with pytest.raises(MisuseError, match="answered 3 values"):
        run(log, Encoder("C", 9, short))
    assert end_of(log) == length


def test_a_log_that_is_being_written_is_refused(tmp_path: Path) -> None:
    log = write(tmp_path / "log", drive(8), A)
    with LogWriter(log), pytest.raises(LogBusy):
        run(log)


def test_undone_it_is_not_in_force(tmp_path: Path) -> None:
    log = write(tmp_path / "log", drive(9), A)
    before = digest(log)
    run(log)
    mapfold = Commands.in_folder(tmp_path)
    (edit,) = mapfold("edits", log, "--json").json
    assert edit["kind"] == "reembed"
    mapfold("edit", log, "undo", edit["command_id"], "--reason", "a worse encoder")
    assert digest(log) == before


def test_vectors_that_are_others_than_the_command_was_given_for_are_an_error(
    tmp_path: Path,
) -> None:
    log = write(tmp_path / "log", drive(10), A)
    encoder = Encoder("B", 9)
    run(log, encoder, batch=5, stopped=lambda: encoder.calls == 1)
    with LogWriter(log) as writer:
        writer.append(EMBEDDINGS_KEY, b'{"space": "B"}')
    with pytest.raises(LogDamaged, match=r"on mapfold/embeddings: encoder: .*required"):
        run(log)
    mapfold = Commands.in_folder(tmp_path)
    verified = mapfold("log", "verify", log, code=3)
    assert "mapfold/embeddings event cannot be read: encoder" in verified.out + verified.err
    with LogWriter(log) as writer:
        command = Reembed(
            command_id="forged", issued_by="x", space="B", dim=9,
            first=Offset(0), end=Offset(end_of(log)), detections=1, sha256="0" * 64,
        )  # fmt: skip
        writer.append("mapfold/command", command.model_dump_json().encode())
    with pytest.raises(FoldError, match="embeddings"):
        digest(log)
    assert digest(log, Settings()), "a map of another space does not read them"


def test_a_command_lists_the_spaces_of_a_log(tmp_path: Path) -> None:
    made = drive(11)
    log = write(tmp_path / "log", made[:6], A)
    write(log, made[6:12], B)
    write(log, made[12:], None)
    run(log, Encoder("C", 4))
    counts = [sum(len(c) for _, c in part) for part in (made[:6], made[6:12], made[12:])]
    mapfold = Commands.in_folder(tmp_path)
    assert mapfold("log", "spaces", log, "--json").json == {
        "detections": sum(counts),
        "bare": counts[2],
        "spaces": [
            {"model": "A", "dim": 6, "recorded": counts[0], "reembedded": 0},
            {"model": "B", "dim": 9, "recorded": counts[1], "reembedded": 0},
            {"model": "C", "dim": 4, "recorded": 0, "reembedded": sum(counts)},
        ],
    }
    assert mapfold("log", "spaces", log).out.splitlines() == [
        f"{sum(counts)} detections, {counts[2]} of them recorded without a vector",
        f"  A, dimension 6: {counts[0]} recorded",
        f"  B, dimension 9: {counts[1]} recorded",
        f"  C, dimension 4: {sum(counts)} re-embedded",
    ]
    in_c = mapfold("state", log, "--space", "C", "--json").json
    assert in_c["digest"] == digest(log, Settings(embedding_model="C"))
    assert mapfold("state", log, "--space", "C", "--set", "eps_m=2", "--json").json
    assert "no detection has a vector of space D" in mapfold("state", log, "--space", "D").err
    assert "no detection" not in mapfold("state", log, "--space", "C").err


def test_vectors_are_imported_and_put_into_force_there(tmp_path: Path) -> None:
    log, mapfold = write(tmp_path / "log", drive(14), A), Commands.in_folder(tmp_path)
    length, expected = end_of(log), run(log).added
    mapfold("import", "copy", *sorted(log.glob("*.mcap")), code=3)
    copy = tmp_path / "copy"
    assert digest(copy, until=length) != digest(log, until=length)
    encoder = Encoder("B", 9)
    done = run(copy, encoder)
    assert (done.known, done.added, encoder.calls) == (expected, 0, 0)
    assert done.command is not None
    assert digest(copy, until=length) == digest(log, until=length)


def test_questions_of_an_evaluation_are_in_the_space_of_the_map(tmp_path: Path) -> None:
    made = drive(12)
    made[3][1].clear()
    other, first = write(tmp_path / "other", made, A), write(tmp_path / "first", made, B)
    run(other)
    pairs = zip(read_keyframes([other], IN_B), read_keyframes([first], IN_B), strict=True)
    vectors = [[(a.vectors, b.vectors)] for a, b in pairs]
    assert any(v is not None for row in vectors for a, _ in row for v in a)
    for row in vectors:
        for a, b in row:
            assert [v if v is None else v.tolist() for v in a] == [
                v if v is None else v.tolist() for v in b
            ]
    assert all(
        v is None for k in read_keyframes([first], Settings(embedding_model="A")) for v in k.vectors
    )


@pytest.mark.seconds
def test_databases_follow_to_another_space(tmp_path: Path, one_database: Targets) -> None:
    made = drive(13)
    log = write(tmp_path / "log", made[:16], A)
    tail(log, one_database, settings_of_the_log, once=True)
    assert _dimension(one_database) == 6
    run(log)
    tail(log, one_database, settings_of_the_log, once=True)
    assert _dimension(one_database) == 6, "a map of the space A does not change"
    append_command(log, command(UseSettings, settings={"embedding_model": "B"}))
    assert tail(log, one_database, settings_of_the_log, once=True).refolds == 1
    assert _dimension(one_database) == 9
    _agrees(log, one_database)
    write(log, made[16:], A)
    tail(log, one_database, settings_of_the_log, once=True)
    _agrees(log, one_database)
    run(log)
    assert tail(log, one_database, settings_of_the_log, once=True).refolds == 1
    _agrees(log, one_database)
    followed = all_rows(one_database)
    rebuild(log, one_database, settings_of_the_log)
    assert all_rows(one_database) == followed


def settings_of_the_log(corrections: Corrections) -> Settings:
    return corrections.settings or Settings()


def _dimension(targets: Targets) -> int:
    with psycopg.connect(targets.vector_url) as connection:
        row = connection.execute(
            "SELECT DISTINCT vector_dims(embedding) FROM detection_embeddings"
        ).fetchone()
    assert row is not None
    return int(row[0])


def _agrees(log: Path, targets: Targets) -> None:
    assert all(report.sound for report in check(log, targets, settings_of_the_log))
