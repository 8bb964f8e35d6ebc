"""Numbers in sentences."""


def counted(number: int, word: str) -> str:
    """``1 keyframe``, ``2 keyframes``, ``3,000 keyframes``."""
    return f"{number:,} {word}" if number == 1 else f"{number:,} {word}s"
