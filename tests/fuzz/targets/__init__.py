"""The targets, one a file."""

from tests.fuzz.target import Target

from .envelope import EnvelopeTarget
from .ledger import LedgerTarget
from .mcap import McapTarget
from .question import QuestionTarget
from .segment import SegmentTarget
from .settings import SettingsTarget
from .snapshot import SnapshotTarget

TARGETS: dict[str, Target] = {
    "envelope": EnvelopeTarget(),
    "question": QuestionTarget(),
    "mcap": McapTarget(),
    "segment": SegmentTarget(),
    "ledger": LedgerTarget(),
    "snapshot": SnapshotTarget(),
    "settings": SettingsTarget(),
}
