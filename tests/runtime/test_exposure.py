"""The start names what each link allows to others."""

import pytest

from companion.config import Config, SigningConfig
from companion.runtime.exposure import exposure
from companion.transport.address import Address


@pytest.mark.parametrize(
    ("link", "is_open", "who"),
    [
        ("udpin:0.0.0.0:14550", True, "anyone on the network"),
        ("tcpin:192.168.1.2:5760", True, "anyone on the network"),
        ("udpout:example.org:14550", True, "anyone on the network"),
        ("udpin:127.0.0.1:14550", False, "programs of this computer"),
        ("tcp:[::1]:5760", False, "programs of this computer"),
        ("serial:/dev/ttyS0:57600", False, "the line or its radio"),
    ],
)
def test_an_unsigned_link_names_who_may_send(link: str, is_open: bool, who: str) -> None:
    found = exposure(Address.parse(link), Config())
    assert found.is_open is is_open and who in found.text
    signed = exposure(Address.parse(link), Config(signing=SigningConfig(key_file="key")))
    assert not signed.is_open and "is signed" in signed.text
    lax = Config(signing=SigningConfig(key_file="key", refuse_unsigned=False))
    assert exposure(Address.parse(link), lax).is_open is is_open
