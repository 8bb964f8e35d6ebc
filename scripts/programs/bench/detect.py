"""What `mapfold detect` adds to the two model calls, on drawn pictures with the tiny models.

Both columns are processor time of this process in milliseconds, so that a busy machine changes them
little; pictures a second are by it, too. A picture goes from a JPEG on the disk to the bytes of an
envelope. `look` is all of that; `models` the time within onnxruntime, of the same pictures in the
same run. What is left is mapfold's own, by steps.
"""

import argparse
import json
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from eventsrc.adapters.detector import files, finder, keyframes
from eventsrc.adapters.detector import vision_models as encoder_module
from eventsrc.adapters.detector.keyframes import GateLimits, KeyframeGate, Keyframes
from eventsrc.adapters.detector.onnx_model import OnnxModel
from eventsrc.adapters.detector.picture_sources import Timing, open_images
from eventsrc.adapters.detector.poses import poses_of_file
from eventsrc.adapters.detector.service import FileOutput
from eventsrc.adapters.detector.vision_models import (
    Encoder,
    Finder,
    FinderOptions,
    read_preparation,
)
from eventsrc.adapters.sim import build_house
from eventsrc.envelope.model import RunId
from tests.support.drawn_pictures import camera_pictures, write_pictures
from tests.support.models import models_for

MOST_ADDED_MS = 8.0
LEAST_PER_S = 60.0


class Stopwatch:
    """Processor time within functions, by name."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    def around(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*args: Any, **kwargs: Any) -> Any:
            started = time.process_time()
            try:
                return function(*args, **kwargs)
            finally:
                spent = time.process_time() - started
                self.seconds[name] = self.seconds.get(name, 0.0) + spent

        return timed


def measure(seconds: float) -> dict[str, Any]:
    """Look at all pictures of the first ``seconds`` of a drive, each as a keyframe."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        drawn = folder / "drawn"
        write_pictures(camera_pictures(until_s=seconds), drawn, threading.Event())
        models = models_for(build_house(7), folder)
        detector, tower = (OnnxModel(path, threads=1) for path in models)
        found = Finder(detector, None, FinderOptions())
        encoder = Encoder(tower, read_preparation(tower.path))
        watch = Stopwatch()
        for model in (detector, tower):
            model.run = watch.around("models", model.run)  # type: ignore[method-assign]
        steps: list[tuple[Any, str, str]] = [
            (files, "decode", "decode the JPEG"),
            (finder, "planes", "input of the detector"),
            (encoder_module, "fitted", "resize crops"),
            (encoder_module, "planes", "input of the encoder"),
            (finder, "suppress", "suppress boxes"),
            (keyframes.Keyframes, "_keyframe", "crops, encoder and envelope"),
        ]
        usual = [(owner, attribute, getattr(owner, attribute)) for owner, attribute, _ in steps]
        for owner, attribute, label in steps:
            setattr(owner, attribute, watch.around(label, getattr(owner, attribute)))
        gate = KeyframeGate(GateLimits(after_s=0.0))
        poses = poses_of_file(drawn / "poses.csv")
        looking = Keyframes(found, encoder, gate, poses, RunId("bench"), note=print)
        output = FileOutput(folder / "out.jsonl")
        started = time.process_time()
        try:
            for picture in open_images(str(drawn), lambda _size: b"", Timing()):
                keyframe = looking.process(picture)
                assert keyframe is not None
                output.send(keyframe)
        finally:
            for owner, attribute, function in usual:
                setattr(owner, attribute, function)
        output.close(0.0)
        spent = time.process_time() - started
    counts = looking.counts
    each = 1000.0 / counts.pictures
    inside = watch.seconds.pop("models")
    return {
        "pictures": counts.pictures,
        "detections": counts.detections,
        "per_s": counts.pictures / spent,
        "look_ms": spent * each,
        "models_ms": inside * each,
        "added_ms": (spent - inside) * each,
        "steps_ms": {name: value * each for name, value in watch.seconds.items()},
    }


def main() -> None:
    """Print the numbers; exit 1 when a bar is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="how much of a drive")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    found = measure(options.seconds)
    if options.json:
        print(json.dumps(found, indent=2))
    else:
        print(f"{found['pictures']} pictures, {found['detections']} detections")
        print(f"look    {found['look_ms']:7.2f} ms   {found['per_s']:.0f} pictures/s")
        print(f"models  {found['models_ms']:7.2f} ms")
        print(
            f"added   {found['added_ms']:7.2f} ms   {found['added_ms'] / found['models_ms']:.2f} ×"
        )
        for name, value in found["steps_ms"].items():
            print(f"        {value:7.2f} ms   {name}")
    passed = found["added_ms"] <= MOST_ADDED_MS and found["per_s"] >= LEAST_PER_S
    raise SystemExit(0 if passed else 1)


if __name__ == "__main__":
    main()
