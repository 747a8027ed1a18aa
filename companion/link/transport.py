"""Byte streams over serial lines, UDP, TCP and memory, opened again for ever. Knows no MAVLink.

    async for stream in connections(Address.parse("udpin:127.0.0.1:14550"), random.random, print):
        try:
            while True:
                data = await stream.read()      # all that is there; ConnectionError when the link ends
                stream.write(answer)            # never waits
            # or, where the answer must not wait for a turn of the event loop:
            await stream.hand_to(receive)       # each piece as it comes, until the link ends
        except ConnectionError as error:
            ...                                 # the next turn opens it again, after a pause

Every kind of link is one `Stream`: a file descriptor watched by the event loop and two closures, to take what
is there and to put what fits. (Draining a socket by `add_reader` costs a tenth of asyncio's datagram
transport.) A write that the line cannot take waits in a bounded queue, out of which the oldest frame is
dropped and counted: an old position is worth nothing, a stalled loop loses the new ones too.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import socket
import termios
import tty
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator
from typing import Any, NamedTuple

FORMS = "serial:DEVICE:BAUD, udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or tcpin:HOST:PORT"
#: Rates that a terminal device of this system can be set to, by their number.
BAUD_RATES = {
    int(name[1:]): value for name, value in vars(termios).items() if name[0] == "B" and name[1:].isdigit()
}
LOOPBACK = "127.0.0.1"
#: A link is drained by so many bytes, and so many datagrams, before others get their turn: noise made to be
#: slow to read (0.3 MB/s) then holds nobody up for more than 0.05 s.
AT_ONCE = 1 << 14
BURST = 64
LONGEST_DATAGRAM = 65536
INBOX_LIMIT = 1 << 20
OUTBOX_LIMIT = 1 << 16
#: Peers that a listening UDP link answers to: the last ones heard.
PEERS = 8
CONNECT_TIMEOUT = 10.0
SHORTEST_PAUSE, LONGEST_PAUSE = 0.25, 10.0
#: A link that lasted so long (s) had been good: its loss begins the pauses anew.
GOOD_AFTER = 10.0


class CannotListen(OSError):
    """The address to listen on is not to be had: for the operator to settle, so no reconnect helps."""


class Address(NamedTuple):
    """Where a link leads: `kind` serial, udpin, udpout, tcp or tcpin; `number` a port or a baud rate."""

    kind: str
    place: str
    number: int

    @classmethod
    def parse(cls, text: str) -> Address:
        """Read a connection string. A link that listens without a host does so on the loopback only."""
        kind, _, rest = text.partition(":")
        place, colon, digits = rest.rpartition(":")
        if not colon and kind in ("udpin", "tcpin"):
            place = ""
        listens = kind in ("udpin", "tcpin")
        if kind not in ("serial", "udpin", "udpout", "tcp", "tcpin") or not digits.isdecimal():
            raise ValueError(f"{text!r} is no connection string: give {FORMS}")
        number = int(digits)
        if kind == "serial":
            if number not in BAUD_RATES:
                raise ValueError(
                    f"{text!r}: {number} is not a baud rate of this system: give one like 57600 or 921600"
                )
        elif not (0 if listens else 1) <= number <= 65535:
            raise ValueError(f"{text!r}: {number} is not a port: give 1 to 65535")
        if not place and not listens:
            raise ValueError(f"{text!r} is no connection string, it names no host or device: give {FORMS}")
        return cls(kind, place.strip("[]") or LOOPBACK, number)

    def __str__(self) -> str:
        place = f"[{self.place}]" if ":" in self.place else self.place
        return f"{self.kind}:{place}:{self.number}"


class Stream:
    """An open link. Not for threads; belongs to the running loop."""

    def __init__(
        self,
        name: str,
        device: int | socket.socket,
        take: Callable[[], bytes | None],
        put: Callable[[bytes], int],
    ) -> None:
        """`take` returns bytes, None for an empty datagram, b"" at the end; `put` how much it took.

        Both may raise OSError; BlockingIOError means that the line is empty or full.
        """
        self.name = name
        self.dropped = 0
        self._device = device
        self._fd = device if isinstance(device, int) else device.fileno()
        self._take, self._put = take, put
        self._loop = asyncio.get_running_loop()
        self._inbox: list[bytes] = []
        self._held = 0
        self._outbox: deque[bytes] = deque()
        self._queued = 0
        self._begun = False  # the first of the outbox is the rest of a frame half written
        self._waiter: asyncio.Future[None] | None = None
        self._end: ConnectionError | None = None
        self._hand: Callable[[bytes], None] | None = None
        self._loop.add_reader(self._fd, self._on_readable)

    @property
    def port(self) -> int:
        """The local port, 0 where the link has none."""
        if isinstance(self._device, socket.socket) and self._device.family in (
            socket.AF_INET,
            socket.AF_INET6,
        ):
            return int(self._device.getsockname()[1])
        return 0

    async def read(self) -> bytes:
        """Wait for bytes and return all that came. ConnectionError when the link has ended."""
        while not self._inbox:
            if self._end is not None:
                raise self._end
            self._waiter = self._loop.create_future()
            try:
                await self._waiter
            finally:
                self._waiter = None
        return self._all()

    async def hand_to(self, receive: Callable[[bytes], None]) -> None:
        """Call `receive` with each piece as soon as it is here, until the link ends: ConnectionError, or what
        `receive` raised.
        """
        self._waiter, self._hand = self._loop.create_future(), receive
        try:
            if self._inbox:
                receive(self._all())
            if self._end is None:
                await self._waiter
        finally:
            self._waiter = self._hand = None
        assert self._end is not None
        raise self._end

    def write(self, frame: bytes) -> None:
        """Send a frame now or as soon as the line takes it. Without effect on a link that has ended."""
        if self._end is not None or not frame:
            return
        self._outbox.append(frame)
        self._queued += len(frame)
        if len(self._outbox) == 1:
            self._flush()
            if self._outbox:
                self._loop.add_writer(self._fd, self._on_writable)
        while self._queued > OUTBOX_LIMIT and len(self._outbox) > 1 + self._begun:
            oldest = self._outbox[int(self._begun)]
            del self._outbox[int(self._begun)]
            self._queued -= len(oldest)
            self.dropped += 1

    def close(self) -> None:
        """End the link; a waiting `read` raises ConnectionError."""
        self._finish("was closed")

    def _all(self) -> bytes:
        data = b"".join(self._inbox)
        self._inbox.clear()
        if self._held >= INBOX_LIMIT and self._end is None:
            self._loop.add_reader(self._fd, self._on_readable)
        self._held = 0
        return data

    def _on_readable(self) -> None:
        taken = 0
        for _ in range(BURST):
            if taken >= AT_ONCE:
                break
            try:
                data = self._take()
            except BlockingIOError:
                break
            except OSError as error:
                return self._finish(f"failed: {_reason(error)}")
            if data is None:
                continue
            if not data:
                return self._finish("was closed by the other side")
            taken += len(data)
            if not self._deliver(data):
                break
        return self._wake() if self._inbox else None

    def _deliver(self, data: bytes) -> bool:
        """Whether there may be more."""
        if self._hand is not None and self._waiter is not None:
            try:
                self._hand(data)
            except Exception as error:
                if not self._waiter.done():
                    self._waiter.set_exception(error)
                return False
            return self._end is None
        self._inbox.append(data)
        self._held += len(data)
        if self._held >= INBOX_LIMIT:
            self._loop.remove_reader(self._fd)
        return self._held < INBOX_LIMIT

    def _on_writable(self) -> None:
        self._flush()
        if not self._outbox and self._end is None:
            self._loop.remove_writer(self._fd)

    def _flush(self) -> None:
        try:
            while self._outbox:
                frame = self._outbox[0]
                done = self._put(frame)
                self._queued -= done
                self._begun = done < len(frame)
                if self._begun:
                    self._outbox[0] = frame[done:]
                    return
                self._outbox.popleft()
        except BlockingIOError:
            pass
        except OSError as error:
            self._finish(f"failed: {_reason(error)}")

    def _finish(self, why: str) -> None:
        if self._end is not None:
            return
        self._end = ConnectionError(f"{self.name} {why}")
        self._loop.remove_reader(self._fd)
        self._loop.remove_writer(self._fd)
        self._outbox.clear()
        if isinstance(self._device, int):
            os.close(self._device)
        else:
            self._device.close()
        self._wake()

    def _wake(self) -> None:
        if self._waiter is not None and not self._waiter.done():
            self._waiter.set_result(None)


def pair() -> tuple[Stream, Stream]:
    """Return the two ends of a link in memory."""
    one, other = socket.socketpair()
    return _over_socket("memory", one), _over_socket("memory", other)


async def connect(address: Address) -> Stream:
    """Open the link once. OSError if it is not to be had, CannotListen if its own address is not."""
    if address.kind == "serial":
        return _open_serial(address)
    loop = asyncio.get_running_loop()
    datagrams = address.kind.startswith("udp")
    kind = socket.SOCK_DGRAM if datagrams else socket.SOCK_STREAM
    found = await loop.getaddrinfo(address.place, address.number, type=kind)
    family, _, _, _, where = found[0]
    sock = socket.socket(family, kind)
    sock.setblocking(False)
    try:
        if address.kind in ("udpin", "tcpin"):
            _bind(address, sock, where)
        if address.kind == "udpin":
            return _listen_udp(address, sock)
        if address.kind == "udpout":
            sock.connect(where)
            return _over_socket(str(address), sock, forgiving=True)
        if address.kind == "tcpin":
            sock.listen(1)
            listener, (sock, _) = sock, await loop.sock_accept(sock)
            listener.close()
        else:
            async with asyncio.timeout(CONNECT_TIMEOUT):
                await loop.sock_connect(sock, where)
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return _over_socket(str(address), sock)
    except BaseException:
        sock.close()
        raise


async def connections(
    address: Address, random: Callable[[], float], say: Callable[[str], None]
) -> AsyncIterator[Stream]:
    """Open the link, and again whenever the body of the `async for` comes back, for ever.

    `random` returns numbers in [0, 1), for the jitter of the pauses; `say` gets one line for each failure
    that differs from the last. CannotListen ends it at once.
    """
    loop = asyncio.get_running_loop()
    pauses = back_off(random)
    said = ""
    while True:
        try:
            stream = await connect(address)
        except CannotListen:
            raise
        except OSError as error:
            line = f"{address}: {_reason(error)}; trying again"
            if line != said:
                say(line)
            said = line
        else:
            said, opened = "", loop.time()
            try:
                yield stream
            finally:
                stream.close()
            if loop.time() - opened >= GOOD_AFTER:
                pauses = back_off(random)
        await asyncio.sleep(next(pauses))


def back_off(random: Callable[[], float]) -> Iterator[float]:
    """Yield pauses in seconds that double up to LONGEST_PAUSE, each shortened by up to a half at random."""
    longest = SHORTEST_PAUSE
    while True:
        yield longest * (1 - random() / 2)
        longest = min(2 * longest, LONGEST_PAUSE)


def _reason(error: OSError) -> str:
    if isinstance(error, TimeoutError) and not error.errno:
        return "no answer"
    return os.strerror(error.errno) if error.errno and error.errno > 0 else error.strerror or str(error)


def _bind(address: Address, sock: socket.socket, where: Any) -> None:
    if address.kind == "tcpin":
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        sock.bind(where)
    except OSError as error:
        in_use = error.errno == errno.EADDRINUSE
        advice = "end the other program or choose another port" if in_use else "choose another host or port"
        raise CannotListen(error.errno, f"cannot listen on {address}: {_reason(error)}; {advice}") from None


def _over_socket(name: str, sock: socket.socket, forgiving: bool = False) -> Stream:
    """Stream over a connected socket. `forgiving`: a datagram that nobody took is no end."""
    sock.setblocking(False)

    def take() -> bytes | None:
        try:
            data = sock.recv(LONGEST_DATAGRAM if forgiving else AT_ONCE)
        except ConnectionRefusedError:
            if forgiving:
                return None
            raise
        return data or (None if forgiving else b"")

    def put(frame: bytes) -> int:
        try:
            return sock.send(frame)
        except (ConnectionRefusedError, BlockingIOError) as error:
            if forgiving and isinstance(error, ConnectionRefusedError):
                return len(frame)
            raise

    return Stream(name, sock, take, put)


def _listen_udp(address: Address, sock: socket.socket) -> Stream:
    peers: dict[Any, None] = {}  # in the order of their last word

    def take() -> bytes | None:
        data, peer = sock.recvfrom(LONGEST_DATAGRAM)
        peers.pop(peer, None)
        peers[peer] = None
        if len(peers) > PEERS:
            del peers[next(iter(peers))]
        return data or None

    def put(frame: bytes) -> int:
        for peer in peers:
            with contextlib.suppress(OSError):  # a peer that is gone, or a full line: one datagram lost
                sock.sendto(frame, peer)
        return len(frame)

    return Stream(str(address), sock, take, put)


def _open_serial(address: Address) -> Stream:
    fd = os.open(address.place, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        tty.setraw(fd)
        mode = termios.tcgetattr(fd)
        mode[2] = mode[2] & ~(termios.CRTSCTS | termios.CSTOPB) | termios.CLOCAL | termios.CREAD
        mode[4] = mode[5] = BAUD_RATES[address.number]
        termios.tcsetattr(fd, termios.TCSANOW, mode)
        termios.tcflush(fd, termios.TCIOFLUSH)
    except termios.error as error:
        os.close(fd)
        raise OSError(error.args[0], f"not a serial line: {error.args[1]}") from None
    return Stream(str(address), fd, lambda: os.read(fd, AT_ONCE), lambda frame: os.write(fd, frame))
