"""A mapfold command that ends when the process that started it does, however that ends.

Its stdin is a pipe that nobody writes to: the end of it means that nobody holds the other end any
more. Then the command gets SIGTERM, as if somebody had asked: a recorder drains and closes its log.
"""

import os
import signal
import sys
import threading

from projections.cli import main


def run() -> None:
    """Run the command that ``sys.argv`` names."""
    threading.Thread(target=_end_with_stdin, name="watch-starter", daemon=True).start()
    main()


def _end_with_stdin() -> None:
    while os.read(sys.stdin.fileno(), 1024):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    run()
