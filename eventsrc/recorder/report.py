"""What a recorder has done so far, as numbers."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class RecorderReport:
    """Counted since this recorder began, but for what the log lacks, its end and the queue.

    ``recorded`` are envelopes that are synced, ``rejected`` payloads that are kept under
    ``mapfold/rejected``. ``queue_full``, ``too_large`` and ``transport_missed`` are messages that
    were sent and are not in the log. ``missing`` are the keyframes that the log's runs lack now,
    whatever the cause and whichever recorder lost them, and ``missing_before`` were lacking when
    this one began; a message lost in the queue is usually missing as well. ``unwritten`` are
    messages that were received and not written, because the log could not be written any more: if
    the next start finds some of them on the disk all the same, the better. ``unsealed`` segments
    are finished and wait to be sealed, ``sealing_error`` says why if that fails; it costs room on
    the disk and loses nothing. ``faults`` are what became of segment files that somebody took
    away, cut short or wrote to, and ``lost_from_log`` how many recorded events were in them.
    """

    recorded: int
    rejected: int
    queue_full: int
    transport_missed: int
    missing: int
    missing_before: int
    queue_depth: int
    queue_size: int
    next_offset: int
    too_large: int = 0
    unwritten: int = 0
    unsealed: int = 0
    sealing_error: str | None = None
    lost_from_log: int = 0
    faults: tuple[str, ...] = ()

    @property
    def lost(self) -> int:
        """Messages that were sent and are not in the log, or are no longer."""
        on_the_way = self.queue_full + self.too_large + self.transport_missed
        return on_the_way + self.unwritten + self.lost_from_log

    @property
    def clean(self) -> bool:
        """True when this recorder lost nothing, rejected nothing and left no new gap."""
        return not (self.rejected or self.lost or self.missing > self.missing_before)
