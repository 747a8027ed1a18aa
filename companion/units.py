"""Units shared by all packages: array type, nanoseconds per second, standard gravity, 0 degrees Celsius.

Inside the program everything is SI and radians; times are integer nanoseconds on one clock (`*_ns`).
"""

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
"""Array of float64; its shape, unit and frame are in the docstring of the function or field."""

SECOND_NS = 1_000_000_000
"""Nanoseconds in a second."""

G0 = 9.80665
"""Standard gravity, m/s^2: the unit behind g, milli-g and micro-g. Not the local gravity, see `nav.earth`."""

ZERO_CELSIUS = 273.15
"""0 degrees Celsius, K."""
