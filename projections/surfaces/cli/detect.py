"""`mapfold detect`: pictures to envelopes, with ONNX models."""

import threading
from collections.abc import Iterable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from eventsrc.adapters.detector import service, vision_models
from eventsrc.adapters.detector.heads import HEADS
from eventsrc.adapters.detector.keyframes import (
    AFTER_S,
    MOVED_M,
    TURNED_DEG,
    KeyframeGate,
    Keyframes,
)
from eventsrc.adapters.detector.onnx_model import OnnxModel
from eventsrc.adapters.detector.picture import Picture
from eventsrc.adapters.detector.picture_sources import QUEUE, LivePictures, open_images
from eventsrc.adapters.detector.poses import Poses, PoseTrack, poses_of_file
from eventsrc.adapters.detector.vision import check_installed
from eventsrc.base.errors import MisuseError
from eventsrc.base.text import visible
from eventsrc.envelope.crops import CROPS_TOPIC
from eventsrc.record.robot.publisher import EnvelopePublisher
from eventsrc.record.transport.config import check_key, parse_address
from eventsrc.record.transport.session import Session, ZenohOptions, open_session

from . import detect_text
from .detect_text import WITHOUT_MODELS, advice, as_document, metrics_of, show_status, summary
from .new_log import DropClassOption, NewLogOptions, drop_event
from .options import JsonOption, PublishKeyOption, ZenohPeer, option
from .signals import stop_on_signals
from .terminal import emit, finish, say

_pictures = partial(option, rich_help_panel="Pictures and poses")
_models = partial(option, rich_help_panel="Models")
_keyframes = partial(option, rich_help_panel="Keyframes")


def detect(
    *,
    images: Annotated[
        str | None, _pictures("DIR|VIDEO", "Folder of JPEG and PNG pictures, or a video.")
    ] = None,
    zenoh_image: Annotated[
        str | None,
        _pictures("KEY", "Zenoh key of pictures: JPEG, PNG, or CDR of CompressedImage or Image."),
    ] = None,
    poses: Annotated[
        Path | None,
        _pictures("FILE", "Poses by stamp: TUM, CSV with a header stamp,x,y,yaw, or JSON lines."),
    ] = None,
    zenoh_pose: Annotated[
        str | None,
        _pictures(
            "KEY",
            "Zenoh key of poses: JSON, or CDR of PoseStamped, PoseWithCovarianceStamped or"
            " Odometry.",
        ),
    ] = None,
    fps: Annotated[
        float | None,
        _pictures("N", "Pictures a second, if neither file names nor the video give times."),
    ] = None,
    start: Annotated[
        str,
        _pictures(
            "TIME",
            "When the first picture was taken, with --fps or for a video: seconds since 1970,"
            " or ISO.",
        ),
    ] = "0",
    queue: Annotated[
        int,
        _pictures(
            "N",
            "How many pictures from Zenoh may wait; newer ones replace the oldest.",
            min=1,
            max=1000,
        ),
    ] = QUEUE,
    detector: Annotated[Path | None, _models("MODEL.onnx", "Object detector.")] = None,
    encoder: Annotated[
        Path | None,
        _models("MODEL.onnx", "Encoder of crops; MODEL.json beside it describes its input."),
    ] = None,
    head: Annotated[
        str,
        _models(
            "NAME",
            f"Format of the detector's output: {', '.join(HEADS)}; yolov8 is for v9, v11 and"
            " v12 too.",
        ),
    ] = "yolov8",
    labels: Annotated[
        str | None,
        _models(
            "FILE", "The detector's classes, one a line, or coco [default: those in the model]."
        ),
    ] = None,
    size: Annotated[
        int,
        _models(
            "PIXELS",
            "Side of the detector's input, if the model does not fix it.",
            min=32,
            max=4096,
        ),
    ] = vision_models.SIZE,
    device: Annotated[str, _models("cpu|cuda", "What the models run on.")] = "cpu",
    threads: Annotated[
        int | None,
        _models("N", "Threads of each model [default: the number of cores].", min=1, max=1024),
    ] = None,
    confidence: Annotated[
        float, _models("P", "Least confidence of a detection.", min=0.0, max=1.0)
    ] = vision_models.CONFIDENCE,
    overlap: Annotated[
        float,
        _models(
            "P",
            "Two boxes of a class that overlap by more (intersection over union) are one.",
            min=0.0,
            max=1.0,
        ),
    ] = vision_models.OVERLAP,
    max_detections: Annotated[
        int, _models("N", "Most detections in a picture.", min=1, max=1000)
    ] = vision_models.MOST,
    moved: Annotated[
        float,
        _keyframes(
            "METRES",
            "Distance from the last keyframe from which a picture is a new keyframe.",
            min=0.0,
        ),
    ] = MOVED_M,
    turned: Annotated[
        float,
        _keyframes(
            "DEGREES",
            "Turn since the last keyframe from which a picture is a new keyframe.",
            min=0.0,
        ),
    ] = TURNED_DEG,
    after: Annotated[
        float | None,
        _keyframes(
            "SECONDS",
            "Time since the last keyframe from which a picture is a new keyframe; 0: every"
            f" picture is one. [default: {AFTER_S:g}; without poses 0]",
            min=0.0,
            show_default=False,
        ),
    ] = None,
    hfov: Annotated[
        float | None,
        _keyframes(
            "DEGREES",
            "Horizontal field of view of the camera, stated in the envelopes.",
            min=1.0,
            max=170.0,
        ),
    ] = None,
    run_id: Annotated[
        str | None,
        _keyframes("ID", "Name of the run, one for each start [default: host and time]."),
    ] = None,
    key: PublishKeyOption = "tb/detections",
    out: Annotated[
        Path | None,
        option("FILE", "Write JSON lines for `import` into a new file; publish nothing."),
    ] = None,
    new_log: NewLogOptions,
    drop_class: DropClassOption = None,
    keep_crops: Annotated[
        bool,
        typer.Option(
            "--keep-crops", help=f"Publish each crop as JPEG too, under {CROPS_TOPIC}/<det_id>."
        ),
    ] = False,
    spool: Annotated[
        Path | None,
        option(
            "FILE",
            "File of envelopes that no recorder has acknowledged; the next start sends them"
            " again [default: detect-spool.sqlite in $MAPFOLD_HOME, else in .mapfold].",
        ),
    ] = None,
    wait: Annotated[
        float, option("SECONDS", "How long to wait for acknowledgements at the end.", min=0.0)
    ] = 30.0,
    metrics: Annotated[
        str | None, option("PORT", "Serve Prometheus metrics; PORT or HOST:PORT.")
    ] = None,
    json_: JsonOption = False,
    peer: ZenohPeer,
) -> None:
    """Find objects in pictures and publish them as envelopes.

    Pictures come from a folder, a video or Zenoh; poses from a file or Zenoh. A picture
    becomes a keyframe when the robot has moved or turned far enough, or after a time. Its objects
    are found and their crops encoded by ONNX models of your own; without them, this command prints
    where to get some. Ctrl-C ends it.

    Exit 3 when anything was left out or lost, or waits in the spool.
    """
    if detector is None or encoder is None:
        say(WITHOUT_MODELS)
        models = (("--detector", detector), ("--encoder", encoder))
        missing = [name for name, path in models if path is None]
        raise MisuseError(f"no {' and no '.join(missing)} given")
    detect_text.check_sources(images, zenoh_image, poses, zenoh_pose)
    timing = detect_text.timing_of(start, fps)
    if out is not None and keep_crops:
        raise MisuseError("--keep-crops publishes crops, but --out nothing; give one of them")
    check_key(key, "--key")
    settings = new_log.for_file(out)
    drops = drop_event(drop_class)
    address = None if metrics is None else parse_address(metrics, "--metrics")
    name = detect_text.run_id_of(run_id)
    check_installed()
    wanted = detect_text.device_of(device)
    given_poses: Poses = PoseTrack() if poses is None else poses_of_file(poses)
    options = vision_models.FinderOptions(head, confidence, overlap, max_detections, size)
    finder = vision_models.Finder(
        OnnxModel(detector, wanted, threads),
        None if labels is None else vision_models.read_labels(labels),
        options,
    )
    opened = vision_models.Encoder(
        OnnxModel(encoder, wanted, threads), vision_models.read_preparation(encoder)
    )
    zenoh = peer.zenoh
    with stop_on_signals() as stop, ExitStack() as stack:
        session = None
        if zenoh_image or zenoh_pose or keep_crops:
            session = stack.enter_context(open_session(zenoh, mode=zenoh.mode))
        live = None
        if session is not None and (zenoh_image or zenoh_pose):
            live = LivePictures(session, zenoh_image, zenoh_pose, stop, queue=queue)
        pictures: Iterable[Picture] = (
            live if images is None and live else open_images(images or "", timing)
        )
        keyframes = Keyframes(
            finder,
            opened,
            KeyframeGate(
                detect_text.limits_of(moved, turned, after, posed=bool(poses or zenoh_pose))
            ),
            live.poses if live is not None and live.poses is not None else given_poses,
            name,
            hfov_deg=hfov,
            keep_crops=keep_crops,
            drop_classes=drop_class or (),
            note=_note,
        )
        output = _output(
            stack,
            None if out is None else service.FileOutput(out, settings, drops),
            zenoh,
            spool or detect_text.spool_path(),
            key,
            session if keep_crops else None,
            stop,
            patient=images is not None,
        )
        detection = service.DetectionRun(keyframes, output, live, stop)
        if address is not None:
            stack.enter_context(metrics_of(address, detection))
        where = str(out) if out is not None else key
        said = zenoh_image or images
        say(f"detecting in {said}, run {name}, to {where}; Ctrl-C ends it")
        with show_status() as watch:
            detection.run(pictures, watch)
        detection.close(wait)
    report = detection.report()
    say(summary(name, report, where))
    for line in advice(
        report, live, posed=bool(poses or zenoh_pose), spool=spool or detect_text.spool_path()
    ):
        say(line)
    if json_:
        emit({"run_id": name, "space": opened.name, **as_document(report)})
    finish(findings=not report.clean)


def _output(
    stack: ExitStack,
    file: service.FileOutput | None,
    options: ZenohOptions,
    spool: Path,
    key: str,
    crops: Session | None,
    stop: threading.Event,
    *,
    patient: bool,
) -> service.Output:
    if file is not None:
        stack.callback(file.close, 0.0)
        return file
    publisher = stack.enter_context(EnvelopePublisher(options, spool, key))
    sender = None if crops is None else service.CropSender(crops, CROPS_TOPIC, _note)
    return service.ZenohOutput(publisher, sender, stop, patient=patient, note=_note)


def _note(line: str) -> None:
    say(visible(line))
