"""Conditions over the map in a small safe language: ``place_count < 3 and not merged('a_p0')``.

`Expression` reads a text once and is then asked of any map that answers `Facts`. No eval: a text
becomes a checked tree of the nodes in `syntax`, and nothing else is ever evaluated.
"""

from .direction import Direction
from .errors import ExpressionError
from .evaluate import Expression, Mention
from .facts import Facts
from .functions import FUNCTIONS, functions_help

__all__ = [
    "FUNCTIONS",
    "Direction",
    "Expression",
    "ExpressionError",
    "Facts",
    "Mention",
    "functions_help",
]
