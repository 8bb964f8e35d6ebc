"""Older envelopes mean what they meant, whatever fields of later names they hold."""

import json
from typing import Any

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from eventsrc.envelope.ingest import Accepted, CheckedEnvelope, Rejected, ingest
from eventsrc.envelope.upcast import check_envelopes, read_envelope, read_envelopes, read_fields
from eventsrc.log import Event
from tests.envelopes import detection, envelope, fields_of

KEY = "tb/detections"
JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-9, 9) | st.floats(-2.0, 2.0) | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=2), inner),
    max_leaves=4,
)
IN_DETECTION = ("depth_m", "depth_sigma_m", "position", "position_sigma_m")
IN_ENVELOPE = {2: {"camera", "floor", "map_z"}, 3: {"floor", "map_z"}, 4: set[str]()}
LATER = st.dictionaries(
    st.sampled_from([*IN_DETECTION, *sorted(IN_ENVELOPE[2]), "x"]), JSON, max_size=3
)
FLOOR = st.sampled_from([{}, {}, {"floor": 1}, {"floor": "attic", "map_z": 2.5}, {"map_z": 0}])
CAMERA = st.fixed_dictionaries(
    {"hfov_deg": st.just(90.0), "width_px": st.just(640.0), "height_px": st.just(400.0)}
)
ENVELOPES = st.builds(
    lambda more, floor, camera, inner, broken: {
        **more,
        **floor,
        **({} if camera is None else {"camera": camera}),
        **envelope(7, detections=[detection("cup", [1.0, 2.0], **each) for each in inner]),
        **broken,
    },
    LATER,
    FLOOR,
    st.none() | CAMERA,
    st.lists(LATER | st.just({"depth_m": 1.5}), max_size=3),
    st.just({}) | st.just({"map_x": "east"}) | st.just({"detections": 3}),
)


def plain(document: dict[str, Any], version: int) -> dict[str, Any]:
    """Without the fields that the version did not know."""
    later = IN_ENVELOPE[version]
    found = {name: value for name, value in document.items() if name not in later}
    if version == 2 and isinstance(found["detections"], list):
        found["detections"] = [
            {name: value for name, value in each.items() if name not in IN_DETECTION}
            for each in found["detections"]
        ]
    return found


@settings(suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(st.tuples(ENVELOPES, st.sampled_from([2, 3, 4])), max_size=4))
def test_an_older_envelope_is_read_as_if_it_had_no_field_of_later_names(
    documents: list[tuple[dict[str, Any], int]],
) -> None:
    events = [
        Event(offset, KEY, 0, 0, json.dumps(document).encode(), version)
        for offset, (document, version) in enumerate(documents)
    ]
    expected = [
        ingest(json.dumps(plain(document, version)).encode()) for document, version in documents
    ]
    read = read_envelopes(events)
    for want, quick in zip(expected, read_fields(events), strict=True):
        assert isinstance(quick, Rejected) == isinstance(want, Rejected)
        if isinstance(quick, Accepted) and isinstance(want, Accepted):
            assert fields_of(quick.envelope) == fields_of(want.envelope)
    checked = check_envelopes(events)
    for event, want, *found in zip(events, expected, read, checked, strict=True):
        both = [read_envelope(event), found[0]]
        for result in both:
            if isinstance(want, Rejected):
                assert result == want
                assert found[1] == want
            else:
                assert isinstance(result, Accepted)
                assert result.envelope == want.envelope
                assert result.det_ids == want.det_ids
                assert [v.tobytes() for v in result.vectors if v is not None] == [
                    v.tobytes() for v in want.vectors if v is not None
                ]
                assert found[1] == CheckedEnvelope.of(want.envelope)
