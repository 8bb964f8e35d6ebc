"""`mapfold detect` on drawn pictures, as a user runs it: to a file, over Zenoh, on bad input."""

import json
import queue
import signal
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import pytest

from eventsrc.adapters.detector.keyframes import CROP_SIDE, GateLimits, KeyframeGate, Keyframes
from eventsrc.adapters.detector.onnx_model import OnnxModel
from eventsrc.adapters.detector.picture_sources import LivePictures
from eventsrc.adapters.detector.poses import PoseTrack
from eventsrc.adapters.detector.service import DetectionRun, FileOutput
from eventsrc.adapters.detector.vision import decode, encode_jpeg, shrunk
from eventsrc.adapters.detector.vision_models import (
    Encoder,
    Finder,
    FinderOptions,
    read_preparation,
)
from eventsrc.adapters.sim import build_house
from eventsrc.envelope.crops import MAX_CROP_BYTES, decode_crop
from eventsrc.envelope.ingest import Accepted, ingest
from eventsrc.envelope.model import RunId
from eventsrc.log import LogReader
from eventsrc.record.transport.session import Received, Session
from projections.fold.settings import Settings
from projections.map.digest import map_digest
from projections.map.fold import fold_log
from tests.support.commands import Commands
from tests.support.drawn_pictures import camera_pictures, publish_pictures, write_pictures
from tests.support.fixtures_zenoh import DEADLINE_S, Program
from tests.support.models import MODEL_NAME, fixed_answer, models_for
from tests.support.scenes import truth_of

DRIVEN_S = 14.0


class Stage:
    """A folder of drawn pictures, the models that know their colours, and commands."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.pictures = folder / "camera"
        self.count = write_pictures(
            camera_pictures(until_s=DRIVEN_S), self.pictures, threading.Event()
        )
        self.detector, self.encoder = models_for(build_house(7), folder)
        self.models = ("--detector", str(self.detector), "--encoder", str(self.encoder))
        self.posed = ("--images", str(self.pictures), "--poses", str(self.pictures / "poses.csv"))
        self.run = Commands.in_folder(folder)


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Stage:
    return Stage(tmp_path_factory.mktemp("detect"))


@pytest.fixture(scope="module")
def made(stage: Stage) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """The numbers and envelopes of one detection into a file."""
    out = stage.folder / "run.jsonl"
    words = ("--threads", "1", "--hfov", "69.4", "--run-id", "cam", "--out", str(out), "--json")
    said = stage.run("detect", *stage.posed, *stage.models, *words)
    return said.json, [json.loads(line) for line in out.read_text().splitlines()]


@pytest.mark.slow
def test_every_picture_is_accounted_for(stage: Stage, made: Any) -> None:
    numbers, envelopes = made
    assert numbers["pictures"] == stage.count == numbers["between"] + numbers["keyframes"]
    assert numbers["keyframes"] == numbers["published"] == len(envelopes) > 20
    assert numbers["detections"] == sum(len(e["detections"]) for e in envelopes) > 40
    assert numbers["space"] == MODEL_NAME


def test_envelopes_are_valid_and_say_what_was_seen(stage: Stage, made: Any) -> None:
    _, envelopes = made
    rows = [r.split(",") for r in (stage.pictures / "poses.csv").read_text().splitlines()[1:]]
    poses = {float(stamp): [float(value) for value in rest] for stamp, *rest in rows}
    for number, envelope in enumerate(envelopes, start=1):
        accepted = ingest(json.dumps(envelope).encode())
        assert isinstance(accepted, Accepted)
        assert all(vector is not None for vector in accepted.vectors)
        assert envelope["keyframe_id"] == number
        assert envelope["camera"] == {"hfov_deg": 69.4, "width_px": 640, "height_px": 400}
        at = [envelope["map_x"], envelope["map_y"], envelope["map_yaw"]]
        assert at == pytest.approx(poses[envelope["timestamp"]])
    truth = truth_of(envelopes, stage.pictures / "truth.jsonl")
    instances = [instance for one in truth for instance in one["instances"]]
    assert sum(i is None for i in instances) <= 0.02 * len(instances)
    assert len(set(instances)) > 5


def test_a_class_is_dropped_before_its_crops_are_encoded(
    stage: Stage, made: Any, tmp_path: Path
) -> None:
    """The log that the file is imported into drops it from other input, too."""
    numbers, whole = made
    classes = [each["class"] for one in whole for each in one["detections"]]
    common = max(sorted({*classes}), key=classes.count)
    out = tmp_path / "dropped.jsonl"
    words = ("--threads", "1", "--run-id", "other", "--json", "--out", out, "--drop-class", common)
    told = stage.run("detect", *stage.posed, *stage.models, *words)
    assert told.json["dropped_detections"] == classes.count(common)
    assert told.json["detections"] == numbers["detections"] - classes.count(common)
    assert f"{classes.count(common)} detections dropped by class" in told.err
    assert "dropped by class" not in stage.run("import", tmp_path / "log", out).err
    said = stage.run("import", tmp_path / "log", stage.folder / "run.jsonl")
    assert f"detections of {common} are not stored" in said.err
    assert f"{classes.count(common)} detections dropped by class" in said.err
    with LogReader(tmp_path / "log") as reader:
        stored = [json.loads(event.payload) for event in reader.read() if event.is_envelope]
    assert common not in [each["class"] for one in stored for each in one["detections"]]
    counts = [one.get("dropped_detections", 0) for one in stored]
    assert sum(counts) == 2 * classes.count(common)


def _digest(log: Path) -> str:
    with LogReader(log) as reader:
        return map_digest(fold_log(reader, Settings())[1])


def test_over_zenoh_into_a_map(
    stage: Stage,
    made: Any,
    tmp_path: Path,
    endpoint: str,
    connected: Callable[[], Session],
    start: Callable[..., Program],
) -> None:
    """The recorded map is that of the same envelopes from a file; every crop is its detection's."""
    numbers, envelopes = made
    crops: queue.Queue[Received] = queue.Queue()
    session = connected()
    session.subscribe("tb/crops/*", crops.put)
    session.confirm()
    recorder = start("record", str(tmp_path / "log"), "--connect", endpoint)
    recorder.wait_for("recording tb/detections")
    words = ("--threads", "1", "--hfov", "69.4", "--run-id", "cam", "--keep-crops")
    spool = str(tmp_path / "spool.sqlite")
    detect = start(
        *("detect", *stage.posed, *stage.models, *words),
        *("--connect", endpoint, "--spool", spool, "--json"),
    )
    assert detect.wait() == 0, detect.lines
    assert recorder.end(signal.SIGINT) == 0, recorder.lines
    said = json.loads(detect.output())
    assert said["published"] == numbers["published"]
    assert (said["waiting"], said["crops_lost"]) == (0, 0)
    with LogReader(tmp_path / "log") as reader:
        kept = [decode_crop(event.payload) for event in reader.read(keys=["tb/crops"])]
    detections = {d["det_id"]: d for e in envelopes for d in e["detections"]}
    assert sorted(crop.det_id for crop in kept) == sorted(detections)
    stage.run("import", tmp_path / "imported", stage.folder / "run.jsonl")
    assert _digest(tmp_path / "log") == _digest(tmp_path / "imported")
    assert said["crops"] == len(detections)
    for _ in range(said["crops"]):
        crop = crops.get(timeout=DEADLINE_S)
        x0, y0, x1, y1 = detections.pop(unquote(crop.key.removeprefix("tb/crops/")))["bbox"]
        height, width = decode(crop.payload).shape[:2]
        assert abs(width - (x1 - x0)) <= 1.1
        assert abs(height - (y1 - y0)) <= 1.1
    assert not detections


def test_a_camera_over_zenoh(
    stage: Stage,
    tmp_path: Path,
    endpoint: str,
    start: Callable[..., Program],
    connected: Callable[[], Session],
) -> None:
    """Each picture sent was looked at or counted as dropped; keyframes have their poses."""
    out = tmp_path / "live.jsonl"
    keys = ("--zenoh-image", "robot/image", "--zenoh-pose", "robot/pose")
    detect = start(
        *("detect", *keys, *stage.models, "--threads", "1", "--connect", endpoint),
        *("--queue", "1000", "--out", str(out), "--json"),
    )
    detect.wait_for("detecting in robot/image")
    sent = publish_pictures(connected(), camera_pictures(per_s=0.1), *keys[1::2])
    code = detect.end(signal.SIGINT)
    said = json.loads(detect.output())
    assert said["pictures"] + said["dropped"] == sent
    assert code == (3 if said["dropped"] else 0), detect.lines
    envelopes = [json.loads(line) for line in out.read_text().splitlines()]
    assert len(envelopes) == said["keyframes"] > 0
    assert said["without_pose"] == said["bad_poses"] == 0
    assert all("map_x" in envelope for envelope in envelopes)


def test_a_camera_has_no_last_picture(
    stage: Stage, tmp_path: Path, connected: Callable[[], Session]
) -> None:
    """One that comes in as it is stopped is looked at or counted, and nothing is said of it."""
    stop, looked = threading.Event(), threading.Event()
    live = LivePictures(connected(), "robot/image", None, stop)
    finder = Finder(OnnxModel(stage.detector), None, FinderOptions())
    encoder = Encoder(OnnxModel(stage.encoder), read_preparation(stage.encoder))
    gate = KeyframeGate(GateLimits())
    keyframes = Keyframes(finder, encoder, gate, PoseTrack(), RunId("r"), note=lambda _line: None)
    detection = DetectionRun(keyframes, FileOutput(tmp_path / "out"), live, stop)
    running = threading.Thread(target=detection.run, args=(live, lambda _report: looked.set()))
    running.start()
    message = Received("robot/image", b"no picture")
    live.queue.put(message, 0.0)
    assert looked.wait(DEADLINE_S)
    threading.Event().wait(0.1)  # it waits for the next one by now
    with live.queue._filled:
        stop.set()
        live.queue.put(message, 0.0)
    running.join(DEADLINE_S)
    detection.close(0.0)
    report = detection.report()
    assert report.counts.pictures + report.dropped == 2
    assert not report.stopped


@pytest.mark.slow
def test_a_recorder_that_is_away_costs_nothing(
    stage: Stage, tmp_path: Path, endpoint: str, start: Callable[..., Program]
) -> None:
    one = tmp_path / "one"
    one.mkdir()
    (one / "5.0.jpg").write_bytes(next(stage.pictures.glob("*.jpg")).read_bytes())
    words = ("detect", *stage.models, "--spool", tmp_path / "spool", "--connect", endpoint)
    said = stage.run(*words, "--images", one, "--wait", "0.2", code=3)
    assert "1 envelope waiting" in said.err
    assert "the next start with it sends them" in said.err
    recorder = start("record", str(tmp_path / "log"), "--connect", endpoint)
    recorder.wait_for("recording")
    said = stage.run(*words, "--images", one, "--run-id", "again", code=0)
    assert recorder.end(signal.SIGINT) == 0
    with LogReader(tmp_path / "log") as reader:
        assert reader.next_offset == 2


def test_without_models_one_screen_says_what_to_fetch(stage: Stage) -> None:
    said = stage.run("detect", code=2)
    lines = said.err.splitlines()
    assert len(lines) <= 24
    assert max(map(len, lines)) <= 100
    assert lines[-1] == "mapfold: no --detector and no --encoder given"
    for word in ("yolox_s.onnx", "AGPL", "clip.json", "--poses", "docs/detector.md"):
        assert word in said.err


def test_bad_pictures_are_counted_and_said(stage: Stage, tmp_path: Path) -> None:
    good = next(stage.pictures.glob("*.jpg")).read_bytes()
    folder = tmp_path / "pictures"
    folder.mkdir()
    noise = np.random.default_rng(0).integers(0, 255, (90, 90, 3), np.uint8)
    damaged = bytearray(encode_jpeg(noise))
    damaged[len(damaged) // 2 : len(damaged) // 2 + 60] = b"\xff\xd0" * 30
    bad = {
        "1.0.jpg": b"",
        "2.0.jpg": good[: len(good) // 2],
        "3.0.jpg": b"<html>404</html>",
        "4.0.jpg": bytes(damaged),
        "5.0.png": b"\x89PNG\r\n\x1a\n" + bytes(40),
    }
    for name, data in ({"6.0.jpg": good, "7.0.jpg": good} | bad).items():
        (folder / name).write_bytes(data)
    out = tmp_path / "run.jsonl"
    said = stage.run("detect", "--images", folder, *stage.models, "--out", out, "--json", code=3)
    assert (said.json["pictures"], said.json["unreadable"], said.json["keyframes"]) == (7, 5, 2)
    told = [line for line in said.err.splitlines() if "left out: " in line]
    assert len(told) == 5
    for name, line in zip(sorted(bad), told, strict=True):
        assert f"/{name}: left out: " in line
    assert "5 unreadable" in said.err.splitlines()[-1]


def test_a_crop_is_kept_in_a_size_that_a_log_takes() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (2000, 3000, 3), np.uint8)
    smaller = shrunk(noise, CROP_SIDE)
    assert smaller.shape == (427, 640, 3)
    worst = np.random.default_rng(0).integers(0, 255, (CROP_SIDE, CROP_SIDE, 3), np.uint8)
    assert shrunk(worst, CROP_SIDE) is worst
    assert len(encode_jpeg(worst)) < MAX_CROP_BYTES


@pytest.mark.slow
@pytest.mark.seconds
def test_a_picture_of_8k(stage: Stage, tmp_path: Path) -> None:
    """33 million pixels are a picture like any other; 100 million are refused."""
    folder = tmp_path / "large"
    folder.mkdir()
    truth = map(json.loads, (stage.pictures / "truth.jsonl").read_text().splitlines())
    fullest = max(truth, key=lambda picture: len(picture["things"]))
    drawn = decode((stage.pictures / f"{fullest['stamp']:.3f}.jpg").read_bytes())
    large = np.repeat(np.repeat(drawn, 12, axis=0), 12, axis=1)[:4320]
    (folder / "1.0.jpg").write_bytes(encode_jpeg(large))
    (folder / "2.0.jpg").write_bytes(encode_jpeg(np.zeros((10_000, 10_000, 3), np.uint8)))
    said = stage.run(
        "detect", "--images", folder, *stage.models, "--out", tmp_path / "o.jsonl", "--json", code=3
    )
    assert (said.json["keyframes"], said.json["unreadable"]) == (1, 1)
    assert "10,000 × 10,000 pixels, more than 64,000,000" in said.err
    (envelope,) = (json.loads(line) for line in (tmp_path / "o.jsonl").read_text().splitlines())
    assert max(max(d["bbox"]) for d in envelope["detections"]) > 1000


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("--images", "none"), "no such folder or video"),
        (("--images", "empty"), "no .jpg, .jpeg or .png in this folder"),
        ((), "give either --images or --zenoh-image"),
        (("--images", "camera", "--zenoh-image", "k"), "give either --images or --zenoh-image"),
        (("--images", "camera", "--head", "resnet"), "choose one of yolov8"),
        (("--images", "camera", "--device", "tpu"), "choose cpu or cuda"),
        (("--images", "camera", "--device", "cuda"), "onnxruntime-gpu"),
        (("--images", "camera", "--labels", "none.txt"), "give a file, or coco"),
        (("--images", "camera", "--labels", "coco"), "yolov8 of 80 classes is 1 × 84 × N"),
        (("--images", "camera", "--poses", "none.csv"), "none.csv: No such file"),
        (("--images", "camera", "--start", "noon"), "neither seconds since 1970 nor an ISO time"),
        (("--images", "camera", "--fps", "-1"), "a number above 0"),
        (("--images", "camera", "--run-id", "a\nb"), "printable characters"),
        (("--images", "camera", "--keep-crops"), "but --out nothing"),
        (("--images", "camera", "--detector", "text.onnx"), "cannot be loaded as ONNX"),
        (("--images", "camera", "--detector", "gone.onnx"), "no such model"),
        (("--images", "camera", "--encoder", "detector.onnx"), "detector.json: No such file"),
        (("--zenoh-image", "a b//c"), "key expression"),
    ],
)
def test_wrong_options_are_one_line(stage: Stage, words: tuple[str, ...], reason: str) -> None:
    (stage.folder / "empty").mkdir(exist_ok=True)
    (stage.folder / "text.onnx").write_text("no model")
    said = stage.run("detect", *stage.models, "--out", "never.jsonl", *words, code=None)
    assert said.code in (1, 2)
    (line,) = said.err.strip().splitlines()
    assert line.startswith("mapfold: ")
    assert reason in line


def test_an_answer_of_nan_is_said_and_counted(stage: Stage, tmp_path: Path) -> None:
    answer = np.zeros((1, 5, 6), np.float32)
    answer[0, :, :4] = np.array([[32, 32, 20, 20, 0.9]]).T
    answer[0, 2, 1] = answer[0, 4, 2] = np.nan
    model = fixed_answer(tmp_path / "nan.onnx", answer)
    (tmp_path / "labels.txt").write_text("thing\n")
    one = tmp_path / "one"
    one.mkdir()
    (one / "5.0.jpg").write_bytes(next(stage.pictures.glob("*.jpg")).read_bytes())
    words = ("--detector", model, "--encoder", stage.encoder, "--labels", tmp_path / "labels.txt")
    said = stage.run(
        "detect", "--images", one, *words, "--out", tmp_path / "o.jsonl", "--json", code=3
    )
    assert (said.json["not_finite"], said.json["detections"]) == (2, 1)
    assert "5.0.jpg: the detector answered NaN or infinity for 2 boxes" in said.err


def test_poses_that_are_none_are_counted(
    stage: Stage,
    tmp_path: Path,
    endpoint: str,
    connected: Callable[[], Session],
    start: Callable[..., Program],
) -> None:
    words = ("--zenoh-image", "k", "--zenoh-pose", "p", "--out", str(tmp_path / "o.jsonl"))
    detect = start("detect", *words, *stage.models, "--connect", endpoint, "--json")
    detect.wait_for("Ctrl-C ends it")
    session = connected()
    poses, images = session.publisher("p"), session.publisher("k")
    assert images.wait_for_subscriber(DEADLINE_S)
    assert poses.wait_for_subscriber(DEADLINE_S)
    for payload in (b"garbage", b'{"x": 1}', b'{"x": 1, "y": 2, "yaw": 0.5}'):
        poses.put(payload)
    images.put(b"no picture")
    session.confirm()
    detect.wait_for("left out: it is neither JPEG nor PNG")
    assert detect.end(signal.SIGINT) == 3
    said = json.loads(detect.output())
    assert (said["bad_poses"], said["unreadable"], said["keyframes"]) == (2, 1, 0)
    assert "2 messages that are not poses" in detect.lines[-2]
    assert "without the numbers x, y and yaw" in detect.lines[-1]


def test_ctrl_c_in_a_folder_says_so(
    stage: Stage, tmp_path: Path, start: Callable[..., Program]
) -> None:
    """What was written by then is whole."""
    out = tmp_path / "o.jsonl"
    words = ("detect", *stage.posed, *stage.models, "--after", "0", "--out", str(out), "--json")
    program = start(*words)
    program.wait_for("Ctrl-C ends it")
    exited = program.end(signal.SIGINT)
    said = json.loads(program.output())
    assert said["pictures"] <= stage.count
    if said["pictures"] < stage.count:
        assert exited == 3
        assert program.lines[-1] == "stopped before the last picture"
    written = out.read_text().splitlines()
    assert len(written) == said["keyframes"] == said["published"]


def test_ctrl_c_ends_it_with_its_numbers(
    stage: Stage, tmp_path: Path, endpoint: str, start: Callable[..., Program]
) -> None:
    words = ("--zenoh-image", "k", "--out", str(tmp_path / "o.jsonl"), "--connect", endpoint)
    program = start("detect", *words, *stage.models)
    program.wait_for("Ctrl-C ends it")
    assert program.end(signal.SIGINT) == 0
    assert "0 pictures, 0 keyframes, 0 detections" in program.lines[-1]


def test_a_file_that_is_there_is_not_written_over(stage: Stage, tmp_path: Path) -> None:
    out = tmp_path / "run.jsonl"
    out.write_text("a drive\n")
    said = stage.run("detect", *stage.posed, *stage.models, "--out", str(out), code=2).err
    assert f"--out {out}: there is such a file; remove it, or choose another" in said
    assert out.read_text() == "a drive\n"
