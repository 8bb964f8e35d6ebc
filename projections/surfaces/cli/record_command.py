"""`mapfold record` and `mapfold router`: from Zenoh to a log, and a router for it."""

import dataclasses
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Annotated, Final

import typer

from eventsrc.base.errors import LogDamaged, MisuseError
from eventsrc.base.text import visible
from eventsrc.envelope.gaps import GapLedger
from eventsrc.envelope.ingest import DEFAULT_MAX_PAYLOAD_BYTES, MAX_PAYLOAD_BYTES
from eventsrc.envelope.model import RunId
from eventsrc.log import LogReader, LogWriter, parse_fsync
from eventsrc.record.gap_history import fold_and_save_ledger
from eventsrc.record.recorder.bridged import Bridge
from eventsrc.record.recorder.edits import EDIT_PREFIX, Edits, KnownCommands, edit_key
from eventsrc.record.recorder.queue import DEFAULT_QUEUE_SIZE
from eventsrc.record.recorder.recorder import DEFAULT_CROPS, DEFAULT_KEYS, Recorder
from eventsrc.record.transport.config import parse_address
from eventsrc.record.transport.session import Router, check_keys, open_session
from eventsrc.ros.library import MessageTypes
from projections.fold.corrections import check_settings

from . import bridge_options
from .bag_text import crop_cutter, stream_lines
from .folded_log import classes_advice
from .new_log import DropClassOption, LogStart, NewLogOptions, drop_event, say_camera
from .options import ConfigOption, JsonOption, ListenOption, ZenohPeer, domain_of, option
from .recorder_text import EVERY_S, RecorderSummary, say_restart, show_status
from .signals import stop_on_signals
from .terminal import say, say_metrics

_LARGEST_BYTES: Final = 128 * 1024 * 1024
"""Lower bound of Zenoh's own size limit, which drops messages silently: most messages that are too
large should reach the recorder and be counted."""


def record(
    *,
    log: Annotated[
        Path, typer.Argument(metavar="LOG", help="The log to append to; created if there is none.")
    ],
    peer: ZenohPeer,
    key: Annotated[
        list[str] | None,
        option(
            "KEY",
            "Key expression to record; wildcards * and ** work; may be repeated. "
            f"[default: {DEFAULT_KEYS[0]}]",
            "--key",
        ),
    ] = None,
    crops: Annotated[
        list[str] | None,
        option(
            "KEY",
            "Key expression PREFIX/* of the JPEGs of detections, which `mapfold detect"
            " --keep-crops` publishes; may be repeated; '' keeps none. "
            f"[default: {DEFAULT_CROPS[0]}]",
            "--crops",
        ),
    ] = None,
    fsync: Annotated[
        str, option("POLICY", "always, <N>ms or never: when events reach the disk.")
    ] = "50ms",
    queue: Annotated[
        int, option("N", "How many messages may wait for the disk.", min=1)
    ] = DEFAULT_QUEUE_SIZE,
    max_payload: Annotated[
        int, option("BYTES", "Larger messages are rejected.", min=1, max=MAX_PAYLOAD_BYTES)
    ] = DEFAULT_MAX_PAYLOAD_BYTES,
    max_events: Annotated[int | None, option("N", "Stop after so many messages.", min=1)] = None,
    gaps: Annotated[
        bool,
        typer.Option(
            "--gaps/--no-gaps",
            help="Missing keyframe ids are losses; off for robots that do not count by one.",
        ),
    ] = True,
    metrics: Annotated[
        str | None, option("PORT", "Serve Prometheus metrics; PORT or HOST:PORT.")
    ] = None,
    accept_edits: Annotated[
        bool,
        typer.Option(
            "--accept-edits",
            help="Record the commands of `mapfold edit` from everybody who may query "
            f"{EDIT_PREFIX}/ on this Zenoh network.",
        ),
    ] = False,
    new_log: NewLogOptions,
    drop_class: DropClassOption = None,
    ros2: bridge_options.Ros2Option = False,
    domain: bridge_options.RecordedDomainOption = None,
    ros2dds: bridge_options.Ros2ddsOption = False,
    choice: bridge_options.BridgeChoice,
    json: JsonOption = False,
) -> None:
    """Record what robots publish over Zenoh, until Ctrl-C.

    With --ros2 also the messages of nodes over rmw_zenoh, with --ros2dds those of a
    zenoh-bridge-ros2dds, and without --key only those.

    Exit 3 when anything was rejected or lost, is missing, or could not be read.
    """
    bridge_options.check_unused(choice, domain, ros2=ros2, ros2dds=ros2dds)
    is_ros = ros2 or ros2dds
    new_log.check()
    drops = drop_event(drop_class)
    policy = parse_fsync(fsync)
    options = dataclasses.replace(
        peer.zenoh, max_message_bytes=max(_LARGEST_BYTES, 4 * max_payload)
    )
    keys = tuple(key or (() if is_ros else DEFAULT_KEYS))
    check_keys(keys)
    crop_keys = _crop_keys(crops)
    types = MessageTypes() if is_ros else None
    number = domain_of(domain) if ros2 else 0
    if ros2dds:
        bridge_options.recording_of(choice, 0, None)
    if is_ros:
        bridge_options.as_of_a_bag(choice)
    address = None if metrics is None else parse_address(metrics, "--metrics")
    with (
        RecorderSummary(log, json=json) as summary,
        stop_on_signals() as stop,
        open_session(options, mode=options.mode) as session,
        ExitStack() as opened,
    ):
        made = None
        if ros2 and types is not None:
            made = bridge_options.find_topics_of_nodes(choice, session, number, types, stop)
            if made is None:
                return
        writer = opened.enter_context(LogWriter(log, fsync=policy, sealing_process=True))
        say_restart(log, writer)
        start = writer.next_offset
        said = LogStart.of(log, writer, new_log, is_ros=is_ros, drops=drops)
        dropper = said.dropper()
        if dropper and choice.topic:
            raise MisuseError(
                f"--topic {visible(choice.topic[0])} keeps messages as they are, with whatever they"
                f" show, but the log drops {visible(', '.join(sorted(dropper.classes)))}"
            )
        said.record(writer)
        if types is not None:
            bridge_options.finish_last_recording(writer, types, dropper)
        ledger = _gap_history(log)
        bridge = None
        if types is not None:
            found = (
                bridge_options.topics_of_bridge(choice, writer.now_ns(), ledger)
                if made is None
                else bridge_options.topics_of_nodes(choice, made, number, ledger)
            )
            cut = crop_cutter(choice.keep_crops, choice.images)
            bridge = Bridge(found.recording, found.topics, types, found.wire, cut, dropper)
        recorder = Recorder(
            session,
            writer,
            keys,
            queue_size=queue,
            max_events=max_events,
            ledger=ledger,
            report_gaps=gaps,
            max_payload_bytes=max_payload,
            edits=_edits(log, writer) if accept_edits else None,
            bridge=bridge,
            crops=crop_keys,
            dropper=dropper,
        )
        summary.watch(writer, recorder)
        with _metrics(address, recorder, log), show_status(log) as watch:
            if bridge is not None and ros2dds:
                bridge_options.say_topics(log, bridge)
                watch = bridge_options.warn_of_silence(bridge, watch, EVERY_S)
            named = ", ".join(keys or (bridge.keys if bridge is not None else ()))
            say(f"recording {named} to {log} from offset {writer.next_offset}; Ctrl-C ends it")
            if accept_edits:
                say(f"taking commands of `mapfold edit` on {edit_key(writer.log_id)}")
            recorder.run(stop, every_s=EVERY_S, watch=watch)
            streams = {} if bridge is None else bridge.derivation.counts
            for line in stream_lines(streams):
                say(line)
            if streams and all(0 < each.numbered == each.detections for each in streams.values()):
                say(classes_advice(log))
    say_camera(log, start)
    summary.finish()


def _crop_keys(given: list[str] | None) -> tuple[str, ...]:
    """The key expressions of ``--crops``. Raises MisuseError."""
    keys = tuple(filter(None, DEFAULT_CROPS if given is None else given))
    for key in keys:
        if not key.endswith("/*") or "*" in key[:-1]:
            raise MisuseError(f"--crops {visible(key)}: write it as PREFIX/*, such as tb/crops/*")
    check_keys(keys)
    return keys


def _gap_history(log: Path) -> GapLedger[RunId] | None:
    """The log's gap history, or None if the log is damaged: recording goes on without it."""
    try:
        with LogReader(log) as reader:
            return fold_and_save_ledger(reader, note=say)
    except LogDamaged as error:
        say(f"recording without gap history: {error}")
        return None


def _edits(log: Path, writer: LogWriter) -> Edits:
    """The receiver of commands; it refuses all of them if those in the log cannot be read."""
    known: KnownCommands | str
    try:
        with LogReader(log) as reader:
            known = KnownCommands.of(reader)
    except LogDamaged as error:
        say(f"recording without edits: {error}")
        known = str(error)
    return Edits(writer, known, check_settings)


@contextmanager
def _metrics(address: tuple[str, int] | None, recorder: Recorder, log: Path) -> Iterator[None]:
    if address is None:
        yield
        return
    from eventsrc.record.metrics import serving_metrics  # not imported unless needed

    with serving_metrics(address, recorder.report, log) as port:
        say_metrics(address, port)
        yield


def router(
    listen: ListenOption = None,
    connect: Annotated[
        list[str] | None, option("ENDPOINT", "Router to connect to; may be repeated.", "--connect")
    ] = None,
    zenoh_config: ConfigOption = None,
) -> None:
    """Run a Zenoh router in this process until Ctrl-C.

    It listens on tcp/127.0.0.1:7447 unless --listen or a configuration file says otherwise.
    --connect links it to other routers.
    """
    options = ZenohPeer(connect=connect, listen=listen, zenoh_config=zenoh_config).zenoh
    with stop_on_signals() as stop, Router(options) as running:
        say(f"router listening on {', '.join(running.endpoints)}; Ctrl-C ends it")
        stop.wait()
    say("router ended")
