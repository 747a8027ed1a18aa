"""Bank of hypotheses: Gaussian-sum filter that decides which source of navigation is false.

Each row of the bank is one hypothesis: a linear Kalman filter (mean, covariance), a log weight, and a label
that states which fault is active since when. All rows are propagated and updated as one batch; the weight of
a row is multiplied by the likelihood of each innovation,

    L_i += ln N(nu_i; 0, S_i).

A false source is not left out by a row: the row carries the source's error (the "lie": offset and rate) as
states and goes on using the source. The price of being false is paid once, by the width of the lie's prior,
and the consistency of the lie earns it back.

    births     every few seconds the heaviest rows get children, each with one fault more, at the prior rate;
               jumps that are taken for something else until they are born, as those of the wind: every second
    deaths     a fault ends at a rate of its own: the child believes the source again
    returns    the first measurement of a source after silence bears children of its own ("captured")
    grades     rows differ in the amplitude of the channel's noise; the evidence selects
    reduction  onsets are kept about geometrically in age, rows of like weight merge by moments

Nothing here knows of records, units or of a particular error model: the caller brings Phi, Q, H, R. All
functions are pure, arrays are replaced and never written to, so an old `Bank` may be kept for roll-back.

What it does not know: measurement noise is white and stated by the caller (correlated errors need states);
nonlinear measurements are linearised by the caller, per row where the rows lie far apart.

References
----------
Blom, Bar-Shalom 1988 (interacting models); Willsky, Jones 1976 (jumps as hypotheses); Joerger, Pervan 2013
(protection levels from a sum over fault hypotheses).

Modules
-------
layout      sources, faults, jumps, and which state stands where
settings    number of rows, births, thresholds
state       the bank, and changes of its states by the caller
recursion   propagation and measurement update
branching   births, deaths, returns
reduction   which rows are kept
readout     estimate, probabilities, decisions
protection  protection level of a sum of Gaussians
"""

from companion.estimate.bank.branching import (
    apply_jump,
    births,
    births_due,
    false_since_first,
    heard_sources,
    jump_births,
    jump_births_due,
    jumped_before,
)
from companion.estimate.bank.layout import (
    NEVER,
    NO_DECAY_S,
    NONE,
    Angle,
    Bools,
    Fault,
    Ints,
    Jump,
    Layout,
    Lie,
    Source,
)
from companion.estimate.bank.protection import exceedance, level
from companion.estimate.bank.readout import (
    decide,
    estimate,
    explanations,
    false_probability,
    grade_probability,
    protection_level,
)
from companion.estimate.bank.recursion import Innovation, Measurement, on_circle, propagate, update
from companion.estimate.bank.reduction import merge_moments, reduce
from companion.estimate.bank.settings import EXHAUSTIVE, Settings
from companion.estimate.bank.state import (
    Bank,
    enlarge,
    families,
    inflate,
    is_sound,
    picked,
    renew,
    shift,
    start,
)

__all__ = [
    "EXHAUSTIVE",
    "NEVER",
    "NONE",
    "NO_DECAY_S",
    "Angle",
    "Bank",
    "Bools",
    "Fault",
    "Innovation",
    "Ints",
    "Jump",
    "Layout",
    "Lie",
    "Measurement",
    "Settings",
    "Source",
    "apply_jump",
    "births",
    "births_due",
    "decide",
    "enlarge",
    "estimate",
    "exceedance",
    "explanations",
    "false_probability",
    "false_since_first",
    "families",
    "grade_probability",
    "heard_sources",
    "inflate",
    "is_sound",
    "jump_births",
    "jump_births_due",
    "jumped_before",
    "level",
    "merge_moments",
    "on_circle",
    "picked",
    "propagate",
    "protection_level",
    "reduce",
    "renew",
    "shift",
    "start",
    "update",
]
