"""`mapfold demo`: record, replay, map and re-localise on one machine, each part real."""

from .play import DemoOptions, run_demo

__all__ = ["DemoOptions", "run_demo"]
