"""Publish envelopes from a robot, with none lost while the link or the recorder is away.

* `EnvelopePublisher.publish` writes the envelope into the spool and returns; it never waits for
  the network. One thread sends (`eventsrc.record.robot.sender`), in the order of publishing.
* An envelope leaves the spool when a recorder's ack names its bytes; an ack names what is synced in
  a log. Until then it is sent again, so it may arrive more than once; the fold counts the first.
* `publish` raises for an envelope that no recorder would accept: it validates as recorders do
  (`eventsrc.envelope.ingest`). A recorder may have narrower rules (`--max-payload`) or older ones.
  An envelope that it refuses, with the bytes and the reason in its log, is quarantined in the spool
  and no longer sent: see `EnvelopePublisher.refused`.
"""

import json
import threading
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from eventsrc.base.errors import InvalidEnvelope, MisuseError
from eventsrc.envelope.ingest import Rejected, ingest
from eventsrc.envelope.system_events import RESERVED_PREFIX, is_system_key
from eventsrc.record.transport.config import check_key
from eventsrc.record.transport.session import ZenohOptions, check_options

from .sender import RESEND_AFTER_S, WINDOW, Sender
from .spool import DEFAULT_SPOOL_BYTES, Refused, Spool


class EnvelopePublisher:
    """Publishes one robot's envelopes under ``key``; a context manager, usable from any thread.

    The constructor opens the spool and begins to send what an earlier process left in it. It raises
    SpoolError if the spool cannot be used, and MisuseError if the key is reserved or malformed, an
    endpoint is malformed or the configuration file invalid. It does not raise when no router
    answers: the sending thread tries until one does.
    """

    def __init__(
        self,
        options: ZenohOptions,
        spool: Path,
        key: str = "tb/detections",
        *,
        max_spool_bytes: int = DEFAULT_SPOOL_BYTES,
        window: int = WINDOW,
        resend_after_s: float = RESEND_AFTER_S,
    ) -> None:
        if is_system_key(key):
            raise MisuseError(
                f"key {key!r}: every recorder refuses envelopes under {RESERVED_PREFIX}; "
                "choose another"
            )
        check_key(key, "key")
        check_options(options)
        self._spool = Spool(spool, max_spool_bytes)
        self._sender = Sender(
            options, key, self._spool, window=window, resend_after_s=resend_after_s
        )
        self._thread = threading.Thread(
            target=self._sender.run, name="envelope-sender", daemon=True
        )
        self._thread.start()
        self._waiting: int | None = None

    def publish(self, envelope: Mapping[str, Any] | bytes) -> None:
        """Spool one envelope: a dictionary, or its JSON as bytes, which are sent unchanged.

        Raises InvalidEnvelope with the reason a recorder would give, SpoolFull when the spool has
        no room, SpoolError when the spool is closed or its disk fails, TransportError when the
        sending thread has died.
        """
        payload = envelope if isinstance(envelope, bytes) else _encode(envelope)
        outcome = ingest(payload)
        if isinstance(outcome, Rejected):
            raise InvalidEnvelope(f"envelope not published: {outcome.reason}")
        self._sender.raise_failure()
        self._spool.add(outcome.envelope.run_id, outcome.envelope.keyframe_id, payload)
        self._sender.wake()

    @property
    def unacknowledged(self) -> int:
        """How many envelopes wait for a recorder's acknowledgement."""
        return len(self._spool)

    @property
    def refused_count(self) -> int:
        """How many envelopes a recorder has refused; they are quarantined in the spool."""
        return self._spool.refused_count

    def refused(self, limit: int = 100) -> list[Refused]:
        """The oldest refused envelopes, each with the refusing recorder's log and its reason."""
        return self._spool.refused(limit)

    def retry_refused(self) -> int:
        """Send the refused envelopes again, for a recorder that was fixed; returns how many.

        Those whose bytes were dropped for new envelopes stay `refused`; the log named there has
        them.
        """
        retried = self._spool.retry_refused()
        self._sender.wake()
        return retried

    def discard_refused(self) -> int:
        """Drop the refused envelopes; returns how many."""
        return self._spool.discard_refused()

    def flush(self, timeout_s: float) -> bool:
        """Wait until everything published is acknowledged or refused.

        True when all of it is acknowledged; False on a timeout or when any is `refused`.
        """
        return self._sender.wait_until_answered(timeout_s) and not self.refused_count

    def close(self, timeout_s: float = 0.0) -> int:
        """`flush`, then stop. Returns how many envelopes wait in the spool for the next process."""
        if self._waiting is None:
            if timeout_s > 0:
                self.flush(timeout_s)
            self._sender.stop()
            self._thread.join()
            self._waiting = len(self._spool)
            self._spool.close()
        return self._waiting

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        self.close()


def _encode(envelope: Mapping[str, Any]) -> bytes:
    try:
        return json.dumps(envelope, ensure_ascii=False, allow_nan=False).encode()
    except (TypeError, ValueError) as error:
        raise InvalidEnvelope(f"envelope not published: not JSON: {error}") from None
