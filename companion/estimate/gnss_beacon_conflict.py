"""GNSS against beacon: decide which of two contradicting sources is faulty, by the shape of their difference.

It is used where no third source decides. The difference is kept as *sights*: a beacon's measurement minus the
value predicted from GNSS's position, whichever source is in use. A beacon fails at an instant and by a
constant: its delay, its place, its north. A spoofed GNSS is pulled off: its position drifts at a rate that
resembles a change of the wind. Over all instants at which it may have started, each hypothesis is weighed as
a Gaussian model with its own prior,

    residual = unit bias + H velocity (t - tau)+          GNSS pulled off
    residual = unit bias + unit step [t >= tau]           the beacon's error stepped

by its evidence: 2 ln p(residuals | model) - 2 ln p(residuals | no fault). Eight ninths of a ramp's chi-square
are a step's too, so that the shape alone needs a minute to decide; but a pull also appears in the wind
derived from GNSS. Its velocity is the change of that wind since tau, within `CALM_M_S`, or a jump of the wind
if one came in between. Where GNSS shows no change it cannot have been pulled off.

A step is N(0, (STEP bias)^2).

The two wrong decisions have different costs. A step that is taken for a pull is small; following a spoofer
has no limit. So a step of less than `SMALL_M` does not count against a beacon, and while a larger one is the
more likely explanation GNSS remains in use, but no longer than `PATIENCE_S`. GNSS is attacked, one's own
beacon only fails: `ODDS`. For a beacon whose last measurement no solution explains the odds are reversed.

It knows no clock, no filter and not which source is in use. Source: Bayesian model comparison as in MacKay,
Information Theory, Inference, and Learning Algorithms (2003), chapter 28.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from companion.estimate.integrity import threshold
from companion.units import Floats

WINDOW_NS = 600_000_000_000
STEP = 20.0  # times the sigma of a beacon's constant error: 1 km, 2 degrees
ODDS = 100.0  # prior odds of a pull of GNSS against a step of a beacon
SMALL_M = 100.0  # of position
SURE = 1e-3  # inverse of the least likelihood ratio of a fault to no fault
INSTANTS = 80  # instants tried, denser towards the end
PATIENCE_S = 60.0  # how long GNSS stays in use while a fault of the beacon is more likely, but not by `ODDS`
SHORTEST_S = 10.0  # a shorter record is not weighed
CALM_M_S = 1.0  # change of mean wind and air-data errors between jumps
BEFORE_S = 60.0  # averaging time of the wind before an instant


class Sight(NamedTuple):
    """Beacon measurement minus its prediction from GNSS, whitened: `residual` is H (2,) (GNSS's error north
    and east, m) + `unit` (the source's constant error) + N(0, 1). `drift` is the velocity of the channel's
    error relative to GNSS, north and east (m/s): minus the wind.
    """

    t_ns: int
    source: str
    residual: float
    H: tuple[float, float]
    unit: float
    drift: tuple[float, float]


class Wind(NamedTuple):
    """Change of the wind: sigma of a jump in each axis (m/s), and jumps per second."""

    jump: float
    rate: float


class Evidence(NamedTuple):
    """Evidence for GNSS pulled off, and for the step of the beacon's `source` that explains most: twice the
    logarithm of the likelihood ratio to no fault. That step would move a position by `moved` m.
    """

    pulled: float
    stepped: float
    source: str
    moved: float

    def liar(self, suspect: bool, for_s: float) -> str | None:
        """Decide which source is faulty: "" for GNSS, or the beacon's source; None while it is not certain
        whether or which, the two having contradicted each other for `for_s`. `suspect` if no solution
        explains that beacon.
        """
        lead = self.stepped - self.pulled
        if not suspect and self.moved < SMALL_M:
            lead = -math.inf
        if lead > 2.0 * math.log(1.0 / ODDS if suspect else ODDS):
            return self.source if self.stepped > threshold(SURE) else None
        if lead > 0.0 and for_s < PATIENCE_S:
            return None
        return "" if self.pulled > threshold(SURE) else None


def keep(sights: tuple[Sight, ...], new: Sight) -> tuple[Sight, ...]:
    """Append a sight and drop those that are too old."""
    if sights and sights[0].t_ns < new.t_ns - WINDOW_NS:
        sights = tuple(s for s in sights if s.t_ns >= new.t_ns - WINDOW_NS)
    return (*sights, new)


def weigh(sights: tuple[Sight, ...], bias: Mapping[str, float], wind: Wind) -> Evidence:
    """Weigh the hypotheses by sights in the order of time. `bias` is one sigma of each source's constant
    error in its unit. The first seconds of sights give no evidence.
    """
    t, y, H, units = _columns(sights, tuple(bias))
    constant = units * np.array(list(bias.values()))
    CC, Cy = constant.T @ constant, constant.T @ y
    nobody = _evidence(CC, Cy)
    drift = np.array([s.drift for s in sights])
    begun = t[0] * np.linspace(0.0, 1.0, INSTANTS + 2)[1:-1] ** 2
    if t[0] > -SHORTEST_S:
        return Evidence(0.0, 0.0, sights[-1].source, 0.0)
    pulled, stepped = [], []
    for tau in begun.tolist():
        on = int(t.searchsorted(tau, "right"))
        ramp, after, told = (t[on:] - tau)[:, None] * H[on:], constant[on:], y[on:]
        before = t[:on] > t[on - 1] - BEFORE_S
        pull = drift[:on][before].mean(axis=0) - drift[on:].mean(
            axis=0
        )  # change of the wind derived from GNSS
        jumped = -math.expm1(wind.rate * tau)
        RR, CR, Ry = ramp.T @ ramp, after.T @ ramp, ramp.T @ told
        left = Cy - CR @ pull, Ry - RR @ pull  # with the mean pull removed
        either = [
            2.0 * math.log(share) + _joint(CC, sigma * CR, sigma**2 * RR, left[0], sigma * left[1])
            for share, sigma in ((1.0 - jumped, CALM_M_S), (jumped, wind.jump))
        ]
        pulled.append(2.0 * float(np.logaddexp(*(0.5 * np.array(either)))) + pull @ (Ry + left[1]))
        SS, Sy = STEP * (after.T @ after), STEP * (after.T @ told)
        stepped.append(
            [_joint(CC, SS[:, [k]], STEP * SS[[k]][:, [k]], Cy, Sy[[k]]) for k in range(len(bias))]
        )
    steps = np.array(stepped)
    each = _averaged(steps) - nobody
    worst = int(each.argmax())
    since = begun[steps[:, worst].argmax()]
    moved = _moved(constant, t > since, H, units, y, worst)
    return Evidence(float(_averaged(np.array(pulled)) - nobody), float(each[worst]), list(bias)[worst], moved)


def apart(sights: tuple[Sight, ...], x: Floats, P: Floats, names: tuple[str, ...]) -> float:
    """Compute the chi-square of two of a constant error of GNSS in all these sights, the constant errors of
    the sources `names` being x (m,) with covariance P (m, m).
    """
    _, y, H, units = _columns(sights, names)
    y = y - units @ x
    # covariance of noise and constants: S^-1 = I - U (P^-1 + U'U)^-1 U'
    inner = P @ np.linalg.inv(np.eye(len(x)) + units.T @ units @ P)
    weighted = np.column_stack((H, y))
    weighted = weighted - units @ (inner @ (units.T @ weighted))
    score, information = H.T @ weighted[:, 2], H.T @ weighted[:, :2]
    return float(score @ np.linalg.lstsq(information, score)[0])


def _columns(sights: tuple[Sight, ...], names: tuple[str, ...]) -> tuple[Floats, Floats, Floats, Floats]:
    """Build times from the last (n,), s, residuals (n,), H (n, 2), units (n, m) by source."""
    t = np.array([(s.t_ns - sights[-1].t_ns) * 1e-9 for s in sights])
    units = np.zeros((len(sights), len(names)))
    for row, s in zip(units, sights, strict=True):
        row[names.index(s.source)] = s.unit
    return t, np.array([s.residual for s in sights]), np.array([s.H for s in sights]), units


def _joint(AA: Floats, AB: Floats, BB: Floats, Ay: Floats, By: Floats) -> float:
    """Compute `_evidence` of the columns of A and B side by side."""
    return _evidence(np.block([[AA, AB], [AB.T, BB]]), np.concatenate((Ay, By)))


def _evidence(AA: Floats, Ay: Floats) -> float:
    """Compute 2 ln p(y | A) - 2 ln p(y | nothing), y (n,) = A (n, p) N(0, I) + N(0, I), by A'A and A'y."""
    information = np.eye(len(AA)) + AA
    return float(Ay @ np.linalg.solve(information, Ay) - np.linalg.slogdet(information)[1])


def _moved(
    constant: Floats, after: npt.NDArray[np.bool_], H: Floats, units: Floats, y: Floats, source: int
) -> float:
    """Compute the displacement (m) of a position by the most likely step of a source."""
    A = np.column_stack((constant, STEP * constant[:, source] * after))
    step = np.linalg.solve(np.eye(A.shape[1]) + A.T @ A, A.T @ y)[-1] * A[:, -1]
    mine = units[:, source] * after != 0.0
    return float(np.abs(step[mine] / np.linalg.norm(H[mine], axis=1)).mean()) if mine.any() else 0.0


def _averaged(evidence: Floats) -> Floats:
    """Average the likelihood over the instants, the first axis."""
    best = evidence.max(axis=0)
    out: Floats = best + 2.0 * np.log(np.exp(0.5 * (evidence - best)).mean(axis=0))
    return out
