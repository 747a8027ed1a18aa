"""INS channel with the errors of its correctors as further states.

    airspeed     wind, north and east (random walk); airspeed scale
    hyperbolic   a bias for each chain, correlated over an hour
    stars        none: the tilt is a state of the INS
    second_ins   the errors of the unit once more: a second one of the same kind, of the same grade

Only what `inertial.correctors` names has states, behind those of the INS. The rows are those of
`corrector_measurements`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from companion.config import Config
from companion.nav.error_model import INS_STATES
from companion.navigator.channel import Nominal, Transition, discretise
from companion.navigator.ins_channel import ARM, DOPPLER, DRIFT, LATENCY, WEIGHTS, InsChannel, ins_channel
from companion.units import Floats

UNIT_NAMES = (*INS_STATES, "EX", "EY", "EZ", "AX", "AY")
INS_NAMES = (*UNIT_NAMES, "driftN", "driftE", "latency", "arm", "dopplerN", "dopplerE")
CHAINS = 3  # lines of position with a bias of their own
CHAIN_BIAS_M, CHAIN_S = 200.0, 3600.0


class ExtraStates(NamedTuple):
    """Further states: names (k,), dynamics A (k, k), spectral densities (k,), first sigmas (k,)."""

    names: tuple[str, ...]
    A: Floats
    density: Floats
    sigma: Floats


class CorrectedIns(NamedTuple):
    """Error model of an INS with correctors; it has the face of a `Channel`.

    The states are those of the INS, `extra`, and with `has_second` those of a second unit.
    """

    ins: InsChannel
    extra: ExtraStates
    has_second: bool
    drift: slice = DRIFT
    doppler: slice = DOPPLER
    latency: int = LATENCY
    arm: int | None = ARM
    grades: tuple[float, ...] = WEIGHTS
    velocity_noise: float = 0.0
    wind: tuple[int, ...] = ()

    @property
    def n(self) -> int:
        """Number of states."""
        return self.ins.n + len(self.extra.names) + len(UNIT_NAMES) * self.has_second

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all states."""
        second = (f"{name}2" for name in UNIT_NAMES if self.has_second)
        return (*INS_NAMES, *self.extra.names, *second)

    def prior(self) -> Floats:
        """First covariances (grades, n, n)."""
        first = self.ins.prior()
        return self._joined(first, np.diag(self.extra.sigma**2))

    def transition(self, nominal: Nominal) -> Transition:
        """Phi and Q since the bank's time; the blocks are independent of each other."""
        ins = self.ins.transition(nominal)
        extra = discretise(self.extra.A, np.diag(self.extra.density)[None], nominal.pending_s)
        return Transition(self._joined(ins.Phi, extra.Phi), self._joined(ins.Q, extra.Q))

    def _joined(self, ins: Floats, extra: Floats) -> Floats:
        """Block diagonal of INS (..., n, n), further states (k, k) or (1, k, k), and the second unit."""
        unit, end = len(UNIT_NAMES), self.ins.n + len(self.extra.names)
        out = np.zeros((*ins.shape[:-2], self.n, self.n))
        out[..., : self.ins.n, : self.ins.n] = ins
        out[..., self.ins.n : end, self.ins.n : end] = extra
        out[..., end:, end:] = ins[..., :unit, :unit] if self.has_second else 0.0
        return out


def corrected_ins(config: Config) -> InsChannel | CorrectedIns:
    """Build the error model of the INS, with the states of the configured correctors."""
    ins = ins_channel(config)
    if not config.inertial.correctors:
        return ins
    return CorrectedIns(ins, _extra_states(config), "second_ins" in config.inertial.correctors)


def _extra_states(config: Config) -> ExtraStates:
    air, used = config.air_data, config.inertial.correctors
    names, rate, density, sigma = list[str](), list[float](), list[float](), list[float]()
    if "airspeed" in used:
        wind = air.wind_walk_m_s_sqrt_s**2
        names += ["wN", "wE", "scale"]
        rate += [0.0] * 3
        density += [wind, wind, 0.0]
        sigma += [air.wind_m_s, air.wind_m_s, 0.01 * air.airspeed_percent]
    if "hyperbolic" in used:
        names += [f"chain{k}" for k in range(CHAINS)]
        rate += [-1.0 / CHAIN_S] * CHAINS
        density += [2.0 * CHAIN_BIAS_M**2 / CHAIN_S] * CHAINS
        sigma += [CHAIN_BIAS_M] * CHAINS
    return ExtraStates(tuple(names), np.diag(rate), np.array(density), np.array(sigma))


def chain_state(k: int) -> str:
    """Name of the bias of a chain; its number counts modulo three."""
    return f"chain{k % CHAINS}"
