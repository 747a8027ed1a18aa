"""Guaranteed prediction of an INS on the Schuler channel: how far off can it be after GNSS is lost?

The bound is the worst r.m.s. error over every correlation of the fixes' errors (Matasov, Martirosyan, 1997).
"""

from companion.estimate.minimax import closed_form

WINDOW_S, SIGMA_M = 15 * 60.0, 30.0  # 30 m fixes for a quarter of an hour

print("ahead, min   position, m   velocity, m/s")
for minutes in (1, 5, 10, 20):
    position, _, velocity, _ = closed_form(WINDOW_S, 60.0 * minutes, SIGMA_M).bounds
    print(f"{minutes:10d}   {position:11.1f}   {velocity:13.3f}")
