"""Small logs for tests, written as the recorder writes them.

Append commands to logs in tests, as `mapfold edit` would.

A log for tests of commands: two rooms that a corridor makes one place, a third far away.

Random logs of everything that a log may have: for what reads logs in another way than others.

Logs that hold verbatim messages (ROS in CDR, JPEG) and envelopes side by side.

Simulated runs, each made once a process: one takes half a second.

The keyframes of logs/sample alone.
"""

import base64
import hashlib
import json
import math
import os
import random
import shutil
import tempfile
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from itertools import count
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from eventsrc.adapters.sim import SimulatedRun, simulate_run
from eventsrc.envelope import commands
from eventsrc.envelope.commands import Anchor, Command, encode_command
from eventsrc.envelope.model import ENVELOPE_VERSION
from eventsrc.envelope.system_events import COMMAND_KEY, MAP_KEY
from eventsrc.log import (
    NEVER,
    Event,
    LogReader,
    LogWriter,
    MessageFormat,
    NewEvent,
    VerbatimEvent,
    seal,
)
from eventsrc.record.append import append_payload
from projections.edit.current import MapToEdit
from projections.edit.make import Stamp
from projections.fold.settings import Settings
from tests.support.envelopes import detection, envelope, payload
from tests.support.fixtures_log import BY_HAND
from tests.support.maps import drawn_map
from tests.support.shared_data import ROOT

KEY = "tb/detections"
WEIRD = (
    "baker's rack",
    "x'}) DETACH DELETE r //",
    "$$; drop table",
    "☕ 🤖",
    '\\ "q" \\n \\',
    "}{[]",
)


def write_log(path: Path, documents: Iterable[Any], *, key: str = KEY) -> Path:
    """Append ``documents`` (envelopes as dictionaries) to the log; logged at 1, 2 … s."""
    with LogWriter(path, fsync=NEVER) as writer:
        for document in documents:
            logged_ns = (writer.next_offset + 1) * 1_000_000_000 + 123_456_789
            append_payload(writer, key, payload(document), logged_ns=logged_ns)
    return path


def append_raw(path: Path, data: bytes, *, key: str = KEY) -> None:
    """Append bytes as they are: what a writer other than ours might have put there."""
    with LogWriter(path, fsync=NEVER) as writer:
        writer.append(key, data)


def walk(
    count: int,
    *,
    seed: int = 0,
    run_id: str = "run-a",
    first: int = 0,
    detections: int = 2,
    dim: int = 8,
    rooms: int = 3,
) -> list[dict[str, Any]]:
    """A robot that wanders between rooms 6 m apart, noise between them, with odd class names."""
    rng = np.random.default_rng(seed)
    classes = [rng.normal(size=dim) for _ in WEIRD]
    documents = []
    for k in range(first, first + count):
        room = int(rng.integers(rooms))
        stray = rng.random() < 0.15
        x = 6.0 * room + (3.0 if stray else 0.0) + float(rng.normal()) * (0.2 if stray else 0.6)
        seen = []
        for _ in range(int(rng.integers(detections + 1))):
            c = int(rng.integers(len(WEIRD)))
            vector = None if rng.random() < 0.1 else classes[c] + 0.3 * rng.normal(size=dim)
            seen.append(detection(WEIRD[c], vector))
        lost = rng.random() < 0.1
        documents.append(
            envelope(
                k,
                None if lost else x,
                None if lost else float(rng.normal()),
                run_id=run_id,
                detections=seen,
            )
        )
    return documents


def bridge(run_id: str = "run-b", first: int = 0) -> Sequence[dict[str, Any]]:
    """Keyframes that join every room of `walk` into one place."""
    return [envelope(first + i, i * 0.7, 0.0, run_id=run_id) for i in range(20)]


_numbers = count()


def command(kind: type[Any], **values: Any) -> Command:
    """A command with an id of its own."""
    made: Command = kind(command_id=f"c{next(_numbers)}", issued_by="ann@lab", **values)
    return made


def append_command(log: Path, given: Command) -> int:
    """Append a command; its offset."""
    with LogWriter(log, fsync=NEVER) as writer:
        return append_to(writer, given)


def append_to(writer: LogWriter, given: Command) -> int:
    """Append a command with an open writer; its offset. Logged as `logs.write_log` does."""
    logged_ns = (writer.next_offset + 1) * 1_000_000_000 + 123_456_789
    return int(writer.append(COMMAND_KEY, encode_command(given), logged_ns=logged_ns))


def name_place(keyframe_id: int, name: str, run_id: str = "run-a") -> Command:
    """Names the place of a keyframe."""
    return command(commands.NamePlace, place=anchor(keyframe_id, run_id), name=name)


def join_frames(
    frame: str, into: str | None, *, dx: float = 0.0, dy: float = 0.0, dyaw: float = 0.0
) -> Command:
    """Joins a map frame to another."""
    transform = commands.RigidTransform.of(dx, dy, dyaw)
    return command(commands.JoinFrames, frame=frame, into=into, transform=transform)


def keep_apart(first: int, second: int, run_id: str = "run-a") -> Command:
    """Keeps the places of two keyframes of a run apart."""
    return command(commands.KeepApart, places=(anchor(first, run_id), anchor(second, run_id)))


def forget_keyframes(first: int, last: int, run_id: str = "run-a") -> Command:
    """Leaves keyframes of a run out."""
    return command(commands.ForgetKeyframes, run_id=run_id, first=first, last=last)


def forget_run(run_id: str) -> Command:
    """Leaves a run out."""
    return command(commands.ForgetRun, run_id=run_id)


def undo(undone: Command) -> Command:
    """Undoes a command."""
    return command(commands.Undo, undone=undone.command_id)


def anchor(keyframe_id: int, run_id: str = "run-a") -> Anchor:
    """A keyframe that stands for its place."""
    return Anchor(run_id=run_id, keyframe_id=keyframe_id)  # type: ignore[arg-type]


CUP, LAMP = [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]
LEFT, RIGHT, FAR = "run-a_p0", "run-a_p1", "run-b_p0"
"""The places: the first two are one since the event at `MERGE`."""
MERGE = 20
EVENTS = 30


def documents() -> list[dict[str, Any]]:
    """Fourteen keyframes in two rooms, nine in the corridor, one without a pose, one alone, and
    five of another run far away."""
    seen = {
        0: [detection("cup", CUP, det_id="cup-1")],
        1: [detection("cup", CUP, det_id="cup-2"), detection("box", det_id="bare")],
        9: [detection("cup", CUP, det_id="cup-3")],
        10: [detection("lamp", LAMP, det_id="lamp-1")],
    }
    xs = [0.5 * i for i in range(7)] + [8 + 0.5 * i for i in range(7)]
    xs += [3.5 + 0.5 * i for i in range(9)]
    found = [envelope(k, x, 0.0, detections=seen.get(k, [])) for k, x in enumerate(xs)]
    found.append(envelope(23, None))
    found.append(envelope(24, -50.0, 0.0))
    found += [envelope(k, 0.5 * k, 20.0, run_id="run-b") for k in range(5)]
    assert len(found) == EVENTS
    return found


def write_rooms(path: Path) -> Path:
    """The log of `documents`."""
    return write_log(path, documents())


def append(log: Path, command: Command) -> int:
    """Append a command as it is; returns its offset."""
    with LogWriter(log) as writer:
        return writer.append(COMMAND_KEY, encode_command(command))


def make(
    log: Path,
    function: Callable[..., Command],
    *args: Any,
    command_id: str = "new",
    settings: Settings | None = None,
) -> Command:
    """The command that a function of `projections.edit.make` makes from a log as it is."""
    with LogReader(log) as reader:
        current = MapToEdit(reader, lambda c: settings or c.settings or Settings())
        return function(current, Stamp(command_id, "me@here", "why"), *args)


def give(log: Path, function: Callable[..., Command], *args: Any, command_id: str) -> Command:
    """Make a command and append it."""
    command = make(log, function, *args, command_id=command_id)
    append(log, command)
    return command


DIMS = (8, 8, 8, 8, 3)


def write_random_log(path: Path, seed: int, count: int = 150) -> Path:
    """Segments, chunks and commits of random size; keyframes that come twice, with vectors of
    several dimensions or none, cameras, floors; refusals, commands, maps, verbatim messages, and
    envelopes of version 1."""
    rng = random.Random(seed)
    options: dict[str, Any] = {"rotate_events": rng.choice((20, 60, 10_000))}
    with (
        patch.object(seal, "CHUNK_BYTES", rng.choice((2_000, 20_000, seal.CHUNK_BYTES))),
        LogWriter(path, fsync=BY_HAND, **options) as writer,
    ):
        for number in range(count):
            _append(writer, rng, number)
            if rng.random() < 0.1:
                writer.sync()
    return path


def _append(writer: LogWriter, rng: random.Random, number: int) -> None:
    kind = rng.random()
    if kind < 0.80:
        document = _envelope(rng, number if rng.random() < 0.95 else rng.randrange(number + 1))
        append_payload(writer, KEY, payload(document), logged_ns=10**9 * number + 7)
    elif kind < 0.86:
        bad = (b"{", b"[1]", b"[]", payload(envelope(number, run_id="")), b'{"run_id": NaN}')
        append_payload(writer, KEY, rng.choice(bad))
    elif kind < 0.90:
        commands = (name_place(2, f"room {number}"), keep_apart(0, 9), forget_keyframes(4, 6))
        append_to(writer, rng.choice(commands))
    elif kind < 0.92:
        drawing = rng.choice(("##. ..# ?.#", "..# ### ..."))
        writer.append(MAP_KEY, drawn_map(drawing).encode())
    elif kind < 0.96:
        writer.append_all([mixed_event(4 * number + rng.randrange(3))])
    else:
        bare = [{"class_name": rng.choice(WEIRD), "confidence": 0.5, "bbox": [0.0, 0.0, 4.0, 4.0]}]
        writer.append_all([NewEvent("old/camera", payload(bare), number, number, 1)])


def _envelope(rng: random.Random, number: int) -> dict[str, Any]:
    fields: dict[str, Any] = {}
    if rng.random() < 0.2:
        fields["camera"] = {"hfov_deg": 70.0, "width_px": 640.0, "height_px": 480.0}
    if rng.random() < 0.2:
        fields |= {"floor": rng.choice((2, "attic"))}
    if rng.random() < 0.2:
        fields["pose_covariance"] = [0.01, 0, 0, 0, 0.02, 0, 0, 0, 0.001]
    if rng.random() < 0.2:
        fields["a field of others"] = {"nested": [1, "two", None]}
    if number % 16 == 4:
        ranges = base64.b64encode(bytes(range(4, 52))).decode()
        scan = {"angle_min": -1.5, "angle_step": 0.25, "range_max": 9.0, "ranges_mm": ranges}
        fields["scan"] = {**scan, "x": 0.1, "yaw": 0.5}
    x = None if rng.random() < 0.1 else 0.3 * number + rng.random()
    return envelope(
        number, x, rng.random(), detections=[_seen(rng) for _ in range(rng.randrange(5))], **fields
    )


def _seen(rng: random.Random) -> dict[str, Any]:
    fields: dict[str, Any] = {}
    if rng.random() < 0.2:
        fields |= {"depth_m": 2.5, "position": [height := rng.random(), 1.0]}
        fields |= {"position_z": -height, "size": [1.0, 0.5, height + 0.01]}
    if rng.random() < 0.1:
        fields["det_id"] = f"det {rng.randrange(10**6)}"
    which = rng.randrange(len(WEIRD))
    if rng.random() < 0.15:
        return detection(WEIRD[which], **fields)
    near = np.random.default_rng(which).normal(size=rng.choice(DIMS))
    return detection(WEIRD[which], near + rng.random() / 5, **fields)


TF = MessageFormat(
    "cdr", "tf2_msgs/msg/TFMessage", "ros2msg", b"geometry_msgs/TransformStamped[] transforms"
)
BOXES = MessageFormat(
    "cdr", "vision_msgs/msg/Detection2DArray", "ros2msg", b"std_msgs/Header header\n" * 40
)
JPEG = MessageFormat("jpeg")
_CDR = b"\x00\x01\x00\x00"


def mixed_event(offset: int) -> NewEvent:
    """What stands at ``offset``: of four events one is an envelope. Some verbatim messages are
    valid envelopes, or look like parts of a log."""
    rng = random.Random(offset)
    logged_ns, stamp_ns = 10**18 + offset, 10**18 + offset - 5
    kind = offset % 4
    if kind == 3:
        number = offset // 4
        return NewEvent(KEY, keyframe(number), logged_ns, (1000 + number) * 10**9)
    if kind == 2:
        content = b"\xff\xd8\xff\xe0" + rng.randbytes(rng.choice((0, 100, 3000))) + b"\xff\xd9"
        return NewEvent("tb/crops", content, logged_ns, stamp_ns, form_version(), JPEG)
    topic, form = ("/tf", TF) if kind == 0 else ("/detections", BOXES)
    content = rng.choice((_CDR + rng.randbytes(rng.choice((0, 8, 900))), keyframe(10**6 + offset)))
    return NewEvent(topic, content, logged_ns, 10**19 // 2 - offset, form_version(), form)


def form_version() -> int:
    """The version of a `NewEvent` that has a format: it has no meaning there."""
    return ENVELOPE_VERSION


def keyframe(number: int) -> bytes:
    """Keyframe ``number`` of a run through three rooms, with things in it."""
    room, angle = number % 3, 0.4 * number
    return json.dumps(
        {
            "run_id": "drive",
            "keyframe_id": number,
            "timestamp": 1000.0 + number,
            "map_x": 8.0 * room + math.cos(angle),
            "map_y": math.sin(angle),
            "map_yaw": 0.0,
            "detections": [{"class": f"thing-{room}", "confidence": 0.9, "bbox": [1, 2, 30, 40]}],
        }
    ).encode()


def recorded(new: NewEvent, offset: int) -> Event:
    """The event that a log has of ``new``."""
    values = offset, new.key, new.logged_ns, new.stamp_ns, new.payload
    if new.format is None:
        return Event(*values)
    return VerbatimEvent(*values, format=new.format)


def mixed_events(count: int) -> list[Event]:
    """The first ``count`` events of `mixed_event`, as a log has them."""
    return [recorded(mixed_event(offset), offset) for offset in range(count)]


@cache
def simulated(seed: int = 7, run: str = "a") -> SimulatedRun:
    """The run, which tests may only read."""
    return simulate_run(seed, run)


SAMPLE = ROOT / "logs" / "sample"


@cache
def sample_drive() -> Path:
    """A log of the 445 keyframes of logs/sample, offsets 0 to 444, without its settings and walls:
    it folds by the classic rules. Not to be changed: all workers share it, and later runs do, too.
    """
    (segment,) = SAMPLE.glob("*.mcap")
    content = hashlib.sha256(segment.read_bytes()).hexdigest()[:16]
    folder = Path(tempfile.gettempdir(), f"mapfold-tests-{os.getuid()}-{content}")
    drive = folder / "sample"
    if not drive.exists():
        folder.mkdir(exist_ok=True)
        made = Path(tempfile.mkdtemp(dir=folder))
        with LogReader(SAMPLE) as reader, LogWriter(made / "sample") as writer:
            for event in reader.read():
                if event.is_envelope:
                    writer.append(event.key, event.payload, logged_ns=event.logged_ns)
        try:
            (made / "sample").rename(drive)
        except OSError:
            if not drive.exists():
                raise  # no other worker was faster
        shutil.rmtree(made)
    return drive
