"""``python -m projections.surfaces.cli.child_process``: a command that ends with its parent.

Its stdin is a pipe that is never written to. The pipe ends when the parent process does, for any
reason; the command gets SIGTERM then, so a recorder drains its queue and closes its log.
"""

import os
import signal
import sys
import threading

from . import main


def run() -> None:
    """Run the command that ``sys.argv`` names."""
    threading.Thread(target=_terminate_at_end_of_stdin, name="watch-parent", daemon=True).start()
    main()


def _terminate_at_end_of_stdin() -> None:
    while os.read(sys.stdin.fileno(), 1024):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    run()
