"""`companion study harm`: does the companion do harm while GNSS is healthy?

    companion study harm --quick
    companion study harm --results logs/harm    # keeps every flight: an interrupted study continues

Simulated flights with a healthy GNSS and one thing wrong, on every inertial channel that it concerns; then
the recordings, where they are there (`sitl.harm_recordings`). A flight passes if GNSS is never excluded, EKF
source set 2 is never requested, and the corrected error is at no time more than 1.2 times as far off as GNSS
itself, r.m.s. over 10 s, plus 3 m. Where no fix has come for 3 s GNSS has no error, and nothing is compared:
in a reboot of the autopilot, until its first fix. Stalls and reboots are flown over the simulated link, all
others record by record.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple, TypeVar

import click
import numpy as np
from msgspec.structs import replace
from rich.table import Table
from threadpoolctl import threadpool_limits

from companion.analysis.jobs import Journal, run_jobs
from companion.analysis.progress import show_count
from companion.analysis.worker_options import worker_options
from companion.config import Config, InertialConfig, OutputConfig
from companion.nav.geometry import displace
from companion.option_types import FloatRange
from companion.output.source_table import SILENT_S
from companion.records import Event, Gnss, RsbnFix, Solution, Stamped
from companion.runtime.core import CompanionCore
from companion.tables import number_table, print_tables
from companion.units import SECOND_NS, Floats
from companion.write_errors import make_folder
from sitl import loopback
from sitl.autopilot import SimulatedAutopilot
from sitl.campaign.flight import sensors_of
from sitl.faults import Fault
from sitl.flight import FlightPlan, Leg
from sitl.harm_recordings import RecordingResult, fly_log, fly_named, list_recordings
from sitl.scenarios import EAST_BEACON, TAKE_OFF, WIND, Scenario, SensorRates
from sitl.sensors import STATED_GRADES
from sitl.world import World

Job = TypeVar("Job")
Result = TypeVar("Result", "HarmResult", RecordingResult)

START_S = 120.0  # something goes wrong from here on, unless it is wrong from the start
GNSS_NOISE_M = 0.8  # white noise of the simulated receiver, one sigma per axis
WINDOW_S, MOST_RATIO, FREE_M = 10.0, 1.2, 3.0
INS = ("INS navigation", "INS MEMS")
OWN = ("air data", "stock")
CHANNELS = (*INS, *OWN)
SEEDS, MINUTES = 3, 10.0
QUICK_SEEDS, QUICK_MINUTES = 1, 5.0
_SUSPECTED = re.compile("(.*) is (?:suspect|excluded):")
_EXCLUDED, _SET_2 = "gnss is excluded", "EKF source set 2"


class Wrong(NamedTuple):
    """One thing that is wrong: a fault, a change of scenario or configuration, a stall (s)."""

    channels: tuple[str, ...] = CHANNELS
    fault: Fault | None = None
    airspeed_sensor: bool = True
    stated: float = 1.0  # stated errors of the INS, as a multiple of the true ones
    noisy: type[Stamped] | None = None  # kind of fixes three times as noisy as stated
    rate_hz: float | None = None
    feeds: bool = True  # a position is sent to the autopilot; else stock goes by its velocity
    stall_s: float = 0.0
    over_link: bool = False


def _fault(name: str, size: float | None = None, start_s: float = START_S) -> Fault:
    return Fault(name, start_s, math.inf, size)


def _wrong(name: str, size: float, start_s: float = START_S) -> Wrong:
    return Wrong(fault=_fault(name, size, start_s))


WRONG: dict[str, Wrong] = {
    "nothing": Wrong(),
    "no airspeed sensor": Wrong(OWN, airspeed_sensor=False),
    "pitot stuck at 8 m/s": Wrong(OWN, _fault("pitot-stuck", 8.0)),
    "pitot stuck at 60 m/s": Wrong(OWN, _fault("pitot-stuck", 60.0)),
    "pitot at zero": Wrong(OWN, _fault("pitot-stuck", 0.0)),
    "pitot reads 1.5x": Wrong(OWN, _fault("pitot-scale", 1.5)),
    "heading off by 5 deg": Wrong(OWN, _fault("heading-off", math.radians(5.0))),
    "INS 100x too fine": Wrong(INS, stated=0.01),
    "INS 10x too fine": Wrong(INS, stated=0.1),
    "INS 10x too coarse": Wrong(INS, stated=10.0),
    "INS 100x too coarse": Wrong(INS, stated=100.0),
    # of the autopilot's position the stock channel uses the velocity only: a jump changes nothing there
    "position jumps 100 m": Wrong(INS, _fault("ins-reset", 100.0), feeds=False),
    # not of an INS stated to be independent: its drift is the mirror image of a GNSS that is drawn off
    "position drifts 1 m/s": Wrong(("stock",), _fault("ins-drift", 1.0), feeds=False),
    "beacon range +50 m": _wrong("beacon-bias", 50.0),
    "beacon range +200 m": _wrong("beacon-bias", 200.0),
    "beacon range +1000 m": _wrong("beacon-bias", 1000.0),
    "beacon azimuth +1 deg": _wrong("beacon-north", math.radians(1.0)),
    "beacon azimuth +5 deg": _wrong("beacon-north", math.radians(5.0)),
    "beacon 3 km away": _wrong("beacon-position", 3000.0, 0.0),
    "GNSS 0.1 s late": _wrong("gnss-latency", 0.1, 0.0),
    "GNSS 0.2 s late": _wrong("gnss-latency", 0.2, 0.0),
    "GNSS 0.3 s late": _wrong("gnss-latency", 0.3, 0.0),
    "GNSS antenna 5 m ahead": _wrong("gnss-lever-arm", 5.0, 0.0),
    "GNSS velocity 0.3 % too small": _wrong("gnss-velocity", -0.003, 0.0),
    "GNSS velocity 1.2 % too small": _wrong("gnss-velocity", -0.012),
    "GNSS velocity 5 % too small": _wrong("gnss-velocity", -0.05),
    "GNSS 3x as noisy as stated": Wrong(noisy=Gnss),
    "beacon 3x as noisy as stated": Wrong(noisy=RsbnFix),
    "stall of 0.3 s": Wrong(stall_s=0.3, over_link=True),
    "stall of 1 s": Wrong(stall_s=1.0, over_link=True),
    "stall of 5 s": Wrong(stall_s=5.0, over_link=True),
    "reboot in the air": Wrong(fault=_fault("reboot"), over_link=True),
    "streams at 1 Hz": Wrong(rate_hz=1.0),
    "streams at 0.5 Hz": Wrong(rate_hz=0.5),
}


class HarmOrder(NamedTuple):
    """One flight."""

    wrong: str
    channel: str
    seed: int
    minutes: float

    @property
    def key(self) -> str:
        """Name of the flight in the results folder."""
        return f"{self.wrong}/{self.channel}/{self.seed}/{self.minutes:g}"


class HarmResult(NamedTuple):
    """What was seen on one flight; `ratio` as in `worst_ratio`, None without solutions.

    `since` is the same from `START_S` on: a start-up that is worse hides it in `ratio`. `suspected` are the
    sources that were reported as suspect or excluded.
    """

    wrong: str
    channel: str
    seed: int
    excluded: bool
    set_2: bool
    ratio: float | None
    since: float | None = None
    suspected: Sequence[str] = ()
    raised: str | None = None

    @property
    def passed(self) -> bool:
        """Whether no harm was done."""
        harmed = self.excluded or self.set_2 or self.raised is not None
        return not harmed and self.ratio is not None and self.ratio <= MOST_RATIO


def scenario_of(order: HarmOrder) -> Scenario:
    """Return the scenario: a minute's run-up, then a turn every 75 s, in wind."""
    wrong = WRONG[order.wrong]
    left, headings = 60.0 * order.minutes - 60.0, (40.0, 110.0, 40.0, 340.0, 70.0)
    count = round(left / 75.0)
    turns = (Leg(left / count, headings[k % len(headings)], 38.0, 60.0) for k in range(count))
    own = order.channel in OWN
    rates = SensorRates(imu=10.0 if order.channel == "stock" else 1.0, truth=1.0)
    if wrong.rate_hz is not None:
        hz = wrong.rate_hz
        rates = SensorRates(hz, local_position=hz, attitude=hz, gnss=hz, air=hz, truth=1.0)
    return Scenario(
        order.wrong,
        FlightPlan((*TAKE_OFF, *turns), winds=(WIND,)),
        grade="mems" if own or order.channel == "INS MEMS" else "navigation",
        beacons=(EAST_BEACON,),
        rates=rates,
        airspeed_sensor=wrong.airspeed_sensor,
        faults=() if wrong.fault is None else (wrong.fault,),
        seed=order.seed,
    )


def config_of(order: HarmOrder) -> Config:
    """Return the default configuration of the channel, with what is stated wrongly."""
    wrong, output = WRONG[order.wrong], OutputConfig(profile="ardupilot")
    inertial = InertialConfig(
        source="air_data" if order.channel == "air data" else "auto" if wrong.feeds else "local_position",
        independent=order.channel in INS,
    )
    if wrong.stated != 1.0:
        true = STATED_GRADES["mems" if order.channel == "INS MEMS" else "navigation"]
        scaled = (
            "gyro_drift_deg_h",
            "angle_random_walk_deg_sqrt_h",
            "accelerometer_bias_ug",
            "tilt_arcsec",
            "heading_arcmin",
        )
        stated = {name: wrong.stated * getattr(true, name) for name in scaled}
        inertial = replace(inertial, **stated)
    return Config(inertial=inertial, output=output if wrong.feeds else OutputConfig())


def fly(order: HarmOrder) -> HarmResult:
    """Fly one flight; an exception is returned as a result."""
    try:
        with threadpool_limits(1):
            flown = _fly_link if WRONG[order.wrong].over_link else _fly_records
            world, solutions, events, set_2, t_fix = flown(scenario_of(order), order)
        excluded = any(event.text.startswith(_EXCLUDED) for event in events)
        fixes = [r for r in world.streams[Gnss] if isinstance(r, Gnss) and r.has_3d_fix]
        ours = beside_fixes(*world.horizontal_errors(solutions), t_fix)
        its = world.horizontal_errors(fixes)
        suspected = sorted({found[1] for event in events if (found := _SUSPECTED.match(event.text))})
        return HarmResult(
            *order[:3],
            excluded,
            set_2,
            ratio=worst_ratio(*_from(0.0, ours, its)),
            since=worst_ratio(*_from(START_S, ours, its)),
            suspected=suspected,
        )
    except Exception as error:  # the study goes on and lists it
        return HarmResult(*order[:3], False, False, None, raised=f"{type(error).__name__}: {error}")


#: world, solutions, events, whether source set 2 was requested, times of the fixes that arrived (s)
_Flown = tuple[World, list[Solution], list[Event], bool, Floats]


def _fly_records(scenario: Scenario, order: HarmOrder) -> _Flown:
    config, world = config_of(order), World(scenario)
    records: Iterable[Stamped] = world.records(sensors_of(config))
    if (noisy := WRONG[order.wrong].noisy) is not None:
        rng = np.random.default_rng(order.seed)
        records = (noisier(r, rng) if isinstance(r, noisy) else r for r in records)
    log = fly_log(records, config)
    solutions = [r for r in log.records if isinstance(r, Solution)]
    events = [r for r in log.records if isinstance(r, Event)]
    return world, solutions, events, bool(log.set_2_ns), _fix_times(world.streams[Gnss])


def _fix_times(records: Iterable[Stamped]) -> Floats:
    return np.array([r.t_ns * 1e-9 for r in records if isinstance(r, Gnss) and r.has_3d_fix])


def noisier(record: Stamped, rng: np.random.Generator) -> Stamped:
    """Return a fix with three times the white noise that it states."""
    more = math.sqrt(3.0**2 - 1.0) * rng.standard_normal(2)
    if isinstance(record, Gnss):
        north, east = GNSS_NOISE_M * more
        place = displace(record.lat, record.lon, record.alt_msl, north, east, 0.0)
        return replace(record, lat=place.lat, lon=place.lon)
    assert isinstance(record, RsbnFix)
    azimuth, slant_range = record.azimuth, record.slant_range
    return replace(
        record,
        azimuth=None if azimuth is None else (azimuth + more[0] * record.sigma_azimuth) % math.tau,
        slant_range=None if slant_range is None else slant_range + more[1] * record.sigma_range,
    )


def _fly_link(scenario: Scenario, order: HarmOrder) -> _Flown:
    start = loopback.START_NS
    autopilot, log = SimulatedAutopilot(scenario, start), loopback.CollectingLog(None)
    core = CompanionCore(config_of(order), log, (loopback.LINK,))
    stall_ns = round(WRONG[order.wrong].stall_s * SECOND_NS)
    begin = start + round((START_S + 7.3) * SECOND_NS)
    loopback.fly_connected(autopilot, core, start, stalls=((begin, begin + stall_ns),) if stall_ns else ())
    solutions = [replace(r, t_ns=r.t_ns - start) for r in log.records if isinstance(r, Solution)]
    events = [r for r in log.records if isinstance(r, Event)]
    t_fix = _fix_times(log.records) - start * 1e-9
    return autopilot.world, solutions, events, any(_SET_2 in event.text for event in events), t_fix


def beside_fixes(t: Floats, error: Floats, t_fix: Floats) -> tuple[Floats, Floats]:
    """Leave out the errors of times before which no fix came, or none in the last `SILENT_S`.

    A solution at the time of a fix is from before it. Parameters: times (n,) s, errors (n,) m, and times (m,)
    s of the fixes that arrived.
    """
    t_fix = np.sort(t_fix)
    last = np.concatenate(([-math.inf], t_fix))[np.searchsorted(t_fix, t)]
    there = t - last <= SILENT_S
    return t[there], error[there]


def _from(start_s: float, ours: tuple[Floats, Floats], its: tuple[Floats, Floats]) -> tuple[Floats, ...]:
    """Cut both series to the time from `start_s` on."""
    (t, error), (t_gnss, error_gnss) = ours, its
    now, its_now = t >= start_s, t_gnss >= start_s
    return t[now], error[now], t_gnss[its_now], error_gnss[its_now]


def worst_ratio(t: Floats, error: Floats, t_gnss: Floats, error_gnss: Floats) -> float | None:
    """Return the greatest ratio of the corrected error less 3 m to GNSS's own, r.m.s. over 10 s.

    Parameters: times (n,) s and horizontal errors (n,) m of the solutions, and the same of GNSS (m,). Windows
    begin every second; None if no window has both.
    """
    if not len(t) or not len(t_gnss):
        return None
    begins = np.arange(math.floor(t[0]), t[-1] - WINDOW_S + 1.0)
    ours, its = (_window_rms(*series, begins) for series in ((t, error), (t_gnss, error_gnss)))
    ratios = (ours - FREE_M) / np.maximum(its, 1e-3)
    known = ratios[np.isfinite(ratios)]
    return max(0.0, float(known.max())) if len(known) else None


def _window_rms(t: Floats, error: Floats, begins: Floats) -> Floats:
    order = np.argsort(t, kind="stable")
    sums = np.concatenate(([0.0], np.cumsum(error[order] ** 2)))
    a, b = (np.searchsorted(t[order], begins + shift) for shift in (0.0, WINDOW_S))
    with np.errstate(invalid="ignore", divide="ignore"):
        out: Floats = np.sqrt((sums[b] - sums[a]) / (b - a))
    return out


def list_orders(names: Iterable[str], channels: Iterable[str], seeds: int, minutes: float) -> list[HarmOrder]:
    """List the flights: every wrong thing on every channel that it concerns."""
    wanted = list(channels)
    return [
        HarmOrder(name, channel, seed, minutes)
        for name in names
        for channel in wanted
        if channel in WRONG[name].channels
        for seed in range(1, seeds + 1)
    ]


class Work(NamedTuple):
    """Who works, and the journal of the results folder, if one is given."""

    journal: Journal | None
    scheduler: str | None
    workers: int

    def results(
        self, work: Callable[[Job], Result], jobs: Mapping[str, Job], kind: type[Result], what: str
    ) -> list[Result]:
        """Return the result of each job: from the journal, or worked out now and kept there.

        Raises ValueError if the journal has other results, or if one is lost with its worker.
        """
        found, lost = self._kept(jobs, kind), ""
        todo = {key: job for key, job in jobs.items() if key not in found}
        with show_count() as progress:
            task = progress.add_task(what, total=len(jobs), completed=len(found))
            for done in run_jobs(work, todo, self.scheduler, self.workers, "campaign"):
                if done.failure:
                    lost = f"{done.key}: {done.failure}"
                    continue
                found[done.key] = done.result
                if self.journal is not None:
                    self.journal.append({"key": done.key, "result": done.result._asdict()})
                progress.update(task, advance=1, description=done.key)
        if lost:
            raise ValueError(f"{lost}: start again, with --results what is finished is kept")
        return [found[key] for key in jobs]

    def _kept(self, jobs: Mapping[str, Job], kind: type[Result]) -> dict[str, Result]:
        if self.journal is None:
            return {}
        try:
            return {e["key"]: kind(**e["result"]) for e in self.journal.entries if e["key"] in jobs}
        except (KeyError, TypeError) as error:
            raise self.journal.invalid(error) from None


def fly_one_recording(data: Path, name: str) -> RecordingResult:
    """Fly one recording in a worker."""
    with threadpool_limits(1):
        return fly_named(data, name)


@click.command("harm")
@click.option("--seeds", type=click.IntRange(1, 10_000), help=f"Flights per case; default: {SEEDS}.")
@click.option("--minutes", type=FloatRange(4.0, 1440.0), help=f"Of each flight; default: {MINUTES:g}.")
@click.option(
    "--quick", is_flag=True, help=f"By default {QUICK_SEEDS} flight per case, of {QUICK_MINUTES:g} minutes."
)
@click.option("--case", "names", multiple=True, type=click.Choice(list(WRONG)), help="Default: all.")
@click.option("--channel", "channels", multiple=True, type=click.Choice(CHANNELS), help="Default: all.")
@click.option(
    "--data",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("../shared/data"),
    show_default=True,
    help="Folder of the recordings; skipped where it is missing.",
)
@click.option(
    "-o",
    "--results",
    type=click.Path(path_type=Path, file_okay=False),
    help="Folder; what has a result in it is not flown again. Default: nothing is kept.",
)
@worker_options
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def command(
    seeds: int | None,
    minutes: float | None,
    quick: bool,
    names: tuple[str, ...],
    channels: tuple[str, ...],
    data: Path,
    results: Path | None,
    scheduler: str | None,
    workers: int,
    as_json: bool,
) -> None:
    """Fly with a healthy GNSS and one thing wrong.

    Replays every recording too. Exit code 1 if harm is done.
    """
    orders = list_orders(
        dict.fromkeys(names or WRONG),
        dict.fromkeys(channels or CHANNELS),
        seeds or (QUICK_SEEDS if quick else SEEDS),
        minutes or (QUICK_MINUTES if quick else MINUTES),
    )
    there = list_recordings(data) if data.is_dir() else []
    try:
        if results is not None:
            make_folder(results)
        work = Work(None if results is None else Journal(results / "harm.jsonl"), scheduler, workers)
        flights = work.results(fly, {order.key: order for order in orders}, HarmResult, "flights")
        fly_one = partial(fly_one_recording, data)
        recordings = work.results(fly_one, {name: name for name in there}, RecordingResult, "recordings")
    except ValueError as error:
        raise SystemExit(f"companion: {error}") from None
    if as_json:
        rows = [result._asdict() | {"passed": result.passed} for result in flights]
        click.echo(json.dumps({"flights": rows, "recordings": [r._asdict() for r in recordings]}))
    else:
        _print_flights(flights)
        if recordings:
            _print_recordings(recordings)
        else:
            click.echo(f"{data}: no recordings")
    if not (all(flight.passed for flight in flights) and all(r.passed for r in recordings)):
        raise SystemExit(1)


def _print_flights(flights: list[HarmResult]) -> None:
    table = Table(title="GNSS healthy, one thing wrong")
    for head in ("wrong", "channel", "excluded", "set 2", "ratio", "since", "suspected", "passed"):
        table.add_column(head, justify="left" if head in ("wrong", "channel", "suspected") else "right")
    cases: dict[tuple[str, str], list[HarmResult]] = {}
    for result in flights:
        cases.setdefault((result.wrong, result.channel), []).append(result)
    for (wrong, channel), same in cases.items():
        ratios = [r.ratio for r in same if r.ratio is not None]
        since = [r.since for r in same if r.since is not None]
        suspected = sorted({name for r in same for name in r.suspected})
        passed = sum(r.passed for r in same)
        table.add_row(
            wrong,
            channel,
            _count(r.excluded for r in same),
            _count(r.set_2 for r in same),
            f"{max(ratios):.2f}" if ratios else "-",
            f"{max(since):.2f}" if since else "-",
            ", ".join(suspected) or "-",
            "yes" if passed == len(same) else f"NO ({passed} of {len(same)})",
        )
    print_tables(table)
    for result in flights:
        if result.raised is not None:
            click.echo(f"{result.wrong}, {result.channel}, seed {result.seed}: {result.raised}")
    passed = sum(result.passed for result in flights)
    click.echo(
        f"{passed} of {len(flights)} flights passed. ratio: greatest (corrected error - 3 m) / error of GNSS,"
        f" r.m.s. over 10 s; at most {MOST_RATIO}. since: the same from {START_S:g} s on, when faults begin"
    )


def _print_recordings(recordings: list[RecordingResult]) -> None:
    heads = ("recording", "fixes", "refused", "corrected", "autopilot", "truth", "set 2", "passed")
    table = number_table("recordings; medians against GNSS in m, times in s", *heads)
    for r in recordings:
        table.add_row(
            r.name.rsplit("/", 1)[-1].split(".")[0],
            str(r.fixes),
            f"{r.refused_s:.1f}",
            *("-" if x is None else f"{x:.2f}" for x in (r.corrected_m, r.autopilot_m, r.truth_m)),
            "-" if r.set_2_s is None else f"{r.set_2_s:.0f}{' HARM' if r.harmful else ''}",
            "yes" if r.passed else "NO",
        )
    print_tables(table)
    click.echo(
        "refused: longest time without a healthy fix used; truth: median of corrected against the truth;"
        " set 2: when first requested"
    )


def _count(values: Iterable[bool]) -> str:
    many = list(values)
    return f"{sum(many)} of {len(many)}" if any(many) else "-"
