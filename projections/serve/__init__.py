"""Re-localisation as a service: over Zenoh, and over HTTP with the extra ``[serve]``."""

from .answering import Answerer
from .pools import Pools
from .room import Room
from .zenoh import ZenohService

__all__ = ["Answerer", "Pools", "Room", "ZenohService"]
