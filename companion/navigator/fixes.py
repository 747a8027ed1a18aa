"""Fixes of GNSS and of beacons: measurements of the bank, and what follows from whether they are believed."""

from __future__ import annotations

import math

from msgspec import structs

from companion.estimate import bank as banks
from companion.estimate.bank.settings import DEFAULT as THRESHOLDS
from companion.estimate.fusion import Azimuth
from companion.navigator import (
    fix_observations,
    height_error,
    latency_velocity,
    measurements,
    own_channel,
    scatter,
)
from companion.navigator.hypotheses import CHANNEL_JUMP_M, GNSS, MOST_BEACONS, POSITION, VELOCITY
from companion.navigator.own_channel import OwnChannel
from companion.navigator.own_error_model import HELD
from companion.navigator.progress import (
    carried,
    decided,
    driver,
    is_silent,
    nearer,
    propagated,
    widened,
)
from companion.navigator.state import (
    EXCLUDED,
    FIXES,
    Beacon,
    Contradiction,
    Pending,
    Settings,
    State,
    Step,
    afresh,
    corrected,
    estimate,
    gnss_is_believed,
    held_s,
    hypotheses,
    is_contradicted,
    is_jammed,
    source_name,
    sources,
)
from companion.records import (
    Event,
    Gnss,
    Output,
    Rejection,
    Reset,
    RsbnFix,
    Severity,
    Source,
    Stamped,
)
from companion.units import SECOND_NS

GATE_SIGMA = 5.0
JUMPED_M = GATE_SIGMA * CHANNEL_JUMP_M  # within it a jump of the channel explains a fix
#: One sigma of a position that begins at a beacon's answer: several times what its place may be off by.
BEACON_FIRST_M = 10_000.0
#: At twice as much a beacon that is elsewhere is less likely than an outlier of GNSS: the bank blamed GNSS.
BEACON_REACH_M = 6000.0
REFUSED_NS = 10 * SECOND_NS  # fixes that no hypothesis takes begin the position again after so long at least


def gnss(state: State, record: Gnss, settings: Settings) -> Step:
    """Use a fix of GNSS: position and velocity are measurements of the bank."""
    config, last = settings.config.gnss, state.gnss_taken
    if not record.has_3d_fix or is_too_soon(record, state, settings):
        return state, []
    if _is_beyond_reach(state, record, settings):
        return _left_for_gnss(state, record, settings)
    first_ns = record.t_ns if state.gnss_first_ns is None else state.gnss_first_ns
    state = _begun(structs.replace(state, gnss_first_ns=first_ns), record, settings)
    if state.nominal is None or state.bank is None or is_silent(state, record.t_ns):
        return state, []
    state = propagated(carried(state, record.t_ns, settings), settings)
    known, channel, nominal = hypotheses(state, settings), settings.model.channel, state.nominal
    assert state.bank is not None
    assert nominal is not None
    if last is not None and last.receiver != record.receiver:
        state = structs.replace(state, bank=measurements.other_receiver(state.bank, channel))
    assert state.bank is not None
    variance = fix_observations.white_sigma(record, config) ** 2
    apart = measurements.gnss_apart(record, nominal.point)
    still = (apart[0] + state.moved[0], apart[1] + state.moved[1])  # as if the nominal had never jumped
    state, factor = _scattered(state, record, "gnss", still, variance)
    state = _velocity_scattered(state, record)
    bank, velocity = state.bank, None
    assert bank is not None
    if config.use_velocity and record.v_n is not None:  # first: the position needs it
        share = state.velocity_scatter.quiet if state.velocity_scatter else 1.0
        sigma = fix_observations.velocity_sigma(record, first_ns, config, last, share)
        noise = factor * (sigma**2 + channel.velocity_noise**2)
        velocity = measurements.gnss_velocity(bank, known, channel, record, nominal.point, nominal.a_n, noise)
        bank = velocity.bank
    is_measured = velocity is not None
    is_believed = (
        velocity is not None and velocity.accepted and not (state.reported and state.reported[VELOCITY])
    )
    stated = record.v_n[:2] if record.v_n is not None and is_believed else None
    state, v_n = latency_velocity.of_gnss(structs.replace(state, bank=bank), record.t_ns, is_measured, stated)
    shows_latency = is_measured or driver(state) not in HELD
    taken = measurements.gnss_position(bank, known, channel, apart, factor * variance, v_n, shows_latency)
    restarted = list[Output]()
    if taken.accepted and not taken.by_former and _apart(state, record, settings) > JUMPED_M:
        # only a row that another doubt has made wide enough explains the jump: the position is what is wrong
        state, restarted = _restarted(state, record, 0, settings)
        taken = taken._replace(bank=state.bank or bank, accepted=False) if restarted else taken
    state = structs.replace(state, bank=taken.bank, gnss_taken=record, gnss_before=last, fixed=True)
    state, out = decided(state, record, settings), list[Output]()
    label = f"gnss {record.receiver}"
    if velocity is not None and (state.reported[VELOCITY] == EXCLUDED or not velocity.accepted):
        out.append(_rejected(state, record, f"velocity of {label}", VELOCITY, velocity))
    if state.reported[GNSS] == EXCLUDED or not taken.accepted:
        out.append(_rejected(state, record, label, GNSS, taken))
        refused_ns = None if taken.accepted or restarted else state.refused_ns or record.t_ns
        least_ns = max(REFUSED_NS, _before_ns(state))
        state, again = _restarted(structs.replace(state, refused_ns=refused_ns), record, least_ns, settings)
        return nearer(state, settings), [*out, *restarted, *again]
    state, more = _believed(state, record, settings)
    return nearer(state, settings), [*out, *more]


def is_too_soon(record: Gnss, state: State, settings: Settings) -> bool:
    """Whether the last fix that was used is too close: fixes are used every `gnss.every_s`.

    One from before it is judged by the state of its own time.
    """
    last = state.gnss_taken
    return last is not None and 0.0 <= (record.t_ns - last.t_ns) * 1e-9 < settings.config.gnss.every_s


def _believed(state: State, record: Gnss, settings: Settings) -> Step:
    """What follows from a fix that is believed: its height is used, and it is a fix of the bound."""
    config, nominal, out = settings.config.gnss, state.nominal, list[Output]()
    assert nominal is not None
    since = math.inf if state.gnss_ns is None else (record.t_ns - state.gnss_ns) * 1e-9
    part = min(since, config.correlation_s) / config.correlation_s
    held = held_s(state, nominal.t_ns)
    level = height_error.update(state.level, record, nominal.point, part, GATE_SIGMA**2, held)
    if level.refused_ns is not None:
        off = abs(nominal.point.position.alt - level.error - record.alt_msl)
        source = f"height of gnss {record.receiver}"
        out.append(Rejection(record.t_ns, record.rx_ns, source, "outlier: innovation, m", off))
    pending = None
    if gnss_is_believed(state, settings):
        pending = Pending(record, nominal.point, (0.0, 0.0), Source.GNSS)
    state = structs.replace(
        state,
        gnss_ns=record.t_ns,
        gnss_fix=(record, nominal.point),
        level=level,
        pending=pending,
        refused_ns=None,
    )
    return state, out


def rsbn(state: State, record: RsbnFix, settings: Settings) -> Step:
    """Use a beacon's answer: azimuth and slant range are measurements of the bank.

    A beacon is followed from the first answer on that the leading hypothesis can take, azimuth and range. Of
    one whose place is stated 13 or 22 km off either agreed by chance, and in the end GNSS was blamed.
    """
    state = _begun(state, record, settings)
    name = f"rsbn {record.beacon}"
    if state.nominal is None or state.bank is None or is_silent(state, record.t_ns):
        return state, [Rejection(record.t_ns, record.rx_ns, name, "no channel at its time")]
    state = propagated(carried(state, record.t_ns, settings), settings)
    before = state
    state, k, out = _beacon(state, record, settings)
    is_followed = any(beacon.identity == record.beacon for beacon in before.beacons)
    nominal = state.nominal
    assert nominal is not None
    assert state.bank is not None
    point, centre = corrected(nominal.point, state, settings)
    point = point._replace(v_n=(*latency_velocity.smoothed(state), point.v_n[2]))
    known = hypotheses(state, settings)
    measured = accepted = believed = Source(0)
    height = settings.config.inertial.height_sigma_m
    for z in fix_observations.from_rsbn(record, point, settings.config.rsbn):
        if isinstance(z, Azimuth) and fix_observations.in_cone_of_silence(z, record.slant_range):
            continue
        part = fix_observations.source_of(z)
        measured |= part
        source = known.azimuth(k) if isinstance(z, Azimuth) else known.range(k)
        label = source_name(source, state)
        metres = fix_observations.distance(z) if isinstance(z, Azimuth) else 1.0
        still = (centre[0] - state.moved[0], centre[1] - state.moved[1])  # as if it had never jumped
        residual = measurements.sight_residual(z, still)
        variance = fix_observations.sight_variance(z, height)
        state, factor = _scattered(state, record, label, (residual,), variance, metres)
        assert state.bank is not None
        taken = measurements.sight(state.bank, known, z, k, factor * variance, centre, point.v_n)
        state = decided(structs.replace(state, bank=taken.bank), record, settings)
        accepted |= part if taken.accepted else Source(0)
        if state.reported[source] == EXCLUDED or not taken.accepted:
            out.append(_rejected(state, record, label, source, taken))
        elif state.false[source] < known.settings.suspect:
            believed |= part
    others = tuple(beacon for beacon in before.unfit if beacon[0] != record.beacon)
    if not is_followed and not (accepted and accepted == measured):
        count = 1 + dict(before.unfit).get(record.beacon, 0)
        return structs.replace(before, unfit=((record.beacon, count), *others)[:MOST_BEACONS]), out
    state = structs.replace(state, fixed=True, unfit=others)
    if believed and believed == measured:
        beacons = list(state.beacons)
        beacons[k] = beacons[k]._replace(believed=True)
        state = structs.replace(state, beacons=tuple(beacons))
    if believed:
        pending = Pending(record, point, centre, believed)
        state = structs.replace(state, rsbn_ns=record.t_ns, pending=pending)
        if record.azimuth is not None:
            state = structs.replace(state, azimuth_ns=record.t_ns if believed & Source.AZIMUTH else None)
        if record.slant_range is not None:
            state = structs.replace(state, range_ns=record.t_ns if believed & Source.RANGE else None)
    return nearer(state, settings), out


def _beacon(state: State, record: RsbnFix, settings: Settings) -> tuple[State, int, list[Output]]:
    """The number of the beacon that answered; a new one takes a new place, or the most silent one's."""
    bank, beacons, out = state.bank, list(state.beacons), list[Output]()
    assert bank is not None
    new = Beacon(record.beacon, (record.lat, record.lon, record.alt), record.t_ns)
    k = next((i for i, beacon in enumerate(beacons) if beacon.identity == new.identity), None)
    if k is None and len(beacons) < MOST_BEACONS:
        larger = settings.model.with_beacon(bank, len(beacons))
        if not beacons and state.gnss_taken is not None:
            larger = settings.model.doubted(larger)
        state = structs.replace(state, bank=larger, beacons=(*beacons, new))
        state = structs.replace(state, false=(*state.false, 0.0, 0.0), reported=(*state.reported, 0, 0))
        return state, len(beacons), out
    if k is None:
        k = min(range(len(beacons)), key=lambda i: beacons[i].last_ns)
    elif new.place != beacons[k].place:
        text = f"beacon {record.beacon} states another position"
        out.append(Event(record.t_ns, record.rx_ns, Severity.NOTICE, text))
    if (new.identity, new.place) != (beacons[k].identity, beacons[k].place):
        state = structs.replace(state, bank=hypotheses(state, settings).renewed(bank, k))
    beacons[k] = new
    return structs.replace(state, beacons=tuple(beacons)), k, out


def _begun(state: State, record: Gnss | RsbnFix, settings: Settings) -> State:
    """With a nominal trajectory and a bank, if this fix is the first that gives a place."""
    nominal = state.nominal
    if nominal is None and isinstance(settings.model.channel, OwnChannel):
        nominal = own_channel.begin(state.sensors, record)
    if nominal is None or state.bank is not None:
        return state
    if nominal.interval is not None:
        nominal = own_channel.restart(nominal, nominal.interval.by, nominal.point.v_n[:2])
    nominal = structs.replace(nominal, since=nominal.point)
    bank = settings.model.begin(0.0)
    if isinstance(record, RsbnFix) and settings.model.channel.wind:
        bank = banks.inflate(bank, POSITION, BEACON_FIRST_M)
    return structs.replace(state, nominal=nominal, bank=bank, started_ns=record.t_ns)


def _is_beyond_reach(state: State, record: Gnss, settings: Settings) -> bool:
    """Whether a first fix of GNSS contradicts a position of one beacon by more than the bank can weigh.

    Not where two beacons agree: then GNSS is what is wrong.
    """
    if state.gnss_taken is not None or state.bank is None or not settings.model.channel.wind:
        return False
    since_ns = record.t_ns - round(1e9 * settings.config.rsbn.timeout_s)
    believed = [beacon for beacon in state.beacons if beacon.believed and beacon.last_ns >= since_ns]
    return len(believed) < 2 and _apart(state, record, settings) > BEACON_REACH_M


def _left_for_gnss(state: State, record: Gnss, settings: Settings) -> Step:
    """Begin again at GNSS once it has contradicted for `REFUSED_NS`: its own first fix may be the wrong one.

    A beacon that is not where it states is likelier than a GNSS that is false from its first fix on.
    """
    apart, before = _apart(state, record, settings), is_contradicted(state, record.t_ns, settings)
    since_ns = record.t_ns if before is None or is_jammed(state) else before.since_ns
    if record.t_ns - since_ns < REFUSED_NS:
        label, why = f"gnss {record.receiver}", "contradicts a position that began at a beacon, m"
        out: list[Output] = [Rejection(record.t_ns, record.rx_ns, label, why, apart, BEACON_REACH_M)]
        if before is None:
            text = f"{label} is {apart:.0f} m off the beacon's position: one of them is wrong"
            out.append(Event(record.t_ns, record.rx_ns, Severity.WARNING, text))
        now = Contradiction(since_ns, record.t_ns, apart)
        return structs.replace(state, contradiction=now), out
    why = f"GNSS is {apart:.0f} m off a position that began at a beacon: position restarted"
    state, out = gnss(afresh(state), record, settings)
    return state, [Reset(record.t_ns, record.rx_ns, "position", why), *out]


def _before_ns(state: State) -> int:
    """How long fixes were believed before those that are refused now."""
    started_ns = state.started_ns or 0
    return max(t or started_ns for t in (state.gnss_ns, state.rsbn_ns)) - started_ns


def _restarted(state: State, record: Gnss, least_ns: int, settings: Settings) -> Step:
    """With the position as open as GNSS is far off, once its fixes have been refused for `least_ns`.

    Of two runs of fixes that contradict each other the longer one is believed: a receiver's first fix may be
    kilometres off, and a spoofer that comes later must last longer than the flight before it. Not where a
    beacon bears the position out, nor beside an INS, which shows a jump of GNSS.
    """
    since_ns = state.refused_ns
    if since_ns is None or not settings.model.channel.wind or is_jammed(state):
        return state, []
    refused_ns = record.t_ns - since_ns
    if refused_ns < least_ns or sources(state, record.t_ns, settings) & FIXES:
        return state, []
    apart = _apart(state, record, settings)
    why = f"no hypothesis explains GNSS, {apart:.0f} m off for {refused_ns * 1e-9:.0f} s: position restarted"
    state = structs.replace(widened(state, apart), started_ns=record.t_ns, refused_ns=None)
    return state, [Reset(record.t_ns, record.rx_ns, "position", why)]


def _apart(state: State, record: Gnss, settings: Settings) -> float:
    """How far a fix is from the estimated position, m."""
    assert state.nominal is not None
    north, east = estimate(state, settings).x[:2].tolist()
    return math.dist(measurements.gnss_apart(record, state.nominal.point), (-north, -east))


def _scattered(
    state: State,
    record: Stamped,
    name: str,
    residual: tuple[float, ...],
    variance: float,
    metres: float = 1.0,
) -> tuple[State, float]:
    """With one more residual of a source; the factor of its stated variance.

    `metres` is the length of the residual's unit.
    """
    lacking = scatter.LACKING.get(driver(state) or "", scatter.LACKING_ELSE)
    seen = scatter.observe(
        state.scatter.get(name), record.t_ns, residual, variance, lacking / max(metres, 1.0)
    )
    return structs.replace(state, scatter={**state.scatter, name: seen}), seen.used


def _velocity_scattered(state: State, record: Gnss) -> State:
    """With one more velocity of GNSS, beside that of an INS or the IMU."""
    before, stated = state.gnss_taken, record.sigma_velocity
    is_other = before is not None and before.receiver != record.receiver
    if driver(state) not in scatter.LACKING or is_other or stated is None or record.v_n is None:
        return structs.replace(state, velocity_scatter=None)
    assert state.nominal is not None
    v_n = state.nominal.point.v_n
    residual = (v_n[0] - record.v_n[0], v_n[1] - record.v_n[1])
    seen = scatter.observe(state.velocity_scatter, record.t_ns, residual, stated**2, 0.0)
    return structs.replace(state, velocity_scatter=seen)


def _rejected(
    state: State, record: Gnss | RsbnFix, label: str, source: int, taken: measurements.Taken
) -> Rejection:
    if state.reported[source] == EXCLUDED:
        why, false = "excluded: false with probability", state.false[source]
        return Rejection(record.t_ns, record.rx_ns, label, why, false, THRESHOLDS.excluded)
    return Rejection(record.t_ns, record.rx_ns, label, "outlier: normalised squared innovation", taken.nis)
