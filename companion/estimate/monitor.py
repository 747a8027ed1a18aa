"""Source monitor: solution separation as a fold over measurements, with exclusions as data.

    monitor, refused = hear(monitor, measurement, allotment)     # every measurement, in the order of time
    monitor, exclusions = watch(monitor, allotment)              # once a second

`integrity` has the mathematics; this module decides when to test. A source is excluded by its separation, if
it is larger than every other's; by a run of measurements that no solution explains; or by the decision of an
arbiter, where there is one. The forks of a source are renewed in turn, so that the older is between one and
two `fork_s` old, but not while a separation exceeds its limit.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from scipy.special import chdtri

from companion.estimate.filterbank import INERTIAL, Bank, Measurement, fork, leave, readmit, refuse, take
from companion.estimate.integrity import Separation, blame, exclude, separations, threshold

BEYOND = "separation"
REFUSED = "refused by every solution"
CONTRADICTED = "contradiction"
LEAD = 0.5  # least lead over the other measuring sources: a model's errors grow with the fault


class Allotment(NamedTuple):
    """Allocation of risk, as probabilities, and the times of the decisions.

    `alarms_per_hour`: false alarms of the separations, all rows together. They are tested once a second;
    tests within `independent_s` count as one. `rejection`: a good measurement rejected. `wrong`: the wrong
    source excluded. `run`: rejections in a row that exclude. `settle_s`: time for which an excluded source
    must pass the gate without a break before it is re-admitted, `slow_s` the same for one that drifted: a
    drift can pass the gate that long. `hold_s`: time for which the inertial channel must be the suspect; a
    jump of a source looks like one of the channel until beacons have averaged enough, and sources jump.
    """

    alarms_per_hour: float = 1e-3
    independent_s: float = 10.0
    rejection: float = 1e-6
    wrong: float = 1e-6
    run: int = 5
    fork_s: float = 120.0
    settle_s: float = 10.0
    slow_s: float = 60.0
    hold_s: float = 60.0

    def false_alarm(self, rows: int) -> float:
        """Return the false-alarm probability of one test of one of `rows` separations."""
        return self.alarms_per_hour * self.independent_s / 3600.0 / max(rows, 1)


class Exclusion(NamedTuple):
    """Exclusion of a source: reason, test statistic and limit. Its measurements after `since_ns` are undone,
    which moves the position by `moved` m.
    """

    t_ns: int
    source: str
    reason: str
    value: float
    limit: float
    since_ns: int
    moved: float


class Refusal(NamedTuple):
    """Rejected measurement: NIS in the solution that it fits best, and the limit."""

    source: str
    value: float
    limit: float


class Judgement(NamedTuple):
    """Decision of an arbiter: the faulty source, None while not certain; the statistic and its limit."""

    source: str | None
    value: float
    limit: float


class Monitor(NamedTuple):
    """Bank, run of rejections of each source, and the start of an unresolved separation."""

    bank: Bank
    runs: tuple[tuple[str, int], ...] = ()
    refused: tuple[tuple[str, int], ...] = ()  # time of the last rejection of each source
    unresolved_ns: int | None = None
    admitted: tuple[tuple[str, int], ...] = ()  # excluded sources, and since when they pass the gate
    drifted: tuple[str, ...] = ()  # sources excluded by separation
    accused_ns: int | None = None  # since when the inertial channel is the suspect

    @property
    def unresolved(self) -> bool:
        """Return whether a separation exceeds its limit without a clear suspect."""
        return self.unresolved_ns is not None


def hear(monitor: Monitor, measurement: Measurement, allotment: Allotment) -> tuple[Monitor, Refusal | None]:
    """Update with one measurement at the bank's time."""
    limit = float(chdtri(len(measurement.z), allotment.rejection))
    taken = take(monitor.bank, measurement, limit)
    runs = dict(monitor.runs)
    runs[measurement.source] = 0 if taken.nis <= limit else runs.get(measurement.source, 0) + 1
    monitor = monitor._replace(bank=taken.bank, runs=tuple(runs.items()))
    if not taken.accepted:
        refused = dict(monitor.refused) | {measurement.source: monitor.bank.t_ns}
        monitor = monitor._replace(refused=tuple(refused.items()))
    return monitor, None if taken.accepted else Refusal(measurement.source, taken.nis, limit)


def watch(
    monitor: Monitor, allotment: Allotment, arbiter: Callable[[], Judgement] | None = None
) -> tuple[Monitor, list[Exclusion]]:
    """Test every separation, exclude at most one source, renew the forks.

    An `arbiter` decides which source is faulty where the separations cannot, the channel itself not being an
    independent reference.
    """
    bank = monitor.bank
    found = separations(bank)
    alarm = allotment.false_alarm(len(found))
    accused = blame(tuple(s for s in found if s.row.without not in bank.excluded), alarm)
    clear = accused is not None and accused.margin >= threshold(allotment.wrong) and accused.lead >= LEAD
    if accused is not None and arbiter is not None:
        clear, (source, value, limit) = False, arbiter()
        if source is not None:
            return _excluded(monitor, source, CONTRADICTED, value, limit, alarm)
    since = None
    if accused is not None and clear and accused.source == INERTIAL:
        since = bank.t_ns if monitor.accused_ns is None else monitor.accused_ns
        clear = (bank.t_ns - since) * 1e-9 >= allotment.hold_s
    monitor = monitor._replace(accused_ns=since)
    if accused is not None and clear:
        return _excluded(monitor, accused.source, BEYOND, accused.statistic, accused.limit, alarm)
    for source, run in monitor.runs:
        if run >= allotment.run and source in bank.sources and source not in bank.excluded:
            told = Exclusion(bank.t_ns, source, REFUSED, float(run), float(allotment.run), bank.t_ns, 0.0)
            left = tuple(name for name in monitor.drifted if name != source)
            refused = monitor._replace(bank=refuse(bank, source), drifted=left)
            return _unresolved(refused, accused is not None), [told]
    if accused is None:
        bank = _renewed(bank, found, round(1e9 * allotment.fork_s))
    return _unresolved(monitor._replace(bank=bank), accused is not None), []


def _unresolved(monitor: Monitor, now: bool) -> Monitor:
    since = monitor.bank.t_ns if monitor.unresolved_ns is None else monitor.unresolved_ns
    return monitor._replace(unresolved_ns=since if now else None)


def offer(
    monitor: Monitor, t_ns: int, source: str, admitted: bool, allotment: Allotment
) -> tuple[Monitor, bool]:
    """Try to re-admit an excluded source, given whether its measurement was `admitted` by the gate
    (`integrity.admits`); return whether it is used from now on.
    """
    since = dict(monitor.admitted)
    if not admitted:
        since.pop(source, None)
    elif (t_ns - since.setdefault(source, t_ns)) * 1e-9 >= probation(monitor, source, allotment):
        del since[source]
        runs = tuple(run for run in monitor.runs if run[0] != source)
        bank = readmit(monitor.bank, source)
        return monitor._replace(bank=bank, runs=runs, admitted=tuple(since.items())), True
    return monitor._replace(admitted=tuple(since.items())), False


def forget(monitor: Monitor, source: str) -> Monitor:
    """Remove `source` with its rows and history; what it contributed to the states remains."""
    runs, refused, admitted = (
        tuple(entry for entry in entries if entry[0] != source)
        for entries in (monitor.runs, monitor.refused, monitor.admitted)
    )
    drifted = tuple(name for name in monitor.drifted if name != source)
    bank = leave(monitor.bank, source)
    return monitor._replace(bank=bank, runs=runs, refused=refused, admitted=admitted, drifted=drifted)


def probation(monitor: Monitor, source: str, allotment: Allotment) -> float:
    """Return the time (s) for which an excluded source must pass the gate without a break."""
    return allotment.slow_s if source in monitor.drifted else allotment.settle_s


def trusted(monitor: Monitor, source: str) -> bool:
    """Return whether the source is used: neither excluded nor in a run of rejections."""
    return source not in monitor.bank.excluded and dict(monitor.runs).get(source, 0) == 0


def _excluded(
    monitor: Monitor, source: str, reason: str, value: float, limit: float, alarm: float
) -> tuple[Monitor, list[Exclusion]]:
    before = monitor.bank
    bank = exclude(before, source, alarm)
    step = bank.x[0, :2] - before.x[0, :2]
    moved = float((step @ step) ** 0.5)
    told = Exclusion(bank.t_ns, source, reason, value, limit, bank.rows[0].since_ns, moved)
    drifted = (*(name for name in monitor.drifted if name != source), source)
    return monitor._replace(bank=bank, unresolved_ns=None, drifted=drifted, accused_ns=None), [told]


def _renewed(bank: Bank, found: tuple[Separation, ...], every_ns: int) -> Bank:
    """Restart each source's oldest fork once its youngest is `every_ns` old."""
    forks: dict[str, list[int]] = {}
    for i, s in enumerate(found, 1):
        if not s.row.never and s.row.without not in bank.excluded:
            forks.setdefault(s.row.without, []).append(i)
    for mine in forks.values():
        mine.sort(key=lambda i: bank.rows[i].since_ns)
        if bank.t_ns - bank.rows[mine[-1]].since_ns >= every_ns:
            bank = fork(bank, mine[0])
    return bank
