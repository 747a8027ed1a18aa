"""Layout of a bank: sources, what may be false or jump, and which state stands where."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from companion.units import Floats

Ints = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]

NONE = -1
"""Index of "no fault"; arrays over faults have their last entry for it."""
FAULT_CODES = 64
"""More than there are faults: the base of the code of an explanation."""
NEVER = -math.inf
"""Time of a measurement that never came, and the logarithm of zero."""
NO_DECAY_S = 1e15
"""Correlation time of a rate that does not decay."""


@dataclass(frozen=True, slots=True)
class Source:
    """One source of measurements.

    Parameters
    ----------
    name : what reports call it.
    dim : number of components of a measurement, 1 or 2 as a rule.
    group, slot : where its lie stands: the group of lie states and the first offset in it. Two sources may
        share slots unless one fault concerns both.
    silence_s : a longer gap freezes the faults of this source; the next measurement is a return.
    presumed : the estimate follows an explanation that holds it to be false only once it is excluded, or
        silent for longer than `silence_s`.
    """

    name: str
    dim: int
    group: int
    slot: int = 0
    silence_s: float = 10.0
    presumed: bool = False


@dataclass(frozen=True, slots=True)
class Lie:
    """Prior of a lie at its onset: one sigma per component, and the process noise of its rate.

    Parameters
    ----------
    offset, rate : one sigma per component, unit of the measurement and unit/s.
    noise : random walk of the rate, unit/s/sqrt(s).
    acceleration : one sigma of the constant rate of the rate, unit/s^2; groups of order 3 only.
    share : part of the fault's prior that this scale gets; shares are normalised.
    """

    offset: float
    rate: float
    noise: float = 0.0
    acceleration: float = 0.0
    share: float = 1.0


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault of one source or of several together.

    Parameters
    ----------
    name : what reports call it.
    sources : indices of the sources that are false, all in the same group.
    rate_h : prior rate of onsets, 1/h, while all of its sources are received.
    lies : scales of the lie at an onset in flight.
    first : prior probability of being false from the first measurement, or after a silence.
    first_lies : scales of the lie then.
    shock : base states and one sigma each of what the fault did to them before it was noticed.
    death_h : rate at which the fault ends, 1/h.
    change_h : rate at which the lie changes (a new offset and rate on top of the old), 1/h.
    quota : rows the fault may hold at least, when rows are short.
    of : indices of two faults that this one is together: it is born of one by the lies of the other.
    """

    name: str
    sources: tuple[int, ...]
    rate_h: float
    lies: tuple[Lie, ...]
    first: float = 0.0
    first_lies: tuple[Lie, ...] = ()
    shock: tuple[tuple[int, float], ...] = ()
    death_h: float = 1.0
    change_h: float = 1.0
    quota: int = 6
    of: tuple[int, ...] = ()


class Angle(NamedTuple):
    """An angle, as two base states: its sine and 1 less its cosine. Linear at any angle."""

    sine: int
    versine: int


@dataclass(frozen=True, slots=True)
class Jump:
    """A jump of base states (channel, wind): the child's covariance grows once; no source is false.

    Parameters
    ----------
    name : what reports call it.
    states : indices of the base states that jump.
    sigma : one sigma of the jump, one per state.
    rate_h : prior rate, 1/h.
    quota : rows the jump may hold at least, when rows are short.
    apart_s : for so long a row that jumped is an explanation of its own, see `explanations`.
    often : it is born every `Settings.jump_s`: before its birth other states learn wrongly from it.
    again_h : rate after it, 1/h; None: the same. What has jumped may jump back.
    angle : an angle that is any one then.
    """

    name: str
    states: tuple[int, ...]
    sigma: tuple[float, ...]
    rate_h: float
    quota: int = 4
    apart_s: float = 0.0
    often: bool = False
    again_h: float | None = None
    angle: Angle | None = None


@dataclass(frozen=True)
class Layout:
    """Which state stands where, and what may go wrong. Base states first, then the groups of lie states.

    A group of size d holds d offsets, then d rates, and with order 3 d accelerations of the lie. Rows carry
    at most one fault per group, so faults that share a group share its states, and faults in different
    groups may be active at the same time in one row.

    Parameters
    ----------
    n_base : number of base states: the error model with all shared states (drift, latency, biases).
    groups : offsets per group.
    sources, faults, jumps : what is received and what may be wrong; faults and jumps have this order.
    grades : amplitudes of the ladder.
    position : indices of the two base states whose radial error the protection level bounds.
    orders : 2 or 3 per group; 2 by default. A lie that accelerates steadily pays in every fix for a wandering
        rate, but only once for an acceleration of its own.
    rate_correlation_s : correlation time of the rates (s), one per group; by default they do not decay. The
        error of an instrument is bounded: beside base states that jump, both would grow against each other.
    """

    n_base: int
    groups: tuple[int, ...]
    sources: tuple[Source, ...]
    faults: tuple[Fault, ...]
    jumps: tuple[Jump, ...] = ()
    grades: tuple[float, ...] = (1.0, 4.0, 16.0, 64.0)
    position: tuple[int, int] = (0, 1)
    orders: tuple[int, ...] = ()
    rate_correlation_s: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for name, given in (("orders", self.orders), ("rate_correlation_s", self.rate_correlation_s)):
            if given and len(given) != len(self.groups):
                raise ValueError(f"{name} {given}: give one for each of {len(self.groups)} groups, or none")
        for s in self.sources:
            if s.slot + s.dim > self.groups[s.group]:
                raise ValueError(f"source {s.name}: group {s.group} has {self.groups[s.group]} offsets only")
        for f in self.faults:
            if len({self.sources[s].group for s in f.sources}) != 1:
                raise ValueError(f"fault {f.name}: its sources must stand in one group")
            parts = [s for i in f.of if i < len(self.faults) for s in self.faults[i].sources]
            if f.of and (len(f.of) != 2 or sorted(parts) != sorted(f.sources)):
                raise ValueError(f"fault {f.name}: of {f.of}: give two faults that have its sources together")
        explanations = (len(self.jumps) + 1) * FAULT_CODES ** len(self.groups)  # each has a code of 64 bits
        if len(self.faults) >= FAULT_CODES or explanations >= 1 << 63:
            many = f"{len(self.faults)} faults, {len(self.groups)} groups, {len(self.jumps)} jumps"
            raise ValueError(f"{many}: give at most {FAULT_CODES - 1} faults, and ten groups with six jumps")

    @cached_property
    def sizes(self) -> tuple[int, ...]:
        """Number of lie states of each group."""
        return tuple(d * o for d, o in zip(self.groups, self.orders or (2,) * len(self.groups)))

    @cached_property
    def n(self) -> int:
        """Number of states of a row."""
        return self.n_base + sum(self.sizes)

    @cached_property
    def starts(self) -> tuple[int, ...]:
        """First state of each group."""
        return tuple(self.n_base + sum(self.sizes[:g]) for g in range(len(self.groups)))

    @cached_property
    def offsets(self) -> Ints:
        """State indices of all offsets."""
        return np.array([a + k for a, d in zip(self.starts, self.groups) for k in range(d)], dtype=np.int64)

    @cached_property
    def rates(self) -> Ints:
        """State indices of all rates, in the order of `offsets`."""
        return np.array(
            [a + d + k for a, d in zip(self.starts, self.groups) for k in range(d)], dtype=np.int64
        )

    @cached_property
    def rate_correlation_times(self) -> Floats:
        """Correlation time of each rate (s), in the order of `rates`."""
        times = self.rate_correlation_s or (NO_DECAY_S,) * len(self.groups)
        return np.repeat(times, self.groups)

    @cached_property
    def accelerations(self) -> tuple[Ints, Ints, Ints]:
        """State indices of the offsets, rates and accelerations of all groups of order 3."""
        third = [g for g, d in enumerate(self.groups) if self.sizes[g] == 3 * d]
        at = [self.starts[g] + k for g in third for k in range(self.groups[g])]
        d = np.array([self.groups[g] for g in third for _ in range(self.groups[g])], dtype=np.int64)
        offsets = np.array(at, dtype=np.int64)
        return offsets, offsets + d, offsets + 2 * d

    @cached_property
    def concerns(self) -> Bools:
        """(faults + 1, sources): whether the fault makes the source false; the last row is "no fault"."""
        table = np.zeros((len(self.faults) + 1, len(self.sources)), dtype=np.bool_)
        for i, f in enumerate(self.faults):
            table[i, list(f.sources)] = True
        return table

    @cached_property
    def joint(self) -> dict[tuple[int, int], int]:
        """The fault that two faults are together, in either order."""
        pairs = ((i, f.of) for i, f in enumerate(self.faults) if f.of)
        return {pair: i for i, (a, b) in pairs for pair in ((a, b), (b, a))}

    def lie_states(self, source: int) -> Ints:
        """State indices of the offsets of a source's lie."""
        s = self.sources[source]
        return self.starts[s.group] + s.slot + np.arange(s.dim)

    def fault_group(self, fault: int) -> int:
        """Group of lie states that a fault uses."""
        return self.sources[self.faults[fault].sources[0]].group

    def jump_event(self, jump: int) -> int:
        """Code of a jump in `Bank.event`."""
        return 1 + 2 * len(self.faults) + jump

    @cached_property
    def _priors(self) -> dict[tuple[int, Lie], tuple[Ints, Floats, Ints, Floats]]:
        """What `lie_prior` returned before."""
        return {}

    def lie_prior(self, fault: int, lie: Lie) -> tuple[Ints, Floats, Ints, Floats]:
        """State indices and variances of a lie, and indices (into `rates`) and densities of its noise."""
        known = self._priors.get((fault, lie))
        if known is not None:
            return known
        f = self.faults[fault]
        g = self.fault_group(fault)
        slots = np.concatenate([self.sources[s].slot + np.arange(self.sources[s].dim) for s in f.sources])
        a, d, m = self.starts[g], self.groups[g], len(slots)
        index = np.concatenate((a + slots, a + d + slots))
        sigma = [lie.offset, lie.rate]
        if self.sizes[g] == 3 * d:
            index = np.concatenate((index, a + 2 * d + slots))
            sigma.append(lie.acceleration)
        elif lie.acceleration:
            raise ValueError(f"fault {f.name}: an acceleration needs a group of order 3")
        prior = index, np.repeat(sigma, m) ** 2, sum(self.groups[:g]) + slots, np.full(m, lie.noise) ** 2
        self._priors[fault, lie] = prior
        return prior
