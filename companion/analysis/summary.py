"""Summary of a flight in one paragraph: duration, outages, errors, bound, rejections, anomalies."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from companion.analysis import error_statistics
from companion.analysis.assessment import GNSS, SMOOTHED, Assessment
from companion.analysis.plot_data import LETTERS
from companion.units import Floats

WITHOUT_FIXES = ("prediction", "untrusted")
FAR_M = 30.0  # a greater median distance between GNSS and the smoothed track is a contradiction
SHORT_S = 30.0  # shorter phases and differences are not mentioned
CHEBYSHEV = 0.75  # least share of moments within twice a valid r.m.s. bound
LATE_S = 0.1  # smaller GNSS delays are usual
FLAT_M = 1.0  # smaller differences of two errors are ignored


def format_time(seconds: float) -> str:
    """Format a time since the start as minutes and seconds, 3:07."""
    whole = round(abs(seconds))
    return f"{'-' if seconds < -0.5 else ''}{whole // 60}:{whole % 60:02d}"


def format_duration(seconds: float) -> str:
    """Format a duration, 3 min 7 s."""
    if seconds < 59.5:
        return f"{seconds:.0f} s" if seconds >= 9.5 else f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    parts = [f"{hours} h" if hours else "", f"{minutes} min" if minutes else "", f"{rest} s" if rest else ""]
    return " ".join(part for part in parts if part)


def format_length(value: float) -> str:
    """Format a length with a unit and digits that fit its size."""
    if not math.isfinite(value):
        return "–"
    if value >= 10_000.0:
        return f"{value / 1000.0:.1f} km"
    return f"{value:.0f} m" if value >= 100.0 else f"{value:.1f} m" if value >= 1.0 else f"{value:.2f} m"


def summarize_flight(a: Assessment) -> str:
    """Return the paragraph."""
    sentences = [
        *_flight_sentences(a),
        *_error_sentences(a),
        *_bound_sentences(a),
        *_rejection_sentences(a),
        *_anomalies(a),
    ]
    return " ".join([*sentences, *a.flight.remarks])


def compare_flights(a: Assessment, b: Assessment) -> str:
    """Describe which of two flights, A or B, had the smaller errors, with fixes and without."""
    if a.reference is None or b.reference is None:
        return "The errors cannot be compared: there is no reference."
    parts = [_split_errors(a), _split_errors(b)]
    sentences = []
    for what, k in (("With fixes", 0), ("Without fixes", 1)):
        pair = parts[0][k], parts[1][k]
        if not all(len(error) for error in pair):
            if any(len(error) for error in pair):
                letter = LETTERS[0] if len(pair[0]) else LETTERS[1]
                sentences.append(f"Only {letter} has a phase {what.lower()}.")
            continue
        rms = _rms(pair[0]), _rms(pair[1])
        if abs(rms[0] - rms[1]) < 0.02 * max(rms):
            sentences.append(f"{what} the errors are equal: {format_length(rms[0])} r.m.s.")
        else:
            (less, better), (more, worse) = sorted(zip(rms, LETTERS, strict=True))
            values = f"{format_length(less)} r.m.s., and {format_length(more)} for {worse}"
            sentences.append(f"{what} {better} had the smaller error: {values}.")
    seconds = [_seconds_without_fixes(flight) for flight in (a, b)]
    if any(seconds) and abs(seconds[0] - seconds[1]) > SHORT_S:
        spans = [format_duration(span) if span else "never" for span in seconds]
        sentences.append(f"A was without for {spans[0]}, B for {spans[1]}.".replace("for never", "never"))
    if a.reference.what != b.reference.what:
        sentences.append("The errors are relative to different references; compare them with care.")
    return " ".join(sentences) or "The errors cannot be compared: one flight has none."


def _split_errors(a: Assessment) -> tuple[Floats, Floats]:
    """Return the errors of the corrected estimate, with fixes and without."""
    corrected = a.errors.get(error_statistics.CORRECTED)
    if corrected is None:
        return np.zeros(0), np.zeros(0)
    alone = _during(a, corrected, WITHOUT_FIXES)
    return corrected.error[~alone], corrected.error[alone]


def _seconds_without_fixes(a: Assessment) -> float:
    """Return the time without any fix, s."""
    return sum(row.end_ns - row.start_ns for row in a.phases if row.name in WITHOUT_FIXES) * 1e-9


def _flight_sentences(a: Assessment) -> list[str]:
    seconds, (k, n) = a.flight.seconds, a.flight.part
    duration = (
        f"The log covers {format_duration(seconds)}"
        if n == 1
        else f"Flight {k} of {n} lasts {format_duration(seconds)}"
    )
    if not len(a.flight.tables["Solution"]["t"]):
        return [
            f"{duration}, without an estimate: there was no inertial channel (a local position with its "
            "origin, or airspeed with attitude), or no fix was accepted."
        ]
    sentences = [f"{duration}."]
    started = float(a.flight.tables["Solution"]["t"][0])
    outages = [outage for outage in a.outages if outage.end > started]
    if not outages:
        sentences.append("GNSS was available throughout.")
    else:
        longest = max(outages, key=lambda outage: outage.end - outage.start)
        times = "once" if len(outages) == 1 else f"{len(outages)} times"
        until = "to the end" if longest.end >= seconds else f"to {format_time(longest.end)}"
        which = "for" if len(outages) == 1 else "longest for"
        span = format_duration(longest.end - longest.start)
        sentences.append(
            f"GNSS was lost {times}, {which} {span} (from {format_time(longest.start)} {until})."
        )
    if alone := _seconds_without_fixes(a):
        sentences.append(f"The position was predicted without any fix for {format_duration(alone)}.")
    untrusted = [phase for phase in a.phases if phase.name == "untrusted"]
    if untrusted:
        sentences.append(
            f"From {format_time(untrusted[0].start_ns * 1e-9)} the prediction was marked untrusted: its "
            "bound exceeded the configured limit or was not available."
        )
    return sentences


def _error_sentences(a: Assessment) -> list[str]:
    corrected = a.errors.get(error_statistics.CORRECTED)
    if corrected is None or a.reference is None:
        return ["There is neither a truth nor a track to smooth, so the errors are unknown."]
    found = zip(_split_errors(a), ("with fixes", "without"), strict=True)
    parts = [f"{format_length(_rms(error))} {how}" for error, how in found if len(error)]
    ins = a.errors.get(error_statistics.INS)
    beside = f"; the inertial channel alone {format_length(_rms(ins.error))}" if ins is not None else ""
    sentences = [
        f"Against {a.reference.what} the error of the estimate was {' and '.join(parts)} (r.m.s.), "
        f"{format_length(float(corrected.error.max()))} at most{beside}."
    ]
    if a.reference.what == SMOOTHED:
        sentences.append(
            "The smoothed track uses the same fixes and error model; errors common to both are not visible."
        )
        gnss = a.errors.get(error_statistics.GNSS)
        if gnss is not None and (apart := float(np.median(gnss.error))) > FAR_M:
            sentences.append(
                f"GNSS AND THE SMOOTHED TRACK DIFFER by {format_length(apart)} (median), "
                "because GNSS was rejected: one of them is wrong, and the stated errors cannot be trusted."
            )
    elif a.reference.what == GNSS:
        sentences.append("GNSS is not a truth: its own error is included in these numbers.")
    return sentences


def _bound_sentences(a: Assessment) -> list[str]:
    corrected = a.errors.get(error_statistics.CORRECTED)
    if corrected is None or not (known := np.isfinite(corrected.bound)).any():
        return ["No guaranteed bound is available."]
    inside = float(np.mean(corrected.error[known] <= corrected.bound[known]))
    broken = [row for row in a.rows if row.held is False]
    alone = known & _during(a, corrected, WITHOUT_FIXES)
    reached = (
        f" reached {format_length(float(corrected.bound[alone].max()))} without fixes and"
        if alone.any()
        else ""
    )
    if not broken:
        return [
            f"The guaranteed bound{reached} held in every phase; the error was within it {_percent(inside)} "
            "of the time."
        ]
    worst = max(broken, key=lambda row: row.share or 0.0)
    judged = sum(row.held is not None for row in a.rows)
    return [
        f"The guaranteed bound{reached} DID NOT HOLD in {len(broken)} of {judged} phases: in the phase "
        f"“{worst.phase}” the error was {worst.share:.2f} times the bound, r.m.s. The error was within the "
        f"bound {_percent(inside)} of the time."
    ]


def _rejection_sentences(a: Assessment) -> list[str]:
    fixes = [group for group in a.groups if group.source.lower().startswith(("gnss", "rsbn"))]
    if not fixes:
        return ["No fix was rejected."]
    total = sum(group.number for group in fixes)
    largest = max(fixes, key=lambda group: group.number)
    far = (
        f", up to {format_length(largest.metres)} from the estimate" if math.isfinite(largest.metres) else ""
    )
    when = f"from {format_time(largest.start)} to {format_time(largest.end)}"
    if largest.number == 1:
        when = f"at {format_time(largest.start)}"
    rejected = "1 fix was rejected" if total == 1 else f"{total} fixes were rejected"
    if len(fixes) == 1:
        return [f"{rejected}, {when}: {largest.reason}{far}."]
    return [
        f"{rejected} in {len(fixes)} events; the largest, {when}, has {largest.number} from "
        f"{largest.source}{far}: {largest.reason}."
    ]


def _anomalies(a: Assessment) -> list[str]:
    found = []
    for row in a.rows:
        ins, corrected = row.rms.get(error_statistics.INS), row.rms.get(error_statistics.CORRECTED)
        if row.seconds < SHORT_S or ins is None or corrected is None:
            continue
        if corrected > 1.2 * ins + FLAT_M:
            found.append(
                f"in the phase “{row.phase}” the corrected estimate ({format_length(corrected)}) was worse "
                f"than the inertial channel alone ({format_length(ins)})"
            )
        if row.inside_twice is not None and row.inside_twice < CHEBYSHEV:
            found.append(
                f"in the phase “{row.phase}” the error was within twice the bound of its moment only "
                f"{_percent(row.inside_twice)} of the time, where at least 75 % are expected"
            )
    for series in a.normalized_errors:
        if series.inside < 0.85:
            share = _percent(series.inside)
            found.append(f"only {share} of {series.what} is within its 95 % limit: the sigmas are too small")
    resets = [line for line in a.timeline if line.kind == "reset"]
    if resets:
        found.append(f"{len(resets)} reset{'s' * (len(resets) > 1)}, the first at {format_time(resets[0].t)}")
    glitches = [line for line in a.timeline if line.kind == "glitch"]
    if glitches:
        more = f", the first of {len(glitches)}" if len(glitches) > 1 else ""
        found.append(f"{glitches[0].text} (at {format_time(glitches[0].t)}{more})")
    found += [
        f"GNSS was {one.seconds:.2f} s behind the local position"
        for one in a.flight.latencies
        if one.seconds > max(LATE_S, 3.0 * one.sigma)
    ]
    return [f"Anomalies: {'; '.join(dict.fromkeys(found))}."] if found else []


def _during(
    a: Assessment, e: error_statistics.ErrorSeries, names: Sequence[str]
) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    inside = np.zeros(len(e.t_ns), dtype=np.bool_)
    for phase in a.phases:
        if phase.name in names:
            inside |= (e.t_ns >= phase.start_ns) & (e.t_ns < phase.end_ns)
    return inside


def _rms(error: Floats) -> float:
    return float(np.sqrt(np.mean(error**2)))


def _percent(share: float) -> str:
    return "100 %" if share == 1.0 else f"{min(100.0 * share, 99.9):.1f} %"
