"""Damage by chance to the files of a log."""

import random
from pathlib import Path

from eventsrc.log.format import list_segments


def maul(log: Path, chance: random.Random) -> None:
    """Damage one to three segments."""
    for _ in range(chance.choice([1, 1, 2, 3])):
        path = chance.choice(list_segments(log)).path
        data = bytearray(path.read_bytes())
        at = chance.randrange(len(data) or 1)
        match chance.choice(["flip", "zeros", "cut", "again", "more"]):
            case "flip" if data:
                data[at] ^= 1 << chance.randrange(8)
            case "zeros":
                data[at : at + 64] = bytes(len(data[at : at + 64]))
            case "cut":
                del data[at:]
            case "again":
                data[at:at] = data[max(0, at - 100) : at]
            case "more":
                data += chance.randbytes(50)
        path.write_bytes(data)
