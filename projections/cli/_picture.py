"""A picture's name, looked at before anything is folded for it."""

from pathlib import Path


def check_picture(out: Path | None) -> None:
    """Raises MisuseError when ``out`` is no picture's name; None is no picture."""
    if out is None:
        return
    # Here and not above: matplotlib takes longer to import than most commands take to run.
    from projections.drawing.canvas import check_name

    check_name(out)
