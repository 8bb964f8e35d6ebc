"""The furniture of each room: classes, models and sizes.

Objects of one model look alike: the six dining chairs are one model, the office chair another.
Sizes are width along the wall, depth from it, and height, in metres; ``base_m`` is the height of
the lower edge above the floor. A model with ``stands`` takes floor space; any other hangs on the
wall or stands on something.
"""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Model:
    """A product model; objects of the same model look nearly the same."""

    name: str
    class_name: str
    width_m: float
    depth_m: float
    height_m: float
    base_m: float = 0.0
    stands: bool = True


_MODELS = (
    Model("couch-linen", "couch", 1.9, 0.85, 0.8),
    Model("armchair-oak", "armchair", 0.8, 0.8, 0.9),
    Model("tv-55", "tv", 1.2, 0.3, 0.75, 0.5),
    Model("bookcase-tall", "bookcase", 0.9, 0.35, 1.9),
    Model("lamp-floor", "lamp", 0.35, 0.35, 1.5),
    Model("lamp-bedside", "lamp", 0.3, 0.3, 0.5, 0.4, stands=False),
    Model("plant-fern", "potted plant", 0.4, 0.4, 0.9),
    Model("plant-cactus", "potted plant", 0.3, 0.3, 0.6),
    Model("table-dining", "dining table", 1.4, 0.9, 0.75),
    Model("chair-dining", "chair", 0.45, 0.45, 0.9),
    Model("chair-office", "chair", 0.6, 0.6, 1.0),
    Model("vase-blue", "vase", 0.2, 0.2, 0.35, 0.75, stands=False),
    Model("picture-print", "picture", 0.6, 0.05, 0.45, 1.0, stands=False),
    Model("picture-portrait", "picture", 0.5, 0.05, 0.7, 0.9, stands=False),
    Model("clock-round", "clock", 0.35, 0.05, 0.35, 1.1, stands=False),
    Model("refrigerator-steel", "refrigerator", 0.7, 0.7, 1.7),
    Model("oven-black", "oven", 0.6, 0.6, 0.85),
    Model("sink-kitchen", "sink", 0.7, 0.6, 0.9),
    Model("sink-bath", "sink", 0.6, 0.45, 0.85),
    Model("microwave-white", "microwave", 0.5, 0.4, 0.3, 0.9, stands=False),
    Model("bin-pedal", "trash can", 0.3, 0.3, 0.55),
    Model("bed-double", "bed", 1.6, 2.0, 0.6),
    Model("bed-single", "bed", 0.9, 2.0, 0.6),
    Model("wardrobe-white", "wardrobe", 1.2, 0.6, 1.9),
    Model("mirror-plain", "mirror", 0.5, 0.05, 0.8, 0.8, stands=False),
    Model("toilet-round", "toilet", 0.4, 0.65, 0.8),
    Model("bathtub-long", "bathtub", 1.6, 0.75, 0.6),
    Model("desk-birch", "desk", 1.3, 0.65, 0.75),
    Model("laptop-grey", "laptop", 0.35, 0.25, 0.25, 0.75, stands=False),
    Model("printer-office", "printer", 0.45, 0.4, 0.3, 0.5, stands=False),
    Model("bear-brown", "teddy bear", 0.35, 0.3, 0.45, 0.4, stands=False),
    Model("suitcase-red", "suitcase", 0.45, 0.3, 0.7),
    Model("rack-coats", "coat rack", 0.5, 0.4, 1.7),
    Model("bench-hall", "bench", 0.9, 0.35, 0.45),
)

MODELS = {model.name: model for model in _MODELS}

FURNITURE: dict[str, tuple[str, ...]] = {
    "living room": (
        *("couch-linen", "tv-55", "armchair-oak", "armchair-oak", "bookcase-tall"),
        *("lamp-floor", "plant-fern", "picture-print", "picture-print", "clock-round"),
    ),
    "dining room": ("plant-cactus", "picture-print", "vase-blue", "lamp-floor"),
    "kitchen": (
        *("refrigerator-steel", "oven-black", "sink-kitchen", "microwave-white"),
        *("bin-pedal", "chair-dining", "chair-dining", "clock-round"),
    ),
    "bedroom": (
        *("bed-double", "wardrobe-white", "lamp-bedside", "lamp-bedside"),
        *("mirror-plain", "picture-portrait"),
    ),
    "bathroom": ("bathtub-long", "toilet-round", "sink-bath", "mirror-plain", "bin-pedal"),
    "study": (
        *("desk-birch", "bookcase-tall", "chair-office", "laptop-grey"),
        *("printer-office", "plant-fern", "picture-print"),
    ),
    "guest room": (
        *("bed-single", "wardrobe-white", "lamp-bedside", "suitcase-red"),
        *("bear-brown", "picture-portrait"),
    ),
    "hall": ("rack-coats", "bench-hall", "plant-cactus", "mirror-plain", "picture-print"),
}
"""Model names by room, in the order in which they are placed: large ones first."""

DINING_SET = ("table-dining", "chair-dining", "chair-dining", "chair-dining", "chair-dining")
"""Placed together in the dining room: the table and four chairs around it."""
