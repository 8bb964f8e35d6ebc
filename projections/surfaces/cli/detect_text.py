"""Options of `mapfold detect`, checked and parsed; its text, numbers and metrics."""

import contextlib
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from eventsrc.adapters.detector.picture_sources import LivePictures
from eventsrc.adapters.detector.poses import NEAR_S
from eventsrc.adapters.detector.service import DetectionRun, Report
from eventsrc.base.text import advised, counted, visible

from .terminal import people, say_metrics

if TYPE_CHECKING:
    from eventsrc.record.metrics import MetricValue
import datetime
import math
import os
import socket

from eventsrc.adapters.detector.keyframes import AFTER_S, GateLimits
from eventsrc.adapters.detector.onnx_model import Device
from eventsrc.adapters.detector.picture_sources import Timing
from eventsrc.base.errors import MisuseError
from eventsrc.base.machine import system_clock
from eventsrc.envelope.model import MAX_TIMESTAMP_S, RunId
from eventsrc.record.transport.session import check_keys

_MAX_RUN: Final = 200


def check_sources(
    images: str | None, zenoh_image: str | None, poses: Path | None, zenoh_pose: str | None
) -> None:
    """Raise MisuseError unless there is one source of pictures and at most one of poses."""
    if (images is None) == (zenoh_image is None):
        raise MisuseError("pictures come from one source: give either --images or --zenoh-image")
    if poses is not None and zenoh_pose is not None:
        raise MisuseError("--poses and --zenoh-pose: give one of them")
    keys = [each for each in (zenoh_image, zenoh_pose) if each is not None]
    if keys:
        check_keys(keys)


def timing_of(start: str, fps: float | None) -> Timing:
    """Parse ``--start`` and ``--fps``."""
    if fps is not None and not 0.0 < fps <= 10_000.0:
        raise MisuseError(f"--fps {fps:g}: give a number above 0, up to 10,000")
    try:
        start_s = float(start)
    except ValueError:
        try:
            moment = datetime.datetime.fromisoformat(start)
        except ValueError:
            raise MisuseError(
                f"--start {start}: neither seconds since 1970 nor an ISO time"
            ) from None
        if moment.tzinfo is None:
            moment = moment.replace(tzinfo=datetime.UTC)
        start_s = moment.timestamp()
    if not 0.0 <= start_s <= MAX_TIMESTAMP_S:
        raise MisuseError(f"--start {start}: give a time from 1970 on")
    return Timing(start_s, fps)


def run_id_of(given: str | None) -> RunId:
    """The run's id: host and time without ``--run-id``."""
    if given is None:
        now = datetime.datetime.fromtimestamp(system_clock() / 1e9, datetime.UTC)
        given = f"{socket.gethostname()[: _MAX_RUN // 2]}-{now:%Y%m%dT%H%M%S}"
    if not given.isprintable() or not 1 <= len(given) <= _MAX_RUN:
        raise MisuseError(
            f"--run-id {visible(given)[:60]}: give a name of 1 to {_MAX_RUN} printable characters"
        )
    return RunId(given)


def device_of(text: str) -> Device:
    """Parse ``--device``."""
    if text == "cpu":
        return "cpu"
    if text == "cuda":
        return "cuda"
    raise MisuseError(f"--device {text}: choose cpu or cuda")


def limits_of(moved: float, turned: float, after: float | None, *, posed: bool) -> GateLimits:
    """The rule for keyframes: without poses and ``--after`` every picture is one."""
    for name, value in (("--moved", moved), ("--turned", turned), ("--after", after or 0.0)):
        if not math.isfinite(value):
            raise MisuseError(f"{name} {value}: give a finite number")
    after_s = after if after is not None else (AFTER_S if posed else 0.0)
    return GateLimits(moved, math.radians(turned), after_s)


def spool_path() -> Path:
    """The default of ``--spool``."""
    return Path(os.environ.get("MAPFOLD_HOME") or ".mapfold") / "detect-spool.sqlite"


_STATUS_EVERY_S: Final = 0.25
WITHOUT_MODELS: Final = """\
mapfold detect needs two ONNX models, which mapfold does not ship: --detector finds objects in
pictures, --encoder turns each crop into an embedding. To have both in a few minutes:

  1. a detector, ready to use (YOLOX-S, Apache-2.0, 36 MB; it does not name its classes):
     curl -LO https://github.com/Megvii-BaseDetection/YOLOX/releases/download/0.1.1rc0/yolox_s.onnx
     then: --detector yolox_s.onnx --head yolox --labels coco
     An export of Ultralytics' YOLOv8 or v11 works without --head and --labels:
     pip install ultralytics; yolo export model=yolo11n.pt format=onnx
     Ultralytics and its weights are AGPL-3.0; what that asks of you: docs/detector.md.

  2. an encoder: the image tower of CLIP or SigLIP, exported once with PyTorch (docs/detector.md has
     the ten lines), and beside clip.onnx a file clip.json that describes its input:
       {"model": "ViT-B-32/laion2b_s34b_b79k", "size": 224, "resize": "crop",
        "mean": [0.48145466, 0.4578275, 0.40821073], "std": [0.26862954, 0.26130258, 0.27577711]}

Then, for a folder of pictures named by their times, with poses in a file:
  mapfold detect --images DIR --poses poses.csv --detector D.onnx --encoder E.onnx
"""
"""Where to get a model, printed when none is given."""


@contextlib.contextmanager
def metrics_of(address: tuple[str, int], detection: DetectionRun) -> Iterator[None]:
    from eventsrc.record.metrics import MetricValue, serving_values  # not imported unless needed

    def values() -> "list[MetricValue]":
        report = detection.report()
        counters = as_document(report)
        waiting = counters.pop("waiting")
        found = [
            MetricValue(
                f"mapfold_detect_{name}", f"As {name} in the report of detect --json.", number, True
            )
            for name, number in counters.items()
            if type(number) is int
        ]
        text = "Envelopes that no recorder has acknowledged yet."
        return [*found, MetricValue("mapfold_detect_waiting", text, waiting)]

    with serving_values(address, values) as port:
        say_metrics(address, port)
        yield


@contextlib.contextmanager
def show_status() -> Iterator[Callable[[Report], None]]:
    """The ``watch`` function of `DetectionRun.run`: on a terminal it shows a status line."""
    if not people.is_terminal:
        yield lambda _report: None
        return
    from rich.live import Live
    from rich.text import Text

    begun = shown = time.monotonic()
    with Live(console=people, transient=True, auto_refresh=False) as live:

        def show(report: Report) -> None:
            nonlocal shown
            now = time.monotonic()
            if now - shown < _STATUS_EVERY_S:
                return
            shown = now
            counts = report.counts
            line = (
                f"{counts.pictures / (now - begun):,.1f}/s · {counts.pictures:,} pictures · "
                f"{counts.keyframes:,} keyframes · {counts.detections:,} detections · "
                f"{report.dropped:,} dropped · {counts.unreadable:,} unreadable"
            )
            live.update(Text(line, no_wrap=True, overflow="ellipsis"), refresh=True)

        yield show


def summary(run_id: str, report: Report, where: str) -> str:
    counts, sent = report.counts, report.delivered
    parts = [
        f"{run_id}: {counted(counts.pictures, 'picture')}",
        counted(counts.keyframes, "keyframe"),
        f"{counted(counts.detections, 'detection')} to {where}",
        f"{counts.without_pose:,} without a pose" if counts.without_pose else "",
        f"{counts.unreadable:,} unreadable" if counts.unreadable else "",
        f"{report.dropped:,} dropped for newer pictures" if report.dropped else "",
        f"{counted(report.too_large, 'picture')} too large" if report.too_large else "",
        f"{counted(report.bad_poses, 'message')} that are not poses" if report.bad_poses else "",
        f"{counts.not_finite:,} boxes of NaN" if counts.not_finite else "",
        f"{counts.too_small:,} boxes of no size" if counts.too_small else "",
        f"{counts.cut:,} boxes too many" if counts.cut else "",
        f"{counted(counts.dropped_detections, 'detection')} dropped by class"
        if counts.dropped_detections
        else "",
        f"{counts.not_encoded:,} without an embedding" if counts.not_encoded else "",
        f"{counted(sent.crops, 'crop')} sent" if sent.crops else "",
        f"{counted(sent.crops_lost, 'crop')} lost" if sent.crops_lost else "",
        f"{counted(sent.no_room, 'keyframe')} lost in a full spool" if sent.no_room else "",
        f"{counted(sent.refused, 'envelope')} refused" if sent.refused else "",
        f"{counted(sent.waiting, 'envelope')} waiting" if sent.waiting else "",
    ]
    return ", ".join(part for part in parts if part)


def advice(report: Report, live: LivePictures | None, *, posed: bool, spool: Path) -> Iterator[str]:
    counts, sent = report.counts, report.delivered
    if report.stopped:
        yield "stopped before the last picture"
    if posed and counts.keyframes and counts.without_pose == counts.keyframes:
        yield (
            f"no keyframe has a pose: none was known within {NEAR_S * 1000:.0f} ms of its picture;"
            " check that both use the same clock"
        )
    if live is not None and live.poses is not None and live.poses.bad_reason is not None:
        yield visible(f"the last message that is no pose: {live.poses.bad_reason}")
    if sent.waiting:
        yield (
            f"{counted(sent.waiting, 'envelope')} not acknowledged by a recorder; they wait in the"
            " spool, and the next start with it sends them"
        )
    if sent.refused:
        listed = advised("spool", spool)
        yield visible(
            f"{counted(sent.refused, 'envelope')} in the spool that a recorder has refused; why,"
            f" and how to send or drop them: {listed}"
        )


def as_document(report: Report) -> dict[str, Any]:
    counts, sent = report.counts, report.delivered
    return {
        **vars(counts),
        "dropped": report.dropped,
        "too_large": report.too_large,
        "bad_poses": report.bad_poses,
        "stopped": report.stopped,
        **vars(sent),
    }
