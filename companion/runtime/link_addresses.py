"""Link addresses of a configuration: checked before a start, the same in `run` and `check-config`."""

from __future__ import annotations

from companion.config import Config, ConfigError
from companion.transport.address import Address


def check_links(config: Config) -> None:
    """Raise ConfigError if an address of `link.connect` is invalid, or two need the same line or port."""
    seen: dict[Address, str] = {}
    for text in config.link.connect:
        try:
            address = Address.parse(text)
        except ValueError as error:
            raise ConfigError(f"link.connect: {error}") from None
        # a serial line has one baud rate: the second link could not open it
        line = address._replace(number=0) if address.kind == "serial" else address
        if line in seen:
            raise ConfigError(f"link.connect: {text!r} is the same link as {seen[line]!r}: remove one")
        seen[line] = text
