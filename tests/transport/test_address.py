"""Valid and invalid connection strings."""

import pytest

from companion.transport.address import Address


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


NO_FORM = r"not a connection string.*udpin:HOST:PORT"
NO_HOST = "is neither an address nor a host name"
NO_DEVICE = "is not a device name"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", NO_FORM),
        ("udp:1.2.3.4:5", NO_FORM),
        ("tcp:5760", NO_FORM),
        ("tcp::5760", NO_FORM),
        ("udpout:host:", NO_FORM),
        ("udpin:host:x", NO_FORM),
        ("serial:57600", NO_FORM),
        ("14550", NO_FORM),
        ("tcp:host:70000", "70000 is not a port"),
        ("serial:/dev/ttyS0:57601", "57601 is not a baud rate"),
        ("serial:/dev/ttyS0:0", ": 0 is not a baud rate"),
        ("serial:/dev/ttyS0:abc", "'abc' is not a baud rate"),
        ("udpout:foo..bar:14550", NO_HOST),
        (f"tcp:{'x' * 70}:5760", NO_HOST),
        ("udpin:.:14550", NO_HOST),
        ("tcp:300.1.1.1:5760", NO_HOST),
        ("tcpin:[::g]:5760", NO_HOST),
        ("tcp:host\0:5760", NO_HOST),
        ("udpin:14550,udpin:14551", NO_HOST),
        ("udpin://127.0.0.1:14550", NO_HOST),
        ("tcp:my host:5760", NO_HOST),
        ("serial:/dev/tty\0x:57600", NO_DEVICE),
        ("serial:/dev/tty\ud800:57600", NO_DEVICE),
        ("serial:/dev/tty\udcff:57600", NO_DEVICE),
    ],
)
def test_error_quotes_the_invalid_string_and_states_the_mistake(text: str, words: str) -> None:
    with pytest.raises(ValueError, match=words) as error:
        Address.parse(text)
    assert repr(text) in str(error.value)


@pytest.mark.parametrize(
    "host", ["127.1", "fe80::1%wlan0", "my_pi.local", "b\u00fccher.example", "autopilot"]
)
def test_possible_host_names_are_accepted(host: str) -> None:
    assert Address.parse(f"udpout:[{host}]:14550").place == host
