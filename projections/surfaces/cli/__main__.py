"""``python -m projections.surfaces.cli``: `mapfold` without its entry point installed.

With ``--ends-with-stdin`` before the command it ends with its parent process: its stdin is a pipe
that is never written to and that ends when the parent does, for any reason. The command gets
SIGTERM then, so a recorder drains its queue and closes its log.
"""

import os
import signal
import sys
import threading

from . import main


def _terminate_at_end_of_stdin() -> None:
    while os.read(sys.stdin.fileno(), 1024):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if sys.argv[1:2] == ["--ends-with-stdin"]:
    del sys.argv[1]
    threading.Thread(target=_terminate_at_end_of_stdin, name="watch-parent", daemon=True).start()
main()
