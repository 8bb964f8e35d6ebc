"""Random damage: to a JSON document, to bytes, to the segments of a log."""

import json
import random
from pathlib import Path
from typing import Any

from eventsrc.log.format import list_segments

_NESTED: Any = "leaf"
for _ in range(300):
    _NESTED = [_NESTED]

VALUES: tuple[Any, ...] = (
    *(None, True, 0, -1, 1.5, 2**63, -(2**63) - 1, 10**400, 1e308, float("nan"), float("inf")),
    *("", "x", "\x00", "\ud800", "\u202e", "x" * 300, "A" * 4097, "9" * 5000, "run", "{}"),
    *([], {}, [[]], [None] * 40, {"x": {}}, [{}] * 40, _NESTED, [1.0] * 17_000),
)


def corrupt_json(text: bytes, rng: random.Random) -> bytes:
    """``text`` with one to three things changed; whole JSON as a rule, never the same as a rule."""
    try:
        document = json.loads(text)
    except (ValueError, RecursionError):
        return corrupt_bytes(text, rng)
    for _ in range(rng.choice((1, 1, 2, 3))):
        document = _changed(document, rng)
    changed = json.dumps(document).encode()  # ensure_ascii: lone surrogates become escapes
    return corrupt_bytes(changed, rng) if rng.random() < 0.2 else changed


def corrupt_bytes(data: bytes, rng: random.Random) -> bytes:
    """``data`` with bits flipped, pieces cut out, doubled, or put in."""
    damaged = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 8))):
        at = rng.randrange(len(damaged) + 1)
        match rng.randrange(6):
            case 0 if at < len(damaged):
                damaged[at] ^= 1 << rng.randrange(8)
            case 1:
                del damaged[at : at + rng.choice((1, 4, 64, 10**9))]
            case 2:
                damaged[at:at] = damaged[max(0, at - rng.choice((1, 8, 100))) : at]
            case 3:
                damaged[at : at + 8] = rng.choice((bytes(8), b"\xff" * 8, b"\x7f" + bytes(7)))
            case 4:
                damaged[at:at] = rng.randbytes(rng.choice((1, 4, 50)))
            case _ if at < len(damaged):
                damaged[at] = rng.randrange(256)
    return bytes(damaged)


def corrupt_log(log: Path, rng: random.Random) -> None:
    """Damage one to three segments."""
    for _ in range(rng.choice([1, 1, 2, 3])):
        path = rng.choice(list_segments(log)).path
        data = bytearray(path.read_bytes())
        at = rng.randrange(len(data) or 1)
        match rng.choice(["flip", "zeros", "cut", "again", "more"]):
            case "flip" if data:
                data[at] ^= 1 << rng.randrange(8)
            case "zeros":
                data[at : at + 64] = bytes(len(data[at : at + 64]))
            case "cut":
                del data[at:]
            case "again":
                data[at:at] = data[max(0, at - 100) : at]
            case "more":
                data += rng.randbytes(50)
        path.write_bytes(data)


def _changed(document: Any, rng: random.Random) -> Any:
    """A copy in which one value, somewhere, is another, is gone, or is there again."""
    if rng.random() < 0.3 or not document or not isinstance(document, dict | list):
        return rng.choice(VALUES)
    if isinstance(document, list):
        at = rng.randrange(len(document))
        if rng.random() < 0.2:
            return [*document, document[at]]
        return [_changed(v, rng) if i == at else v for i, v in enumerate(document)]
    name = rng.choice([*document])
    if rng.random() < 0.2:
        return {k: v for k, v in document.items() if k != name}
    return {k: _changed(v, rng) if k == name else v for k, v in document.items()}
