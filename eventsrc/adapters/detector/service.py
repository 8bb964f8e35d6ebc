"""The loop of `mapfold detect`: a source's pictures through the models to an output, which is Zenoh
through a robot's spool, or a file of JSON lines.
"""

import json
import threading
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

from eventsrc.base.errors import MapfoldError, MisuseError, SpoolFull, TransportError
from eventsrc.base.text import counted
from eventsrc.base.user_files import written_whole
from eventsrc.envelope.commands import UseSettings
from eventsrc.envelope.dropped_classes import DropClasses
from eventsrc.envelope.model import stamp_ns
from eventsrc.record.importers.json_lines import command_record
from eventsrc.record.robot.publisher import EnvelopePublisher
from eventsrc.record.transport.session import Session

from .keyframes import CropJpeg, DetectedKeyframe, Keyframes, PictureCounts
from .picture import Picture
from .picture_sources import LivePictures

_SLICE_S: Final = 0.25
_LAST_CHANCE_S: Final = 2.0


@dataclass
class Delivered:
    """Counts of keyframes by outcome: ``waiting`` and ``refused`` ones are in the spool, those with
    ``no_room`` did not fit into it."""

    published: int = 0
    waiting: int = 0
    refused: int = 0
    no_room: int = 0
    crops: int = 0
    crops_lost: int = 0
    """Crops not sent because there was no subscriber."""


class FileOutput:
    """Envelopes as JSON lines in a new file, which gets its name when it is closed, or when a write
    fails: then it has the whole lines before. A log that it is imported into begins with
    ``settings``, and drops what ``drops`` says. Raises MisuseError if the file exists already or
    cannot be made, MapfoldError where writing fails."""

    def __init__(
        self, path: Path, settings: UseSettings | None = None, drops: DropClasses | None = None
    ) -> None:
        self.delivered = Delivered()
        self._begins: list[UseSettings | DropClasses] = [b for b in (settings, drops) if b]
        if path.is_file():
            raise MisuseError(f"--out {path}: there is such a file; remove it, or choose another")
        self._path, self._stack = path, ExitStack()
        self._file = self._stack.enter_context(written_whole(path))

    def send(self, keyframe: DetectedKeyframe) -> None:
        """Write its envelope."""
        whole = self._file.tell() if self._file.seekable() else None
        try:
            for said in self._begins:
                first = command_record(said, stamp_ns(keyframe.envelope["timestamp"]))
                self._file.write(_encode(first) + b"\n")
            self._begins = []
            self._file.write(_encode(keyframe.envelope) + b"\n")
        except MapfoldError as error:
            if whole is not None:  # keyframes of a camera cannot be had a second time
                self._file.truncate(whole)
            self._stack.close()
            count = counted(self.delivered.published, "keyframe")
            raise MapfoldError(f"{error}; {self._path} has the {count} before") from None
        self.delivered.published += 1

    def close(self, wait_s: float) -> None:  # noqa: ARG002  as `ZenohOutput` has it
        """Close the file."""
        self._stack.close()


class ZenohOutput:
    """Envelopes over Zenoh through a spool, which keeps them until a recorder acknowledges them;
    crops directly.

    While the spool is full, `send` waits if ``patient`` (pictures from files), else it drops the
    keyframe (a camera).
    """

    def __init__(
        self,
        publisher: EnvelopePublisher,
        crops: "CropSender | None",
        stop: threading.Event,
        *,
        patient: bool,
        note: Callable[[str], None],
    ) -> None:
        self._counts = Delivered()
        self._publisher, self._crops, self._stop = publisher, crops, stop
        self._patient, self._note = patient, note

    @property
    def delivered(self) -> Delivered:
        """The counts so far, and the number of envelopes in the spool."""
        spooled = self._publisher
        return replace(self._counts, waiting=spooled.unacknowledged, refused=spooled.refused_count)

    def send(self, keyframe: DetectedKeyframe) -> None:
        """Spool its envelope and send its crops."""
        payload = _encode(keyframe.envelope)
        while True:
            try:
                self._publisher.publish(payload)
            except SpoolFull as full:
                if self._patient and not self._stop.is_set():
                    self._publisher.flush(_SLICE_S)
                    continue
                if self._counts.no_room == 0:
                    self._note(f"keyframe lost: {full}")
                self._counts.no_room += 1
                return
            break
        self._counts.published += 1
        if self._crops is not None:
            for crop in keyframe.crops:
                sent = self._crops.send(crop)
                self._counts.crops += sent
                self._counts.crops_lost += not sent

    def close(self, wait_s: float) -> None:
        """Wait for acknowledgements, for a shorter time after ``stop``, and close the spool."""
        left_s = min(wait_s, _LAST_CHANCE_S) if self._stop.is_set() else wait_s
        stopped = self._stop.is_set()
        while left_s > 0 and self._publisher.unacknowledged:
            self._publisher.flush(min(_SLICE_S, left_s))
            left_s -= _SLICE_S
            if self._stop.is_set() and not stopped:
                break
        self._publisher.close()


Output = FileOutput | ZenohOutput


class CropSender:
    """Publishes crops under ``prefix/det_id``, percent-encoded where a key allows less."""

    def __init__(self, session: Session, prefix: str, note: Callable[[str], None]) -> None:
        self._session, self._prefix, self._note = session, prefix, note
        self._heard = session.publisher(f"{prefix}/*")
        self._noted = False

    def send(self, crop: CropJpeg) -> bool:
        """Publish a crop; return False if there is no subscriber."""
        if not self._heard.has_subscriber:
            if not self._noted:
                self._note(
                    f"crops are lost: there is no subscriber to {self._prefix}/*;"
                    " a recorder keeps them, unless its --crops says otherwise"
                )
            self._noted = True
            return False
        try:
            self._session.put(f"{self._prefix}/{quote(crop.det_id, safe='')}", crop.jpeg)
        except TransportError as error:
            if not self._noted:
                self._note(str(error))
            self._noted = True
            return False
        return True


def _encode(envelope: dict[str, Any]) -> bytes:
    return json.dumps(envelope, ensure_ascii=False, separators=(",", ":")).encode()


@dataclass(frozen=True, slots=True)
class Report:
    """Counts of pictures, of keyframes by delivery, and of messages received over Zenoh."""

    counts: PictureCounts
    delivered: Delivered
    dropped: int = 0
    """Pictures dropped for newer ones."""
    too_large: int = 0
    """Pictures too large to be taken."""
    poses: int | None = None
    """Poses received over Zenoh; None if poses are not received."""
    bad_poses: int = 0
    stopped: bool = False
    """Whether the run ended before the last picture of a file, folder or stream."""

    @property
    def clean(self) -> bool:
        """Whether nothing was lost, left out or kept waiting."""
        sent = self.delivered
        unsent = sent.waiting + sent.refused + sent.no_room + sent.crops_lost
        lost = self.counts.lost + unsent + self.dropped + self.too_large + self.bad_poses
        return not lost and not self.stopped


class DetectionRun:
    """One run of the detector; `report` may be called from any thread."""

    def __init__(
        self, keyframes: Keyframes, output: Output, live: LivePictures | None, stop: threading.Event
    ) -> None:
        self._keyframes, self._output, self._live, self._stop = keyframes, output, live, stop
        self._stopped = False

    def run(self, pictures: Iterable[Picture], watch: Callable[[Report], None]) -> None:
        """Process all pictures, or until ``stop`` is set; ``watch`` is called after each.

        Pictures received over Zenoh have no last one; their iterator ends with ``stop``.
        """
        for picture in pictures:
            if self._stop.is_set() and pictures is not self._live:
                self._stopped = True
                return
            keyframe = self._keyframes.process(picture)
            if keyframe is not None:
                self._output.send(keyframe)
            watch(self.report())

    def close(self, wait_s: float) -> None:
        """Close the output, after waiting at most ``wait_s`` seconds for acknowledgements."""
        self._output.close(wait_s)

    def report(self) -> Report:
        """The counts so far."""
        counts, delivered = self._keyframes.counts, self._output.delivered
        stopped = self._stopped
        if self._live is None:
            return Report(counts, delivered, stopped=stopped)
        queue, poses = self._live.queue, self._live.poses
        return Report(
            *(counts, delivered, queue.dropped, queue.too_large),
            poses=None if poses is None else poses.count,
            bad_poses=0 if poses is None else poses.bad,
            stopped=stopped,
        )
