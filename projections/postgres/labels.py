"""Names of the graph, its labels, the table of vectors and the sinks; ids of vertices and edges.

A graph of AGE is a schema and each label a table. The id of a vertex or edge is its graphid,
``label id << 48 | number``. AGE numbers labels per graph in the order in which they are created,
from 3 on; we create ours in the order written here, so the label ids are constants. The numbers are
the fold's ordinals, so every id follows from the log alone and no write has to look one up:

    Run, Keyframe, Observation, Object, Place     ordinal + 1
    Pose, HAS_KEYFRAME, HAS_POSE, IN_PLACE        keyframe + 1
    HAS_OBSERVATION, OBSERVES                     observation + 1
    LOCATED_IN                                    object + 1
    ADJACENT_TO                                   (a + 1) << 24 | (b + 1)
    Floor                                         floor + 1
    Building                                      1
    PART_OF of a Place                            place + 1
    PART_OF of a Floor                            1 << 40 | (floor + 1)

The last three labels are younger than the others and so come after the edges.
"""

from dataclasses import dataclass
from typing import Final, Literal, TypeAlias, get_args

GRAPH: Final = "semantic_map"
NEXT_GRAPH: Final = "semantic_map_next"
"""The shadow a rebuild writes."""
OLD_GRAPH: Final = "semantic_map_old"
"""The graph that a shadow replaced, until its last reader has ended."""
TABLE: Final = "detection_embeddings"
MAP_TABLE: Final = "occupancy_map"
"""The table of occupancy maps of the graph's sink, in the schema ``mapfold``."""

VertexLabel: TypeAlias = Literal[
    "Run", "Keyframe", "Pose", "Observation", "Object", "Place", "Floor", "Building"
]
EdgeLabel: TypeAlias = Literal[
    "HAS_KEYFRAME",
    "HAS_POSE",
    "HAS_OBSERVATION",
    "OBSERVES",
    "LOCATED_IN",
    "IN_PLACE",
    "ADJACENT_TO",
    "PART_OF",
]
Label: TypeAlias = VertexLabel | EdgeLabel

VERTEX_LABELS: Final[tuple[VertexLabel, ...]] = get_args(VertexLabel)
EDGE_LABELS: Final[tuple[EdgeLabel, ...]] = get_args(EdgeLabel)
_YOUNGEST: Final[tuple[Label, ...]] = ("Floor", "Building", "PART_OF")
LABELS: Final[tuple[Label, ...]] = (
    *(label for label in (*VERTEX_LABELS, *EDGE_LABELS) if label not in _YOUNGEST),
    *_YOUNGEST,
)
"""In the order in which they are created."""
LABEL_IDS: Final[dict[Label, int]] = {label: 3 + i for i, label in enumerate(LABELS)}

CHANGING_EDGES: Final[tuple[EdgeLabel, ...]] = (
    "LOCATED_IN",
    "IN_PLACE",
    "ADJACENT_TO",
    "PART_OF",
)
"""Edges that a later event may move or remove; the others are written once."""

KEYS: Final[dict[Label, str]] = {
    "Run": "run_id",
    "Observation": "det_id",
    "Object": "object_id",
    "Place": "place_id",
    "Floor": "floor",
}
"""The property by which readers find a vertex; each gets a btree index."""

MATCHED: Final[tuple[Label, ...]] = ("Observation", "Object", "Place")
"""Vertices that readers find by ``{key: value}``, which only a GIN index serves."""

COUNT_KEYS: Final[dict[Label, str]] = {
    "Run": "runs",
    "Keyframe": "keyframes",
    "Pose": "poses",
    "Observation": "observations",
    "Object": "objects",
    "Place": "places",
    "Floor": "floors",
    "Building": "buildings",
    **{label: label for label in EDGE_LABELS},
}
"""The name under which `MapView.counts` counts a label's rows."""


def graphid_base(label: Label) -> int:
    """The graphid of number 0 of a label; add the number to get a row's id."""
    return LABEL_IDS[label] << 48


def number_of(graphid: int) -> int:
    """The number in a graphid."""
    return graphid & (1 << 48) - 1


def floor_part_number(floor: int) -> int:
    """The number of the edge from a floor (ordinal) to the building."""
    return 1 << 40 | (floor + 1)


def adjacency_number(a: int, b: int) -> int:
    """The number of the edge between places ``a`` and ``b`` (ordinals, below 2²⁴ - 1 each)."""
    if not 0 <= a < b < (1 << 24) - 1:
        raise ValueError(f"places {a} and {b} cannot be an edge: want 0 ≤ a < b < 2²⁴ - 1")
    return (a + 1) << 24 | (b + 1)


SinkName: TypeAlias = Literal["graph", "vectors"]
"""The ``name`` of a sink of the databases: the key of its checkpoint, dead letters and locks."""


@dataclass(frozen=True, slots=True)
class SinkTraits:
    """What this folder's modules know of a sink of the databases: the numbers of the lock of its
    writer and of the one that drops replaced tables; its tables, each schema and name; whether its
    name is plural; whether a refold keeps its rows if no correction changes observations."""

    writer_lock: int
    drop_lock: int
    tables: tuple[tuple[str, str], ...]
    is_plural: bool = False
    is_kept: bool = False

    @property
    def was(self) -> str:
        """The verb of messages about it."""
        return "were" if self.is_plural else "was"


SINKS: Final[dict[SinkName, SinkTraits]] = {
    "graph": SinkTraits(1, 17, (*((GRAPH, each) for each in LABELS), ("mapfold", MAP_TABLE))),
    "vectors": SinkTraits(2, 18, (("public", TABLE),), is_plural=True, is_kept=True),
}
