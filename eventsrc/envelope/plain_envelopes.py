"""Read envelopes of known fields in half of pydantic's time, for callers that need no models.

`read_plain` accepts a subset of what `eventsrc.envelope.model` accepts: envelopes with known fields
only, whose texts are printable. For any other payload it returns None, and the caller uses
pydantic, which also gives the reasons. The results have the fields and values of the models, except
that an integer floor stays an integer. So the models of `eventsrc.envelope.model` alone define what
is valid; a property test compares the two on payloads near the rules' limits.
"""

from collections.abc import Mapping
from typing import Annotated, Any, Final, Self

import msgspec
from msgspec import Meta

from .model import (
    COVARIANCE_SIZE,
    MAX_DEPTH_M,
    MAX_DETECTIONS,
    MAX_DIMENSION,
    MAX_ID_LENGTH,
    MAX_POSITION_M,
    MAX_TIMESTAMP_S,
    covariance_fault,
    stamp_ns,
)

_Text = Annotated[str, Meta(min_length=1, max_length=MAX_ID_LENGTH)]
_Int64 = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
_Position = Annotated[float, Meta(ge=-MAX_POSITION_M, le=MAX_POSITION_M)]
_Sigma = Annotated[float, Meta(ge=0.001, le=1000.0)]
_Pixels = Annotated[float, Meta(ge=1.0, le=1e6)]


class _Known(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True, gc=False):
    """A JSON object with known fields only."""

    def model_copy(self, *, update: Mapping[str, Any]) -> Self:
        """A copy with other values of some fields, as `pydantic.BaseModel.model_copy` makes it."""
        return msgspec.structs.replace(self, **update)


class PlainDetection(_Known, rename={"class_name": "class"}):
    """The fields of `eventsrc.envelope.model.Detection`."""

    class_name: _Text
    confidence: float
    bbox: tuple[float, float, float, float]
    det_id: _Text | None = None
    embedding: str | None = None
    embedding_dim: Annotated[int, Meta(ge=1, le=MAX_DIMENSION)] | None = None
    embedding_model: _Text | None = None
    depth_m: Annotated[float, Meta(gt=0.0, le=MAX_DEPTH_M)] | None = None
    depth_sigma_m: _Sigma | None = None
    position: tuple[_Position, _Position] | None = None
    position_sigma_m: _Sigma | None = None


class PlainCamera(_Known):
    """The fields of `eventsrc.envelope.model.EnvelopeCamera`."""

    hfov_deg: Annotated[float, Meta(ge=1.0, le=170.0)]
    width_px: _Pixels
    height_px: _Pixels
    yaw_rad: Annotated[float, Meta(ge=-7.0, le=7.0)] = 0.0


class PlainEnvelope(_Known):
    """The fields of `eventsrc.envelope.model.Envelope`."""

    run_id: _Text
    keyframe_id: _Int64
    timestamp: Annotated[float, Meta(ge=0.0, le=MAX_TIMESTAMP_S)]
    detections: Annotated[tuple[PlainDetection, ...], Meta(max_length=MAX_DETECTIONS)]
    map_x: _Position | None = None
    map_y: _Position | None = None
    map_yaw: float | None = None
    camera: PlainCamera | None = None
    floor: _Text | _Int64 | None = None
    map_z: _Position | None = None
    pose_covariance: (
        Annotated[tuple[float, ...], Meta(min_length=COVARIANCE_SIZE, max_length=COVARIANCE_SIZE)]
        | None
    ) = None

    @property
    def stamp_ns(self) -> int:
        """``timestamp`` as int nanoseconds."""
        return stamp_ns(self.timestamp)


_decode: Final = msgspec.json.Decoder(PlainEnvelope).decode


def read_plain(payload: bytes) -> PlainEnvelope | None:
    """The envelope in ``payload``, valid except for its embeddings, which are not decoded; None if
    pydantic must validate it. Call `eventsrc.envelope.ingest.check_cost` before."""
    try:
        envelope = _decode(payload)
    except ValueError:  # msgspec's errors, and bytes that are not UTF-8
        return None
    except RecursionError:
        return None
    return envelope if _is_plain(envelope) else None


def _is_plain(envelope: PlainEnvelope) -> bool:
    """Whether the envelope keeps the rules that its types do not state. Texts are printable, so
    they have no control characters."""
    if not envelope.run_id.isprintable():
        return False
    if not (envelope.map_x is None) is (envelope.map_y is None) is (envelope.map_yaw is None):
        return False
    if isinstance(envelope.floor, str) and not envelope.floor.isprintable():
        return False
    covariance = envelope.pose_covariance
    if covariance is not None and covariance_fault(covariance) is not None:
        return False
    ids: list[str] = []
    for detection in envelope.detections:
        if not detection.class_name.isprintable():
            return False
        model, det_id = detection.embedding_model, detection.det_id
        if model is not None and not model.isprintable():
            return False
        if det_id is not None:
            ids.append(det_id)
    # A given id may equal another, or one generated for a detection without an id.
    return not ids or (len(set(ids)) == len(envelope.detections) and all(map(str.isprintable, ids)))
