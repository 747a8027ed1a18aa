"""Detection of stale data: repeated records, and old values under new times.

    outputs = detector.judge(record)      # None: use the record; else drop it and return these outputs

Streams repeat: an autopilot sends its last fix at the stream's rate, a router sends every frame twice, a
receiver that hangs goes on with its last numbers under new times. A repeat with the old time is dropped, and
reported only if it lasts; one of GNSS is passed on, for it shows that the receiver is there. The same numbers
under a new time are another matter. No two readings of a noisy sensor are alike to the last bit, and what
moves is not where it was: a position that stands still at a speed is false at once, an attitude or an
airspeed after seconds, a beacon's answer (rounded to 10 m and 0.01 degrees: two running are alike once in
1500) and a sample of an IMU that turns at the third of a kind.

It knows no other record than the one before of the same source, and no clock but their times.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from companion.records import (
    AirData,
    Attitude,
    Gnss,
    Imu,
    LocalPosition,
    Output,
    Pressure,
    Reboot,
    Rejection,
    RsbnFix,
    Stamped,
)
from companion.units import SECOND_NS

MOVING_M_S = 1.0
FLYING_M_S = 5.0
#: An old time may be repeated for so long before it is reported: streams are faster than their sensors.
PATIENCE_S = 3.0
AIRSPEED_S, ATTITUDE_S = 10.0, 2.0
#: Answers of a beacon alike under new times: with azimuth and range, with one of them.
ANSWERS, HALF_ANSWERS = 3, 5
#: Samples of an IMU alike under new times. At rest a simulator's are alike: their rates are zero, or drift to
#: 4 mrad/s and change within 4.6 s (ArduPilot's, rounded to 1 mrad/s).
SAMPLES, TURNING_RAD_S, RESTING_S = 3, 0.005, 6.0
#: So many of one source are remembered: a beacon's answer comes on two links, and PX4 sends a pressure at
#: once (HIGHRES_IMU) and again up to 0.2 s later (SCALED_PRESSURE): late, it would cost a roll-back.
REMEMBERED: dict[type[Stamped], int] = {RsbnFix: 8, Pressure: 32}
#: Two answers alike and this near are one that came twice, and so are two of anything else: what maps the
#: autopilot's times is adjusted in between.
SAME_ANSWER_NS, SAME_NS = 50_000_000, 5_000_000
REPORT_EVERY = SECOND_NS
MOST_SOURCES = 256  # remembered; a receiver in error, or a stranger, may name 65536 beacons


class Run(NamedTuple):
    """Equal records of one source: their content, their last time, and how often the time changed."""

    content: tuple[Any, ...]
    stamp: int
    since_ns: int  # arrival of the first
    stamped_ns: int  # arrival of the first under the last time
    times: int = 1  # under times of their own
    reported_ns: int | None = None


class Law(NamedTuple):
    """How a kind of record is judged: its source's name, what must change, and when it ought to have.

    `stale` gets the record, under how many times it came alike and for how many seconds.
    """

    source: Callable[[Any], str]
    content: Callable[[Any], tuple[Any, ...]]
    stale: Callable[[Any, int, float], bool]


def _moves(v_n: tuple[float, ...] | None) -> bool:
    return v_n is not None and math.hypot(*v_n) > MOVING_M_S


def _turns(record: Imu, lasted_s: float) -> bool:
    rate = max(map(abs, record.w_b))
    return rate > TURNING_RAD_S or (rate > 0.0 and lasted_s >= RESTING_S)


def _enough(record: RsbnFix, times: int, lasted_s: float) -> bool:
    whole = record.azimuth is not None and record.slant_range is not None
    return times >= (ANSWERS if whole else HALF_ANSWERS)


LAWS: dict[type[Stamped], Law] = {
    LocalPosition: Law(
        lambda r: "inertial channel",
        lambda r: (r.x_n, r.v_n),
        lambda r, times, lasted_s: _moves(r.v_n),
    ),
    Gnss: Law(
        lambda r: f"gnss {r.receiver}",
        lambda r: (r.lat, r.lon, r.alt_msl, r.v_n, r.fix),
        lambda r, times, lasted_s: r.has_3d_fix and _moves(r.v_n),
    ),
    Imu: Law(
        lambda r: f"imu {r.source}",
        lambda r: (r.f_b, r.w_b),
        lambda r, times, lasted_s: times >= SAMPLES and _turns(r, lasted_s),
    ),
    Attitude: Law(
        lambda r: "attitude",
        lambda r: (r.roll, r.pitch, r.heading),  # its rates may go on: they are the gyros' own
        lambda r, times, lasted_s: lasted_s >= ATTITUDE_S,
    ),
    AirData: Law(
        lambda r: "air data",
        lambda r: (r.airspeed,),
        lambda r, times, lasted_s: r.airspeed > FLYING_M_S and lasted_s >= AIRSPEED_S,
    ),
    Pressure: Law(lambda r: "pressure", lambda r: (r.static,), lambda r, times, lasted_s: False),
    RsbnFix: Law(lambda r: f"rsbn {r.beacon}", lambda r: (r.azimuth, r.slant_range), _enough),
}


class StaleDataDetector:
    """The last run of every source; `judge` all records in the order of arrival."""

    def __init__(self) -> None:
        self._runs: dict[str, Run] = {}
        self._answers: dict[str, deque[tuple[int, tuple[Any, ...]]]] = {}

    def judge(self, record: Stamped) -> list[Output] | None:
        """Return None if `record` may be used, else the outputs that report it (often none)."""
        law = LAWS.get(type(record))
        if law is None:
            if isinstance(record, Reboot):
                self._runs.clear()
            return None
        source, content = law.source(record), law.content(record)
        if source not in self._runs:
            self._make_room()
        if type(record) in REMEMBERED and self._came(source, record, content):
            return []
        stamp, same = (record.stamp_us, 0) if isinstance(record, Gnss) else (record.t_ns, SAME_NS)
        run = self._runs.get(source)
        if run is None or content != run.content:
            self._runs[source] = Run(content, stamp, record.rx_ns, record.rx_ns)
            return None
        if abs(stamp - run.stamp) <= same:  # no news; but a sensor that is well would have some by now
            claimed = not isinstance(record, Gnss) or record.has_3d_fix
            lasted_s = (record.rx_ns - run.stamped_ns) * 1e-9
            if claimed and lasted_s > PATIENCE_S:
                return self._rejection(record, source, run, lasted_s, "its time stands still")
            return None if isinstance(record, Gnss) else []
        run = run._replace(stamp=stamp, stamped_ns=record.rx_ns, times=run.times + 1)
        self._runs[source] = run
        lasted_s = (record.rx_ns - run.since_ns) * 1e-9
        if law.stale(record, run.times, lasted_s):
            return self._rejection(
                record, source, run, lasted_s, "it is frozen: old numbers under a new time"
            )
        return None

    def _came(self, source: str, record: Stamped, content: tuple[Any, ...]) -> bool:
        """Whether this came before, on another link or in another message; else it is remembered."""
        t_ns, known = record.t_ns, self._answers.setdefault(source, deque(maxlen=REMEMBERED[type(record)]))
        if any(abs(t_ns - t) <= SAME_ANSWER_NS and content == c for t, c in known):
            return True
        known.append((t_ns, content))
        return False

    def _make_room(self) -> None:
        """Forget the source that brought nothing new for the longest, if there are too many."""
        if len(self._runs) >= MOST_SOURCES:
            del self._runs[min(self._runs, key=lambda source: self._runs[source].stamped_ns)]
            self._answers = {source: known for source, known in self._answers.items() if source in self._runs}

    def _rejection(self, record: Stamped, source: str, run: Run, lasted_s: float, why: str) -> list[Output]:
        if run.reported_ns is not None and record.rx_ns - run.reported_ns < REPORT_EVERY:
            return []
        self._runs[source] = run._replace(reported_ns=record.rx_ns)
        return [Rejection(record.t_ns, record.rx_ns, source, why, lasted_s)]
