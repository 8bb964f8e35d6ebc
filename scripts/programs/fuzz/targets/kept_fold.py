"""A fold kept beside a log: it goes on as before, or is passed over."""

import hashlib
import random
import zlib
from collections.abc import Sequence
from contextlib import suppress

from projections.fold.semantic_map import SemanticMap
from projections.fold.settings import Settings
from projections.store.kept_files import MAGIC, unpack
from projections.store.timeline_cache import MISFITS
from scripts.programs.attack.corruption import corrupt_bytes, corrupt_json
from scripts.programs.fuzz.target import Target
from tests.support.folds import fold, state_bytes
from tests.support.logs import walk

_HEAD = len(MAGIC) + hashlib.sha256().digest_size
_LENGTH_BYTES = 8


class KeptFoldTarget(Target):
    """The bytes of the file."""

    def seeds(self) -> Sequence[bytes]:
        """A small map, and an empty one."""
        folded = [fold(walk(count, seed=2)) for count in (0, 12)]
        return [state_bytes(one) for one in folded]

    def mutate(self, data: bytes, rng: random.Random) -> bytes:
        """The file itself, its index or its arrays, with lengths and checksum made right."""
        if rng.random() < 0.1:
            return corrupt_bytes(data, rng)
        try:
            content = zlib.decompress(data[_HEAD:])
        except zlib.error:
            return corrupt_bytes(data, rng)
        start = _LENGTH_BYTES + int.from_bytes(content[:_LENGTH_BYTES], "little")
        index, arrays = content[_LENGTH_BYTES:start], content[start:]
        if rng.random() < 0.6:
            index = corrupt_json(index, rng)
        else:
            arrays = corrupt_bytes(arrays, rng)
        body = zlib.compress(len(index).to_bytes(_LENGTH_BYTES, "little") + index + arrays, 1)
        return MAGIC + hashlib.sha256(body).digest() + body

    def check(self, data: bytes) -> None:
        """Passed over, or loaded. A reader cannot know whether the content is true: anybody who can
        write here can make a false map with its checksum."""
        with suppress(*MISFITS, zlib.error):
            SemanticMap(Settings()).load(unpack(data))
