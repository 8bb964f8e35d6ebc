"""Text, numbers and metrics of `mapfold detect`."""

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
