"""The moment when a process leaves its model: the error of an INS, say, after something in it broke.

    before   z_i = Psi_i a + N(0, sigma_i^2)                    a unknown, Psi the model
    after    the same + b + c (t_i - t_k) + d (t_i - t_k)^2 from i = k on           b, c, d and k unknown

What comes after is a function of which nothing is known (Brandin et al., section 6.5); its first power terms,
a jump, a drift, an acceleration, are what can be told of it while it is young. For every k the gain

    G_k = RSS(before) - min over b, c, d of RSS(after)

is chi-square with 3 degrees of freedom while the model holds, whatever a is. It is looked at again and again
as the samples come in; with M pairs of a moment and a look in all, the chance that any G_k ever exceeds the
chi-square limit of false_alarm / M is at most `false_alarm`: Boole's inequality, no simulation behind it. The
moment is then the k of the greatest gain, the most likely one, found with as much more data as passed
between it and the first alarm.

The noise is taken for independent: samples of GNSS, whose errors last, are to be thinned to their
correlation time, or `sigma` raised. Innovations of a filter need no model, Psi is empty then.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri

Array = npt.NDArray[np.float64]

FEWEST = 5  # samples after the model's own number before the first look
CONFIDENCE = 0.95


class Departure(NamedTuple):
    """The likeliest moment t, between `earliest` and `latest` with 95 %, noticed at `noticed`, all in s.

    `gain` against `limit` is what gave the alarm.
    """

    t: float
    earliest: float
    latest: float
    noticed: float
    gain: float
    limit: float


def departure(
    t: npt.ArrayLike,
    z: npt.ArrayLike,
    sigma: npt.ArrayLike,
    model: npt.ArrayLike | None = None,
    false_alarm: float = 1e-3,
    terms: int = 3,
    looks: int = 100,
) -> Departure | None:
    """When z (N,) left the model, or None if nothing says that it did.

    t (N,) s rising; sigma (N,) or one for all, in the unit of z; model (N, q) the values of its functions at
    t, None for a z that should be zero but for its noise; `terms` of power after the moment. It is looked at
    `looks` times, evenly over the samples: fewer notice later, more ask for a little more evidence.
    ValueError where the numbers do not fit.
    """
    t, y, Psi = _samples(t, z, sigma, model, false_alarm, terms, looks)
    N, q = Psi.shape
    weight = 1.0 / np.broadcast_to(np.asarray(sigma, float), t.shape)
    ends = np.unique(np.linspace(N, q + FEWEST, min(looks, N - q - FEWEST + 1)).astype(int))
    limit = float(chdtri(terms, false_alarm / float(ends.sum())))
    for end in ends:
        gains = _gains(t[:end], y[:end], Psi[:end], weight[:end], terms)
        k = int(gains.argmax())
        if gains[k] > limit:
            alarm, more = float(gains[k]), min(2 * int(end) - k, N)
            gains = _gains(t[:more], y[:more], Psi[:more], weight[:more], terms)
            # a bend's moment is no regular parameter: it takes its terms along, where 1 degree is too few
            likely = np.flatnonzero(gains >= gains.max() - float(chdtri(1.0 + terms, 1.0 - CONFIDENCE)))
            moment, first, last = (float(t[i]) for i in (gains.argmax(), likely[0], likely[-1]))
            return Departure(moment, first, last, float(t[end - 1]), alarm, limit)
    return None


def _gains(t: Array, y: Array, Psi: Array, weight: Array, terms: int) -> Array:
    """G_k (N,) for a change at each sample k, all at once.

    The columns 1, t, t^2, .. from k on, in standard deviations, less their part in the model's span; their
    products with everything are sums from k to the end.
    """
    Q = np.linalg.qr(Psi)[0]
    tau = (t - t[0]) / (t[-1] - t[0])
    e = y - Q @ (Q.T @ y)
    columns = weight[:, None] * np.vander(tau, terms, increasing=True)

    def tail(of: Array) -> Array:
        sums: Array = np.cumsum(of[::-1], axis=0)[::-1]
        return sums

    scale = np.sqrt(tail(columns**2))
    g = tail(columns * e[:, None]) / scale
    F = tail(columns[:, :, None] * columns[:, None, :])
    shared = tail(Q[:, :, None] * columns[:, None, :])  # (N, q, terms)
    F = (F - shared.mT @ shared) / (scale[:, :, None] * scale[:, None, :])
    # what the model has already, or what is too short to tell, gains nothing
    eigenvalues, V = np.linalg.eigh(F)
    along = (V.mT @ g[:, :, None])[:, :, 0]
    known = eigenvalues > 1e-9
    gain: Array = np.divide(along**2, eigenvalues, out=np.zeros_like(along), where=known).sum(1)
    return gain


def _samples(
    t: npt.ArrayLike,
    z: npt.ArrayLike,
    sigma: npt.ArrayLike,
    model: npt.ArrayLike | None,
    false_alarm: float,
    terms: int,
    looks: int,
) -> tuple[Array, Array, Array]:
    """t, and z and Psi in standard deviations."""
    t, z, sigma = np.asarray(t, float), np.asarray(z, float), np.asarray(sigma, float)
    Psi = np.zeros((len(t), 0)) if model is None else np.asarray(model, float)
    if t.ndim != 1 or z.shape != t.shape or sigma.shape not in ((), t.shape):
        shapes = f"t {t.shape}, z {z.shape}, sigma {sigma.shape}"
        raise ValueError(f"{shapes} do not fit: give N times, N values, and one sigma or N")
    if Psi.ndim != 2 or len(Psi) != len(t):
        raise ValueError(f"the model {Psi.shape} does not fit {len(t)} samples: give a row for each")
    if len(t) < Psi.shape[1] + FEWEST:
        raise ValueError(f"{len(t)} samples are too few: give at least {Psi.shape[1] + FEWEST}")
    if not all(np.isfinite(each).all() for each in (t, z, sigma, Psi)):
        raise ValueError("a sample is not finite: leave it out")
    if (sigma <= 0.0).any():
        raise ValueError(f"sigma is {sigma.min():g} somewhere: it must be positive")
    if (np.diff(t) < 0.0).any() or t[-1] <= t[0]:
        raise ValueError("the times do not rise: sort the samples by time")
    if not 0.0 < false_alarm < 1.0 or looks < 1 or terms < 1:
        raise ValueError(
            f"false_alarm {false_alarm}, terms {terms}, looks {looks}: give a chance, and 1 or more"
        )
    return t, z / sigma, Psi / sigma.reshape(-1, 1)
