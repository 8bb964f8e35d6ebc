"""A tail under fusion by evidence that is killed outright goes on without a row that differs."""

import os
import subprocess
import threading
from pathlib import Path

import pytest

from projections.fold.settings import Settings
from projections.postgres import tail
from projections.postgres.check import check
from projections.postgres.checkpoints import has_schema, load
from projections.postgres.connection import Targets, connect
from tests.property.test_hostile_evidence import hostile_drive
from tests.support.commands import PROGRAM
from tests.support.logs import write_log
from tests.support.thorough import mostly_slow, rounds

EVIDENCE = Settings(fusion="evidence")
WAIT_S = 60
_NAMES = ("q'\"", "$$ DROP TABLE", "\\ \\' }) RETURN 1 //", "$q$", "{x}", "a`b", "椅子")


def _log(folder: Path) -> Path:
    """A log of hostile envelopes with class names that mean something to SQL and Cypher."""
    documents = [document for seed in range(rounds(60, 20)) for document in hostile_drive(seed)]
    for number, document in enumerate(documents):
        document |= {"keyframe_id": number, "run_id": f"run'{number % 3}$$"}
        document["detections"] = [
            {**seen, "class": _NAMES[(number + at) % len(_NAMES)]}
            for at, seen in enumerate(document["detections"])
        ]
    return write_log(folder / "log", documents)


@pytest.mark.slow
def test_a_killed_tail_goes_on_without_a_row_that_differs(
    tmp_path: Path, one_database: Targets
) -> None:
    log = _log(tmp_path)
    arguments = [str(PROGRAM), "tail", str(log), "--db", one_database.graph_url]
    reached = []
    for _ in range(2):
        running = subprocess.Popen(
            [*arguments, "--set", "fusion=evidence"],
            env=dict(os.environ),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        watchdog = threading.Timer(WAIT_S, running.kill)
        watchdog.start()
        try:
            with connect(one_database.graph_url, autocommit=True) as witness:
                before = reached[-1] if reached else 0
                while True:
                    assert running.poll() is None
                    known = load(witness, "graph") if has_schema(witness) else None
                    if known is not None and known.next_offset > before:
                        break
        finally:
            watchdog.cancel()
            running.kill()
            running.wait(WAIT_S)
        with connect(one_database.graph_url, autocommit=True) as witness:
            known = load(witness, "graph")
            assert known is not None
            reached.append(known.next_offset)
    tail(log, one_database, EVIDENCE, once=True)
    for report in check(log, one_database, EVIDENCE):
        assert (report.sound, report.differing, report.foreign) == (True, 0, ())
    assert reached[0] > 0


@pytest.mark.parametrize(
    "name", mostly_slow(["size_spread", "range_spread", "range_m", "bearing_rad"])
)
def test_constants_that_would_divide_by_nothing_are_refused(tmp_path: Path, name: str) -> None:
    log = _log(tmp_path)
    done = subprocess.run(
        [str(PROGRAM), "state", str(log), "--set", f"evidence.{name}=1e-200"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert f"evidence.{name}=1e-200: input should be greater than or equal to 0.0" in done.stderr
