"""The state of a fold as bytes: what is not as it was written is refused."""

import contextlib
import hashlib
import zlib
from typing import Any

import numpy as np
import pytest

from projections.fold.semantic_map import SemanticMap
from projections.fold.settings import Settings
from projections.store.kept_files import MAGIC, MalformedState, pack, unpack
from projections.store.timeline_cache import MISFITS
from tests.support.envelopes import detection, envelope
from tests.support.folds import Folded, state_bytes


def _documents(count: int) -> list[dict[str, Any]]:
    return [
        envelope(i, i % 17 / 4, i % 5 / 3, detections=[detection("cup", [1.0, i % 3, 0.5])])
        for i in range(count)
    ]


@pytest.mark.parametrize("instead", [None, 7, "x", [], [[1]], {}, 1 << 70, np.zeros((2, 2))])
@pytest.mark.parametrize("settings", [Settings(), Settings(places="rooms")])
def test_content_that_does_not_fit_together_is_refused(settings: Settings, instead: Any) -> None:
    """Whatever stands in place of any value, by another hand: an error that a cache passes over, or
    a fold."""
    state = unpack(state_bytes(Folded.start(settings).extend(_documents(5))))
    for name in state:
        with contextlib.suppress(*MISFITS):
            SemanticMap(settings).load(unpack(pack(state | {name: instead})))
    for name in ("places.joined", "seen.offsets"):
        with pytest.raises(MISFITS):
            SemanticMap(settings).load({k: v for k, v in state.items() if k != name})


def test_bytes_with_another_head_or_checksum_are_refused() -> None:
    with pytest.raises(MalformedState, match="does not begin"):
        unpack(b"\x80\x04pickle")
    body = zlib.compress(b"")
    with pytest.raises(MalformedState, match="checksum"):
        unpack(MAGIC + b"0" * 32 + body)


@pytest.mark.seconds
def test_a_decompression_bomb_is_refused() -> None:
    squeeze = zlib.compressobj(1)
    first, again = (
        squeeze.compress(bytes(1_000_000)) + squeeze.flush(zlib.Z_FULL_FLUSH) for _ in range(2)
    )
    body = first + 499 * again + squeeze.flush()
    assert len(body) < 4_000_000
    with pytest.raises(MalformedState, match="decompresses to more than"):
        unpack(MAGIC + hashlib.sha256(body).digest() + body)
