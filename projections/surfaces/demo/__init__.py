"""`mapfold demo`: record, replay, map and re-localise on one machine, with real parts."""

from .play import DemoOptions, run_demo

__all__ = ["DemoOptions", "run_demo"]
