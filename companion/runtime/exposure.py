"""What the links allow to others: one sentence for each link, for the start of the service and the doctor."""

from __future__ import annotations

import ipaddress
from typing import NamedTuple

from companion.config import Config
from companion.transport.address import Address


class Exposure(NamedTuple):
    """Who may send on a link; `is_open` if that is anyone on a network."""

    is_open: bool
    text: str


def exposure(address: Address, config: Config) -> Exposure:
    """Return the exposure of a link at `address`."""
    if config.signing.key_file and config.signing.refuse_unsigned:
        return Exposure(False, f"{address} is signed: frames without the key have no effect")
    allows = "set parameters and pose as a beacon or the autopilot"
    if address.kind == "serial":
        return Exposure(False, f"{address} is not signed: who reaches the line or its radio may {allows}")
    if _is_loopback(address.place):
        return Exposure(False, f"{address} is not signed: programs of this computer may {allows}")
    advice = "sign it (companion signing init), or use the loopback address; see docs/security.md"
    return Exposure(True, f"{address} is open and not signed: anyone on the network may {allows}; {advice}")


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
