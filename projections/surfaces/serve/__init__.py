"""Re-localisation as a service over Zenoh, and over HTTP with the extra ``[serve]``."""

from .answering import Answerer
from .fair_queue import FairQueue
from .pools import Pools
from .zenoh import ZenohService

__all__ = ["Answerer", "FairQueue", "Pools", "ZenohService"]
