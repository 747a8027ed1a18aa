"""`python -m sitl.endurance.forgeries`: what each forged message can do, on unsigned and signed links.

A simulated flight with GNSS and a beacon is repeated with forged frames added, ten a second from 20 s on, and
compared with the flight without them: the greatest distance between the positions sent to the autopilot, the
share of the messages sent, and what was reported. The forger sends as itself (system 66), or with the ids of
the autopilot from another address, or with the ids and the address of the autopilot (a serial line, a router,
a forged source address).
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable, Hashable, Sequence
from functools import partial
from typing import NamedTuple, TypeAlias

import click
from rich.table import Table

from companion.config import Config
from companion.link import dialect, frame
from companion.link.dialect import mavlink, rsbn
from companion.link.signing import Signing
from companion.runtime.core import CompanionCore
from companion.storage.deferred_log import NoLog
from companion.tables import print_tables
from companion.units import SECOND_NS
from sitl.endurance.parameter_sweep import CONFIGS, recorded_flight
from sitl.loopback import LINK, START_NS
from sitl.world import BOOT_S

FORGED_FROM_S, INTERVAL_NS = 20.0, SECOND_NS // 10
KEY, STRANGERS_KEY = bytes(range(32)), bytes(32)
OURS = {"target_system": 1, "target_component": 191}
#: Frames and their senders at a time.
Forger: TypeAlias = Callable[[int], list[tuple[bytes, Hashable]]]
AUTOPILOT, STRANGER = "autopilot", "stranger"
#: Names of the table's rows, and the message at each time (boot time, ms). A place 20 km away, 60 m/s.
FORGERIES: dict[str, Callable[[int], dialect.Message]] = {
    "HEARTBEAT": lambda ms: dialect.new("HEARTBEAT", type=mavlink.MAV_TYPE_FIXED_WING, autopilot=3),
    "SYSTEM_TIME": lambda ms: dialect.new("SYSTEM_TIME", time_boot_ms=ms + 5000, time_unix_usec=2**50),
    "TIMESYNC": lambda ms: dialect.new("TIMESYNC", tc1=ms * 1_000_000 + 10**9, ts1=START_NS),
    "GPS_GLOBAL_ORIGIN": lambda ms: dialect.new(
        "GPS_GLOBAL_ORIGIN", latitude=601_800_000, longitude=303_000_000, altitude=10_000
    ),
    "GPS_RAW_INT": lambda ms: dialect.new(
        "GPS_RAW_INT",
        time_usec=1000 * ms,
        fix_type=mavlink.GPS_FIX_TYPE_3D_FIX,
        lat=601_800_000 + ms % 1000,
        lon=303_000_000,
        alt=400_000,
        eph=80,
        vel=6000,
    ),
    "LOCAL_POSITION_NED": lambda ms: dialect.new(
        "LOCAL_POSITION_NED", time_boot_ms=ms, x=2e4 + ms % 97, y=9e3, z=-400.0, vx=60.0, vy=20.0
    ),
    "ATTITUDE": lambda ms: dialect.new(
        "ATTITUDE", time_boot_ms=ms, roll=0.5, pitch=0.3, yaw=3.0 + 1e-4 * (ms % 97)
    ),
    "VFR_HUD": lambda ms: dialect.new("VFR_HUD", airspeed=90.0 + 0.01 * (ms % 97), heading=180, alt=400.0),
    "RAW_IMU": lambda ms: dialect.new("RAW_IMU", time_usec=1000 * ms, xacc=2000, yacc=ms % 97, zacc=-1000),
    "SYS_STATUS": lambda ms: dialect.new("SYS_STATUS"),
    "RSBN_MEASUREMENT": lambda ms: dialect.new(
        "RSBN_MEASUREMENT",
        time_usec=1000 * ms,
        beacon_id=1,
        status=rsbn.RSBN_STATUS_AZIMUTH_VALID | rsbn.RSBN_STATUS_RANGE_VALID,
        azimuth=1.0 + 1e-3 * (ms % 97),
        sigma_azimuth=2e-3,
        slant_range=20_000.0 + ms % 97,
        sigma_range=100.0,
        beacon_lat=601_000_000,
        beacon_lon=301_000_000,
    ),
    "RADIO_STATUS": lambda ms: dialect.new("RADIO_STATUS", rssi=1, txbuf=0),
    "COMMAND_ACK": lambda ms: dialect.new("COMMAND_ACK", command=42007, result=4),
    "PARAM_SET GNSS_SIGMA_M": lambda ms: dialect.new(
        "PARAM_SET", param_id="GNSS_SIGMA_M", param_value=1000.0, param_type=9, **OURS
    ),
    "PARAM_SET ODOMETRY_HZ": lambda ms: dialect.new(
        "PARAM_SET", param_id="ODOMETRY_HZ", param_value=0.0, param_type=9, **OURS
    ),
    "COMMAND_LONG 511, ODOMETRY off": lambda ms: dialect.new(
        "COMMAND_LONG", command=511, param1=mavlink.MAVLINK_MSG_ID_ODOMETRY, param2=-1.0, **OURS
    ),
}
SENDERS: dict[str, tuple[int, int, Hashable]] = {
    "another system": (66, 1, STRANGER),
    "autopilot's ids": (1, 1, STRANGER),
    "autopilot's ids and address": (1, 1, AUTOPILOT),
}


class Sent(NamedTuple):
    """What a flight sent to the autopilot: times and positions (m) of ODOMETRY, all messages, the events."""

    odometry: list[tuple[int, float, float]]
    messages: list[tuple[int, bytes]]
    events: list[str]


class Effect(NamedTuple):
    """Effect of a forgery: greatest displacement (m), share of ODOMETRY still sent, first new event."""

    displaced_m: float
    share: float
    event: str


def signed(data: bytes, signing: Signing, now_ns: int) -> bytes:
    """Return an unsigned MAVLink 2 frame with a signature."""
    (found,) = frame.Reader().receive(data)
    assert isinstance(found, frame.Frame)
    message = dialect.decode(found)
    return frame.encode(
        message,
        found.sequence,
        found.system,
        found.component,
        lambda head: signing.sign(head, 7, now_ns),
    )


def fly(config: Config, forged: Forger, key: bytes | None = None) -> Sent:
    """Fly the recorded flight, signed with `key`, with the `forged` frames of each tenth of a second."""
    core = CompanionCore(config, NoLog(), (LINK,), Signing(key, timestamp=1 << 40) if key else None)
    autopilot = Signing(key, timestamp=1 << 40) if key else None
    due, events = START_NS + round(FORGED_FROM_S * 1e9), list[str]()
    odometry, messages = list[tuple[int, float, float]](), list[tuple[int, bytes]]()
    for now, data in recorded_flight(config.inertial.independent):
        core.receive(LINK, signed(data, autopilot, now) if autopilot else data, now, AUTOPILOT)
        if now >= due:
            due += INTERVAL_NS
            for raw, peer in forged(now):
                core.receive(LINK, raw, now, peer)
        if core.deadline() <= now:
            core.poll(now)
        for sent in core.to_send(LINK, now):
            (found,) = frame.Reader().receive(sent)
            assert isinstance(found, frame.Frame)
            message = dialect.decode(found)
            if found.msgid == mavlink.MAVLINK_MSG_ID_ODOMETRY:
                odometry.append((now, message.x, message.y))
            if found.msgid == rsbn.MAVLINK_MSG_ID_NAVIGATION_STATUS:
                message.rejected = 0  # counts the forged frames that were rejected
            messages.append((found.msgid, dialect.payload(message)))
        events += [event.text for event in core.take_events()]
    return Sent(odometry, messages, events)


def forger(name: str, sender: str, key: bytes | None = None) -> Forger:
    """Return the frames of one row of the table at a time; `key` signs them."""
    system, component, peer = SENDERS[sender]
    signing = Signing(key, timestamp=1 << 41) if key else None

    def forged(now: int) -> list[tuple[bytes, Hashable]]:
        ms = _boot_ms(now)
        sign = (lambda head: signing.sign(head, 7, now)) if signing else None
        frames = [frame.encode(FORGERIES[name](ms), ms & 0xFF, system, component, sign)]
        if sender == "another system" and name != "HEARTBEAT":  # it poses as a vehicle
            frames.append(frame.encode(FORGERIES["HEARTBEAT"](ms), ms & 0xFF, system, component, sign))
        return [(data, peer) for data in frames]

    return forged


def together(rows: Sequence[Forger], now: int) -> list[tuple[bytes, Hashable]]:
    """Return the frames of several forgers."""
    return [frame for row in rows for frame in row(now)]


def _boot_ms(now_ns: int) -> int:
    return (now_ns - START_NS) // 1_000_000 + round(1e3 * BOOT_S)


def compare(plain: Sent, disturbed: Sent) -> Effect:
    """Return the effect of a forgery."""
    times = [t for t, _, _ in plain.odometry]
    displaced = 0.0
    for t, x, y in disturbed.odometry:
        at = min(max(bisect.bisect(times, t), 1), len(times) - 1)
        (t0, x0, y0), (t1, x1, y1) = plain.odometry[at - 1], plain.odometry[at]
        share = (t - t0) / max(t1 - t0, 1)
        displaced = max(displaced, math.hypot(x - x0 - share * (x1 - x0), y - y0 - share * (y1 - y0)))
    new = next((text for text in disturbed.events if text not in plain.events), "")
    return Effect(displaced, len(disturbed.odometry) / max(len(plain.odometry), 1), new)


@click.command()
@click.option("--only", type=click.Choice([*FORGERIES]), help="One message; default: all.")
def main(only: str | None) -> None:
    """Print the effect of every forged message, by sender, on an unsigned and on a signed link."""
    config = CONFIGS[1]
    plain = fly(config, lambda now: [])
    plain_signed = fly(config, lambda now: [], KEY)
    table = Table("forged, 10 a second", "sender", "moved, m", "ODOMETRY", "reported", "signed link")
    for name in [only] if only else FORGERIES:
        rows = [forger(name, sender, key) for sender in SENDERS for key in (None, STRANGERS_KEY)]
        attacked = fly(config, partial(together, rows), KEY)
        on_signed = "no effect" if attacked.messages == plain_signed.messages else "EFFECT"
        for sender in SENDERS:
            effect = compare(plain, fly(config, forger(name, sender)))
            table.add_row(
                name,
                sender,
                f"{effect.displaced_m:.0f}",
                f"{100.0 * effect.share:.0f} %",
                effect.event.removeprefix(f"{LINK}: ")[:60],
                on_signed,
            )
    print_tables(table)


if __name__ == "__main__":
    main()
