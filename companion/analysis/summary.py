"""Summary of a flight in sentences: duration, outages, errors, bound, rejections, anomalies."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from companion.analysis import error_statistics, flight_events
from companion.analysis.assessment import GNSS, SMOOTHED, Assessment, deviation
from companion.analysis.error_statistics import root_mean_square
from companion.analysis.flight_events import (
    NO_ESTIMATE,
    OUTAGE_MIN_S,
    WITHOUT_FIXES,
    OutageInterval,
    RejectionGroup,
    in_phases_without_fixes,
    phase_title,
    source_title,
    usable_gnss,
)
from companion.units import Floats

#: GNSS contradicts the smoothed track where it is farther off than `FAR_M`, and than `FAR_TIMES` the r.m.s.
#: error that it states, for `FAR_S` or longer.
FAR_M, FAR_TIMES, FAR_S = 30.0, 3.0, 10.0
SHORT_S = 30.0  # shorter phases are not mentioned
BEGIN_S = 120.0  # until then an INS that starts without an error has not drifted
CHEBYSHEV = 0.75  # least share of moments within twice a valid r.m.s. bound
LATE_S = 0.1  # smaller GNSS delays are usual
CONSISTENT = 0.85  # least share of normalized errors within their 95 % limit
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


def format_share(share: float) -> str:
    """Format a share; 100 % is all of it, 0 % nothing."""
    if share in (0.0, 1.0):
        return f"{100.0 * share:.0f} %"
    return f"{min(100.0 * share, 99.9):.1f} %"


class Worst(NamedTuple):
    """The greatest horizontal distances of a flight, m: of the estimate from the reference and its time (s),
    of GNSS from the estimate or the reference, of the estimate as it started. NaN if unknown."""

    estimate: float
    t: float
    gnss: float
    starting: float


def worst_of(a: Assessment) -> Worst:
    """Return the greatest distances; nothing in the sentences is greater."""
    corrected, gnss = a.errors.get(error_statistics.CORRECTED), a.errors.get(error_statistics.GNSS)
    far = [group.metres for group in a.groups if group.source.lower().startswith("gnss")]
    far += [float(gnss.error.max())] if gnss is not None else []
    farthest = max((d for d in far if math.isfinite(d)), default=math.nan)
    if corrected is None:
        return Worst(math.nan, math.nan, farthest, math.nan)
    first = _first_counted(a, corrected)
    k = first + int(np.argmax(corrected.error[first:]))
    starting = float(corrected.error[:first].max()) if first else math.nan
    return Worst(float(corrected.error[k]), corrected.t_ns[k] * 1e-9, farthest, starting)


def rms_after_start(a: Assessment, source: str) -> float | None:
    """Return the r.m.s. distance of a source from the reference over what `worst_of` counts, m."""
    series = a.errors.get(source)
    return None if series is None else root_mean_square(series.error[_first_counted(a, series) :])


def _first_counted(a: Assessment, series: error_statistics.ErrorSeries) -> int:
    """Return the index of the first error that counts: not one of a start by beacons alone."""
    start_ns = _started_ns(a)
    first = int(np.searchsorted(series.t_ns, start_ns))
    first = max(first, int(np.searchsorted(series.t_ns, start_ns, "right")) - 1)  # both may be of one moment
    return first if first < len(series.t_ns) else 0


def _started_ns(a: Assessment) -> int:
    """Return when the first fixes of GNSS followed a short time with beacons alone, 0 if they did not."""
    names = [_rests_on(phase.name) for phase in a.phases[:2]]
    _, start_ns, end_ns = a.phases[0]
    return end_ns if names == [BY_BEACONS, WITH_GNSS] and end_ns - start_ns < SHORT_S * 1e9 else 0


def describe_worst(a: Assessment) -> str:
    """Name the greatest distance of the estimate: an error only against a truth."""
    t = worst_of(a).t
    when = f", at {format_time(t)}" if math.isfinite(t) else ""
    if a.reference is None or a.against_truth:
        return f"greatest {deviation(a)}{when}"
    return f"greatest distance from {a.reference.what}{when}"


def count_held(a: Assessment) -> str:
    """Return in how many of the phases with a useful guaranteed bound it held: "3 of 5"."""
    useful = [row for row in a.rows if row.useful]
    return f"{sum(row.held is True for row in useful)} of {len(useful)}" if useful else "none useful"


def summarize_flight(a: Assessment) -> list[str]:
    """Return the sentences."""
    estimated = len(a.flight.tables["Solution"]["t"]) > 0
    return [
        *_flight_sentences(a),
        *(_error_sentences(a) if estimated else []),
        *(_bound_sentences(a) if estimated else []),
        *_rejection_sentences(a),
        *_anomalies(a),
        *a.flight.remarks,
    ]


def describe_gnss(a: Assessment) -> str:
    """Describe what became of GNSS over the flight, without a full stop."""
    if absent := _absent_gnss(a):
        return f"GNSS was {absent}"
    if a.outages:
        return f"GNSS was lost for up to {describe_outage(a)}"
    first, start = float(usable_gnss(a.flight)["rx"].min()), float(a.flight.tables["Solution"]["t"][0])
    if first > start + OUTAGE_MIN_S:
        return f"GNSS had a fix from {format_time(first)} on"
    return "GNSS had a fix throughout" + (", while the autopilot sent" if a.silences else "")


def longest_outage(a: Assessment) -> float:
    """Return the longest time without GNSS, s: the whole flight if it never had a fix."""
    if _absent_gnss(a):
        return a.flight.seconds
    return max((outage.end - outage.start for outage in a.outages), default=0.0)


def describe_outage(a: Assessment) -> str:
    """Return the longest time without GNSS, or why there is none."""
    longest = longest_outage(a)
    return _absent_gnss(a) or (format_duration(longest) if longest else "never lost")


def _absent_gnss(a: Assessment) -> str:
    """Return how GNSS was missing all the time, empty if it ever had a fix."""
    if len(usable_gnss(a.flight)["t"]):
        return ""
    return "received without a fix" if len(a.flight.tables["Gnss"]["t"]) else "never received"


#: What the position of a phase rests on, as the sentences name it.
RESTS_ON = (WITH_GNSS, BY_BEACONS, WITHOUT, OTHERWISE) = (
    "with GNSS",
    "by beacons alone",
    "without fixes",
    "at other times",
)


def rms_by_source(a: Assessment) -> dict[str, float]:
    """Return the r.m.s. distance from the reference (m) by what the position rests on, where there is any.

    As in `worst_of`, a start by beacons alone does not count.
    """
    corrected = a.errors.get(error_statistics.CORRECTED)
    if corrected is None:
        return {}
    first = _first_counted(a, corrected)
    t, error = corrected.t[first:], corrected.error[first:]
    errors: dict[str, list[Floats]] = {}
    for phase in a.phases:
        errors.setdefault(_rests_on(phase.name), []).append(error[phase.covers(t)])
    found = {how: np.concatenate(errors[how]) for how in RESTS_ON if how in errors}
    return {how: root_mean_square(error) for how, error in found.items() if len(error)}


def _rests_on(phase: str) -> str:
    if phase in WITHOUT_FIXES:
        return WITHOUT
    return WITH_GNSS if "GNSS" in phase else BY_BEACONS if "RSBN" in phase else OTHERWISE


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
        return [f"{duration}, without an estimate."]
    sentences = [f"{duration}."]
    alone = _seconds_without_fixes(a)
    if not a.outages:
        unused = alone > 0.0 and not _absent_gnss(a)
        but = f", but was not used for {format_duration(alone)}" if unused else ""
        alone = 0.0 if unused else alone
        sentences.append(f"{describe_gnss(a)}{but}.")
    else:
        sentences.append(f"GNSS was lost {_how_often(a.outages, seconds)}.")
    if a.silences:
        sentences.append(f"Nothing was received from the autopilot {_how_often(a.silences, seconds)}.")
    if alone:
        sentences.append(f"The position was predicted without any fix for {format_duration(alone)}.")
    untrusted = [phase for phase in a.phases if phase.name == "untrusted"]
    if untrusted:
        sentences.append(
            f"From {format_time(untrusted[0].start_ns * 1e-9)} the prediction was marked untrusted: its "
            "bound exceeded the configured limit or was not available."
        )
    return sentences


def _how_often(gaps: Sequence[OutageInterval], seconds: float) -> str:
    longest = max(gaps, key=lambda gap: gap.end - gap.start)
    times, which = ("once", "for") if len(gaps) == 1 else (f"{len(gaps)} times", "longest for")
    until = "to the end" if longest.end >= seconds else f"to {format_time(longest.end)}"
    span = format_duration(longest.end - longest.start)
    return f"{times}, {which} {span} (from {format_time(longest.start)} {until})"


def _error_sentences(a: Assessment) -> list[str]:
    corrected = a.errors.get(error_statistics.CORRECTED)
    if corrected is None or a.reference is None:
        return ["There is nothing to compare the estimate with: its accuracy is unknown."]
    parts = [f"{format_length(rms)} {how}" for how, rms in rms_by_source(a).items()]
    ins = rms_after_start(a, error_statistics.INS)
    beside = "" if ins is None else f"; the inertial channel alone {format_length(ins)}"
    subject = f"The {deviation(a)} of the estimate"
    subject += "" if a.against_truth else f" from {a.reference.what}"
    worst = worst_of(a)
    before = f", {format_length(worst.starting)} before GNSS" if math.isfinite(worst.starting) else ""
    sentences = [
        f"{subject} was {', '.join(parts)} (r.m.s.), {format_length(worst.estimate)} at most "
        f"({format_time(worst.t)}{before}){beside}."
    ]
    if a.reference.what == SMOOTHED:
        sentences.append(
            "The smoothed track uses the same fixes and model; what is wrong in both is not visible."
        )
        if (torn := gnss_contradiction(a)) is not None:
            sentences.append(
                f"From {format_time(torn.start)} to {format_time(torn.end)} GNSS and the smoothed track "
                f"differ by {format_length(torn.apart)} (median): one of them is wrong, and the distances of "
                "that time cannot be trusted."
            )
    elif a.reference.what == GNSS:
        sentences.append("GNSS may itself be off; these distances include that.")
    return sentences


class Contradiction(NamedTuple):
    """Time from `start` to `end` (s) in which GNSS was far off the smoothed track: `apart`, median (m)."""

    start: float
    end: float
    apart: float


def gnss_contradiction(a: Assessment) -> Contradiction | None:
    """Return the longest time in which GNSS or the smoothed track must be wrong, if there is one."""
    gnss = a.errors.get(error_statistics.GNSS)
    if gnss is None or a.reference is None or a.reference.what != SMOOTHED:
        return None
    far = gnss.error > np.fmax(FAR_M, FAR_TIMES * gnss.claimed)
    t, error = gnss.t[far], gnss.error[far]
    ends = [0, *np.flatnonzero(np.diff(t) > OUTAGE_MIN_S) + 1, len(t)]
    spans = [
        Contradiction(float(t[i]), float(t[j - 1]), float(np.median(error[i:j])))
        for i, j in pairwise(ends)
        if j > i
    ]
    longest = max(spans, key=lambda span: span.end - span.start, default=None)
    return None if longest is None or longest.end - longest.start < FAR_S else longest


def worse_than_inertial(a: Assessment) -> list[error_statistics.PhaseErrors]:
    """Return the phases in which the estimate was worse than the inertial channel alone.

    Not one within the first `BEGIN_S`: a simulated INS starts without an error, and no fix is as good.
    """
    return [
        row
        for row, phase in zip(a.rows, a.phases, strict=True)
        if phase.end_ns * 1e-9 > BEGIN_S and is_worse_than_inertial(row)
    ]


def is_worse_than_inertial(row: error_statistics.PhaseErrors) -> bool:
    """Return whether in a phase worth mentioning the estimate was worse than the inertial channel alone.

    A phase without an estimate may have a few at its end: those do not stand for it.
    """
    ins, corrected = row.rms.get(error_statistics.INS), row.rms.get(error_statistics.CORRECTED)
    if row.seconds < SHORT_S or row.phase == NO_ESTIMATE or ins is None or corrected is None:
        return False
    return corrected > 1.2 * ins + FLAT_M


def _bound_sentences(a: Assessment) -> list[str]:
    corrected = a.errors.get(error_statistics.CORRECTED)
    if corrected is None or not (known := np.isfinite(corrected.bound)).any():
        return ["No guaranteed bound is available."]
    inside = float(np.mean(corrected.error[known] <= corrected.bound[known]))
    broken = [row for row in a.rows if row.held is False]
    alone = known & in_phases_without_fixes(a.phases, corrected.t)
    reached = (
        f" reached {format_length(float(corrected.bound[alone].max()))} without fixes and"
        if alone.any()
        else ""
    )
    judged = [row for row in a.rows if row.useful]
    useless = [row.phase for row in a.rows if row.bound is not None and not row.useful]
    found = []
    if useless:
        first = f"{', the first' if len(useless) > 1 else ''} “{phase_title(useless[0])}”"
        found.append(f"No useful guaranteed bound in {_count_phases(useless)}{first}.")
    if judged and not broken:
        where = "that had one" if inside == 1.0 else f"of the {_count_phases(judged)} in which it is of use"
        found.append(f"The guaranteed bound{reached} held at every instant {where}.")
    elif broken:
        worst = min(broken, key=lambda row: row.inside or 0.0)
        found.append(
            f"The guaranteed bound{reached} was exceeded in {len(broken)} of {len(judged)} phases, most often"
            f" in “{phase_title(worst.phase)}”: there the {deviation(a)} was within it "
            f"{format_share(worst.inside or 0.0)} of the time, over the flight {format_share(inside)}."
        )
    return found


def _rejection_sentences(a: Assessment) -> list[str]:
    """Describe what was rejected: positions of fixes, velocities of GNSS, and what else most.

    One rejected fix in a flight is usual: it is in the table.
    """
    velocities = _velocity_rejections(a)
    fixes = [group for group in a.groups if flight_events.is_fix(group.source)]
    if not fixes:
        what = "position fix" if any(map(_of_velocity, a.groups)) else "fix"
        return [f"No {what} was rejected.", *velocities, *_other_rejections(a)]
    total = sum(group.number for group in fixes)
    if total == 1:
        return velocities
    return [_fix_rejections(fixes, total), *velocities]


def _fix_rejections(fixes: Sequence[RejectionGroup], total: int) -> str:
    """Return the sentence on rejected positions of fixes."""
    largest = max(fixes, key=lambda group: group.number)
    far = (
        f", up to {format_length(largest.metres)} from the estimate" if math.isfinite(largest.metres) else ""
    )
    when = f"from {format_time(largest.start)} to {format_time(largest.end)}"
    if largest.number == 1:
        when = f"at {format_time(largest.start)}"
    rejected = f"{total} fixes were rejected"
    if len(fixes) == 1:
        return f"{rejected}, {when}: {flight_events.describe_reason(largest)}{far}."
    return (
        f"{rejected} in {len(fixes)} events; the largest, {when}, has {largest.number} from "
        f"{source_title(largest.source)}{far}: {flight_events.describe_reason(largest)}."
    )


def _of_velocity(group: RejectionGroup) -> bool:
    return flight_events.is_gnss_velocity(group.source)


def _velocity_rejections(a: Assessment) -> list[str]:
    """Return a sentence for each receiver whose velocity was rejected more than once."""
    found: dict[str, list[RejectionGroup]] = {}
    for group in a.groups:
        if _of_velocity(group):
            found.setdefault(source_title(group.source), []).append(group)
    return [
        f"The {name} was rejected {number} times, from {format_time(groups[0].start)} to "
        f"{format_time(max(group.end for group in groups))}."
        for name, groups in found.items()
        if (number := sum(group.number for group in groups)) > 1
    ]


def _other_rejections(a: Assessment) -> list[str]:
    """Return a sentence on the source, neither fix nor velocity of one, of which most was rejected."""
    numbers = Counter[tuple[str, str]]()
    for group in a.groups:
        if not _of_velocity(group):
            numbers[source_title(group.source), flight_events.reason_title(group.reason)] += group.number
    return [
        f"Of other measurements, {name} was rejected most, {n} times: {reason}."
        for (name, reason), n in numbers.most_common(1)
        if n > 1
    ]


def _anomalies(a: Assessment) -> list[str]:
    found = [
        f"in the phase “{phase_title(row.phase)}” the estimate "
        f"({format_length(row.rms[error_statistics.CORRECTED])}) was worse than the inertial channel alone "
        f"({format_length(row.rms[error_statistics.INS])})"
        for row in worse_than_inertial(a)
    ]
    found += [
        f"in the phase “{phase_title(row.phase)}” the {deviation(a)} was within twice the bound of its "
        f"moment only {format_share(row.inside_twice)} of the time, where at least 75 % are expected"
        for row in a.rows
        if row.seconds >= SHORT_S and row.inside_twice is not None and row.inside_twice < CHEBYSHEV
    ]
    for series in a.normalized_errors:
        if series.inside < CONSISTENT:
            share = format_share(series.inside)
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


def _count_phases(phases: Sequence[object]) -> str:
    return f"{len(phases)} phase{'s' if len(phases) != 1 else ''}"
