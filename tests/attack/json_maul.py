"""Damage by chance to a JSON document: one of its values becomes another, or its bytes do."""

import json
import random
from typing import Any

_NESTED: Any = "leaf"
for _ in range(300):
    _NESTED = [_NESTED]

VALUES: tuple[Any, ...] = (
    *(None, True, 0, -1, 1.5, 2**63, -(2**63) - 1, 10**400, 1e308, float("nan"), float("inf")),
    *("", "x", "\x00", "\ud800", "\u202e", "x" * 300, "A" * 4097, "9" * 5000, "run", "{}"),
    *([], {}, [[]], [None] * 40, {"x": {}}, [{}] * 40, _NESTED, [1.0] * 17_000),
)


def maul_json(text: bytes, chance: random.Random) -> bytes:
    """``text`` with one to three things changed; whole JSON as a rule, never the same as a rule."""
    try:
        document = json.loads(text)
    except (ValueError, RecursionError):
        return maul_bytes(text, chance)
    for _ in range(chance.choice((1, 1, 2, 3))):
        document = _changed(document, chance)
    changed = json.dumps(document).encode()  # ensure_ascii: lone surrogates become escapes
    return maul_bytes(changed, chance) if chance.random() < 0.2 else changed


def maul_bytes(data: bytes, chance: random.Random) -> bytes:
    """``data`` with bits flipped, pieces cut out, doubled, or put in."""
    mauled = bytearray(data)
    for _ in range(chance.choice((1, 1, 2, 8))):
        at = chance.randrange(len(mauled) + 1)
        match chance.randrange(6):
            case 0 if at < len(mauled):
                mauled[at] ^= 1 << chance.randrange(8)
            case 1:
                del mauled[at : at + chance.choice((1, 4, 64, 10**9))]
            case 2:
                mauled[at:at] = mauled[max(0, at - chance.choice((1, 8, 100))) : at]
            case 3:
                mauled[at : at + 8] = chance.choice((bytes(8), b"\xff" * 8, b"\x7f" + bytes(7)))
            case 4:
                mauled[at:at] = chance.randbytes(chance.choice((1, 4, 50)))
            case _ if at < len(mauled):
                mauled[at] = chance.randrange(256)
    return bytes(mauled)


def _changed(document: Any, chance: random.Random) -> Any:
    """A copy in which one value, somewhere, is another, is gone, or is there again."""
    if chance.random() < 0.3 or not document or not isinstance(document, dict | list):
        return chance.choice(VALUES)
    if isinstance(document, list):
        at = chance.randrange(len(document))
        if chance.random() < 0.2:
            return [*document, document[at]]
        return [_changed(v, chance) if i == at else v for i, v in enumerate(document)]
    name = chance.choice([*document])
    if chance.random() < 0.2:
        return {k: v for k, v in document.items() if k != name}
    return {k: _changed(v, chance) if k == name else v for k, v in document.items()}
