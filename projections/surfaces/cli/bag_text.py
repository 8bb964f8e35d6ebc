"""Bags of ROS 2 on the command line: options, the file of labels, and the report of a bag."""

import functools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import typer

from eventsrc.adapters.detector.keyframes import crops_of_message
from eventsrc.adapters.detector.vision import check_installed
from eventsrc.base.errors import MisuseError
from eventsrc.base.text import counted, visible
from eventsrc.record.importers.bag_streams import BagOptions
from eventsrc.record.importers.map_yaml import read_labels
from eventsrc.record.importers.ros_bags import BagReport
from eventsrc.ros.pictures import CutCrops
from eventsrc.ros.stream import DEFAULT_MAX_GAP_NS, Counts

from .options import option

_PANEL: Final = "Bags of ROS 2"
_MOST_UNUSED: Final = 10
_MOST_RUN_ID: Final = 100
"""Longest run id, so that default detection ids keep within their limit."""
_NS: Final = 1_000_000_000
MAX_GAP_S: Final = 3_600.0


def ros_option(panel: str, name: str, metavar: str, text: str) -> typer.models.OptionInfo:
    """An option about messages of ROS, listed under ``panel``; `import` and `record` have them."""
    made: typer.models.OptionInfo = option(metavar, text, name, rich_help_panel=panel)
    return made


def labels_option(panel: str) -> typer.models.OptionInfo:
    """``--labels``."""
    text = "Names of numbered classes: JSON, YAML, or one a line, the first that of class 0."
    return ros_option(panel, "--labels", "FILE", text)


def model_option(panel: str) -> typer.models.OptionInfo:
    """``--embedding-model``."""
    text = "The model of embeddings that do not name theirs."
    return ros_option(panel, "--embedding-model", "NAME", text)


def heights_option(panel: str) -> typer.models.OptionInfo:
    """``--heights``."""
    return _flag(panel, "--heights", "State the robot's height in envelopes; it separates floors.")


def keep_crops_option(panel: str) -> typer.models.OptionInfo:
    """``--keep-crops``."""
    text = "Keep the crop of each detection, cut from its picture; needs mapfold[detector]."
    return _flag(panel, "--keep-crops", text)


def _flag(panel: str, name: str, text: str) -> typer.models.OptionInfo:
    option: typer.models.OptionInfo = typer.Option(name, help=text, rich_help_panel=panel)
    return option


def crop_cutter(keep: bool, images: str | None) -> CutCrops | None:
    """What cuts crops for ``--keep-crops``; None without it. Raises MisuseError."""
    if not keep:
        if images is not None:
            raise MisuseError(f"--images {visible(images)} is for crops; give --keep-crops too")
        return None
    check_installed()
    return crops_of_message


def max_gap_option(panel: str) -> typer.models.OptionInfo:
    """``--max-gap``."""
    text = "Longest time between two poses to interpolate between them."
    return ros_option(panel, "--max-gap", "SECONDS", text)


_named = functools.partial(ros_option, _PANEL)


def _topic(name: str, text: str) -> typer.models.OptionInfo:
    return _named(name, "TOPIC", text)


@dataclass(frozen=True, kw_only=True)
class BagChoice:
    """Which topics of a bag `mapfold import` uses, and how."""

    detections: Annotated[
        list[str] | None,
        _topic(
            "--detections",
            "Topic of vision_msgs/Detection2DArray or Detection3DArray; may be repeated. Default: "
            "all of the first type, else of the second.",
        ),
    ] = None
    pose: Annotated[
        str | None,
        _named(
            "--pose",
            "tf|TOPIC|none",
            "Where poses come from: transforms, or a topic of nav_msgs/Odometry or "
            "geometry_msgs/PoseWithCovarianceStamped. Default: transforms, else such a topic.",
        ),
    ] = None
    covariance: Annotated[
        str | None,
        _topic(
            "--covariance",
            "Topic whose latest covariance is the error of poses by transforms; or none. Default: "
            "one in the map's frame.",
        ),
    ] = None
    embeddings: Annotated[
        str | None,
        _topic(
            "--embeddings",
            "Topic of std_msgs/String or Float32MultiArray, as docs/ros.md describes; or none. "
            "Default: one with embedding in its name.",
        ),
    ] = None
    camera: Annotated[
        str | None,
        _topic(
            "--camera",
            "Topic of sensor_msgs/CameraInfo; or none. Default: that of the detections' frame.",
        ),
    ] = None
    classes: Annotated[
        list[str] | None,
        _topic(
            "--classes",
            "Topic that names classes, of LabelInfo, ParameterEvent or VisionInfo; may be"
            " repeated; or none. Default: the nearest of each.",
        ),
    ] = None
    grid: Annotated[
        str | None,
        _topic("--grid", "Topic of nav_msgs/OccupancyGrid; or none. Default: topics called map."),
    ] = None
    map_frame: Annotated[
        str | None,
        _named("--map-frame", "FRAME", "The frame of the map. Default: map, else the root."),
    ] = None
    base_frame: Annotated[
        str | None,
        _named("--base-frame", "FRAME", "The robot's frame. Default: base_link or base_footprint."),
    ] = None
    run_id: Annotated[
        str | None,
        _named(
            "--run-id", "ID", "The run of a bag's keyframes. Default: its name and when it began."
        ),
    ] = None
    labels: Annotated[Path | None, labels_option(_PANEL)] = None
    embedding_model: Annotated[str | None, model_option(_PANEL)] = None
    heights: Annotated[bool, heights_option(_PANEL)] = False
    keep_crops: Annotated[bool, keep_crops_option(_PANEL)] = False
    images: Annotated[
        str | None,
        _topic("--images", "Topic of the pictures for --keep-crops. Default: the nearest."),
    ] = None
    scan: Annotated[
        str | None,
        _topic("--scan", "Topic of sensor_msgs/LaserScan; or none. Default: one, if no map."),
    ] = None
    max_gap: Annotated[float, max_gap_option(_PANEL)] = DEFAULT_MAX_GAP_NS / 1e9

    def options(self) -> BagOptions:
        """These choices for the importer. Raises MisuseError for an invalid one."""
        return BagOptions(
            tuple(self.detections or ()),
            self.pose,
            self.covariance,
            self.embeddings,
            self.camera,
            tuple(self.classes or ()),
            self.grid,
            self.map_frame,
            self.base_frame,
            check_run_id(self.run_id),
            self.embedding_model,
            {} if self.labels is None else read_labels(self.labels),
            self.heights,
            max_gap_ns(self.max_gap),
            self.images,
            self.scan,
            crop_cutter(self.keep_crops, self.images),
        )


def check_run_id(run_id: str | None) -> str | None:
    """``--run-id``, if a run can have it."""
    if run_id is not None and not (run_id.isprintable() and 1 <= len(run_id) <= _MOST_RUN_ID):
        raise MisuseError(
            f"--run-id {visible(run_id)[:_MOST_RUN_ID]!r}: give 1 to {_MOST_RUN_ID} printable "
            "characters"
        )
    return run_id


def max_gap_ns(seconds: float) -> int:
    """``--max-gap`` as nanoseconds."""
    if not (math.isfinite(seconds) and 0.0 < seconds <= MAX_GAP_S):
        raise MisuseError(f"--max-gap {seconds:g}: give seconds above 0, up to {MAX_GAP_S:g}")
    return round(seconds * _NS)


def bag_lines(report: BagReport) -> Iterator[str]:
    """A bag's contents: what was used, and what was not and why."""
    topics = counted(len(report.topics), "topic")
    yield (
        f"{report.name}: {counted(report.messages, 'message')} of {topics}, "
        f"{report.duration_s:,.1f} s"
    )
    used = [topic for topic in report.topics if topic.used_for]
    unused = [topic for topic in report.topics if not topic.used_for]
    shown = [*used, *unused[:_MOST_UNUSED]]
    name_width = max((len(visible(topic.topic)) for topic in shown), default=0)
    count_width = max((len(f"{topic.messages:,}") for topic in shown), default=0)
    for topic in shown:
        yield (
            f"  {visible(topic.topic):{name_width}}  {topic.messages:>{count_width},}  "
            f"{visible(topic.type)}: {visible(topic.used_for or 'not used')}"
        )
    if len(unused) > _MOST_UNUSED:
        yield f"  … and {len(unused) - _MOST_UNUSED:,} more topics that are not used"
    yield from (f"  {line}" for line in stream_lines(report.streams))
    if report.unchanged_grids:
        same = counted(report.unchanged_grids, "occupancy grid")
        yield f"  {same} had the cells of the one before"
    for note in report.notes:
        yield f"  note: {visible(note)}"


def stream_lines(streams: Mapping[str, Counts]) -> Iterator[str]:
    """For each topic of detections: its keyframes, what they lack, and unused messages."""
    for name, counts in streams.items():
        yield f"{visible(name)}: {_keyframes(counts)}"
        for topic_name, count in counts.unused.items():
            reason = visible(counts.reasons[topic_name][:200])
            yield f"{visible(topic_name)}: {count:,} could not be used; the first: {reason}"


def _keyframes(counts: Counts) -> str:
    """The keyframes of a stream, and what they lack."""
    lacks = (
        (counts.without_pose, "without a pose"),
        (counts.without_camera_frame, "with the pose of the base, not of the camera"),
        (counts.without_base_frame, "with the heading of the camera, not of the base"),
        (counts.without_camera, "without the camera's field of view"),
        (counts.without_covariance, "with a pose, but without its error"),
    )
    parts = [f"{number:,} {what}" for number, what in lacks if number]
    seen = counted(counts.detections, "detection")
    measured = f", {counts.with_position:,} with a position" if counts.with_position else ""
    parts.append(f"{seen}, {counts.with_embedding:,} with an embedding{measured}")
    if counts.with_scan:
        parts.append(f"{counts.with_scan:,} with a scan")
    if counts.crops or counts.without_picture or counts.outside:
        parts.append(counted(counts.crops, "crop"))
    if counts.without_picture:
        parts.append(f"{counted(counts.without_picture, 'keyframe')} without a picture of its time")
    if counts.outside:
        parts.append(f"{counted(counts.outside, 'box')} outside the picture")
    if counts.numbered:
        parts.append(f"{counts.numbered:,} with a number as the class")
    if counts.unclassified:
        parts.append(f"{counts.unclassified:,} without a class")
    return "; ".join([counted(counts.keyframes, "keyframe"), *parts])
