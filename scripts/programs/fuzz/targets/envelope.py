"""`eventsrc.envelope.ingest`: never raises; what it accepts is encoded and accepted again."""

import random
from collections.abc import Sequence

from eventsrc.envelope.ingest import Accepted, CheckedEnvelope, Rejected, check_all, ingest
from scripts.programs.attack.corruption import corrupt_json
from scripts.programs.fuzz.target import Target
from tests.support.envelopes import detection, envelope, payload
from tests.support.logs import walk

MAX_REASON = 2_000


class EnvelopeTarget(Target):
    """One payload of a robot."""

    def seeds(self) -> Sequence[bytes]:
        """Envelopes with and without pose, detections and embeddings."""
        odd = detection("☕", [0.5, -1.0, 2.0], det_id="d-1", extra={"x": [1, None]})
        documents = [*walk(5, seed=1), envelope(1, None), envelope(2, detections=[odd])]
        return [payload(document) for document in documents]

    def mutate(self, data: bytes, rng: random.Random) -> bytes:
        """One value becomes another."""
        return corrupt_json(data, rng)

    def check(self, data: bytes) -> None:
        """`ingest` and `check_all` agree; a reason is short."""
        said = ingest(data)
        (kept,) = check_all((data,))
        assert isinstance(said, Rejected) == isinstance(kept, Rejected)
        if isinstance(said, Rejected):
            assert 0 < len(said.reason) <= MAX_REASON
            assert said == kept
        else:
            assert isinstance(said, Accepted)
            assert CheckedEnvelope.of(said.envelope) == kept
            assert len(said.det_ids) == len(said.vectors) == len(said.envelope.detections)
            assert 0 <= said.envelope.stamp_ns < 2**63
