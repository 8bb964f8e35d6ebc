"""Keys that envelopes can be published under."""

import pytest

from eventsrc.base.errors import MisuseError
from eventsrc.record.transport.config import check_key


@pytest.mark.parametrize(
    "key", ["k", "k" * 1024, "tb/detections", "robot-7/küche/é", "@a/b", "a:b/c.d"]
)
def test_valid_keys_pass(key: str) -> None:
    assert check_key(key, "--key") == key


@pytest.mark.parametrize(
    ("key", "says"),
    [
        ("a b/*", "one of the characters * $ ? #"),
        ("tb/**", "one of the characters * $ ? #"),
        ("a$b", "one of the characters * $ ? #"),
        ("tb/x?y", "one of the characters * $ ? #"),
        ("a b", "white space"),
        ("a\tb", "white space"),
        ("a\x00b", "white space"),
        ("", "a part of it is empty"),
        ("/tb", "a part of it is empty"),
        ("tb//x", "a part of it is empty"),
        ("mapfold/loss", "mapfold's own"),
        ("k" * 1025, "1025 bytes long, more than 1024"),
        ("é" * 513, "1026 bytes long, more than 1024"),
    ],
)
def test_invalid_keys_are_misuse(key: str, says: str) -> None:
    with pytest.raises(MisuseError, match="--key") as caught:
        check_key(key, "--key")
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)
