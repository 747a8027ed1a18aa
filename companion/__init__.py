"""Navigation companion: position of an aircraft during GNSS outages, with a guaranteed error bound.

Data
    A *record* (`companion.records`) is an immutable value in SI units and radians, stamped with the time
    it is valid for and the time it arrived. A *message* is MAVLink. A *frame* is a message's bytes.
    An *error* is computed minus true: `error = INS - truth`, so `corrected = INS - error`.

Frames
    n   local level, north-east-down (NED), at the aircraft's own geodetic position
    b   body, forward-right-down
    e   earth-centred, earth-fixed (WGS84)
    i   inertial
    A module after a paper with x east, y north keeps that order and states it.
    An azimuth is measured at the beacon, clockwise from true north, towards the aircraft.

Names
    v_n     a vector in frame n            C_nb    rotation from b to n (v_n = C_nb v_b)
    lat, lon, alt   geodetic, radians and metres above the WGS84 ellipsoid; *_msl above mean sea level
    sigma_x one standard deviation of x    *_deg   degrees: in messages, configuration and reports only
    t_ns    integer nanoseconds on the companion's monotonic clock; durations are float seconds

Packages
    records     data types that flow between packages     units       units and constants
    plausibility  limits of the numbers in a record
    config/     configuration and output profiles         transport/  serial, UDP and TCP connections
    link/       MAVLink: frames, sessions, decoding       nav/        earth, geometry, INS error model
    estimate/   Kalman, minimax, maximum likelihood       navigator/  records in, solutions out; no I/O
    output/     gate and messages to the autopilot        runtime/    core without I/O, asyncio service
    storage/    MCAP flight logs                          importers/  tlog, dataflash, ulog
    analysis/   replay, assessment, report                doctor/     check of the autopilot's configuration
    study/      numerical studies                         bench/      benchmarks
    The package `sitl` beside this one has the simulator, the loopback and the campaigns.

    bytes -> link -> records -> navigator -> solutions -> output -> link -> bytes. The log stores inputs and
    outputs; a replay of the inputs gives the same outputs bit for bit.
"""

__version__ = "0.2.0"
