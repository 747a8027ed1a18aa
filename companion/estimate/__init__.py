"""Estimation: filters, smoothers, maximum-likelihood fixes, minimax prediction, and fault monitoring.

Linear filtering
    kalman               predict, update, consistency tests; the one implementation of the update
    schemes              feedforward and feedback correction of an INS
    linear_system        a linear Gaussian system as a list of stages
    smoother             Rauch-Tung-Striebel and two-point smoothing
    two_point_bvp        block-tridiagonal solver of the two-point boundary value problem
Bounded disturbances
    restrictive          filter with bounded inputs, one step at a time
    bounded_lsq          least squares in a box
Positions from beacons
    observations         positions, azimuths, ranges and heights as whitened equations
    initial_position     intersections of lines of position
    levenberg_marquardt  minimisation in two or three unknowns
    fusion               maximum-likelihood position and its covariance
    weights              best coefficients for readings of known errors, and departures from them
Guaranteed prediction
    schuler              dynamics of one horizontal INS error
    minimax_lp           guaranteed linear estimation by exchange
    minimax              closed form on the Schuler channel
    predictor            window of fixes, and the guaranteed error of linear estimates from it
Curves
    polynomial           approximation of an unknown function, and its order
Faults
    bank                 bank of hypotheses: which source is false, and the protection level

SI and radians, unless a name ends in `_tau` (radians of Schuler phase). numpy and scipy only, no I/O; where a
function takes a time, it is in ns. `step`, `predict`, `update` and `solve` exist in several modules and are
reached through them, for example `kalman.update`.
"""

from companion.estimate import (
    bank,
    bounded_lsq,
    kalman,
    minimax_lp,
    predictor,
    restrictive,
    schemes,
    smoother,
    two_point_bvp,
    weights,
)
from companion.estimate.fusion import (
    Ambiguous,
    Azimuth,
    Fix,
    Height,
    NoFix,
    Observation,
    Position,
    Range,
    Unobservable,
    maximum_likelihood,
)
from companion.estimate.kalman import Gaussian
from companion.estimate.minimax import ClosedForm, Continuous, closed_form, closed_form_tau, continuous_tau
from companion.estimate.minimax_lp import Design, Infeasible, LeastSquares, Minimax
from companion.estimate.polynomial import Order, Track, select_order, smooth_track
from companion.estimate.predictor import Anchored, Estimate, Program, Target, Window, anchor
from companion.estimate.schuler import MEAN_EARTH, Scale, schuler_row, transition
from companion.estimate.smoother import (
    Smoothed,
    forward_filter,
    rts,
    rts_backward,
    two_point,
)

__all__ = [
    "MEAN_EARTH",
    "Ambiguous",
    "Anchored",
    "Azimuth",
    "ClosedForm",
    "Continuous",
    "Design",
    "Estimate",
    "Fix",
    "Gaussian",
    "Height",
    "Infeasible",
    "LeastSquares",
    "Minimax",
    "NoFix",
    "Observation",
    "Order",
    "Position",
    "Program",
    "Range",
    "Scale",
    "Smoothed",
    "Target",
    "Track",
    "Unobservable",
    "Window",
    "anchor",
    "bank",
    "bounded_lsq",
    "closed_form",
    "closed_form_tau",
    "continuous_tau",
    "forward_filter",
    "kalman",
    "maximum_likelihood",
    "minimax_lp",
    "predictor",
    "restrictive",
    "rts",
    "rts_backward",
    "schemes",
    "schuler_row",
    "select_order",
    "smooth_track",
    "smoother",
    "transition",
    "two_point",
    "two_point_bvp",
    "weights",
]
