"""Connection strings, good and bad."""

import pytest

from companion.link.address import Address


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("serial:/dev/ttyAMA0:921600", ("serial", "/dev/ttyAMA0", 921600)),
        ("serial:/dev/serial/by-id/usb-a:b:57600", ("serial", "/dev/serial/by-id/usb-a:b", 57600)),
        ("udpin:0.0.0.0:14550", ("udpin", "0.0.0.0", 14550)),
        ("udpin::14550", ("udpin", "127.0.0.1", 14550)),
        ("udpin:14550", ("udpin", "127.0.0.1", 14550)),
        ("tcpin:5760", ("tcpin", "127.0.0.1", 5760)),
        ("udpout:[::1]:14550", ("udpout", "::1", 14550)),
        ("tcp:sitl.local:5760", ("tcp", "sitl.local", 5760)),
    ],
)
def test_connection_strings(text: str, address: tuple[str, str, int]) -> None:
    assert Address.parse(text) == address
    assert Address.parse(str(Address.parse(text))) == address


@pytest.mark.parametrize(
    "text",
    ["", "udp:1.2.3.4:5", "tcp:5760", "tcp::5760", "udpout:host:", "udpin:host:x", "serial:57600", "14550"],
)
def test_a_bad_connection_string_is_quoted_with_the_forms(text: str) -> None:
    with pytest.raises(ValueError, match=r"no connection string.*udpin:HOST:PORT") as error:
        Address.parse(text)
    assert repr(text) in str(error.value)


def test_impossible_ports_and_baud_rates_are_named() -> None:
    with pytest.raises(ValueError, match="70000 is not a port"):
        Address.parse("tcp:host:70000")
    with pytest.raises(ValueError, match="57601 is not a baud rate"):
        Address.parse("serial:/dev/ttyS0:57601")
