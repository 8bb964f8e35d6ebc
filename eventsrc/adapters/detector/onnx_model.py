"""Run ONNX models by onnxruntime. Only this module imports it, when the first model is opened.

A JSON file beside a model, of the same name, describes its input (`read_description`).
docs/decisions/dependencies.md says why onnxruntime.
"""

import hashlib
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Final, Literal, NamedTuple, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, ValidationError

from eventsrc.base.errors import MapfoldError, MisuseError
from eventsrc.base.user_files import FileFault, open_file, read_file
from eventsrc.envelope.model import Text

Device: TypeAlias = Literal["cpu", "cuda"]
Array: TypeAlias = NDArray[np.floating[Any]]
_TYPES: Final[Mapping[str, type[np.floating[Any]]]] = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
}


class ModelError(MapfoldError):
    """A model cannot be used: its file, its inputs or its outputs are wrong."""


class Tensor(NamedTuple):
    """The name, type and sizes of an input or output; a size that is not fixed is None."""

    name: str
    type: str
    shape: tuple[int | None, ...]

    @property
    def text(self) -> str:
        """The sizes as text: ``1 × 3 × 640 × 640``."""
        return shape_text(self.shape)


def shape_text(shape: tuple[int | None, ...]) -> str:
    """Sizes as text, with ``?`` for one that is not fixed."""
    return " × ".join("?" if size is None else f"{size}" for size in shape) or "a number"


class Description(BaseModel):
    """What the JSON file beside a model says: ``model`` names the space of its vectors."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid", allow_inf_nan=False)

    EXAMPLE: ClassVar[str]
    PAGE: ClassVar[str] = "docs/detector.md"
    model: Text


Described = TypeVar("Described", bound=Description)
_MAX_DESCRIPTION_BYTES: Final = 64 * 1024


def read_description(model: Path, kind: type[Described]) -> Described:
    """The description of a model. Raises MisuseError."""
    path = model.with_suffix(".json")
    try:
        text = read_file(path, _MAX_DESCRIPTION_BYTES)
    except FileFault as fault:
        raise MisuseError(
            f"{path}: {fault}; this file describes the input of {model.name}, such as"
            f" {kind.EXAMPLE}; see {kind.PAGE}"
        ) from None
    try:
        return kind.model_validate_json(text)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"])) or "the file"
        reason = "no such field" if first["type"] == "extra_forbidden" else first["msg"]
        raise MisuseError(f"{path}: {place}: {reason}; see {kind.PAGE}") from None


def model_sha256(path: Path, description: Description, *more: bytes) -> str:
    """SHA-256 of a model with its description, its files of weights and more, in hex."""
    model = path.read_bytes()
    parts = (model, description.model_dump_json().encode(), *more)
    digest = hashlib.sha256(b"\0".join(parts))
    for name in weight_files(model):
        with open_file(path.parent / name) as weights:
            digest.update(hashlib.file_digest(weights, "sha256").digest())
    return digest.hexdigest()


def weight_files(model: bytes) -> list[str]:
    """The files beside an ONNX model that hold its weights, as newer exporters write them.

    Found as the values of the keys ``location`` of the model's external data (onnx.proto,
    ``StringStringEntryProto``).
    """
    names = set()
    for found in _LOCATION.finditer(model):
        length = found[1][0]  # below 128, the whole of protobuf's variable-length integer
        names.add(model[found.end() : found.end() + length].decode("utf-8", "surrogateescape"))
    return sorted(names)


_LOCATION: Final = re.compile(rb"\x0a\x08location\x12([\x01-\x7f])")


class OnnxFile:
    """A model. Raises MisuseError if the file is missing or onnxruntime, which ``extra`` installs,
    cannot do what is asked, ModelError if the file is no model."""

    extra: ClassVar[str] = "words"

    def __init__(self, path: Path, device: Device = "cpu", threads: int | None = None) -> None:
        self.path = path
        if not path.is_file():
            raise MisuseError(f"{path}: no such model; see docs/detector.md")
        ort, self._faults = _onnxruntime(self.extra)
        options = ort.SessionOptions()
        options.log_severity_level = 4  # faults come as exceptions
        if threads is not None:
            options.intra_op_num_threads = threads
        wanted = _providers(ort, device)
        try:
            self._session = ort.InferenceSession(str(path), options, providers=wanted)
        except self._faults as fault:
            raise ModelError(f"{path}: cannot be loaded as ONNX: {_reason(fault)}") from None
        if device == "cuda" and self._session.get_providers()[0] != wanted[0]:
            raise MisuseError(
                "--device cuda: onnxruntime could not start CUDA, whose libraries may be missing"
                " or of another version; use --device cpu"
            )
        self.inputs = tuple(_tensor(each) for each in self._session.get_inputs())
        self.outputs = tuple(_tensor(each) for each in self._session.get_outputs())

    @property
    def metadata(self) -> Mapping[str, str]:
        """The metadata that the exporter wrote into the file."""
        found: Mapping[str, str] = self._session.get_modelmeta().custom_metadata_map
        return found

    def output(self, *names: str) -> str:
        """The first of ``names`` that is an output, else the name of the only output. Raises
        ModelError."""
        there = [each.name for each in self.outputs]
        for name in names:
            if name in there:
                return name
        if len(there) != 1:
            raise ModelError(
                f"{self.path}: it has the outputs {', '.join(there)}, and none of them is "
                f"{' or '.join(names) or 'named'}; export it with one output"
            )
        return there[0]

    def answer(self, given: Mapping[str, NDArray[Any]], output: str) -> Array:
        """The output for some inputs. Raises ModelError."""
        try:
            (answer,) = self._session.run([output], dict(given))
        except self._faults as fault:
            raise ModelError(f"{self.path}: {_reason(fault)}") from None
        if not isinstance(answer, np.ndarray) or answer.dtype.kind != "f":
            raise ModelError(f"{self.path}: output {output} is no array of floating point numbers")
        return answer


class OnnxModel(OnnxFile):
    """A model that takes pictures, (n, 3, height, width), as its only input. Raises as `OnnxFile`
    does, and ModelError for another input."""

    extra = "detector"

    def __init__(self, path: Path, device: Device = "cpu", threads: int | None = None) -> None:
        super().__init__(path, device, threads)
        self.input = self._only_input()
        self._dtype = _TYPES[self.input.type]

    @property
    def size(self) -> tuple[int, int] | None:
        """Width and height of the input in pixels; None if they are not fixed."""
        _, _, height, width = self.input.shape
        return None if width is None or height is None else (width, height)

    @property
    def batch(self) -> int | None:
        """The number of pictures that it takes at once; None if that is not fixed."""
        return self.input.shape[0]

    def run(self, pictures: NDArray[np.float32], output: str) -> Array:
        """The output for ``pictures``, shape (n, 3, height, width). Raises ModelError."""
        return self.answer({self.input.name: pictures.astype(self._dtype, copy=False)}, output)

    def _only_input(self) -> Tensor:
        if len(self.inputs) != 1:
            names = ", ".join(each.name for each in self.inputs) or "none"
            raise ModelError(
                f"{self.path}: it has the inputs {names}; one that takes pictures is needed"
                " (of CLIP, export the image tower alone)"
            )
        found = self.inputs[0]
        if len(found.shape) != 4 or found.shape[1] not in (3, None) or found.type not in _TYPES:
            raise ModelError(
                f"{self.path}: its input {found.name} is {found.type} of {found.text}; "
                "n × 3 × height × width of float is needed"
            )
        return found


def _tensor(described: Any) -> Tensor:
    shape = tuple(size if isinstance(size, int) else None for size in described.shape)
    return Tensor(described.name, described.type, shape)


def _onnxruntime(extra: str) -> tuple[Any, tuple[type[Exception], ...]]:
    """The module, and the exceptions that it raises. MisuseError if it is not installed."""
    try:
        import onnxruntime
        from onnxruntime.capi import onnxruntime_pybind11_state as state
    except ImportError as error:
        if isinstance(error.__cause__ or error.__context__, KeyboardInterrupt):
            raise KeyboardInterrupt from None  # in the import, where pybind11 hides it
        raise MisuseError(
            f"ONNX models need onnxruntime; install mapfold with the extra {extra}: "
            f"pip install 'mapfold[{extra}]'"
        ) from None
    kinds = [kind for kind in vars(state).values() if isinstance(kind, type)]
    faults = tuple(kind for kind in kinds if issubclass(kind, Exception))
    return onnxruntime, (*faults, RuntimeError, ValueError)


def _providers(ort: Any, device: Device) -> list[str]:
    if device == "cpu":
        return ["CPUExecutionProvider"]
    if "CUDAExecutionProvider" not in ort.get_available_providers():
        raise MisuseError(
            "--device cuda: this onnxruntime has no CUDA; pip uninstall onnxruntime and"
            " pip install onnxruntime-gpu, or use --device cpu"
        )
    return ["CUDAExecutionProvider", "CPUExecutionProvider"]


def _reason(fault: Exception) -> str:
    """The last part of onnxruntime's message, which begins with codes and source lines."""
    words = " ".join(str(fault).split())
    return words.rpartition("Status Message: ")[2][:300] or type(fault).__name__
