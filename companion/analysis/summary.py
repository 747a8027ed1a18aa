"""A flight in one paragraph: how long, what was lost when, how large the error was, whether the bound held,
and what is odd. Numbers in (`assess`), sentences out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from companion.analysis import error_statistics
from companion.analysis.assessment import GNSS, SMOOTHED, Assessment
from companion.analysis.flight_arrays import Floats
from companion.analysis.plot_data import LETTERS

WITHOUT_FIXES = ("prediction", "untrusted")
FAR_M = 30.0  # farther than this from the smoothed track GNSS contradicts it
SHORT_S = 30.0  # what happens in less is not worth a sentence
CHEBYSHEV = 0.75  # of moments, at least, lie within twice a bound on the r.m.s. that is right
LATE_S = 0.1  # GNSS behind the local position by less is usual
FLAT_M = 1.0  # nearer than this to each other, two errors are the same


def clock(seconds: float) -> str:
    """Minutes and seconds since the start, 3:07."""
    whole = round(abs(seconds))
    return f"{'-' if seconds < -0.5 else ''}{whole // 60}:{whole % 60:02d}"


def lasting(seconds: float) -> str:
    """A duration in words, 3 min 7 s."""
    if seconds < 59.5:
        return f"{seconds:.0f} s" if seconds >= 9.5 else f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    parts = [f"{hours} h" if hours else "", f"{minutes} min" if minutes else "", f"{rest} s" if rest else ""]
    return " ".join(part for part in parts if part)


def metres(value: float) -> str:
    """A length with as many digits as it deserves."""
    if not math.isfinite(value):
        return "–"
    if value >= 10_000.0:
        return f"{value / 1000.0:.1f} km"
    return f"{value:.0f} m" if value >= 100.0 else f"{value:.1f} m" if value >= 1.0 else f"{value:.2f} m"


def verdict(a: Assessment) -> str:
    """The paragraph."""
    sentences = [*_flown(a), *_errors(a), *_bound(a), *_refused(a), *_odd(a)]
    return " ".join([*sentences, *a.flight.remarks])


def comparison(a: Assessment, b: Assessment) -> str:
    """Which of two flights, A or B, was nearer to its reference, with fixes and without."""
    if a.reference is None or b.reference is None:
        return "There is nothing to compare errors with."
    parts = [_parted(a), _parted(b)]
    sentences = []
    for what, k in (("With fixes", 0), ("Without fixes", 1)):
        pair = parts[0][k], parts[1][k]
        if not all(len(error) for error in pair):
            if any(len(error) for error in pair):
                letter = LETTERS[0] if len(pair[0]) else LETTERS[1]
                sentences.append(f"{what} was {letter} alone.")
            continue
        rms = _rms(pair[0]), _rms(pair[1])
        if abs(rms[0] - rms[1]) < 0.02 * max(rms):
            sentences.append(f"{what} both were off by {metres(rms[0])} r.m.s.")
        else:
            (less, better), (more, worse) = sorted(zip(rms, LETTERS, strict=True))
            against = f"{metres(less)} r.m.s. against {metres(more)} of {worse}"
            sentences.append(f"{what} {better} was nearer: {against}.")
    lone = [_lone(flight) for flight in (a, b)]
    if any(lone) and abs(lone[0] - lone[1]) > SHORT_S:
        spans = [lasting(span) if span else "never" for span in lone]
        sentences.append(f"A was without for {spans[0]}, B for {spans[1]}.".replace("for never", "never"))
    if a.reference.what != b.reference.what:
        sentences.append("The two are counted from different references, so compare with care.")
    return " ".join(sentences) or "No error is known of one of the two."


def _parted(a: Assessment) -> tuple[Floats, Floats]:
    """The errors of the corrected estimate, with fixes and without."""
    corrected = a.errors.get(error_statistics.CORRECTED)
    if corrected is None:
        return np.zeros(0), np.zeros(0)
    alone = _during(a, corrected, WITHOUT_FIXES)
    return corrected.error[~alone], corrected.error[alone]


def _lone(a: Assessment) -> float:
    """Seconds without any fix."""
    return sum(row.end_ns - row.start_ns for row in a.phases if row.name in WITHOUT_FIXES) * 1e-9


def _flown(a: Assessment) -> list[str]:
    seconds, (k, n) = a.flight.seconds, a.flight.part
    lasts = f"The log holds {lasting(seconds)}" if n == 1 else f"Flight {k} of {n} lasts {lasting(seconds)}"
    if not len(a.flight.tables["Solution"]["t"]):
        return [
            f"{lasts}, without an estimate: there was no inertial channel (a local position with its origin, "
            "or airspeed with attitude), or no fix that was believed."
        ]
    sentences = [f"{lasts}."]
    started = float(a.flight.tables["Solution"]["t"][0])
    holes = [hole for hole in a.outages if hole.end > started]
    if not holes:
        sentences.append("GNSS was there throughout.")
    else:
        longest = max(holes, key=lambda hole: hole.end - hole.start)
        times = "once" if len(holes) == 1 else f"{len(holes)} times"
        until = "to the end" if longest.end >= seconds else f"to {clock(longest.end)}"
        which = "for" if len(holes) == 1 else "longest for"
        span = lasting(longest.end - longest.start)
        sentences.append(f"GNSS was lost {times}, {which} {span} (from {clock(longest.start)} {until}).")
    if alone := _lone(a):
        sentences.append(f"The position was predicted without any fix for {lasting(alone)}.")
    untrusted = [phase for phase in a.phases if phase.name == "untrusted"]
    if untrusted:
        sentences.append(
            f"From {clock(untrusted[0].start_ns * 1e-9)} the prediction was called untrusted: its bound had "
            "passed the configured limit or could not be given."
        )
    return sentences


def _errors(a: Assessment) -> list[str]:
    corrected = a.errors.get(error_statistics.CORRECTED)
    if corrected is None or a.reference is None:
        return ["There is neither truth nor a track to smooth, so no error can be told."]
    found = zip(_parted(a), ("with fixes", "without"), strict=True)
    parts = [f"{metres(_rms(error))} {how}" for error, how in found if len(error)]
    ins = a.errors.get(error_statistics.INS)
    beside = f"; the inertial channel alone {metres(_rms(ins.error))}" if ins is not None else ""
    sentences = [
        f"Against {a.reference.what} the estimate was off by {' and '.join(parts)} (r.m.s.), "
        f"{metres(float(corrected.error.max()))} at most{beside}."
    ]
    if a.reference.what == SMOOTHED:
        sentences.append(
            "The smoothed track rests on the same fixes and error model: what both got wrong it hides."
        )
        gnss = a.errors.get(error_statistics.GNSS)
        if gnss is not None and (apart := float(np.median(gnss.error))) > FAR_M:
            sentences.append(
                f"GNSS AND THAT TRACK ARE {metres(apart)} APART in the median, for GNSS was refused: one of "
                "them is wrong, and no error told here is to be trusted."
            )
    elif a.reference.what == GNSS:
        sentences.append("GNSS is no truth: its own error is in these numbers.")
    return sentences


def _bound(a: Assessment) -> list[str]:
    corrected = a.errors.get(error_statistics.CORRECTED)
    if corrected is None or not (known := np.isfinite(corrected.bound)).any():
        return ["No guaranteed bound was given."]
    inside = float(np.mean(corrected.error[known] <= corrected.bound[known]))
    broken = [row for row in a.rows if row.held is False]
    alone = known & _during(a, corrected, WITHOUT_FIXES)
    reached = (
        f" reached {metres(float(corrected.bound[alone].max()))} without fixes and" if alone.any() else ""
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


def _refused(a: Assessment) -> list[str]:
    fixes = [group for group in a.groups if group.source.lower().startswith(("gnss", "rsbn"))]
    if not fixes:
        return ["No fix was refused."]
    total = sum(group.number for group in fixes)
    largest = max(fixes, key=lambda group: group.number)
    far = f", up to {metres(largest.metres)} off the estimate" if math.isfinite(largest.metres) else ""
    when = f"from {clock(largest.start)} to {clock(largest.end)}"
    if largest.number == 1:
        when = f"at {clock(largest.start)}"
    refused = "1 fix was refused" if total == 1 else f"{total} fixes were refused"
    if len(fixes) == 1:
        return [f"{refused}, {when}: {largest.reason}{far}."]
    return [
        f"{refused} in {len(fixes)} events; the largest, {when}, took {largest.number} of "
        f"{largest.source}{far}: {largest.reason}."
    ]


def _odd(a: Assessment) -> list[str]:
    found = []
    for row in a.rows:
        ins, corrected = row.rms.get(error_statistics.INS), row.rms.get(error_statistics.CORRECTED)
        if row.seconds < SHORT_S or ins is None or corrected is None:
            continue
        if corrected > 1.2 * ins + FLAT_M:
            found.append(
                f"in the phase “{row.phase}” the corrected estimate ({metres(corrected)}) was worse than the "
                f"inertial channel alone ({metres(ins)})"
            )
        if row.inside_twice is not None and row.inside_twice < CHEBYSHEV:
            found.append(
                f"in the phase “{row.phase}” the error was within twice the bound of its moment only "
                f"{_percent(row.inside_twice)} of the time, where 75 % are due"
            )
    for misfit in a.misfits:
        if misfit.inside < 0.85:
            share = _percent(misfit.inside)
            found.append(f"only {share} of {misfit.what} is within its 95 % limit: sigmas are too small")
    resets = [line for line in a.timeline if line.kind == "reset"]
    if resets:
        found.append(f"{len(resets)} reset{'s' * (len(resets) > 1)}, the first at {clock(resets[0].t)}")
    glitches = [line for line in a.timeline if line.kind == "glitch"]
    if glitches:
        more = f", the first of {len(glitches)}" if len(glitches) > 1 else ""
        found.append(f"{glitches[0].text} (at {clock(glitches[0].t)}{more})")
    found += [
        f"GNSS came {one.seconds:.2f} s behind the local position"
        for one in a.flight.latencies
        if one.seconds > max(LATE_S, 3.0 * one.sigma)
    ]
    return [f"Odd: {'; '.join(dict.fromkeys(found))}."] if found else []


def _during(
    a: Assessment, e: error_statistics.Errors, names: Sequence[str]
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
