"""The loop of `mapfold detect`: a source's pictures through the models to an output."""

import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from .keyframes import Counts, Keyframes
from .live import LivePictures
from .outputs import Delivered, Output
from .picture import Picture


@dataclass(frozen=True, slots=True)
class Report:
    """Counts of pictures, of keyframes by delivery, and of messages received over Zenoh."""

    counts: Counts
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


class Detection:
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
