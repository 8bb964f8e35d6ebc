"""ONNX models with known weights: a detector that finds coloured boxes, an encoder of mean colours.

They are made for the pictures of `tests.support.drawn_pictures`, whose colours lie on a lattice
of five levels a channel, and they are real models: onnxruntime runs them as it runs any other.

Logs that keep crops, and encoders of them whose vectors a test can work out.
"""

import hashlib
import json
import random
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from eventsrc.adapters.reembedding import Vector
from eventsrc.adapters.sim.house import House
from eventsrc.envelope.crops import (
    CROP_ENCODING,
    CROP_SCHEMA,
    CROP_SCHEMA_ENCODING,
    CROP_SCHEMA_TEXT,
    Crop,
    encode_crop,
)
from eventsrc.envelope.model import DetId
from eventsrc.log import NEVER, LogWriter, MessageFormat
from eventsrc.record.append import append_payload
from tests.support.drawn_pictures import Colour, thing_colours
from tests.support.envelopes import detection, embedding, envelope, payload

OPSET = 17
STRIDE = 4
MODEL_NAME = "tiny/mean-colour"
DIMENSION = 16
_LEAST_CELLS = 3.0


class Graph:
    """Collects the nodes and constants of a model."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def add(self, kind: str, *inputs: str, **attributes: Any) -> str:
        name = f"v{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, list(inputs), [name], **attributes))
        return name

    def constant(self, values: Any, kind: Any = np.float32) -> str:
        name = f"c{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(values, kind), name))
        return name

    def save(
        self,
        path: Path,
        inputs: Mapping[str, Sequence[int | str]],
        outputs: Mapping[str, Sequence[int | str]],
        names: Mapping[str, str] | None = None,
        kind: int = TensorProto.FLOAT,
        metadata: Mapping[str, str] | None = None,
        answers: int | None = None,
    ) -> Path:
        """Write the model; ``names`` renames values to outputs. ``kind`` is the type of the inputs,
        and of the outputs unless ``answers`` is."""
        for output, value in (names or {}).items():
            self.nodes.append(helper.make_node("Identity", [value], [output]))
        graph = helper.make_graph(
            self.nodes,
            "tiny",
            [helper.make_tensor_value_info(n, kind, list(s)) for n, s in inputs.items()],
            [
                helper.make_tensor_value_info(n, answers or kind, list(s))
                for n, s in outputs.items()
            ],
            self.constants,
        )
        model = helper.make_model(
            graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=8
        )
        if metadata:
            helper.set_model_props(model, dict(metadata))
        onnx.checker.check_model(model)
        path.write_bytes(model.SerializeToString())
        return path


def colour_detector(
    path: Path, colours: Sequence[tuple[Colour, str]], size: tuple[int, int] = (640, 640)
) -> Path:
    """A detector in the form of YOLOv8's exports: one anchor for each colour of a class.

    An anchor's box is around the pixels of its colour, its score the part of the box they fill.
    """
    labels = sorted({label for _, label in colours})
    width, height = size
    rows, columns = height // STRIDE, width // STRIDE
    g = Graph()
    ints = np.int64
    fewer = g.add(
        "Slice",
        "images",
        g.constant([STRIDE // 2, STRIDE // 2], ints),
        g.constant([height, width], ints),
        g.constant([2, 3], ints),
        g.constant([STRIDE, STRIDE], ints),
    )
    scaled = g.add("Mul", fewer, g.constant(4.0))
    level = g.add("Round", scaled)
    off = g.add("ReduceMax", g.add("Abs", g.add("Sub", scaled, level)), axes=[1], keepdims=1)
    code = g.add(
        "ReduceSum",
        g.add("Mul", level, g.constant(np.reshape([25.0, 5.0, 1.0], (1, 3, 1, 1)))),
        g.constant([1], ints),
        keepdims=1,
    )
    blurred = g.add("Greater", off, g.constant(0.25))  # between two colours, at an edge
    code = g.add("Where", blurred, g.constant(-1.0), code)
    wanted = [_code(colour) for colour, _ in colours]
    same = g.add("Equal", code, g.constant(np.reshape(wanted, (1, -1, 1, 1))))
    mask = g.add("Cast", same, to=TensorProto.FLOAT)  # 1 × K × rows × columns
    in_column = g.add("ReduceSum", mask, g.constant([2], ints), keepdims=0)  # 1 × K × columns
    in_row = g.add("ReduceSum", mask, g.constant([3], ints), keepdims=0)  # 1 × K × rows
    area = g.add("ReduceSum", in_row, g.constant([2], ints), keepdims=0)  # 1 × K
    x0, x1 = _ends(g, in_column, columns)
    y0, y1 = _ends(g, in_row, rows)
    wide, high = g.add("Sub", x1, x0), g.add("Sub", y1, y0)
    floor = g.constant(1.0)
    cells = g.add("Mul", g.add("Max", wide, floor), g.add("Max", high, floor))
    filled = g.add("Min", g.add("Div", area, cells), floor)
    large = g.add(
        "And",
        g.add("GreaterOrEqual", wide, g.constant(_LEAST_CELLS)),
        g.add("GreaterOrEqual", high, g.constant(_LEAST_CELLS)),
    )
    score = g.add("Where", large, filled, g.constant(0.0))
    one_hot = np.array([[float(label == each) for _, label in colours] for each in labels])
    scores = g.add(
        "Mul", g.constant(one_hot[None]), g.add("Unsqueeze", score, g.constant([1], ints))
    )
    half, step = g.constant(0.5 * STRIDE), g.constant(float(STRIDE))
    parts = [
        g.add("Mul", g.add("Add", x0, x1), half),
        g.add("Mul", g.add("Add", y0, y1), half),
        g.add("Mul", wide, step),
        g.add("Mul", high, step),
    ]
    boxes = [g.add("Unsqueeze", part, g.constant([1], ints)) for part in parts]
    answer = g.add("Concat", *boxes, scores, axis=1)
    return g.save(
        path,
        {"images": (1, 3, height, width)},
        {"output0": (1, 4 + len(labels), len(colours))},
        {"output0": answer},
        metadata={"names": repr(dict(enumerate(labels)))},
    )


def _ends(g: Graph, counts: str, length: int) -> tuple[str, str]:
    """First index with two pixels or more, and the one behind the last; none, if there are none."""
    there = g.add("GreaterOrEqual", counts, g.constant(2.0))
    index = np.arange(length, dtype=np.float32).reshape(1, 1, -1)
    low = g.add("Where", there, g.constant(index), g.constant(float(length)))
    high = g.add("Where", there, g.constant(index + 1), g.constant(0.0))
    return (
        g.add("ReduceMin", low, axes=[2], keepdims=0),
        g.add("ReduceMax", high, axes=[2], keepdims=0),
    )


def _code(colour: Colour) -> float:
    red, green, blue = (round(value / 255 * 4) for value in colour)
    return float(25 * red + 5 * green + blue)


def mean_colour_encoder(path: Path, size: int = 32, batch: int | str = "n") -> Path:
    """An encoder that averages colours, takes the grey off, and turns the rest into 16 numbers.

    So crops of one hue are alike, whatever grey is around the thing. Writes the JSON too.
    """
    g = Graph()
    mean = g.add("ReduceMean", "pixel_values", axes=[2, 3], keepdims=0)
    rng = np.random.default_rng(7)
    lifted, _ = np.linalg.qr(rng.normal(size=(DIMENSION, 3)))
    matrix = (np.eye(3) - 1 / 3) @ lifted.T
    answer = g.add("MatMul", mean, g.constant(matrix))
    g.save(
        path,
        {"pixel_values": (batch, 3, size, size)},
        {"image_embeds": (batch, DIMENSION)},
        {"image_embeds": answer},
    )
    preparation = {
        "model": MODEL_NAME,
        "size": size,
        "resize": "stretch",
        "mean": [0.5, 0.5, 0.5],
        "std": [0.5, 0.5, 0.5],
    }
    path.with_suffix(".json").write_text(json.dumps(preparation))
    return path


def text_tower(path: Path, vectors: Mapping[str, Vector], model: str, **said: Any) -> Path:
    """A text tower that gives each word its vector, as CLIP's do: the mean over the tokens that are
    none that fill up, made a unit vector. Writes the JSON and the tokenizer too."""
    from tokenizers import Tokenizer
    from tokenizers.models import WordLevel
    from tokenizers.pre_tokenizers import Whitespace

    vocabulary = {"[PAD]": 0, "[UNK]": 1, **{word: n for n, word in enumerate(vectors, 2)}}
    tokenizer = Tokenizer(WordLevel(vocabulary, unk_token="[UNK]"))
    tokenizer.pre_tokenizer = Whitespace()
    tokenizer.save(str(path.with_name("tokenizer.json")))
    dimension = len(next(iter(vectors.values())))
    unknown = [np.zeros(dimension), np.full(dimension, 1e-3)]
    table = np.vstack([*unknown, *vectors.values()]).astype(np.float32)
    g = Graph()
    rows = g.add("Gather", g.constant(table), "input_ids")
    used = g.add("Cast", "attention_mask", to=TensorProto.FLOAT)
    mean = g.add(
        "ReduceMean",
        g.add("Mul", rows, g.add("Unsqueeze", used, g.constant([2], int))),
        axes=[1],
        keepdims=0,
    )
    answer = g.add("LpNormalization", mean, axis=1)
    shape = (1, "tokens")
    g.save(
        path,
        {"input_ids": shape, "attention_mask": shape},
        {"text_embeds": (1, dimension)},
        {"text_embeds": answer},
        kind=TensorProto.INT64,
        answers=TensorProto.FLOAT,
    )
    path.with_suffix(".json").write_text(json.dumps({"model": model, "context": 8, **said}))
    return path


def models_for(house: House, folder: Path) -> tuple[Path, Path]:
    """Detector and encoder for the pictures of a house."""
    classes = {thing.instance: thing.model.class_name for thing in house.things}
    colours = [(colour, classes[name]) for name, colour in thing_colours(house).items()]
    return (
        colour_detector(folder / "detector.onnx", colours),
        mean_colour_encoder(folder / "encoder.onnx"),
    )


def fixed_answer(path: Path, answer: NDArray[Any], size: tuple[int, int] = (64, 64)) -> Path:
    """A detector that answers the same for every picture."""
    g = Graph()
    nothing = g.add("Mul", g.add("ReduceMean", "images", keepdims=0), g.constant(0.0))
    value = g.add("Add", g.constant(answer), nothing)
    return g.save(
        path, {"images": (1, 3, size[1], size[0])}, {"output0": answer.shape}, {"output0": value}
    )


KEY = "tb/detections"
TOPIC = "tb/crops"
FORMAT = MessageFormat(CROP_ENCODING, CROP_SCHEMA, CROP_SCHEMA_ENCODING, CROP_SCHEMA_TEXT)


def jpeg(thing: int, look: int) -> bytes:
    """Bytes that a test's encoder understands: a thing, and how it looked."""
    return b"\xff\xd8\xff" + f"{thing} {look}".encode() + b"\xff\xd9"


class Encoder:
    """A vector for each thing of `jpeg`, turned a little by its look; ``answers`` replaces the
    vectors of some JPEGs."""

    def __init__(
        self, space: str, dimension: int, answers: dict[bytes, Vector | str] | None = None
    ) -> None:
        self.space, self.dimension = space, dimension
        self.sha256 = hashlib.sha256(f"{space} {dimension}".encode()).hexdigest()
        self.answers = answers or {}
        self.calls = 0

    def encode(self, jpegs: Sequence[bytes]) -> list[Vector | str]:
        self.calls += 1
        return [self.answers.get(each, self.vector(each)) for each in jpegs]

    def vector(self, each: bytes) -> Vector:
        thing, look = each[3:-2].split()
        base, noise = self._drawn(thing), self._drawn(thing + b" " + look)
        return np.asarray(base + 0.3 * noise, np.float32)

    def _drawn(self, name: bytes) -> Any:
        seed = hashlib.sha256(self.space.encode() + name).digest()[:8]
        return np.random.default_rng(int.from_bytes(seed, "big")).normal(size=self.dimension)


def drive(seed: int, keyframes: int = 24) -> list[tuple[dict[str, Any], dict[str, bytes]]]:
    """Envelopes without vectors, and the JPEGs of their detections by det_id."""
    rng = random.Random(seed)
    made = []
    for k in range(keyframes):
        room = k * 3 // keyframes
        seen = [
            (f"k{k}d{i}", thing := rng.randrange(4) + 4 * room, jpeg(thing, rng.randrange(10**6)))
            for i in range(rng.randrange(4))
        ]
        found = [detection(f"class-{thing % 3}", det_id=det_id) for det_id, thing, _ in seen]
        where = 6.0 * room + rng.uniform(-1, 1), rng.uniform(-1, 1)
        made.append((envelope(k, *where, detections=found), {d: each for d, _, each in seen}))
    return made


def with_vectors(
    made: dict[str, Any], crops: dict[str, bytes], encoder: Encoder | None
) -> dict[str, Any]:
    """An envelope with a vector of ``encoder`` for each detection that has a crop."""
    if encoder is None:
        return made
    detections = []
    for each in made["detections"]:
        crop = crops.get(each["det_id"])
        own = {} if crop is None else embedding(encoder.vector(crop))
        named = {} if crop is None else {"embedding_model": encoder.space}
        detections.append(each | own | named)
    return {**made, "detections": detections}


def write(
    path: Path,
    made: Sequence[tuple[dict[str, Any], dict[str, bytes]]],
    encoder: Encoder | None,
) -> Path:
    """A log of envelopes with vectors of ``encoder``, each behind its crops."""
    with LogWriter(path, fsync=NEVER) as writer:
        for number, (document, crops) in enumerate(made):
            now = (number + 1) * 10**9
            for det_id, each in crops.items():
                add_crop(writer, det_id, each, now)
            full = with_vectors(document, crops, encoder)
            append_payload(writer, KEY, payload(full), logged_ns=now)
    return path


def add_crop(writer: LogWriter, det_id: str, each: bytes, now: int = 1) -> None:
    message = encode_crop(Crop(DetId(det_id), each), now)
    writer.append(TOPIC, message, logged_ns=now, form=FORMAT)
