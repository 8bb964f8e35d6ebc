"""Keys that envelopes can be published under: Zenoh's, without what only a subscriber may write,
and not too long.
"""

from typing import Final

from .errors import MisuseError
from .system_events import RESERVED_PREFIX, is_system_key

MAX_KEY_BYTES: Final = 1024
"""Bound of a key in UTF-8. A log repeats it in each of its chunks, and an answer's key is made of
it; Zenoh itself fails inside on keys of 64 kB."""
_ONLY_IN_EXPRESSIONS = frozenset("*$?#")


def check_key(key: str, option: str) -> str:
    """Return ``key`` if messages can bear it; MisuseError that names ``option`` if not."""
    if is_system_key(key):
        raise MisuseError(
            f"{option} {key!r}: keys under {RESERVED_PREFIX} are mapfold's own; choose another"
        )
    fault = _fault(key)
    if fault:
        raise MisuseError(
            f"{option} {key!r}: {fault}, so nothing can be published under it; "
            "write a key such as tb/detections"
        )
    return key


def fault_in_log(key: str) -> str | None:
    """Why a log does not keep envelopes under ``key``, whoever sends them; None if it does."""
    if is_system_key(key):
        return "is reserved for mapfold's own events"
    if key.isascii() and len(key) <= MAX_KEY_BYTES:  # as a rule, and quickly told
        return None
    try:
        size = len(key.encode())
    except UnicodeEncodeError:
        return "is no UTF-8"
    return f"is {size} bytes long, more than {MAX_KEY_BYTES}" if size > MAX_KEY_BYTES else None


def _fault(key: str) -> str | None:
    if any(character in _ONLY_IN_EXPRESSIONS for character in key):
        return "it is a pattern for many keys"
    if any(character.isspace() or not character.isprintable() for character in key):
        return "it holds white space"
    if not all(key.split("/")):
        return "a part of it is empty"
    in_log = fault_in_log(key)
    return None if in_log is None else f"it {in_log}"
