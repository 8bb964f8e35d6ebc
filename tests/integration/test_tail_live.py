"""A tail that follows a growing log: rows, status, metrics, stopping, dead letters."""

import re
import threading
import urllib.request
from pathlib import Path

import psycopg
import pytest

from eventsrc.log import ALWAYS, LogWriter
from eventsrc.record.append import append_payload
from projections.fold.map_errors import ProjectionBusy
from projections.fold.settings import Settings
from projections.postgres import RebuildProgress, TailProgress, TailReport, rebuild, tail
from projections.postgres.batch_writer import serving_tail_metrics
from projections.postgres.connection import Targets
from projections.postgres.status import projection_status
from tests.support.envelopes import payload
from tests.support.logs import bridge, walk, write_log
from tests.support.rows import all_rows

SETTINGS = Settings()
WAIT_S = 60.0


class Tail:
    """A tail in a thread of its own."""

    def __init__(self, log: Path, targets: Targets) -> None:
        self.progress, self.stop = TailProgress(), threading.Event()
        self.reports: list[TailReport] = []
        self._thread = threading.Thread(target=self._run, args=(log, targets))

    def _run(self, log: Path, targets: Targets) -> None:
        self.reports.append(tail(log, targets, SETTINGS, stop=self.stop, progress=self.progress))

    def __enter__(self) -> "Tail":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop.set()
        self._thread.join(WAIT_S)
        assert not self._thread.is_alive()


def test_it_follows_across_writers_and_rotations(tmp_path: Path, one_database: Targets) -> None:
    log = write_log(tmp_path / "log", walk(5))
    documents = walk(60, first=5, seed=1) + list(bridge())
    with Tail(log, one_database) as running:
        assert running.progress.wait(5, WAIT_S)
        for start in range(0, len(documents), 20):  # each writer seals its segment
            with LogWriter(log, fsync=ALWAYS) as writer:
                for document in documents[start : start + 20]:
                    append_payload(writer, "tb/detections", payload(document))
                assert running.progress.wait(writer.next_offset, WAIT_S)
    assert running.reports[0].next_offset == 85
    tailed = all_rows(one_database)
    rebuild(log, one_database, SETTINGS)
    assert all_rows(one_database) == tailed


def test_status_prints_each_state_of_a_tail(tmp_path: Path, one_database: Targets) -> None:
    log = write_log(tmp_path / "log", walk(20))

    def conditions() -> set[str]:
        return {s.condition for s in projection_status(log, one_database, SETTINGS).sinks}

    assert conditions() == {"missing"}
    rebuild(log, one_database, SETTINGS, until=10)
    assert conditions() == {"behind"}
    status = projection_status(log, one_database, SETTINGS)
    assert [s.lag for s in status.sinks] == [10, 10]
    assert not status.healthy
    with Tail(log, one_database) as running:
        assert running.progress.wait(20, WAIT_S)
        assert conditions() == {"following"}
        assert projection_status(log, one_database, SETTINGS).sinks[0].writer == "mapfold tail"
        with psycopg.connect(one_database.graph_url) as connection:
            connection.execute(
                "UPDATE mapfold.checkpoint SET heartbeat_at = now() - interval '1 hour'"
            )
        assert conditions() == {"stalled"}
    assert conditions() == {"idle"}
    other = SETTINGS.with_assignments(["eps_m=2"])
    found = projection_status(log, one_database, other).sinks
    assert {s.condition for s in found} == {"other"}
    assert "eps_m=1.5 there, 2.0 here" in str(found[0].note)
    away = Targets("postgresql://u@127.0.0.1:1/none", one_database.vector_url)
    assert [s.condition for s in projection_status(log, away, SETTINGS).sinks] == [
        "unreachable",
        "idle",
    ]


def test_a_tail_is_following_from_its_start(tmp_path: Path, one_database: Targets) -> None:
    """It writes a heartbeat at once; an earlier tail's is old."""
    log = write_log(tmp_path / "log", walk(20))
    tail(log, one_database, SETTINGS, once=True)
    with psycopg.connect(one_database.graph_url) as connection:
        connection.execute("UPDATE mapfold.checkpoint SET heartbeat_at = now() - interval '1 hour'")
    with Tail(log, one_database) as running:
        assert running.progress.wait(20, WAIT_S)
        found = projection_status(log, one_database, SETTINGS)
        assert {s.condition for s in found.sinks} == {"following"}
        assert found.healthy


@pytest.mark.slow
def test_status_of_a_running_replay_is_rebuilding(tmp_path: Path, one_database: Targets) -> None:
    log = write_log(tmp_path / "log", walk(20))
    rebuild(log, one_database, SETTINGS, until=10)
    seen = []

    def look(_: object) -> None:
        seen.append({s.condition for s in projection_status(log, one_database, SETTINGS).sinks})

    rebuild(log, one_database, SETTINGS, progress=look)
    assert seen[0] == {"rebuilding"}


@pytest.mark.slow
def test_a_first_replay_is_not_missing(tmp_path: Path, one_database: Targets) -> None:
    log = write_log(tmp_path / "log", walk(20))
    seen = []

    def look(at: RebuildProgress) -> None:
        if at.stage == "writing":
            status = projection_status(log, one_database, SETTINGS)
            seen.append({(s.condition, s.writer, s.note) for s in status.sinks})
            assert status.healthy

    rebuild(log, one_database, SETTINGS, progress=look)
    assert seen == [{("rebuilding", "mapfold replay", None)}]


@pytest.mark.slow
def test_a_busy_sink_is_reported_with_its_writer_and_server_process(
    tmp_path: Path, one_database: Targets
) -> None:
    log = write_log(tmp_path / "log", walk(5))
    with Tail(log, one_database) as running:
        assert running.progress.wait(5, WAIT_S)
        with pytest.raises(
            ProjectionBusy, match=r"\(mapfold tail; PostgreSQL serves it in process"
        ):
            rebuild(log, one_database, SETTINGS)


def scraped(running: Tail, log: Path) -> str:
    with serving_tail_metrics(("127.0.0.1", 0), running.progress, log) as port:
        address = f"http://127.0.0.1:{port}/metrics"
        body: bytes = urllib.request.urlopen(address, timeout=10).read()
    return body.decode()


def test_metrics_of_a_tail(tmp_path: Path, one_database: Targets) -> None:
    log = write_log(tmp_path / "log", walk(12))
    rebuild(log, one_database, SETTINGS, until=7)
    with Tail(log, one_database) as running:
        assert running.progress.wait(12, WAIT_S)
        text = scraped(running, log)
    assert "mapfold_tail_events_total 5.0" in text
    assert "mapfold_tail_next_offset 12.0" in text
    assert "mapfold_tail_lag 0.0" in text
    assert "mapfold_tail_commit_age_seconds " in text
    page = (Path(__file__).resolve().parents[2] / "docs/projections.md").read_text("utf-8")
    names = set(re.findall(r"^(mapfold_tail_\w+)", text, re.MULTILINE))
    assert names == set(re.findall(r"mapfold_tail_\w+", page))


def test_no_commit_age_before_the_first_commit(tmp_path: Path, one_database: Targets) -> None:
    log = write_log(tmp_path / "log", walk(12))
    rebuild(log, one_database, SETTINGS)
    with Tail(log, one_database) as running:
        assert running.progress.wait(12, WAIT_S)
        text = scraped(running, log)
    assert "mapfold_tail_next_offset 12.0" in text
    assert "commit_age" not in text


def test_progress_wait_times_out() -> None:
    assert not TailProgress().wait(1, 0.01)
