"""Prometheus scrapes a recorder."""

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest

from eventsrc.base.errors import TransportError
from eventsrc.record.metrics import MAX_CONNECTIONS, serving_metrics
from eventsrc.record.recorder.writer_thread import RecorderReport
from tests.support.envelopes import envelope, payload
from tests.support.fixtures_zenoh import Program, scrape
from tests.support.http_attacks import answer, ask, connect

REPORT = RecorderReport(
    *(12, 3, 4, 5, 6, 0, 7, 100, 15),
    unsealed=8,
    sealing_error="disk is on fire",
    lost_from_log=10,
    messages=13,
    crops=14,
)


def test_every_metric_is_scraped_with_its_current_value(tmp_path: Path) -> None:
    with serving_metrics(("127.0.0.1", 0), lambda: REPORT, tmp_path) as port:
        scraped = scrape(port)
    assert scraped.pop("mapfold_recorder_disk_free_bytes") > 0
    assert scraped == {
        "mapfold_recorder_recorded_total": 12,
        "mapfold_recorder_rejected_total": 3,
        "mapfold_recorder_queue_full_total": 4,
        "mapfold_recorder_transport_missed_total": 5,
        "mapfold_recorder_lost_from_log_total": 10,
        "mapfold_recorder_messages_total": 13,
        "mapfold_recorder_crops_total": 14,
        "mapfold_recorder_missing": 6,
        "mapfold_recorder_queue_depth": 7,
        "mapfold_recorder_queue_size": 100,
        "mapfold_recorder_next_offset": 15,
        "mapfold_recorder_unsealed": 8,
        "mapfold_recorder_sealing_failing": 1,
    }


def test_a_busy_port_is_one_clear_line(tmp_path: Path) -> None:
    with (
        serving_metrics(("127.0.0.1", 0), lambda: REPORT, tmp_path) as port,
        pytest.raises(TransportError, match=f"127.0.0.1:{port}.*in use.*--metrics"),
        serving_metrics(("127.0.0.1", port), lambda: REPORT, tmp_path),
    ):
        pytest.fail("two servers on one port")


@pytest.mark.slow
def test_open_connections_block_no_scrape_and_the_oldest_are_closed(tmp_path: Path) -> None:
    with ExitStack() as held, serving_metrics(("127.0.0.1", 0), lambda: REPORT, tmp_path) as port:
        silent = [held.enter_context(connect(port)) for _ in range(5 * MAX_CONNECTIONS)]
        for connection in silent:
            connection.send(b"GET /metrics HTTP/1.1\r\n")
        assert scrape(port)["mapfold_recorder_recorded_total"] == 12
        for connection in silent[:MAX_CONNECTIONS]:
            assert answer(connection) == b""


def test_a_silent_connection_is_closed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("eventsrc.record.metrics._Handler.timeout", 0.2)
    with serving_metrics(("127.0.0.1", 0), lambda: REPORT, tmp_path) as port:
        assert ask(port, b"GET /metrics HTTP/1.1\r\n") == b""


def test_a_metrics_address_off_loopback_gets_a_warning(
    start: Callable[..., Program], endpoint: str, tmp_path: Path
) -> None:
    args = ("record", str(tmp_path / "log"), "--connect", endpoint, "--metrics")
    recorder = start(*args, "0.0.0.0:0")
    assert "everybody who can reach it reads" in recorder.wait_for("warning: --metrics 0.0.0.0:0")


def test_the_record_command_serves_metrics(
    start: Callable[..., Program],
    publish: Callable[..., Program],
    endpoint: str,
    tmp_path: Path,
) -> None:
    recorder = start(
        "record",
        str(tmp_path / "log"),
        "--connect",
        endpoint,
        "--metrics",
        "0",
        "--fsync",
        "always",
    )
    line = recorder.wait_for("metrics on")
    port = int(line.rsplit(":", 1)[1].removesuffix("/metrics"))
    recorder.wait_for("recording")
    publish("tb/detections", payload(envelope(1)).decode(), "bad")
    recorder.wait_for("rejected 1 payload")
    scraped = scrape(port)
    assert scraped["mapfold_recorder_recorded_total"] == 1
    assert scraped["mapfold_recorder_rejected_total"] == 1
    assert scraped["mapfold_recorder_sealing_failing"] == 0
