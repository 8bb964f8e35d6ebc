"""`mapfold reembed`: add vectors of another encoder to a log, made from its crops of detections."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import numpy as np

from eventsrc.adapters.detector.onnx_model import Device, OnnxModel, model_sha256
from eventsrc.adapters.detector.picture import PictureError, Pixels
from eventsrc.adapters.detector.vision import check_installed, decode
from eventsrc.adapters.detector.vision_models import Encoder, read_preparation
from eventsrc.adapters.reembedding import DEFAULT_BATCH, Reembedding, Vector, reembed
from eventsrc.base.text import advised, counted, visible
from eventsrc.envelope.crops import CROPS_TOPIC
from eventsrc.envelope.system_events import MAX_REEMBEDDED

from .detect_text import device_of
from .folded_log import LogArgument
from .options import JsonOption, option, user_at_host
from .signals import stop_on_signals
from .terminal import Bar, emit, finish, say


class OnnxCropEncoder:
    """An ONNX encoder and the JSON file beside it, for `eventsrc.adapters.reembedding`."""

    def __init__(self, path: Path, device: Device, threads: int | None) -> None:
        preparation = read_preparation(path)
        check_installed()
        self._encoder = Encoder(OnnxModel(path, device, threads), preparation)
        self.space, self.dimension = self._encoder.name, self._encoder.dimension
        self.sha256 = model_sha256(path, preparation)

    def encode(self, jpegs: Sequence[bytes]) -> list[Vector | str]:
        """A vector for each JPEG, of NaN where the model has none; or why it cannot be decoded."""
        decoded: list[Pixels | str] = [_decoded(jpeg) for jpeg in jpegs]
        good = [crop for crop in decoded if not isinstance(crop, str)]
        vectors = iter(self._encoder.encode(good))
        none = np.full(self.dimension, np.nan, np.float32)
        return [
            crop if isinstance(crop, str) else none if (vector := next(vectors)) is None else vector
            for crop in decoded
        ]


def _decoded(jpeg: bytes) -> Pixels | str:
    try:
        return decode(jpeg)
    except PictureError as error:
        return str(error)


def reembed_log(
    log: LogArgument,
    encoder: Annotated[
        Path,
        option(
            "MODEL.onnx",
            "Encoder of crops; MODEL.json beside it names its space and describes its input,"
            " as for `mapfold detect`.",
        ),
    ],
    batch: Annotated[
        int, option("N", "Vectors in one event.", min=1, max=MAX_REEMBEDDED)
    ] = DEFAULT_BATCH,
    crops: Annotated[
        list[str] | None,
        option(
            "TOPIC",
            f"Where the log keeps crops; may be repeated. [default: {CROPS_TOPIC}]",
            "--crops",
        ),
    ] = None,
    device: Annotated[str, option("cpu|cuda", "What the model runs on.")] = ("cpu"),
    threads: Annotated[int | None, option("N", "Threads of the model.", min=1)] = None,
    reason: Annotated[str, option("TEXT", "Why, for those who read the log later.")] = "",
    json_: JsonOption = False,
) -> None:
    """Add vectors of another encoder to a log, made from the crops that it keeps.

    They are appended; `--space NAME` then maps the log in their space. Run an interrupted command
    again to continue it. Exit 3 when crops cannot be decoded or encoded.
    """
    model = OnnxCropEncoder(encoder, device_of(device), threads)
    with stop_on_signals() as stop, Bar() as bar:
        done = reembed(
            log,
            model,
            topics=tuple(crops or (CROPS_TOPIC,)),
            batch=batch,
            issued_by=user_at_host(),
            reason=reason,
            progress=lambda at, end: bar.show("reading", at, end),
            stopped=stop.is_set,
        )
    _report(log, encoder, done)
    if json_:
        emit({**asdict(done), "faults": [fault._asdict() for fault in done.faults]})
    finish(findings=bool(done.corrupt or done.unusable or done.stopped))


def _report(log: Path, encoder: Path, done: Reembedding) -> None:
    for fault in done.faults:
        who = "a crop" if fault.det_id is None else f"the crop of {visible(fault.det_id)}"
        say(f"{log}: {who} at offset {fault.offset}: {fault.reason}")
    parts = [f"{done.added:,} re-embedded in {visible(done.space)}, dimension {done.dimension:,}"]
    for count, what in (
        (done.known, "were before"),
        (done.own, "recorded in it"),
        (done.without_crop, "without a crop"),
        (done.corrupt, "with a corrupt crop"),
        (done.unusable, "with NaN or zero from the encoder"),
    ):
        parts += [f"{count:,} {what}"] if count else []
    say(f"{log}: {counted(done.detections, 'detection')}: {', '.join(parts)}")
    if done.stopped:
        again = advised("reembed", log, "--encoder", encoder)
        say(f"{log}: interrupted, and no map has these yet; go on with: {visible(again)}")
    elif done.command is not None:
        say(f"{log}: in force by the command at offset {done.command}")
