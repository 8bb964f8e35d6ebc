"""What can be wrong with an expression, said with the column where it is wrong."""

from eventsrc.errors import MisuseError


class ExpressionError(MisuseError):
    """An expression cannot be read; ``column`` counts from 1, ``pointer`` shows the spot.

    The message stays one line like every other error; a command prints ``pointer`` above it.
    """

    def __init__(self, source: str, column: int, reason: str) -> None:
        super().__init__(f"expression, column {column}: {reason}")
        self.source = source
        self.column = column
        self.reason = reason

    @property
    def pointer(self) -> str:
        """Two lines: the expression, and a caret under the column."""
        return f"  {self.source}\n  {' ' * (self.column - 1)}^"
