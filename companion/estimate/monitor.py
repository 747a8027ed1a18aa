"""The watch over the sources: solution separation as a fold over measurements, with exclusions as data.

    monitor, refused = hear(monitor, measurement, allotment)     # every measurement, in the order of time
    monitor, exclusions = watch(monitor, allotment)              # once a second

`integrity` has the mathematics; here stands when it is asked. A source falls by its separation, clear of
every other's; by a run of measurements that no solution can explain; or by the word of an arbiter, where
there is one. The forks of a source are renewed in turn, so that the older is between one and two `fork_s`
old, and never while something stands apart.
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
LEAD = 0.5  # by which one must stand apart from others that measure: a model's errors grow with the lie


class Allotment(NamedTuple):
    """What may go wrong, as probabilities.

    `alarms_per_hour`: false alarms of the separations, all rows together. They are tested once a second,
    but one test says little new within `independent_s`. `rejection`: a good measurement refused. `wrong`:
    the wrong source accused. `run`: refusals in a row that exclude. `settle_s`: how long an excluded source
    must be admitted without a break before it is heard again, and `slow_s` one that drifted: it may pass
    for good that long. `hold_s`: how long the inertial channel must stand accused; a jump of a source looks
    like one of the channel until beacons have averaged enough, and sources jump.
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
        """Of one test of one of `rows` separations."""
        return self.alarms_per_hour * self.independent_s / 3600.0 / max(rows, 1)


class Exclusion(NamedTuple):
    """A source left out: why, the number that told and its limit. What it said after `since_ns` is undone,
    which moved the position by `moved` m.
    """

    t_ns: int
    source: str
    reason: str
    value: float
    limit: float
    since_ns: int
    moved: float


class Refusal(NamedTuple):
    """A measurement not taken: NIS in the solution that it fits best, and the limit."""

    source: str
    value: float
    limit: float


class Judgement(NamedTuple):
    """Who lies, None while that is not sure; the number that told and its limit."""

    source: str | None
    value: float
    limit: float


class Monitor(NamedTuple):
    """The bank, the run of refusals of each source, since when something stands apart and is not clear."""

    bank: Bank
    runs: tuple[tuple[str, int], ...] = ()
    refused: tuple[tuple[str, int], ...] = ()  # when a measurement of each source was last refused
    unresolved_ns: int | None = None
    admitted: tuple[tuple[str, int], ...] = ()  # excluded sources, and since when they have been admitted
    drifted: tuple[str, ...] = ()  # sources excluded by separation
    accused_ns: int | None = None  # since when the inertial channel stands accused

    @property
    def unresolved(self) -> bool:
        """Whether something stands apart and is not yet clear."""
        return self.unresolved_ns is not None


def hear(monitor: Monitor, measurement: Measurement, allotment: Allotment) -> tuple[Monitor, Refusal | None]:
    """One more measurement, at the bank's time."""
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

    An `arbiter` is asked who lies where the separations cannot tell, the channel itself being no witness.
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
    """What an excluded source says, which the gate (`integrity.admits`) has or has not `admitted`; whether it
    is heard again from now on.
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
    """As if `source` had never been heard, but for what it taught the others."""
    runs, refused, admitted = (
        tuple(entry for entry in entries if entry[0] != source)
        for entries in (monitor.runs, monitor.refused, monitor.admitted)
    )
    drifted = tuple(name for name in monitor.drifted if name != source)
    bank = leave(monitor.bank, source)
    return monitor._replace(bank=bank, runs=runs, refused=refused, admitted=admitted, drifted=drifted)


def probation(monitor: Monitor, source: str, allotment: Allotment) -> float:
    """How long (s) an excluded source must be admitted without a break."""
    return allotment.slow_s if source in monitor.drifted else allotment.settle_s


def trusted(monitor: Monitor, source: str) -> bool:
    """Whether the source is heard: neither excluded nor in a run of refusals."""
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
    """Each source's oldest fork begun again once its youngest is `every_ns` old."""
    forks: dict[str, list[int]] = {}
    for i, s in enumerate(found, 1):
        if not s.row.never and s.row.without not in bank.excluded:
            forks.setdefault(s.row.without, []).append(i)
    for mine in forks.values():
        mine.sort(key=lambda i: bank.rows[i].since_ns)
        if bank.t_ns - bank.rows[mine[-1]].since_ns >= every_ns:
            bank = fork(bank, mine[0])
    return bank
