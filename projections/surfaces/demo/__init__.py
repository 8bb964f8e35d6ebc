"""`mapfold demo`: record, replay, map and re-localise on one machine, with real parts."""

from .play import run_demo

__all__ = ["run_demo"]
