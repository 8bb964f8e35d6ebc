"""`mapfold record --ros2dds`: the options of a bridge from ROS, and the messages at the start."""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Final

import typer

from eventsrc.base.errors import LogDamaged, MisuseError
from eventsrc.base.text import counted, visible
from eventsrc.envelope.gaps import GapLedger
from eventsrc.envelope.model import RunId
from eventsrc.log import LogReader, LogWriter
from eventsrc.record.importers.label_files import read_labels
from eventsrc.record.recorder.bridged import Bridge, append_missing
from eventsrc.record.recorder.recorder import DEFAULT_KEYS
from eventsrc.record.recorder.writer_thread import RecorderReport
from eventsrc.ros.derivation import RosRecording, topic_of
from eventsrc.ros.library import MessageTypes
from eventsrc.ros.stream import DEFAULT_MAX_GAP_NS, Stream

from .bag_text import (
    check_run_id,
    crop_cutter,
    heights_option,
    keep_crops_option,
    labels_option,
    max_gap_ns,
    max_gap_option,
    model_option,
    ros_option,
)
from .terminal import say

TF_POSE: Final = "tf"
NONE: Final = "none"
_DETECTIONS: Final = "/detections"
_GRID: Final = "/map"
_QUIET_S: Final = 5.0
_PANEL: Final = "Messages of ROS 2, with --ros2dds"


_option = functools.partial(ros_option, _PANEL)

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
    """The options of `mapfold record` that go with ``--ros2dds``."""

    namespace: Annotated[
        str, _option("--namespace", "NS", "The namespace in the bridge's configuration, as /bot1.")
    ] = ""
    detections: Annotated[
        list[str] | None,
        _option(
            "--detections",
            "TOPIC",
            f"Topic of vision_msgs/Detection2DArray; may be repeated. [default: {_DETECTIONS}]",
        ),
    ] = None
    pose: Annotated[
        str,
        _option(
            "--pose",
            "tf|TOPIC|none",
            "Where poses come from: transforms, or a topic of Odometry or "
            "PoseWithCovarianceStamped.",
        ),
    ] = TF_POSE
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
        str, _option("--grid", "TOPIC", "Topic of OccupancyGrid, for the map's walls; or none.")
    ] = _GRID
    map_frame: Annotated[str, _option("--map-frame", "FRAME", "The frame of the map.")] = "map"
    base_frame: Annotated[str, _option("--base-frame", "FRAME", "The robot's frame.")] = "base_link"
    run_id: Annotated[
        str | None,
        _option(
            "--run-id", "ID", "The run of the keyframes. [default: namespace and time of the start]"
        ),
    ] = None
    labels: Annotated[Path | None, labels_option(_PANEL)] = None
    embedding_model: Annotated[str | None, model_option(_PANEL)] = None
    heights: Annotated[bool, heights_option(_PANEL)] = False
    keep_crops: Annotated[bool, keep_crops_option(_PANEL)] = False
    images: Annotated[
        str | None,
        _option("--images", "TOPIC", "Topic of the pictures for --keep-crops, which needs it."),
    ] = None
    max_gap: Annotated[float, max_gap_option(_PANEL)] = DEFAULT_MAX_GAP_NS / 1e9
    topic: Annotated[
        list[str] | None,
        _option("--topic", "TOPIC", "Another topic to keep, of any type; may be repeated."),
    ] = None


def check_unused(choice: BridgeChoice) -> None:
    """Raise MisuseError if an option needs --ros2dds, which is not given."""
    if choice != BridgeChoice():
        raise MisuseError(
            "--namespace, --detections, --pose and the other options for messages of ROS go with "
            "--ros2dds"
        )


def open_bridge(choice: BridgeChoice, writer: LogWriter, ledger: GapLedger[RunId] | None) -> Bridge:
    """The recorder of the topics of ``choice``. First makes the envelopes that a killed recorder
    left out. Raises MisuseError for an invalid topic, MapfoldError without rosbags."""
    types = MessageTypes()
    recording, topics = recording_of(choice, writer.now_ns(), ledger)
    cut = crop_cutter(choice.keep_crops, choice.images)
    try:
        with LogReader(writer.path) as reader:
            made = append_missing(reader, writer, types)
    except LogDamaged as error:
        say(f"not checked which envelopes the last recording of ROS lacks: {error}")
    else:
        if made:
            say(
                f"{writer.path}: the last recording of ROS did not finish; made "
                f"{counted(made, 'event')} from its messages"
            )
    return Bridge(recording, topics, types, cut)


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
    run = check_run_id(choice.run_id) or _run_id(choice.namespace, now_ns)
    by_transforms = choice.pose == TF_POSE
    labels = {} if choice.labels is None else read_labels(choice.labels)
    gap_ns = max_gap_ns(choice.max_gap)
    streams = []
    for topic in detections:
        run_id = RunId(run if len(detections) == 1 else f"{run}:{_camera(topic)}")
        highest = None if ledger is None else ledger.highest(run_id)
        streams.append(
            Stream(
                topic,
                run_id,
                None if choice.pose == NONE else full("/tf", "--namespace"),
                None if choice.pose == NONE else full("/tf_static", "--namespace"),
                None if by_transforms else given(choice.pose, "--pose"),
                given(choice.covariance, "--covariance"),
                given(choice.embeddings, "--embeddings"),
                given(choice.camera, "--camera"),
                choice.map_frame,
                choice.base_frame,
                labels,
                choice.embedding_model,
                choice.heights,
                max_gap_ns=gap_ns,
                first_keyframe=0 if highest is None else highest + 1,
                classes=tuple(full(t, "--classes") for t in choice.classes or () if t != NONE),
                images=given(choice.images, "--images"),
            )
        )
    grid = given(choice.grid, "--grid")
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
        others = stream.embeddings, stream.camera, *stream.classes
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
    """``watch``, plus one warning if no bridge has announced a topic some seconds after the
    start."""
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
