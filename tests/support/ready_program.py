"""A program that says on stderr when it is ready, and ends at a signal."""

import os
import signal
import threading

from tests.support.prefork import Process


class ReadyProgram:
    """``program``, whose stderr is the write end of a pipe to ``read_end``; what it says to people
    is in ``said``. Waits until it names Ctrl-C or is gone."""

    def __init__(self, program: Process, read_end: int, ready_s: float, end_s: float) -> None:
        self.program, self._end_s = program, end_s
        self._stderr = os.fdopen(read_end)
        self.said: list[str] = []
        self._ready = threading.Event()
        self._reader = threading.Thread(target=self._read)
        self._reader.start()
        assert self._ready.wait(ready_s), self.text

    @property
    def text(self) -> str:
        """What it has said to people."""
        return "\n".join(self.said)

    def _read(self) -> None:
        with self._stderr:
            for line in self._stderr:
                self.said.append(line.rstrip("\n"))
                if "Ctrl-C" in line:
                    self._ready.set()
        self._ready.set()

    def end(self) -> int:
        """SIGTERM; its exit code."""
        self.program.send_signal(signal.SIGTERM)
        try:
            return int(self.program.wait(self._end_s))
        finally:
            self.program.kill()
            self.program.wait()
            self._reader.join()
