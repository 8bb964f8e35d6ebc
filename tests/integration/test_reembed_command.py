"""Crops from Zenoh into a log, and `mapfold reembed` with an ONNX encoder, as a user runs them."""

import json
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eventsrc.adapters.detector.onnx_model import weight_files
from eventsrc.adapters.detector.vision import encode_jpeg
from eventsrc.envelope.crops import (
    MAX_CROP_BYTES,
    Crop,
    InvalidCrop,
    decode_crop,
    encode_crop,
    received_crop,
)
from eventsrc.envelope.model import DetId
from eventsrc.log import LogReader, VerbatimEvent
from eventsrc.record.transport.session import Session
from eventsrc.ros.library import MessageTypes
from projections.surfaces.cli.reembed import OnnxCropEncoder
from tests.support.commands import Commands
from tests.support.envelopes import detection, envelope
from tests.support.fixtures_zenoh import Program
from tests.support.models import FORMAT, fixed_answer, mean_colour_encoder
from tests.support.thorough import examples

WEIGHTS = "clip.onnx.data"
NAMES = st.characters(codec="utf-8", exclude_characters="\0")
IDS = ("run 1/kf#2?d0", "cup-1", "☕")


def picture(level: int) -> bytes:
    return encode_jpeg(np.full((24, 30, 3), (level, 255 - level, 40), np.uint8))


@settings(max_examples=examples(200), deadline=None)
@given(det_id=st.text(NAMES, min_size=1, max_size=40), size=st.integers(0, 9))
@pytest.mark.slow
def test_a_crop_is_a_compressed_image_of_ros(det_id: str, size: int) -> None:
    jpeg = b"\xff\xd8\xff" + bytes(size) + b"\xff\xd9"
    topic, crop = received_crop(f"a/tb/crops/{quote(det_id, safe='')}", jpeg)
    assert (topic, crop) == ("a/tb/crops", Crop(DetId(det_id), jpeg))
    message = encode_crop(crop, 1_500_000_000_000_000_007)
    assert decode_crop(message) == crop
    for end in range(0, len(message), 3):
        with pytest.raises(InvalidCrop):
            decode_crop(message[:end])


def test_weights_in_a_file_beside_the_model_are_a_part_of_it(tmp_path: Path) -> None:
    path = mean_colour_encoder(tmp_path / "clip.onnx")
    assert weight_files(path.read_bytes()) == []
    whole = OnnxCropEncoder(path, "cpu", None).sha256
    onnx.save_model(
        onnx.load(path), path, save_as_external_data=True, location=WEIGHTS, size_threshold=0
    )
    assert weight_files(path.read_bytes()) == [WEIGHTS]
    apart = OnnxCropEncoder(path, "cpu", None).sha256
    weights = bytearray((tmp_path / WEIGHTS).read_bytes())
    weights[40] ^= 1
    (tmp_path / WEIGHTS).write_bytes(weights)
    assert len({whole, apart, OnnxCropEncoder(path, "cpu", None).sha256}) == 3


def test_it_is_read_by_the_types_of_ros() -> None:
    message = encode_crop(Crop(DetId("☕"), b"\xff\xd8\xff\xd9"), 7_000_000_009)
    found: Any = MessageTypes().decode(message, FORMAT.schema)
    assert (found.header.frame_id, found.format) == ("☕", "jpeg")
    assert (found.header.stamp.sec, found.header.stamp.nanosec) == (7, 9)
    assert bytes(found.data) == b"\xff\xd8\xff\xd9"


@pytest.mark.parametrize(
    ("key", "payload", "says"),
    [
        ("tb/crops/a", b"", "no whole JPEG"),
        ("tb/crops/a", b"\xff\xd8\xff no end", "no whole JPEG"),
        ("tb/crops/%ff", b"\xff\xd8\xff\xd9", "no UTF-8"),
        ("tb/crops/%00", b"\xff\xd8\xff\xd9", "is no det_id"),
        ("crop", b"\xff\xd8\xff\xd9", "PREFIX/DET_ID"),
        ("tb/crops/" + 300 * "a", b"\xff\xd8\xff\xd9", "is no det_id"),
        ("tb/crops/a", b"\xff\xd8\xff" + bytes(MAX_CROP_BYTES) + b"\xff\xd9", "at most 1,048,576"),
    ],
)
def test_what_is_no_crop_is_refused(key: str, payload: bytes, says: str) -> None:
    with pytest.raises(InvalidCrop, match=says):
        received_crop(key, payload)


@pytest.mark.seconds
def test_crops_are_recorded_and_re_embedded(
    tmp_path: Path, endpoint: str, connected: Callable[[], Session], start: Callable[..., Program]
) -> None:
    log, mapfold = tmp_path / "log", Commands.in_folder(tmp_path)
    recorder = start("record", str(log), "--connect", endpoint, "--json", "--key", "tb/**")
    recorder.wait_for("recording tb/**")
    session = connected()
    crops = {det_id: picture(40 * n) for n, det_id in enumerate(IDS)}
    found = [detection("cup", [1.0, float(n)], det_id=d) for n, d in enumerate(IDS)]
    session.put("tb/detections", json.dumps(envelope(1, detections=found)).encode())
    for det_id, jpeg in crops.items():
        session.put(f"tb/crops/{quote(det_id, safe='')}", jpeg)
    session.put("tb/crops/broken", crops["cup-1"][:-9] + b"\xff\xd9")
    session.put("tb/crops/none", b"text")
    blocking = session.publisher("tb/crops/huge")  # a plain put drops where the link is full
    blocking.put(bytes(3 * MAX_CROP_BYTES))
    recorder.wait_for("rejected 2 payloads")
    assert recorder.end(signal.SIGINT) == 3, recorder.lines
    said = json.loads(recorder.output())
    assert (said["recorded"], said["crops"], said["rejected"]) == (1, 4, 2)
    assert (said["messages"], said["missing"]) == (0, 0)
    assert any("4 crops, " in line for line in recorder.lines)
    with LogReader(log) as reader:
        kept = [e for e in reader.read(keys={"tb/crops"}) if isinstance(e, VerbatimEvent)]
    assert {e.format for e in kept} == {FORMAT}
    assert {c.det_id: c.jpeg for c in map(decode_crop, [e.payload for e in kept[:3]])} == crops
    shown = mapfold("log", "cat", log, "--key", "tb/crops").out
    assert f"crop of cup-1, {len(crops['cup-1']):,} bytes" in shown
    assert mapfold("log", "verify", log, code=None).code in (0, 3)

    model = mean_colour_encoder(tmp_path / "new.onnx")
    again = mapfold("reembed", log, "--encoder", model, "--json", "--reason", "better")
    done = again.json
    assert (done["detections"], done["added"], done["corrupt"], done["faults"]) == (3, 3, 0, [])
    space = done["space"]
    spaces = mapfold("log", "spaces", log, "--json").json["spaces"]
    assert [(s["model"], s["reembedded"]) for s in spaces][1] == (space, 3)
    state = mapfold("state", log, "--space", space, "--json").json
    assert state["counts"]["foreign_embeddings"] == 0
    assert "3 vectors of" in mapfold("log", "cat", log, "--key", "mapfold/embeddings").out
    assert "no.log" in mapfold("reembed", "no.log", "--encoder", model, code=2).err
    assert not (tmp_path / "no.log").exists()
    once_more = mapfold("reembed", log, "--encoder", model)
    assert "0 re-embedded" in once_more.err
    assert "3 were before" in once_more.err

    nan = fixed_answer(tmp_path / "nan.onnx", np.full((1, 5), np.nan, np.float32), (32, 32))
    nan.with_suffix(".json").write_text(
        '{"model": "nan", "size": 32, "mean": [0, 0, 0], "std": [1, 1, 1]}'
    )
    failed = mapfold("reembed", log, "--encoder", nan, code=3)
    assert "3 with NaN or zero from the encoder" in failed.err
    assert f"the crop of cup-1 at offset {kept[1].offset}: the encoder answers NaN" in failed.err


def test_crops_are_recorded_under_a_prefix(tmp_path: Path) -> None:
    said = Commands.in_folder(tmp_path)("record", "log", "--crops", "tb/**", code=2).err
    assert "--crops tb/**: write it as PREFIX/*, such as tb/crops/*" in said


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ((), "Missing option '--encoder'"),
        (("--encoder", "none.onnx"), "none.json: No such file or directory"),
        (("--encoder", "text.onnx"), "cannot be loaded as ONNX"),
        (("--encoder", "text.onnx", "--device", "tpu"), "--device tpu"),
    ],
)
def test_bad_models_are_said(tmp_path: Path, words: tuple[str, ...], says: str) -> None:
    (tmp_path / "text.onnx").write_text("text")
    (tmp_path / "text.json").write_text(
        '{"model": "m", "size": 8, "mean": [0, 0, 0], "std": [1, 1, 1]}'
    )
    said = Commands.in_folder(tmp_path)("reembed", "log", *words, code=None)
    assert said.code in (1, 2)
    assert says in said.err
    assert not (tmp_path / "log").exists(), "nothing is made"
