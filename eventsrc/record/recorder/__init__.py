"""Record from Zenoh to a log: Zenoh's channel → bounded queue → one writer thread."""

from .queue import DEFAULT_QUEUE_SIZE
from .recorder import DEFAULT_CROPS, DEFAULT_KEYS, Recorder
from .writer_thread import RecorderReport

__all__ = ["DEFAULT_CROPS", "DEFAULT_KEYS", "DEFAULT_QUEUE_SIZE", "Recorder", "RecorderReport"]
