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
    readings             readings of a position whose errors may be correlated, iterated
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
function takes a time, it is in ns. Names are imported from their modules; `step`, `predict`, `update` and
`solve` exist in several and are reached through them, for example `kalman.update`.
"""
