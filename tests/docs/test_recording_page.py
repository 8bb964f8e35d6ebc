"""The commands of docs/recording.md do what it says."""

import json
import re
import signal
from collections.abc import Callable
from pathlib import Path

from eventsrc.envelope.grid_messages import is_grid_message, read_grid_message
from eventsrc.envelope.ingest import Accepted, ingest
from eventsrc.envelope.model import MAX_DEPTH_M, MAX_POSITION_M
from eventsrc.envelope.occupancy_map import decode_map
from eventsrc.envelope.readers import (
    DetectionModel,
    EnvelopeCamera,
    EnvelopeModel,
    EnvelopeScan,
)
from eventsrc.record.metrics import serving_metrics
from eventsrc.record.recorder.queue import DEFAULT_QUEUE_BYTES, DEFAULT_QUEUE_SIZE
from eventsrc.record.recorder.writer_thread import RecorderReport
from eventsrc.record.robot.spool import DEFAULT_SPOOL_BYTES
from eventsrc.record.transport.config import DEFAULT_ENDPOINT
from eventsrc.record.transport.session import ZenohOptions, open_session
from eventsrc.ros.stream import Counts
from tests.support.fixtures_zenoh import Program, scrape

PAGE = (Path(__file__).parents[2] / "docs" / "recording.md").read_text()
Start = Callable[..., Program]


def _blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)


def _block(language: str) -> str:
    (block,) = _blocks(language)
    return block


def test_the_grid_on_the_page_is_accepted() -> None:
    grid = _blocks("json")[1].encode()
    assert is_grid_message(grid)
    assert decode_map(read_grid_message(grid, "tb/map").encode()).cells.tolist() == [
        [100, 100, 100],
        [255, 0, 100],
    ]


def test_the_three_terminals_say_what_the_page_says(
    start: Start, start_code: Start, endpoint: str, tmp_path: Path
) -> None:
    log = str(tmp_path / "log")
    recorder = start("record", log, "--preset", "full", "--connect", endpoint)
    recorder.wait_for("recording")
    code = _block("python").replace(DEFAULT_ENDPOINT, endpoint)
    robot = start_code(code.replace("spool.sqlite", str(tmp_path / "spool.sqlite")))
    assert robot.wait() == 0, robot.lines
    assert recorder.end(signal.SIGINT) == 0
    for line in recorder.lines:
        assert f"    {line.replace(log, 'logs/run-7')}\n" in PAGE


def test_every_metric_is_on_the_page(tmp_path: Path) -> None:
    topic = "/detections"
    report = RecorderReport(
        0, 0, 0, 0, 0, 0, 0, 1, 0, unread=((topic, 1, "why"),), streams=((topic, Counts()),)
    )
    with serving_metrics(("127.0.0.1", 0), lambda: report, tmp_path) as port:
        served = {name.partition("{")[0] for name in scrape(port)}
    assert set(re.findall(r"mapfold_recorder_\w+", PAGE)) == served


def test_the_configuration_is_one_that_zenoh_reads(endpoint: str, tmp_path: Path) -> None:
    file = tmp_path / "zenoh.json5"
    file.write_text(_block("json5"))
    options = ZenohOptions(connect=(endpoint,), config_file=file)
    with open_session(options, mode="client") as session:
        assert session.is_connected


def test_the_numbers_on_the_page_are_those_in_the_code() -> None:
    assert f"{DEFAULT_QUEUE_SIZE:,} messages" in PAGE
    assert f"or {DEFAULT_QUEUE_BYTES >> 20} MB" in PAGE
    assert f"at most {DEFAULT_SPOOL_BYTES >> 30} GiB (" in PAGE


def test_the_envelope_on_the_page_has_every_field_and_is_accepted() -> None:
    of_envelope = _blocks("json")[0]
    document = json.loads(of_envelope)
    assert isinstance(ingest(of_envelope.encode()), Accepted)
    seen = {**document["detections"][0], "det_id": "by default"}
    shown = (document, document["camera"], document["scan"], seen)
    models = (EnvelopeModel, EnvelopeCamera, EnvelopeScan, DetectionModel)
    for fields, model in zip(shown, models, strict=True):
        assert set(fields) == {f.alias or name for name, f in model.model_fields.items()}


def test_the_bounds_of_optional_fields_on_the_page_are_those_of_the_envelope() -> None:
    schema = EnvelopeModel.model_json_schema()["$defs"]
    hfov = schema["EnvelopeCamera"]["properties"]["hfov_deg"]
    assert (hfov["minimum"], hfov["maximum"]) == (1, 170)
    for name in ("depth_sigma_m", "position_sigma_m"):
        sigma = schema["DetectionModel"]["properties"][name]["anyOf"][0]
        assert (sigma["minimum"], sigma["maximum"]) == (0.001, 1000)
        assert f"`{name}`" in PAGE
    assert MAX_DEPTH_M == 1000.0
    assert MAX_POSITION_M == 1e7
