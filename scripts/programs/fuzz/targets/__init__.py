"""The targets, one a file."""

from scripts.programs.fuzz.target import Target

from .envelope import EnvelopeTarget
from .kept_fold import KeptFoldTarget
from .ledger import LedgerTarget
from .mcap import McapTarget
from .question import QuestionTarget
from .segment import SegmentTarget
from .settings import SettingsTarget

TARGETS: dict[str, Target] = {
    "envelope": EnvelopeTarget(),
    "question": QuestionTarget(),
    "mcap": McapTarget(),
    "segment": SegmentTarget(),
    "ledger": LedgerTarget(),
    "kept-fold": KeptFoldTarget(),
    "settings": SettingsTarget(),
}
