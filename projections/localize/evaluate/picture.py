"""Picture of an evaluation: each question's true position, and a line to a wrong answer."""

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

from eventsrc.base.output_files import write_files
from projections.map.view import MapView

from .trials import Trial

_GOOD, _BAD, _UNKNOWN, _DRIVE = "#2a7f62", "#c0392b", "#8e8e8e", "#d9d9d9"


def draw_failures(view: MapView, trials: Sequence[Trial], out: Path) -> None:
    """Draw to ``out`` (.png, .svg or .pdf). Raises MisuseError where no file can be made
    there, MapfoldError where writing it fails."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 8), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    drive = [k.pose for k in view.keyframes if k.pose is not None]
    axes.scatter([p.x_um / 1e6 for p in drive], [p.y_um / 1e6 for p in drive], 6, _DRIVE)
    for trial in trials:
        if trial.known:
            _draw(axes, trial)
    known = [t for t in trials if t.known]
    axes.set_title(
        f"{sum(t.correct for t in known)} of {len(known)} poses within 1.5 m", loc="left"
    )
    axes.set_xlabel(
        "green: within 1.5 m   red: not, with a line to the answer   grey: answered 'unknown'"
    )
    axes.set_aspect("equal")
    picture = BytesIO()
    figure.savefig(picture, format=out.suffix[1:])
    write_files({out: picture.getvalue()})


def _draw(axes: object, trial: Trial) -> None:
    question, pose = trial.question, trial.answer.pose
    colour = _GOOD if trial.correct else _UNKNOWN if trial.answer.unknown else _BAD
    if pose is not None and not trial.correct:
        axes.plot(  # type: ignore[attr-defined]
            [question.x, pose.x], [question.y, pose.y], color=colour, linewidth=0.7, alpha=0.6
        )
    axes.scatter([question.x], [question.y], 12, colour)  # type: ignore[attr-defined]
