"""The text tower of CLIP, SigLIP or the like, an ONNX model: from words to a vector of the space of
its image tower.

Beside ``clip_text.onnx`` are its tokenizer, ``tokenizer.json`` as the library `tokenizers` writes
it, and ``clip_text.json``, which docs/embedding_spaces.md describes:

    {"model": "ViT-B-32/laion2b_s34b_b79k", "context": 77, "prompt": "a photo of a {}"}

A text is at most `MOST_TEXT` characters; tokens beyond the context are cut off. Batch of one, on
the CPU; for one thread at a time.
"""

from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from eventsrc.base.errors import MisuseError
from eventsrc.base.user_files import FileFault, read_file
from eventsrc.envelope.model import MAX_DIMENSION

from .onnx_model import Description, ModelError, OnnxFile, model_sha256, read_description

MOST_TEXT: Final = 256
_MAX_TOKENIZER_BYTES: Final = 64 * 1024 * 1024
_INTEGERS: Final = {"tensor(int64)": np.int64, "tensor(int32)": np.int32}
_TRIED: Final = "chair"


class TextDescription(Description):
    """The content of the JSON file beside a text tower.

    ``context`` tokens go in, filled up with ``pad``. ``prompt`` has the words in place of ``{}``.
    ``input`` and ``mask`` are the names of the inputs for tokens and for which of them are none
    that fills up.
    """

    EXAMPLE = '{"model": "NAME", "context": 77, "prompt": "a photo of a {}"}'
    PAGE = "docs/embedding_spaces.md"

    context: Annotated[int, Field(ge=1, le=4096)] = 77
    pad: Annotated[int, Field(ge=0, le=2**31 - 1)] = 0
    prompt: Annotated[str, Field(max_length=256)] = "{}"
    input: str = "input_ids"
    mask: str = "attention_mask"
    output: str | None = None

    @field_validator("prompt")
    @classmethod
    def _has_one_place(cls, prompt: str) -> str:
        if prompt.count("{}") != 1:
            raise ValueError("write {} once, where the words go")
        return prompt


class TextTower:
    """An opened text tower: the ``model`` that names its space, its ``dimension``, and the SHA-256
    of all its files. Raises MisuseError, and ModelError for files that do not fit each other."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._description = read_description(path, TextDescription)
        self._file = OnnxFile(path)
        self._tokenizer, tokens = _tokenizer(path.with_name("tokenizer.json"))
        self._tokenizer.enable_truncation(self._description.context)
        self._tokenizer.enable_padding(
            length=self._description.context, pad_id=self._description.pad
        )
        self._types = self._inputs()
        wanted = (self._description.output,) if self._description.output else ()
        self._output = self._file.output(*wanted, "text_embeds", "text_features", "embedding")
        self.model = self._description.model
        self.sha256 = model_sha256(path, self._description, tokens)
        self.dimension = len(self._run(_TRIED))

    def encode(self, words: str) -> NDArray[np.float32]:
        """The unit vector of some words. Raises MisuseError for words that have none."""
        if len(words) > MOST_TEXT:
            raise MisuseError(f"the words have {len(words):,} characters; give at most {MOST_TEXT}")
        try:
            vector = self._run(words).astype(np.float64)
        except ModelError as error:  # of these words, not of all
            raise MisuseError(str(error)) from None
        norm = float(np.linalg.norm(vector))
        if not np.isfinite(norm) or norm < 1e-12:
            raise MisuseError(f"{self.path} has no vector for {words!r}")
        return (vector / norm).astype(np.float32)

    def _inputs(self) -> dict[str, Any]:
        """The types of the inputs by name. Raises ModelError."""
        names = [each.name for each in self._file.inputs]
        wanted = self._description
        if wanted.input not in names or not set(names) <= {wanted.input, wanted.mask}:
            raise ModelError(
                f"{self.path}: it has the inputs {', '.join(names) or 'none'}; {wanted.input} and"
                f" at most {wanted.mask} are needed (of CLIP, export the text tower alone)"
            )
        for each in self._file.inputs:
            if each.type not in _INTEGERS or len(each.shape) != 2:
                raise ModelError(
                    f"{self.path}: its input {each.name} is {each.type} of {each.text};"
                    " n × tokens of int64 or int32 is needed"
                )
        return {each.name: _INTEGERS[each.type] for each in self._file.inputs}

    def _run(self, words: str) -> NDArray[np.floating[Any]]:
        spoken = words.encode("utf-8", "replace").decode()  # half a pair of UTF-16 is no character
        try:
            found = self._tokenizer.encode(self._description.prompt.replace("{}", spoken))
        except Exception as error:  # noqa: BLE001 - the library raises no class of its own
            raise ModelError(f"{self.path.with_name('tokenizer.json')}: {error}") from None
        given = {self._description.input: found.ids, self._description.mask: found.attention_mask}
        inputs = {name: np.array([given[name]], kind) for name, kind in self._types.items()}
        answer = self._file.answer(inputs, self._output)
        if answer.ndim != 2 or len(answer) != 1 or not 0 < answer.shape[1] <= MAX_DIMENSION:
            raise ModelError(
                f"{self.path}: output {self._output} is {' × '.join(map(str, answer.shape))} for a"
                " text; one vector is needed: export the pooled embedding"
            )
        row: NDArray[np.floating[Any]] = answer[0]
        return row


def _tokenizer(path: Path) -> tuple[Any, bytes]:
    """The tokenizer in a file, and the bytes there. Raises MisuseError."""
    try:
        import tokenizers
    except ImportError:
        raise MisuseError(
            "words need tokenizers; install mapfold with the extra words: pip install"
            " 'mapfold[words]'"
        ) from None
    try:
        content = read_file(path, _MAX_TOKENIZER_BYTES)
    except FileFault as fault:
        raise MisuseError(f"{path}: {fault}; this file splits texts into tokens") from None
    try:
        return tokenizers.Tokenizer.from_buffer(content), content
    except ValueError as error:
        raise MisuseError(f"{path}: no tokenizer of the library tokenizers: {error}") from None
