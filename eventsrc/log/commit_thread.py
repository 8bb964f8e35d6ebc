"""Who brings a group to the disk: the thread that appends, or another beside it.

In turn, an append that makes a commit due returns when that is done. Overlapped, a thread writes
and syncs one group while the next is taken; what comes meanwhile makes the next group larger, up to
`SLACK` times what the policy says, and only then must the appending thread wait. Either way groups
reach the file one after the other, in order, and an event counts when its own group is synced. A
rotation is one more such step: the next segment takes events while the last one is being finished
and the file of the next is made.
"""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

from eventsrc.errors import LogError

from .active_segment import ActiveSegment
from .group import Group

SLACK = 16
"""4,096 events or 64 MiB: at 40,000 events a second, what comes while one sync takes 100 ms, as it
does when a sealed segment is being written to the same disk."""


Done = Callable[[], None]


def _rotate(segment: ActiveSegment, rest: Group, following: ActiveSegment, done: Done) -> None:
    """Raises LogError; ``following`` then takes nothing either."""
    try:
        segment.end(rest)
        following.create()
    except OSError as error:
        raise following.refuse(
            f"{segment.path.parent}: no new segment at offset {following.base}: "
            f"{error.strerror or error}; every event before it is safe. "
            "Free space or fix the disk, then start again"
        ) from error
    except LogError as error:
        following.refuse(str(error))
        raise
    done()


class Commits:
    """In turn."""

    slack = 1

    def begin(self, segment: ActiveSegment) -> bool:
        """See to it that what was taken gets committed; False when that must wait."""
        segment.commit()
        return True

    def rotate(self, segment: ActiveSegment, following: ActiveSegment, done: Done) -> None:
        """Commit the rest of ``segment``, make the file of ``following``, call ``done``."""
        _rotate(segment, segment.cut(), following, done)

    def finish(self, segment: ActiveSegment) -> None:
        """Return when everything taken is committed. Raises LogError if it cannot be."""
        segment.commit()

    def settle(self) -> None:
        """Return when nothing is under way. Raises what became of it if that was an error."""

    def close(self) -> None:
        """Commit nothing more; what is under way is waited for."""


class OverlappedCommits(Commits):
    """In a thread of its own. Belongs to the thread that appends, like the segment."""

    slack = SLACK

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="mapfold-commit")
        self._last: Future[None] | None = None

    def begin(self, segment: ActiveSegment) -> bool:
        """Hand over what was taken, unless the last group is still under way and there is room."""
        if self._last is not None and not self._last.done() and not segment.full():
            return False
        self.settle()
        self._last = self._thread.submit(segment.write, segment.cut())
        return True

    def rotate(self, segment: ActiveSegment, following: ActiveSegment, done: Done) -> None:
        """The same, beside the thread that appends to ``following`` by now."""
        self.settle()
        self._last = self._thread.submit(_rotate, segment, segment.cut(), following, done)

    def finish(self, segment: ActiveSegment) -> None:
        """Wait for the last group and commit the rest."""
        self.settle()
        segment.commit()

    def settle(self) -> None:
        """Wait for the last group, and raise what became of it if that was an error."""
        last, self._last = self._last, None
        if last is not None:
            last.result()

    def close(self) -> None:
        """Wait for the last group; its error, if it had one, is with the segment."""
        self._thread.shutdown()
