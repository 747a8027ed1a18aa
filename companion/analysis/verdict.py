"""Verdict on a flight: good, caution or fault, the reason in one sentence, and the number that decides.

Against a truth a promise that was not kept is a fault; against a smoothed track or GNSS, which may be wrong
themselves, it is a reason for caution. The first rule that applies decides.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np

from companion.analysis import error_statistics, flight_events
from companion.analysis.assessment import GNSS, Assessment, deviation
from companion.analysis.flight_arrays import Flight
from companion.analysis.summary import (
    CONSISTENT,
    SHORT_S,
    describe_gnss,
    describe_worst,
    format_duration,
    format_length,
    format_share,
    format_time,
    gnss_contradiction,
    worse_than_inertial,
    worst_of,
)

REJECTED_S = 10.0  # fixes rejected for longer are worth a look
LEAST_S = 10.0  # a shorter estimate is not judged

Level = Literal["good", "caution", "fault"]


class Verdict(NamedTuple):
    """Level, reason (one sentence), the number that decides and what it is."""

    level: Level
    reason: str
    number: str
    what: str

    @property
    def word(self) -> str:
        """The level as the user reads it."""
        return self.level.capitalize()


def judge_flight(a: Assessment) -> Verdict:
    """Return the verdict: that of the first rule that applies."""
    return next((verdict for rule in _RULES if (verdict := rule(a)) is not None), None) or _kept(a)


def _promise(a: Assessment) -> Level:
    """The level of a promise that was not kept."""
    return "fault" if a.against_truth else "caution"


def _no_estimate(a: Assessment) -> Verdict | None:
    if len(a.flight.tables["Solution"]["t"]):
        return None
    return Verdict("fault", f"There is no estimate. {missing_input(a.flight)}", "0", "positions estimated")


def _bound_broken(a: Assessment) -> Verdict | None:
    """The error of a phase was above the guaranteed bound: r.m.s. against r.m.s., as it is stated."""
    broken = [row for row in a.rows if row.held is False and (row.share or 0.0) > 1.0]
    if not broken:
        return None
    worst = max(broken, key=lambda row: row.share or 0.0)
    return Verdict(
        _promise(a),
        f"The guaranteed bound did not hold in the phase “{flight_events.phase_title(worst.phase)}”.",
        _times_the_limit(worst.share or 0.0),
        f"the bound (r.m.s. {deviation(a)}; limit 1)",
    )


def _times_the_limit(share: float) -> str:
    """Format what is above 1; a little above is not written as 1."""
    return f"{share:.2f} ×" if share >= 1.005 else f"{share:.5f} ×"


def _moments_beyond_bound(a: Assessment) -> Verdict | None:
    """Moments beyond a bound on the r.m.s. error break no promise, but a user wants to see them."""
    beyond = [row for row in a.rows if row.held is False and row.inside is not None]
    if not beyond:
        return None
    worst = min(beyond, key=lambda row: row.inside or 0.0)
    return Verdict(
        "caution",
        f"At moments the {deviation(a)} was above the guaranteed bound, which limits its r.m.s. only; "
        f"most often in the phase “{flight_events.phase_title(worst.phase)}”.",
        format_share(worst.inside or 0.0),
        "of this phase within the bound",
    )


def _protection_broken(a: Assessment) -> Verdict | None:
    """The error exceeded the protection level.

    Not stated against GNSS, which may be rejected rightly, nor against a track that GNSS contradicts.
    """
    ours = a.errors.get(error_statistics.CORRECTED)
    if ours is None or a.reference is None or a.reference.what == GNSS:
        return None
    if gnss_contradiction(a) is not None:
        return None
    error, level = ours.error, ours.protection
    beyond = np.flatnonzero(error > level)  # False where one of them is not known
    if not len(beyond):
        return None
    k = beyond[np.argmax(error[beyond] / level[beyond])]
    off = deviation(a) if a.against_truth else f"{deviation(a)} from {a.reference.what}"
    return Verdict(
        _promise(a),
        f"The {off} exceeded the protection level at {format_time(ours.t_ns[k] * 1e-9)}: "
        f"{format_length(error[k])} against {format_length(level[k])}.",
        _times_the_limit(error[k] / level[k]),
        "the protection level (limit 1)",
    )


def _worse_than_inertial(a: Assessment) -> Verdict | None:
    worse = worse_than_inertial(a)
    if not worse or a.reference is None or a.reference.what == GNSS:
        return None
    row = max(worse, key=lambda row: row.rms[error_statistics.CORRECTED])
    ins, ours = row.rms[error_statistics.INS], row.rms[error_statistics.CORRECTED]
    return Verdict(
        _promise(a),
        f"In the phase “{flight_events.phase_title(row.phase)}” the estimate was worse than the inertial "
        f"channel alone, which had {format_length(ins)}.",
        format_length(ours),
        f"r.m.s. {deviation(a)} of the estimate",
    )


def _contradiction(a: Assessment) -> Verdict | None:
    torn = gnss_contradiction(a)
    if torn is None:
        return None
    return Verdict(
        "caution",
        f"From {format_time(torn.start)} to {format_time(torn.end)} GNSS and the smoothed track contradict "
        "each other: one of them is wrong.",
        format_length(torn.apart),
        "between them (median)",
    )


def _missing(a: Assessment) -> Verdict | None:
    """A part without an estimate, but for a silence at the end: the autopilot was switched off then.

    One that is switched on again sends a few messages before its reboot is recognised.
    """
    parts = [p for p in a.phases if p.name == flight_events.NO_ESTIMATE]
    end = max(a.flight.seconds - flight_events.PHASE_MIN_S, a.flight.tables["Solution"]["t"].max())
    off = next((s.start for s in a.silences if s.end >= end), math.inf)
    if parts and parts[-1].start_ns * 1e-9 > off - flight_events.PHASE_MIN_S:
        parts.pop()
    if not parts:
        return None
    return Verdict(
        "caution",
        f"There was no estimate for a part of the flight, from {format_time(parts[0].start_ns * 1e-9)} on.",
        format_duration(sum(p.end_ns - p.start_ns for p in parts) * 1e-9),
        "without an estimate",
    )


def _untrusted(a: Assessment) -> Verdict | None:
    seconds = sum((p.end_ns - p.start_ns) * 1e-9 for p in a.phases if p.name == "untrusted")
    if not seconds:
        return None
    return Verdict(
        "caution",
        "For a part of the flight the position was marked as not to be trusted: fly by other means then.",
        format_duration(seconds),
        "not to be trusted",
    )


def _unlimited(a: Assessment) -> Verdict | None:
    """Nothing limited the position in a phase without fixes: no useful guaranteed bound, no protection level.

    A bound of no use alone is no caution: in flight the position is trusted by its protection level.
    """
    solution = a.flight.tables["Solution"]
    seconds = 0.0
    for row, phase in zip(a.rows, a.phases, strict=True):
        if phase.name in flight_events.WITHOUT_FIXES and row.seconds >= SHORT_S and not row.useful:
            levels = solution["protection"][phase.covers(solution["t"])]
            seconds += row.seconds * (not np.isfinite(levels).any())
    if not seconds:
        return None
    return Verdict(
        "caution",
        "Without fixes nothing limited the position: no useful guaranteed bound and no protection level.",
        format_duration(seconds),
        "without a limit",
    )


def _inconsistent(a: Assessment) -> Verdict | None:
    small = [series for series in a.normalized_errors if series.inside < CONSISTENT]
    if not small:
        return None
    worst = min(small, key=lambda series: series.inside)
    return Verdict(
        "caution",
        f"The stated sigmas are too small for what was found ({worst.what}).",
        format_share(worst.inside),
        "within the 95 % limit",
    )


def _longest_rejection(a: Assessment) -> flight_events.RejectionGroup | None:
    """Return the longest rejection of fixes or of the velocities of GNSS, None if it is short."""
    found = [
        g for g in a.groups if flight_events.is_fix(g.source) or flight_events.is_gnss_velocity(g.source)
    ]
    longest = max(found, key=lambda g: g.end - g.start, default=None)
    return None if longest is None or longest.end - longest.start < REJECTED_S else longest


def _rejections(a: Assessment) -> Verdict | None:
    longest = _longest_rejection(a)
    if longest is None or _promise(a) == "fault":
        return None
    name = flight_events.source_title(longest.source)
    velocity = flight_events.is_gnss_velocity(longest.source)
    what, kind = (f"The {name} was", "velocities") if velocity else (f"Fixes of {name} were", "fixes")
    return Verdict(
        "caution",
        f"{what} rejected from {format_time(longest.start)}; whether this was right, the log cannot show.",
        format_duration(longest.end - longest.start),
        f"of {kind} rejected",
    )


def _reset(a: Assessment) -> Verdict | None:
    resets = [line for line in a.timeline if line.kind == "reset"]
    if not resets:
        return None
    return Verdict(
        "caution",
        f"The estimate was reset, first at {format_time(resets[0].t)}: {resets[0].text}.",
        str(len(resets)),
        "resets" if len(resets) > 1 else "reset",
    )


def _no_reference(a: Assessment) -> Verdict | None:
    if a.reference is not None and error_statistics.CORRECTED in a.errors:
        return None
    return Verdict("caution", "There is nothing to compare the estimate with.", "unknown", "accuracy")


def _too_short(a: Assessment) -> Verdict | None:
    seconds = sum(row.seconds for row in a.rows if row.phase != flight_events.NO_ESTIMATE)
    if seconds >= LEAST_S:
        return None
    reason = f"There is an estimate of {format_duration(seconds)}: less than {LEAST_S:.0f} s show nothing."
    return Verdict("caution", reason, format_duration(seconds), "with an estimate")


def _kept(a: Assessment) -> Verdict:
    worst = worst_of(a).estimate
    happened = describe_gnss(a)
    if (rejected := _longest_rejection(a)) is not None:
        seconds = format_duration(rejected.end - rejected.start)
        the = "the " * flight_events.is_gnss_velocity(rejected.source)
        happened += f", {the}{flight_events.source_title(rejected.source)} was rejected for {seconds}"
    reason = f"{happened}, and {_describe_bound(a)}."
    return Verdict("good", reason, format_length(worst), describe_worst(a))


def _describe_bound(a: Assessment) -> str:
    """Describe in how many phases the guaranteed bound held; it was exceeded in none."""
    useful = [row.useful for row in a.rows if row.phase != flight_events.NO_ESTIMATE]
    if not any(useful):
        return "no phase has a useful guaranteed bound"
    if all(useful):
        return "the guaranteed bound held in every phase"
    counted = f"{sum(useful)} of {len(useful)} phases"
    return f"the guaranteed bound held in {counted}; it was of no use in the others"


_RULES: tuple[Callable[[Assessment], Verdict | None], ...] = (
    _no_estimate,
    _bound_broken,
    _protection_broken,
    _worse_than_inertial,
    _moments_beyond_bound,
    _contradiction,
    _missing,
    _untrusted,
    _no_reference,
    _inconsistent,
    _unlimited,
    _rejections,
    _reset,
    _too_short,
)


def missing_input(flight: Flight) -> str:
    """Say what is missing for an estimate, and which message would give it."""
    has = {
        name: f"/in/{name}" in flight.streams
        for name in ("Gnss", "RsbnFix", "LocalPosition", "LocalOrigin", "Attitude", "AirData", "Imu")
    }
    received = [flight_events.topic_name(f"/in/{name}") for name, known in has.items() if known]
    logged = f"Logged are {', '.join(received)}. " if received else "No input was logged. "
    if not has["RsbnFix"] and not len(flight_events.usable_gnss(flight)["t"]):
        state = "GNSS never had a 3D fix" if has["Gnss"] else "no position was received"
        return (
            f"{logged}A fix is missing, for {state}: it needs GPS_RAW_INT with a fix, or a beacon's replies."
        )
    if (has["Attitude"] and (has["AirData"] or has["Imu"])) or (has["LocalPosition"] and has["LocalOrigin"]):
        return f"{logged}A channel is there, but no fix was accepted: see the rejections below."
    beside = "" if has["Attitude"] else "ATTITUDE with "
    wanted = f"{beside}airspeed (VFR_HUD) or an IMU (RAW_IMU, HIGHRES_IMU)"
    origin = (
        "the message GPS_GLOBAL_ORIGIN"
        if has["LocalPosition"]
        else "LOCAL_POSITION_NED with GPS_GLOBAL_ORIGIN"
    )
    return (
        f"{logged}What carries the position between fixes is missing: it needs {wanted}, or, with an INS of "
        f"its own, {origin}."
    )
