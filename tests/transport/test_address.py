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


@pytest.mark.parametrize(
    "text",
    ["", "udp:1.2.3.4:5", "tcp:5760", "tcp::5760", "udpout:host:", "udpin:host:x", "serial:57600", "14550"],
)
def test_error_quotes_the_invalid_string_and_lists_the_forms(text: str) -> None:
    with pytest.raises(ValueError, match=r"not a connection string.*udpin:HOST:PORT") as error:
        Address.parse(text)
    assert repr(text) in str(error.value)


def test_invalid_ports_and_baud_rates_are_reported() -> None:
    with pytest.raises(ValueError, match="70000 is not a port"):
        Address.parse("tcp:host:70000")
    with pytest.raises(ValueError, match="57601 is not a baud rate"):
        Address.parse("serial:/dev/ttyS0:57601")
    with pytest.raises(ValueError, match=": 0 is not a baud rate"):
        Address.parse("serial:/dev/ttyS0:0")
    with pytest.raises(ValueError, match="'abc' is not a baud rate"):
        Address.parse("serial:/dev/ttyS0:abc")


@pytest.mark.parametrize(
    "text",
    [
        "udpout:foo..bar:14550",
        f"tcp:{'x' * 70}:5760",
        "udpin:.:14550",
        "tcp:300.1.1.1:5760",
        "tcpin:[::g]:5760",
        "tcp:host\0:5760",
        "udpin:14550,udpin:14551",
        "udpin://127.0.0.1:14550",
        "tcp:my host:5760",
    ],
)
def test_invalid_host_is_reported(text: str) -> None:
    with pytest.raises(ValueError, match="is neither an address nor a host name") as error:
        Address.parse(text)
    assert repr(text) in str(error.value)


@pytest.mark.parametrize("text", ["serial:/dev/tty\0x:57600", "serial:/dev/tty\ud800:57600"])
def test_invalid_device_is_reported(text: str) -> None:
    with pytest.raises(ValueError, match="is not a device name") as error:
        Address.parse(text)
    assert repr(text) in str(error.value)


@pytest.mark.parametrize(
    "host", ["127.1", "fe80::1%wlan0", "my_pi.local", "b\u00fccher.example", "autopilot"]
)
def test_possible_host_names_are_accepted(host: str) -> None:
    assert Address.parse(f"udpout:[{host}]:14550").place == host
