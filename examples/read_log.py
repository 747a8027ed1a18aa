"""Read a log: print the error of the estimate against the truth once a minute of flight.

python examples/read_log.py LOG.mcap
"""

import math
import sys

from companion.nav.geometry import Geodetic, separation
from companion.records import Solution, Truth
from companion.storage import flight_log

if len(sys.argv) != 2:
    sys.exit("usage: python examples/read_log.py LOG.mcap")
truth = start_ns = None
next_ns = 0
for entry in flight_log.read(sys.argv[1]):
    record = entry.value
    if isinstance(record, Truth):
        truth = Geodetic(record.lat, record.lon, record.alt)
    elif isinstance(record, Solution) and truth is not None and record.t_ns >= next_ns:
        next_ns = record.t_ns + 60_000_000_000
        start_ns = record.t_ns if start_ns is None else start_ns
        north, east, _ = separation(Geodetic(record.lat, record.lon, truth.alt), truth)
        sigma = math.sqrt(record.covariance[0] + record.covariance[3])
        error = math.hypot(north, east)
        minutes = (record.t_ns - start_ns) / 60e9
        print(f"{minutes:6.1f} min {record.mode:11} error {error:7.1f} m, sigma {sigma:.1f} m")
