"""Foxglove WebSocket server of the live view: every channel of the log with its schema, as it is written."""

from __future__ import annotations

from collections.abc import Iterable

import foxglove
from foxglove import Channel, Schema

from companion.analysis.live import follow


class FoxgloveServer:
    """A server on `host`:`port` (0: any free port) that forwards messages.

    Raises OSError or RuntimeError if it cannot listen.
    """

    def __init__(self, host: str, port: int) -> None:
        self._context = foxglove.Context()
        self._server = foxglove.start_server(name="companion", host=host, port=port, context=self._context)
        self._channels: dict[follow.Channel, Channel] = {}

    @property
    def port(self) -> int:
        """The port it listens on."""
        return int(self._server.port)

    def forward(self, messages: Iterable[follow.Message]) -> None:
        """Send messages to all clients; a slow client misses the oldest ones."""
        for message in messages:
            if message.channel.encoding != "json":
                continue  # raw frames
            channel = self._channels.get(message.channel)
            if channel is None:
                channel = self._channels[message.channel] = self._open(message.channel)
            channel.log(message.content, log_time=message.log_ns)

    def _open(self, found: follow.Channel) -> Channel:
        schema = Schema(name=found.schema, encoding="jsonschema", data=found.data)
        return Channel(found.topic, schema=schema, message_encoding=found.encoding, context=self._context)

    def stop(self) -> None:
        """Close the server."""
        self._server.stop()
