"""Words for `find`: the text encoder that the settings of a map name, loaded once in a process.

The settings have the model's file and the SHA-256 of the model with its tokenizer and description.
On a machine that has the file elsewhere, `ELSEWHERE` in the environment says where; the SHA-256
must be the same. Messages name the file without its folder, as some go over a network.
"""

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Final

from eventsrc.base.errors import MapfoldError, MisuseError
from projections.ask.words import NotComparedError, ObjectVectors, Words
from projections.edit.current import MapToEdit
from projections.fold.settings import Settings
from projections.map.view import MapView
from projections.store.history_recorder import map_after

if TYPE_CHECKING:
    from eventsrc.adapters.detector.text_tower import TextTower

ELSEWHERE: Final = "MAPFOLD_TEXT_ENCODER"
_LOCK: Final = threading.RLock()
"""Of all that is below: a tower is for one thread at a time."""


def words_of(
    view: MapView, vectors: Callable[[MapView], ObjectVectors] = ObjectVectors.of
) -> Words | None:
    """Words by the text encoder of a map; None where its settings name none. ``vectors`` is called
    once for a map, when its words are compared."""
    return None if view.settings.text_encoder is None else _MapWords(view, vectors)


def with_text_encoder(settings: Settings, current: MapToEdit) -> Settings:
    """Settings to record in a log: with the SHA-256 of a text encoder that they newly name. Raises
    MisuseError for files that are none, and for a space other than that of the map's embeddings."""
    found = identified(settings)
    if settings.text_encoder is None or found is settings:
        return settings
    view = map_after(
        current.reader,
        settings.model_copy(update={"text_encoder": None}),
        current.end,
        corrections=current.corrections,
        note=current.note,
        embeddings=True,
    )
    with _LOCK:
        first = view.embedded()[:1]
        if len(first):
            model = view.observations[int(first[0])].embedding_model
            tower = _opened(Path(settings.text_encoder))
            _check_space(tower, model, view.vectors(first).shape[1])
    return found


def identified(settings: Settings) -> Settings:
    """Settings with path and SHA-256 of a text encoder that they newly name. Raises MisuseError."""
    if settings.text_encoder is None or settings.text_encoder_sha256 is not None:
        return settings
    path = Path(settings.text_encoder)
    with _LOCK:
        tower = _opened(path)
    return settings.model_copy(
        update={"text_encoder": str(path.absolute()), "text_encoder_sha256": tower.sha256}
    )


class _MapWords:
    """The text encoder and the vectors of a map."""

    def __init__(self, view: MapView, vectors: Callable[[MapView], ObjectVectors]) -> None:
        self._view, self._read = view, vectors
        self._file = Path(view.settings.text_encoder or "")

    @property
    def model(self) -> str:
        """The space of the vectors."""
        with self._comparing():
            return self._tower().model

    def cosines(self, words: str) -> dict[str, float]:
        """The cosine of the words with each Object that has a vector."""
        with self._comparing():
            if not words.strip():
                raise MisuseError("there are no words")
            tower, vectors = self._tower(), self._view.once(self._read)
            if not vectors.object_ids:
                raise MisuseError("no Object of this map has an embedding")
            _check_space(tower, vectors.model, vectors.means.shape[1])
            return vectors.cosines(tower.encode(words))

    @contextmanager
    def _comparing(self) -> Iterator[None]:
        try:
            with _LOCK:
                yield
        except MisuseError as error:
            raise NotComparedError(self._without_folder(error)) from None

    def _without_folder(self, error: Exception) -> str:
        folders = {str(Path(each).parent) for each in (self._file, os.environ.get(ELSEWHERE, "."))}
        text = str(error)
        for folder in folders - {"."}:
            text = text.replace(f"{folder}/", "")
        return f"words are compared with names of classes only: {text}"

    def _tower(self) -> "TextTower":
        wanted = self._view.settings.text_encoder_sha256
        file = self._file  # of this machine, unless the log recorded it
        if wanted is not None:
            file = Path(os.environ.get(ELSEWHERE) or file)
        if not os.path.isfile(file):  # noqa: PTH113 - `is_file` raises for a name that is too long
            elsewhere = f"; {ELSEWHERE}=MODEL.onnx says where it is" if wanted else ""
            raise MisuseError(f"the text encoder {file.name} is not here{elsewhere}")
        tower = _opened(file)
        if wanted not in (None, tower.sha256):
            raise MisuseError(
                f"the text encoder {file.name} or a file beside it is another one than the log's:"
                f" SHA-256 {tower.sha256[:16]}…, not {wanted[:16]}…"
            )
        return tower


def _opened(path: Path) -> "TextTower":
    """The tower in a file, as that is now."""
    stamps = [
        (each.stat().st_mtime_ns, each.stat().st_size)
        for each in (path, path.with_suffix(".json"), path.with_name("tokenizer.json"))
        if each.is_file()
    ]
    try:
        return _tower(path.absolute(), tuple(stamps))
    except MisuseError:
        raise
    except MapfoldError as error:
        raise MisuseError(str(error)) from None


@lru_cache(maxsize=2)
def _tower(path: Path, _: tuple[tuple[int, int], ...]) -> "TextTower":
    # Imported here: questions without words need no models.
    from eventsrc.adapters.detector.text_tower import TextTower

    return TextTower(path)


def _check_space(tower: "TextTower", model: str | None, dimension: int) -> None:
    if (tower.model, tower.dimension) != (model or tower.model, dimension):
        raise MisuseError(
            f"the text encoder {tower.path.name} is of the space {tower.model}, dimension"
            f" {tower.dimension:,}, the map's embeddings are of {model}, dimension {dimension:,};"
            " give the text tower of that model, or map the log in its space (--space)"
        )
