"""Write the map of a log into the databases: once (`rebuild`) or as the log grows (`tail`)."""

from .batch_writer import TailProgress, TailReport
from .live_tail import tail
from .rebuild import ForeignEmbedding, RebuildProgress, RebuildReport, rebuild

__all__ = [
    "ForeignEmbedding",
    "RebuildProgress",
    "RebuildReport",
    "TailProgress",
    "TailReport",
    "rebuild",
    "tail",
]
