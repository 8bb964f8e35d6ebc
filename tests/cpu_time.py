"""Processor time of running processes, from /proc."""

import os
from pathlib import Path

_TICKS = os.sysconf("SC_CLK_TCK")


def cpu_seconds(pid: int) -> float:
    """What a process has used so far with all its threads, those that ended included; 0 where there
    is no /proc."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except FileNotFoundError:
        return 0.0
    fields = stat.rpartition(")")[2].split()  # its name may hold blanks and brackets
    return (int(fields[11]) + int(fields[12])) / _TICKS
