"""What a target of fuzzing is."""

import random
from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cache

MAX_MESSAGE = 2_000


def check_message(error: Exception) -> None:
    """Check that an error says something, and not too much."""
    assert 0 < len(str(error)) <= MAX_MESSAGE


class Target(ABC):
    """One reader of other people's bytes."""

    @abstractmethod
    def seeds(self) -> Sequence[bytes]:
        """Valid inputs."""

    @abstractmethod
    def mutate(self, data: bytes, rng: random.Random) -> bytes:
        """``data``, which need not be valid, with something about it changed."""

    @abstractmethod
    def check(self, data: bytes) -> None:
        """Read ``data``. Raises whatever is no documented error; AssertionError: it is misread."""

    def mutated_seed(self, rng: random.Random) -> bytes:
        """A valid input that was damaged once or a few times."""
        data = rng.choice(self._seeds())
        for _ in range(rng.choice((1, 1, 2, 4))):
            data = self.mutate(data, rng)
        return data

    @cache  # noqa: B019  # one target of each kind, as long as the process lives
    def _seeds(self) -> Sequence[bytes]:
        return self.seeds()
