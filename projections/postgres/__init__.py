"""Write the map of a log into the databases: once (`rebuild`) or as the log grows (`tail`)."""

from .foreign_embedding import ForeignEmbedding
from .rebuild import RebuildProgress, RebuildReport, rebuild
from .tail import tail
from .tail_progress import TailProgress, TailReport

__all__ = [
    "ForeignEmbedding",
    "RebuildProgress",
    "RebuildReport",
    "TailProgress",
    "TailReport",
    "rebuild",
    "tail",
]
