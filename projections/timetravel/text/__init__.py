"""What time travel finds, as lines for people. The data itself is in the parent package."""

from .differences import difference_text
from .merges import merge_text, merges_text
from .searches import search_text
from .stories import story_text
from .whatifs import whatif_text

__all__ = [
    "difference_text",
    "merge_text",
    "merges_text",
    "search_text",
    "story_text",
    "whatif_text",
]
