"""Moving a log into the databases: at once (`rebuild`) or as it grows (`tail`)."""

from .rebuild import RebuildProgress, RebuildReport, rebuild
from .tail import TailReport, tail

__all__ = ["RebuildProgress", "RebuildReport", "TailReport", "rebuild", "tail"]
