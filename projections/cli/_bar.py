"""How far a long command is, for people at a terminal."""

from types import TracebackType

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from eventsrc.cli._shell import people


class Bar:
    """A progress bar with rate and time left on a terminal, silence elsewhere."""

    def __init__(self) -> None:
        self._progress = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"),
            TimeRemainingColumn(),
            console=people,
            transient=True,
            disable=not people.is_terminal,
        )
        self._task = self._progress.add_task("folding", total=None, rate="")

    def __enter__(self) -> "Bar":
        self._progress.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.stop()

    def show(self, stage: str, done: int, total: int) -> None:
        """Show that ``done`` of ``total`` events are through, and what is going on."""
        speed = self._progress.tasks[0].speed
        rate = f"{speed:,.0f} events/s" if speed else ""
        self._progress.update(self._task, description=stage, completed=done, total=total, rate=rate)

    def stop(self) -> None:
        """Take the bar away. May be called twice."""
        self._progress.stop()
