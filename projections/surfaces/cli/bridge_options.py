"""`mapfold record --ros2` and `--ros2dds`: options for messages of ROS, and lines at the start."""

import dataclasses
import functools
import threading
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Final, NamedTuple

import typer

from eventsrc.base.errors import LogDamaged, MisuseError
from eventsrc.base.text import counted, visible
from eventsrc.envelope.dropped_classes import ClassDropper
from eventsrc.envelope.gaps import GapLedger
from eventsrc.envelope.model import RunId
from eventsrc.log import LogReader, LogWriter
from eventsrc.record.importers.bag_streams import BagOptions, Choice
from eventsrc.record.importers.map_yaml import read_labels
from eventsrc.record.recorder.bridged import Bridge, append_missing
from eventsrc.record.recorder.checking import CheckedMessage
from eventsrc.record.recorder.recorder import DEFAULT_KEYS
from eventsrc.record.recorder.writer_thread import RecorderReport
from eventsrc.record.ros_node import MAP_FRAME, find_topics
from eventsrc.record.transport.session import Session
from eventsrc.ros.derivation import RosRecording
from eventsrc.ros.library import MessageTypes
from eventsrc.ros.stream import DEFAULT_MAX_GAP_NS, Stream
from eventsrc.ros.wire import BridgeWire, RmwWire, Wire, topic_of

from . import bag_text
from .options import domain_option
from .terminal import say

TF_POSE: Final = "tf"
NONE: Final = "none"
_DETECTIONS: Final = "/detections"
_GRID: Final = "/map"
_BASE_FRAME: Final = "base_link"
_QUIET_S: Final = 5.0
_PANEL: Final = "Messages of ROS 2, with --ros2 or --ros2dds"


_option = functools.partial(bag_text.ros_option, _PANEL)

Ros2Option = Annotated[
    bool,
    typer.Option(
        "--ros2",
        help="Record what nodes over rmw_zenoh publish, and make keyframes of it; the topics are "
        "found as those of a bag are; needs mapfold[ros].",
        rich_help_panel=_PANEL,
    ),
]


RecordedDomainOption = Annotated[
    int | None, domain_option("The domain of the nodes, with --ros2.", rich_help_panel=_PANEL)
]
Ros2ddsOption = Annotated[
    bool,
    typer.Option(
        "--ros2dds",
        help="Record what a zenoh-bridge-ros2dds sends, and make keyframes of it; needs "
        "mapfold[ros].",
        rich_help_panel=_PANEL,
    ),
]


@dataclass(frozen=True, kw_only=True)
class BridgeChoice:
    """Options that go with ``--ros2``, where None is what the graph says, and ``--ros2dds``."""

    namespace: Annotated[
        str,
        _option(
            "--namespace",
            "NS",
            "The namespace in the bridge's configuration, as /bot1; with --ros2 only detections "
            "under it are taken.",
        ),
    ] = ""
    detections: Annotated[
        list[str] | None,
        _option(
            "--detections",
            "TOPIC",
            "Topic of vision_msgs/Detection2DArray or Detection3DArray; may be repeated. "
            f"[default: all, with --ros2dds {_DETECTIONS}]",
        ),
    ] = None
    pose: Annotated[
        str | None,
        _option(
            "--pose",
            "tf|TOPIC|none",
            "Where poses come from: transforms, or a topic of Odometry or "
            f"PoseWithCovarianceStamped. [default: {TF_POSE}, with --ros2 if there are any]",
        ),
    ] = None
    covariance: Annotated[
        str | None,
        _option(
            "--covariance",
            "TOPIC",
            "Topic whose latest covariance is the error of poses by transforms, such as "
            "/amcl_pose.",
        ),
    ] = None
    embeddings: Annotated[
        str | None,
        _option("--embeddings", "TOPIC", "Topic of the detections' embeddings; see docs/ros.md."),
    ] = None
    camera: Annotated[str | None, _option("--camera", "TOPIC", "Topic of CameraInfo.")] = None
    classes: Annotated[
        list[str] | None,
        _option(
            "--classes",
            "TOPIC",
            "Topic that names classes, of LabelInfo, ParameterEvent (/parameter_events) or"
            " VisionInfo; may be repeated.",
        ),
    ] = None
    grid: Annotated[
        str | None,
        _option(
            "--grid",
            "TOPIC",
            "Topic of OccupancyGrid, for the map's walls; or none. "
            f"[default: {_GRID}, with --ros2 the nearest of that name]",
        ),
    ] = None
    map_frame: Annotated[
        str | None, _option("--map-frame", "FRAME", f"The frame of the map. [default: {MAP_FRAME}]")
    ] = None
    base_frame: Annotated[
        str | None,
        _option("--base-frame", "FRAME", f"The robot's. [default: {_BASE_FRAME}, or as found]"),
    ] = None
    run_id: Annotated[
        str | None,
        _option(
            "--run-id", "ID", "The run of the keyframes. [default: namespace and time of the start]"
        ),
    ] = None
    labels: Annotated[Path | None, bag_text.labels_option(_PANEL)] = None
    embedding_model: Annotated[str | None, bag_text.model_option(_PANEL)] = None
    heights: Annotated[bool, bag_text.heights_option(_PANEL)] = False
    keep_crops: Annotated[bool, bag_text.keep_crops_option(_PANEL)] = False
    images: Annotated[
        str | None,
        _option("--images", "TOPIC", "Topic of the pictures for --keep-crops, which needs it."),
    ] = None
    scan: Annotated[
        str | None, _option("--scan", "TOPIC", "Topic of LaserScan, for walls where no map is.")
    ] = None
    max_gap: Annotated[float, bag_text.max_gap_option(_PANEL)] = DEFAULT_MAX_GAP_NS / 1e9
    topic: Annotated[
        list[str] | None,
        _option("--topic", "TOPIC", "Another topic to keep, of any type; may be repeated."),
    ] = None


def check_unused(choice: BridgeChoice, domain: int | None, *, ros2: bool, ros2dds: bool) -> None:
    """Raise MisuseError if an option needs --ros2 or --ros2dds, which is not given, or both are."""
    if ros2 and ros2dds:
        raise MisuseError("--ros2 and --ros2dds: give the one that the robot has")
    if not ros2 and domain is not None:
        raise MisuseError("--domain goes with --ros2")
    if choice != BridgeChoice() and not (ros2 or ros2dds):
        raise MisuseError(
            "--namespace, --detections, --pose and the other options for messages of ROS go with "
            "--ros2 or --ros2dds"
        )


class RecordedRos(NamedTuple):
    """What of ROS is recorded: how envelopes are made, all topics that are kept, how they come."""

    recording: RosRecording
    topics: tuple[str, ...]
    wire: Wire


def topics_of_bridge(
    choice: BridgeChoice, now_ns: int, ledger: GapLedger[RunId] | None
) -> RecordedRos:
    """What of a bridge is recorded."""
    return RecordedRos(*recording_of(choice, now_ns, ledger), BridgeWire())


def find_topics_of_nodes(
    choice: BridgeChoice, session: Session, domain: int, types: MessageTypes, stop: threading.Event
) -> Choice | None:
    """The topics of nodes over rmw_zenoh and their uses, once somebody publishes detections; None
    if ``stop`` is set before. Prints what is taken. Raises MisuseError."""
    wire, options = RmwWire(domain), as_of_a_bag(choice)
    made = find_topics(session, wire, types, options, choice.namespace, stop=stop, note=say)
    if made is None:
        say("ended before anybody published detections; nothing is recorded")
        return None
    width = max(len(visible(topic)) for topic in made.uses)
    for topic, use in sorted(made.uses.items()):
        say(f"  {visible(topic):{width}}  {visible(use)}")
    for note in made.notes:
        say(f"  note: {visible(note)}")
    return made


def topics_of_nodes(
    choice: BridgeChoice, made: Choice, domain: int, ledger: GapLedger[RunId] | None
) -> RecordedRos:
    """What of the nodes over rmw_zenoh is recorded."""
    streams = tuple(
        dataclasses.replace(each, first_keyframe=_next_keyframe(ledger, RunId(each.run_id)))
        for each in made.streams
    )
    recording = RosRecording(key=DEFAULT_KEYS[0], streams=streams, grids=tuple(made.grids))
    others = (topic_of("", topic, "--topic") for topic in choice.topic or ())
    topics = dict.fromkeys([*used_topics(recording), *others])
    return RecordedRos(recording, tuple(topics), RmwWire(domain))


def as_of_a_bag(choice: BridgeChoice) -> BagOptions:
    """The options as those of a bag. Raises MisuseError."""

    def full(topic: str | None, option: str) -> str | None:
        return topic if topic in (None, NONE, TF_POSE) else topic_of("", topic, option)

    topic_of(choice.namespace, "topic", "--namespace")
    detections = (topic_of("", topic, "--detections") for topic in choice.detections or ())
    classes = (full(topic, "--classes") or "" for topic in choice.classes or ())
    return BagOptions(
        detections=tuple(detections),
        pose=full(choice.pose, "--pose"),
        covariance=full(choice.covariance, "--covariance"),
        embeddings=full(choice.embeddings, "--embeddings"),
        camera=full(choice.camera, "--camera"),
        classes=tuple(classes),
        grid=full(choice.grid, "--grid"),
        map_frame=choice.map_frame,
        base_frame=choice.base_frame,
        run_id=bag_text.check_run_id(choice.run_id),
        embedding_model=choice.embedding_model,
        labels={} if choice.labels is None else read_labels(choice.labels),
        heights=choice.heights,
        max_gap_ns=bag_text.max_gap_ns(choice.max_gap),
        images=full(choice.images, "--images"),
        scan=full(choice.scan, "--scan"),
        cut=bag_text.crop_cutter(choice.keep_crops, choice.images),
    )


def finish_last_recording(
    writer: LogWriter, types: MessageTypes, dropper: ClassDropper[CheckedMessage]
) -> None:
    """Make the envelopes that a killed recorder left out, before those of this one are numbered."""
    try:
        with LogReader(writer.path) as reader:
            made = append_missing(reader, writer, types, dropper)
    except LogDamaged as error:
        say(f"not checked which envelopes the last recording of ROS lacks: {error}")
    else:
        if made:
            say(
                f"{writer.path}: the last recording of ROS did not finish; made "
                f"{counted(made, 'event')} from its messages"
            )


def _next_keyframe(ledger: GapLedger[RunId] | None, run_id: RunId) -> int:
    highest = None if ledger is None else ledger.highest(run_id)
    return 0 if highest is None else highest + 1


def recording_of(
    choice: BridgeChoice, now_ns: int, ledger: GapLedger[RunId] | None
) -> tuple[RosRecording, tuple[str, ...]]:
    """The topics and settings from which envelopes are made, and all topics that are kept. Raises
    MisuseError."""
    if choice.keep_crops and choice.images is None:
        raise MisuseError("--keep-crops needs the pictures; give --images TOPIC too")

    def full(topic: str, option: str) -> str:
        return topic_of(choice.namespace, topic, option)

    def given(topic: str | None, option: str) -> str | None:
        return None if topic in (None, NONE) else full(topic, option)

    detections = list(
        dict.fromkeys(full(t, "--detections") for t in choice.detections or [_DETECTIONS])
    )
    run = bag_text.check_run_id(choice.run_id) or _run_id(choice.namespace, now_ns)
    pose = choice.pose or TF_POSE
    labels = {} if choice.labels is None else read_labels(choice.labels)
    gap_ns = bag_text.max_gap_ns(choice.max_gap)
    streams = []
    for topic in detections:
        run_id = RunId(run if len(detections) == 1 else f"{run}:{_camera(topic)}")
        streams.append(
            Stream(
                topic,
                run_id,
                None if pose == NONE else full("/tf", "--namespace"),
                None if pose == NONE else full("/tf_static", "--namespace"),
                None if pose == TF_POSE else given(pose, "--pose"),
                given(choice.covariance, "--covariance"),
                given(choice.embeddings, "--embeddings"),
                given(choice.camera, "--camera"),
                choice.map_frame or MAP_FRAME,
                choice.base_frame or _BASE_FRAME,
                labels,
                choice.embedding_model,
                choice.heights,
                max_gap_ns=gap_ns,
                first_keyframe=_next_keyframe(ledger, run_id),
                classes=tuple(full(t, "--classes") for t in choice.classes or () if t != NONE),
                images=given(choice.images, "--images"),
                scan=given(choice.scan, "--scan"),
            )
        )
    grid = given(choice.grid or _GRID, "--grid")
    recording = RosRecording(
        key=DEFAULT_KEYS[0], streams=tuple(streams), grids=() if grid is None else (grid,)
    )
    others = (full(topic, "--topic") for topic in choice.topic or ())
    return recording, tuple(dict.fromkeys([*used_topics(recording), *others]))


def used_topics(recording: RosRecording) -> list[str]:
    """The topics from which envelopes and maps are made."""
    found: dict[str, None] = {}
    for stream in recording.streams:
        pose = [stream.pose, stream.covariance, stream.tf, stream.tf_static]
        others = stream.embeddings, stream.camera, stream.scan, *stream.classes
        for topic in (stream.detections, *pose, *others):
            if topic is not None:
                found[topic] = None
    return [*found, *recording.grids]


def _camera(topic: str) -> str:
    """The part of a run id that distinguishes the runs of several topics of detections."""
    return topic.strip("/").removesuffix("/detections")


def _run_id(namespace: str, now_ns: int) -> str:
    began = datetime.fromtimestamp(now_ns // 1_000_000_000, UTC)
    return f"{namespace.strip('/').replace('/', '-') or 'ros'}-{began:%Y%m%dT%H%M%S}"


def say_topics(log: Path, bridge: Bridge) -> None:
    """Print what is recorded, and the run ids of the keyframes."""
    runs = ", ".join(visible(stream.run_id) for stream in bridge.recording.streams)
    keys = ", ".join(bridge.keys)
    say(f"recording of a zenoh-bridge-ros2dds to {log}: {keys}; keyframes of {runs}")


def warn_of_silence(
    bridge: Bridge, watch: Callable[[RecorderReport], None], every_s: float
) -> Callable[[RecorderReport], None]:
    """``watch``, and one warning if no bridge announces a topic for some seconds."""
    calls = 0

    def watching(report: RecorderReport) -> None:
        nonlocal calls
        calls += 1
        if calls == round(_QUIET_S / every_s) and not (bridge.types_known or report.messages):
            say(
                f"no bridge has announced any of {', '.join(bridge.topics)} yet: check that "
                "zenoh-bridge-ros2dds runs, is connected to the same router, and has the namespace "
                "that --namespace says"
            )
        watch(report)

    return watching
