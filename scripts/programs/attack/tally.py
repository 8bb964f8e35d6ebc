"""The results of an attack, and a table of all of them."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field

MEMORY_LIMIT_MB = 600
ANSWER_LIMIT_S = 2.0
_ROLES = ("recorder", "reader", "server")
_COLUMNS = (
    *("attack", "rounds", "acknowledged", "lost", "invented", "tracebacks"),
    *(f"{role} MB" for role in _ROLES),
    *("answers", "slowest s", "held"),
)


@dataclass(slots=True)
class Tally:
    """The numbers of one attack over all of its rounds. ``complaints`` say what else was wrong."""

    name: str
    rounds: int = 0
    acknowledged: int = 0
    lost: int = 0
    invented: int = 0
    tracebacks: int = 0
    peak_mb: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))
    answers: int = 0
    slowest_s: float = 0.0
    complaints: list[str] = field(default_factory=list)

    def note_memory(self, role: str, peak_mb: float, command: str) -> None:
        """Note the peak memory of a command that has ended."""
        self.peak_mb[role] = max(self.peak_mb[role], peak_mb)
        if role in _ROLES and peak_mb > MEMORY_LIMIT_MB:
            self.complaints.append(f"{command} took {peak_mb:,.0f} MB")

    def answered(self, after_s: float) -> None:
        """Note the time of an answer to an honest question."""
        self.answers += 1
        self.slowest_s = max(self.slowest_s, after_s)

    @property
    def held(self) -> bool:
        """Whether no rule was violated."""
        bad = self.lost or self.invented or self.tracebacks or self.complaints
        return not bad and self.slowest_s <= ANSWER_LIMIT_S

    def row(self) -> tuple[str, ...]:
        """Its line of the table."""
        counts = (self.rounds, self.acknowledged, self.lost, self.invented, self.tracebacks)
        peaks = (f"{self.peak_mb[r]:,.0f}" if r in self.peak_mb else "-" for r in _ROLES)
        slowest = f"{self.slowest_s:.2f}" if self.answers else "-"
        verdict = "yes" if self.held else "NO"
        answers = f"{self.answers:,}"
        return (self.name, *(f"{n:,}" for n in counts), *peaks, answers, slowest, verdict)


def table(tallies: Sequence[Tally]) -> str:
    """One line an attack, in columns."""
    rows = [_COLUMNS, *(tally.row() for tally in tallies)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]) for row in rows
    )
