"""`mapfold demo`: the whole story on one machine, each part real, every number measured."""

from .play import DemoOptions, run_demo

__all__ = ["DemoOptions", "run_demo"]
