"""INS channel with the errors of its correctors as further states.

    airspeed     wind, north and east (random walk); airspeed scale
    hyperbolic   a bias for each chain, correlated over an hour
    stars        none: the tilt is a state of the INS

Only what `inertial.correctors` names has states, behind those of the INS. The rows are those of
`corrector_measurements`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from companion.config import Config
from companion.nav.error_model import INS_STATES
from companion.navigator.channel import Nominal, Transition, discretise
from companion.navigator.ins_channel import InsChannel, ins_channel
from companion.units import Floats

INS_NAMES = (*INS_STATES, "EX", "EY", "EZ", "AX", "AY", "driftN", "driftE", "latency")
CHAINS = 3  # lines of position with a bias of their own
CHAIN_BIAS_M, CHAIN_S = 200.0, 3600.0


class ExtraStates(NamedTuple):
    """Further states: names (k,), dynamics A (k, k), spectral densities (k,), first sigmas (k,)."""

    names: tuple[str, ...]
    A: Floats
    density: Floats
    sigma: Floats


class CorrectedIns(NamedTuple):
    """Error model of an INS with correctors; it has the face of a `Channel`."""

    ins: InsChannel
    extra: ExtraStates
    drift: slice
    latency: int
    grades: tuple[float, ...]
    velocity_noise: float = 0.0
    wind: tuple[int, ...] = ()

    @property
    def n(self) -> int:
        """Number of states."""
        return self.ins.n + len(self.extra.names)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all states."""
        return (*INS_NAMES, *self.extra.names)

    def prior(self) -> Floats:
        """First covariances (grades, n, n)."""
        first = self.ins.prior()
        P = np.zeros((len(first), self.n, self.n))
        P[:, : self.ins.n, : self.ins.n] = first
        P[:, self.ins.n :, self.ins.n :] = np.diag(self.extra.sigma**2)
        return P

    def transition(self, nominal: Nominal) -> Transition:
        """Phi and Q since the bank's time: both blocks are independent of each other."""
        ins = self.ins.transition(nominal)
        extra = discretise(self.extra.A, np.diag(self.extra.density)[None], nominal.pending_s)
        Phi, Q = np.eye(self.n), np.zeros((len(ins.Q), self.n, self.n))
        Phi[: self.ins.n, : self.ins.n], Phi[self.ins.n :, self.ins.n :] = ins.Phi, extra.Phi
        Q[:, : self.ins.n, : self.ins.n], Q[:, self.ins.n :, self.ins.n :] = ins.Q, extra.Q
        return Transition(Phi, Q)


def corrected_ins(config: Config) -> InsChannel | CorrectedIns:
    """Build the error model of the INS, with the states of the configured correctors."""
    ins = ins_channel(config)
    if not config.inertial.correctors:
        return ins
    return CorrectedIns(ins, _extra_states(config), ins.drift, ins.latency, ins.grades)


def _extra_states(config: Config) -> ExtraStates:
    air, used = config.air_data, config.inertial.correctors
    names, density, sigma = list[str](), list[float](), list[float]()
    if "airspeed" in used:
        wind = air.wind_change_m_s_sqrt_s**2 + air.wind_jump_m_s**2 * air.wind_jumps_per_hour / 3600.0
        names += ["wN", "wE", "scale"]
        density += [wind, wind, 0.0]
        sigma += [air.wind_m_s, air.wind_m_s, 0.01 * air.airspeed_percent]
    if "hyperbolic" in used:
        names += [f"chain{k}" for k in range(CHAINS)]
        density += [2.0 * CHAIN_BIAS_M**2 / CHAIN_S] * CHAINS
        sigma += [CHAIN_BIAS_M] * CHAINS
    A = np.zeros((len(names), len(names)))
    index = {name: i for i, name in enumerate(names)}
    for k in range(CHAINS if "hyperbolic" in used else 0):
        A[index[f"chain{k}"], index[f"chain{k}"]] = -1.0 / CHAIN_S
    return ExtraStates(tuple(names), A, np.array(density), np.array(sigma))


def chain_state(k: int) -> str:
    """Name of the bias of a chain; its number counts modulo three."""
    return f"chain{k % CHAINS}"
