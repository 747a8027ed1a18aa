"""Navigation companion: keeps an aircraft's position, and a guaranteed bound on it, when GNSS is gone.

Data
    A *record* (`companion.records`) is an immutable value in SI units and radians, stamped with the time
    it is valid for and the time it arrived. A *message* is MAVLink. A *frame* is a message's bytes.
    An *error* is always computed minus true: `error = INS - truth`, so `corrected = INS - error`.

Frames
    n   local level, north-east-down (NED), at the aircraft's own geodetic position
    b   body, forward-right-down
    e   earth-centred, earth-fixed (WGS84)
    i   inertial
    Papers with x east, y north keep their order inside their own module and say so.
    An azimuth is counted from true north clockwise, at the beacon, towards the aircraft.

Names
    v_n     a vector in frame n            C_nb    rotation that takes b to n (v_n = C_nb v_b)
    lat, lon, alt   geodetic radians and metres above the WGS84 ellipsoid unless a name says `msl`
    sigma_x one standard deviation of x    *_deg   degrees: only on the wire, in configuration, in reports
    t_ns    integer nanoseconds on the companion's one monotonic clock; durations are float seconds

Map
    records     every value that flows                      config    what the operator may set
    link/       bytes <-> messages (no clock, no sockets but in `transport`)
    wire        messages <-> records                        navigator records -> records (pure)
    profiles    which message feeds which autopilot         feed      what of a solution goes to it
    nav/        the physics: earth, strapdown, error model, beacons
    estimate/   the mathematics: fusion, minimax, kalman, restrictive, schemes, smoother, polynomial
    log/        MCAP files, replay                          service   the asyncio shell
"""

__version__ = "0.1.0"
