"""Moving a log into the databases: at once (`rebuild`) or as it grows (`tail`)."""

from .foreign_embedding import ForeignEmbedding
from .progress import TailProgress, TailReport
from .rebuild import RebuildProgress, RebuildReport, rebuild
from .tail import tail

__all__ = [
    "ForeignEmbedding",
    "RebuildProgress",
    "RebuildReport",
    "TailProgress",
    "TailReport",
    "rebuild",
    "tail",
]
