"""Keys that envelopes can be published under: Zenoh's, without what only a subscriber may write."""

from .errors import MisuseError
from .system_events import RESERVED_PREFIX, is_system_key

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


def _fault(key: str) -> str | None:
    if any(character in _ONLY_IN_EXPRESSIONS for character in key):
        return "it is a pattern for many keys"
    if any(character.isspace() or not character.isprintable() for character in key):
        return "it holds white space"
    if not all(key.split("/")):
        return "a part of it is empty"
    return None
