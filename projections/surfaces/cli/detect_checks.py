"""Check and parse the options of `mapfold detect`."""

import datetime
import math
import os
import socket
from pathlib import Path
from typing import Final

from eventsrc.adapters.detector.keyframes import AFTER_S, GateLimits
from eventsrc.adapters.detector.onnx_model import Device
from eventsrc.adapters.detector.picture_sources import Timing
from eventsrc.base.errors import MisuseError
from eventsrc.base.machine import system_clock
from eventsrc.base.text import visible
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
