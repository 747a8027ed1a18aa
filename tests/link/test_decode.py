"""Decoding of each message: fields, units, sentinels, NaN and invalid positions."""

import math
import pathlib
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion import records as r
from companion.importers import tlog
from companion.link import dialect, frame
from companion.link.clock import BootClock
from companion.link.decode import UERE, Autopilot, Sender, decode
from companion.link.dialect import mavlink
from companion.units import G0
from tests.frames import on_wire

CUT = (pathlib.Path(__file__).parents[1] / "data" / "dronekit_copter_cut.tlog").read_bytes()
RX = 1_000_000_000_000
BOOT = RX - 200_000_000_000
NAN, INF = math.nan, math.inf
LAT, LON = -353_623_294, 1_491_657_228


class BootedAt:
    def local(self, stamp: int, received: int) -> int:
        return BOOT + stamp if stamp else received


def decoded(name: str, autopilot: Autopilot = "ardupilot", **fields: Any) -> tuple[r.Stamped, ...]:
    found = on_wire(dialect.new(name, **fields), 1, 1)
    return decode(dialect.decode(found), RX, Sender(BootedAt(), autopilot))


def one(name: str, autopilot: Autopilot = "ardupilot", **fields: Any) -> Any:
    (record,) = decoded(name, autopilot, **fields)
    return record


FIX: dict[str, Any] = {"time_usec": 77_228_000, "fix_type": 3, "lat": LAT, "lon": LON, "alt": 588_590}


def test_a_full_fix() -> None:
    fix = one(
        "GPS_RAW_INT",
        **FIX,
        eph=121,
        epv=200,
        vel=1729,
        cog=9000,
        satellites_visible=12,
        alt_ellipsoid=610_123,
        h_acc=300,
        v_acc=450,
        vel_acc=120,
    )
    assert isinstance(fix, r.Gnss)
    assert (fix.t_ns, fix.rx_ns, fix.stamp_us) == (BOOT + 77_228_000_000, RX, 77_228_000)
    assert (fix.receiver, fix.fix, fix.satellites) == (0, 3, 12)
    assert (math.degrees(fix.lat), math.degrees(fix.lon)) == pytest.approx((-35.3623294, 149.1657228))
    assert (fix.alt_msl, fix.alt, fix.hdop) == pytest.approx((588.59, 610.123, 1.21))
    assert (fix.sigma_horizontal, fix.sigma_vertical, fix.sigma_velocity) == pytest.approx((0.3, 0.45, 0.12))
    assert fix.v_n == pytest.approx((0.0, 17.29, 0.0), abs=1e-12)


@pytest.mark.parametrize("ellipsoid", [0, 2**31 - 1, -(2**31)])
def test_a_height_above_the_ellipsoid_that_is_none_is_left_out(ellipsoid: int) -> None:
    assert one("GPS_RAW_INT", **FIX, alt_ellipsoid=ellipsoid).alt is None


def test_second_receiver_has_its_own_number() -> None:
    assert one("GPS2_RAW", **FIX).receiver == 1


def test_dilution_is_used_where_no_accuracy_is_given() -> None:
    """HDOP covers both axes: two equal axes of UERE x HDOP / sqrt 2 add up to it."""
    fix = one("GPS_RAW_INT", **FIX, eph=200, epv=300, vel=0xFFFF, h_acc=0xFFFFFFFF)
    assert math.hypot(fix.sigma_horizontal, fix.sigma_horizontal) == pytest.approx(2.0 * UERE)
    assert fix.sigma_vertical == pytest.approx(3.0 * UERE)


@pytest.mark.parametrize(
    ("fields", "absent"),
    [
        ({"vel": 0xFFFF}, "v_n"),
        ({"vel": 100, "cog": 0xFFFF}, "v_n"),
        ({"satellites_visible": 255}, "satellites"),
        ({"eph": 0xFFFF}, "hdop"),
        ({"eph": 9999}, "hdop"),
        ({"eph": 0xFFFF, "h_acc": 0}, "sigma_horizontal"),
        ({"epv": 0xFFFF, "v_acc": 0xFFFFFFFF}, "sigma_vertical"),
        ({"vel_acc": 0}, "sigma_velocity"),
        ({"alt_ellipsoid": 0}, "alt"),
    ],
)
def test_unknown_values_of_a_receiver_are_absent(fields: dict[str, int], absent: str) -> None:
    assert getattr(one("GPS_RAW_INT", **FIX, **fields), absent) is None


def test_lost_fix_is_decoded_without_a_position() -> None:
    fix = one("GPS_RAW_INT", fix_type=1, eph=9999, epv=0xFFFF)
    assert (fix.fix, fix.lat, fix.lon, fix.v_n) == (1, 0.0, 0.0, None)
    assert fix.t_ns == RX  # time 0 is "unknown"


STAR: dict[str, Any] = {"altitude": 0.7, "azimuth": NAN, "sigma_altitude": 1e-4}
LINE: dict[str, Any] = {"a_lat": 600_000_000, "b_lat": 580_000_000, "difference": 1e4, "sigma": 50.0}
REJECTED: list[tuple[str, dict[str, Any], str]] = [
    ("GPS_RAW_INT", FIX | {"lat": 0, "lon": 0}, "no position yet"),
    ("GPS_RAW_INT", FIX | {"lat": 900_000_001}, "lat 90 deg is outside"),
    ("GPS_RAW_INT", FIX | {"lon": -1_800_000_001}, "lon -180 deg is outside"),
    ("GPS_GLOBAL_ORIGIN", {"latitude": 0x7FFFFFFF, "longitude": 1}, "latitude 214"),
    ("HOME_POSITION", {}, "no position yet"),
    ("GLOBAL_POSITION_INT", {"alt": 90}, "no position yet"),
    ("GLOBAL_POSITION_INT", {"lat": -1460, "lon": -7465}, "reckons from latitude and longitude 0"),
    ("LOCAL_POSITION_NED", {"y": NAN}, "y is nan"),
    ("LOCAL_POSITION_NED", {"vz": -INF}, "vz is -inf"),
    ("ATTITUDE", {"yaw": INF}, "yaw is inf"),
    ("ATTITUDE_QUATERNION", {}, "length 0"),
    ("ATTITUDE_QUATERNION", {"q1": NAN}, "q1 is nan"),
    ("HIGHRES_IMU", {"fields_updated": 63, "zgyro": NAN}, "zgyro is nan"),
    ("AIRSPEED", {"airspeed": NAN, "flags": 2}, "airspeed is nan"),
    ("WIND", {"direction": NAN}, "direction is nan"),
    ("WIND_COV", {"wind_x": NAN}, "wind_x is nan"),
    ("SCALED_PRESSURE", {"press_abs": INF}, "press_abs is inf"),
    ("EKF_STATUS_REPORT", {"pos_horiz_variance": NAN}, "is nan"),
    ("SIM_STATE", {"lat_int": LAT, "lon_int": LON, "vn": NAN}, "vn is nan"),
    ("HIL_STATE_QUATERNION", {"lat": LAT, "lon": LON, "attitude_quaternion": [NAN] * 4}, "length nan"),
    ("RSBN_MEASUREMENT", {"status": 3 | 4, "azimuth": 1.0}, "test signal"),
    ("RSBN_MEASUREMENT", {"status": 3 | 8, "azimuth": 1.0}, "repeats its last answer"),
    ("RSBN_MEASUREMENT", {"status": 0, "azimuth": 1.0, "slant_range": 1.0}, "neither azimuth nor range"),
    ("RSBN_MEASUREMENT", {"status": 1, "azimuth": 57.3}, "not an angle in radians"),
    ("RSBN_MEASUREMENT", {"status": 2, "slant_range": -5.0}, "not positive"),
    (
        "RSBN_MEASUREMENT",
        {"status": 2, "slant_range": 5e3, "sigma_range": -1.0, "beacon_lat": LAT},
        "sigma_range -1",
    ),
    ("RSBN_MEASUREMENT", {"status": 1, "azimuth": 1.0, "beacon_lat": 10**9}, "beacon_lat 100 deg"),
    ("RSBN_MEASUREMENT", {"status": 1, "azimuth": 1.0}, "beacon_lat and beacon_lon are 0"),
    ("STAR_FIX", STAR | {"altitude": 45.0}, "altitude 45 is beyond the limit 1.57"),
    ("STAR_FIX", STAR | {"azimuth": 200.0}, "not an angle in radians"),
    ("STAR_FIX", STAR | {"sigma_altitude": 0.0}, "sigma_altitude 0 is not positive"),
    ("STAR_FIX", STAR | {"zenith_lat": 10**9}, "zenith_lat 100 deg"),
    ("RANGE_DIFFERENCE", LINE | {"sigma": NAN}, "sigma is nan"),
    ("RANGE_DIFFERENCE", LINE | {"b_lat": LINE["a_lat"]}, "at one place"),
    ("RANGE_DIFFERENCE", LINE | {"difference": 1e9}, "difference 1e+09 is beyond the limit"),
    ("SECOND_INS_POSITION", {}, "no position yet"),
]


@pytest.mark.parametrize(("name", "fields", "reason"), REJECTED)
def test_unusable_message_is_rejected_with_name_and_reason(
    name: str, fields: dict[str, Any], reason: str
) -> None:
    rejection = one(name, **fields)
    assert isinstance(rejection, r.Rejection)
    assert (rejection.source, rejection.t_ns) == (name, RX)
    assert reason in rejection.reason


def test_positions_and_velocities() -> None:
    assert one("LOCAL_POSITION_NED", time_boot_ms=500, x=1, y=2, z=-3, vx=4, vy=5, vz=6) == r.LocalPosition(
        BOOT + 500_000_000, RX, (1.0, 2.0, -3.0), (4.0, 5.0, 6.0)
    )
    known = one(
        "GLOBAL_POSITION_INT", time_boot_ms=500, lat=LAT, lon=LON, alt=9, relative_alt=-7, vx=-5, hdg=35997
    )
    assert known.v_n == pytest.approx((-0.05, 0.0, 0.0))
    assert (known.alt_msl, known.height_above_home) == pytest.approx((0.009, -0.007))
    assert known.heading == pytest.approx(math.radians(359.97))
    assert one("GLOBAL_POSITION_INT", lat=LAT, hdg=0xFFFF).heading is None


@pytest.mark.parametrize(
    ("autopilot", "projection"), [("ardupilot", "ardupilot"), ("px4", "px4"), ("other", "tangent")]
)
def test_origin_has_the_projection_of_its_autopilot(autopilot: Autopilot, projection: str) -> None:
    origin = one("GPS_GLOBAL_ORIGIN", autopilot, latitude=LAT, longitude=LON, altitude=150_100)
    assert (origin.projection, origin.alt_msl) == (projection, pytest.approx(150.1))


def test_both_attitudes_agree() -> None:
    """Aerospace sequence: heading 270 degrees, then pitch 30, then roll -20, made by half angles."""
    roll, pitch, yaw = math.radians(-20), math.radians(30), math.radians(-90)
    (sr, cr), (sp, cp), (sy, cy) = ((math.sin(a / 2), math.cos(a / 2)) for a in (roll, pitch, yaw))
    q = {
        "q1": cr * cp * cy + sr * sp * sy,
        "q2": sr * cp * cy - cr * sp * sy,
        "q3": cr * sp * cy + sr * cp * sy,
        "q4": cr * cp * sy - sr * sp * cy,
    }
    rates = {"rollspeed": 0.5, "pitchspeed": 0.25, "yawspeed": -0.5}
    by_angles = one("ATTITUDE", roll=roll, pitch=pitch, yaw=yaw, **rates)
    by_quaternion = one("ATTITUDE_QUATERNION", **q, **rates)
    assert by_angles.heading == pytest.approx(math.radians(270))
    assert by_angles.w_b == by_quaternion.w_b == (0.5, 0.25, -0.5)
    for name in ("roll", "pitch", "heading"):
        assert getattr(by_quaternion, name) == pytest.approx(getattr(by_angles, name), abs=1e-6)
    assert one("ATTITUDE", rollspeed=NAN).w_b is None


def test_highres_imu_gives_the_updated_fields_only() -> None:
    fields = {"zacc": -9.75, "xgyro": 0.5, "abs_pressure": 995.0, "diff_pressure": 1.5, "temperature": 15.0}
    pressure, imu = decoded("HIGHRES_IMU", "px4", time_usec=5000, id=2, fields_updated=6719 | 0x400, **fields)
    assert imu == r.Imu(BOOT + 5_000_000, RX, 2, (0.0, 0.0, -9.75), (0.5, 0.0, 0.0))
    assert pressure == r.Pressure(BOOT + 5_000_000, RX, 99_500.0, 150.0, 288.15)
    assert decoded("HIGHRES_IMU", fields_updated=0x1C0) == ()
    assert [type(x) for x in decoded("HIGHRES_IMU", fields_updated=63)] == [r.Imu]
    assert decoded("HIGHRES_IMU", fields_updated=6719)[0].differential is None  # type: ignore[attr-defined]


def test_scaled_units_are_thousandths() -> None:
    for source, name in enumerate(("SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3")):
        imu = one(name, zacc=-1000, ygyro=250)
        assert imu.source == source
        assert imu.f_b == pytest.approx((0.0, 0.0, -G0))
        assert imu.w_b == pytest.approx((0.0, 0.25, 0.0))
    assert decoded("SCALED_IMU3", xmag=34) == ()


def test_raw_imu_is_decoded_for_ardupilot_only() -> None:
    assert one("RAW_IMU", "ardupilot", zacc=-1000).f_b == pytest.approx((0.0, 0.0, -G0))
    assert decoded("RAW_IMU", "px4", zacc=-1000) == decoded("RAW_IMU", "other", zacc=-1000) == ()


def test_air_and_wind() -> None:
    air = one("VFR_HUD", airspeed=25.0, groundspeed=NAN, heading=90, climb=-1.5, alt=600.0)
    assert air == r.AirData(RX, RX, 25.0, False, None, -1.5, math.radians(90), 600.0)
    assert decoded("VFR_HUD", airspeed=NAN) == ()
    # From the north-east at 13, rising at 5: 12 level, towards the south-west.
    blown = one("WIND", direction=45.0, speed=13.0, speed_z=-5.0)
    assert blown.v_n == pytest.approx((-12 / math.sqrt(2), -12 / math.sqrt(2), -5.0))
    assert one("WIND_COV", "px4", wind_y=3.0, var_horiz=0.5).sigma == pytest.approx(0.5)
    assert one("WIND_COV", "other", wind_y=3.0, var_horiz=0.5).sigma is None
    assert one("WIND_COV", "other", horiz_accuracy=0.75).sigma == 0.75


def test_airspeed_message_is_of_a_sensor_and_tells_its_health() -> None:
    sensor, air = decoded("AIRSPEED", airspeed=25.0, flags=2)
    assert sensor == r.AirspeedSensor(RX, RX, True)
    assert air == r.AirData(RX, RX, 25.0, sensed=True)
    assert decoded("AIRSPEED", airspeed=63.5, flags=1) == (r.AirspeedSensor(RX, RX, False),)
    assert decoded("AIRSPEED", id=1, airspeed=8.0, flags=0) == ()  # of two sensors the one that is not used
    assert decoded("AIRSPEED", id=1, airspeed=25.0, flags=2) == (sensor, air)
    assert decoded("AIRSPEED", airspeed=8.0, flags=0) == (sensor,)  # nor is the first one where that is it
    assert one("VFR_HUD", airspeed=25.0).sensed is None  # it may be the estimator's own number


@pytest.mark.parametrize(
    ("present", "enabled", "health", "healthy"),
    [
        (16, 16, 16, True),
        (0xFFFF, 0x3F, 0x1F, True),
        (16, 16, 0, False),
        (16, 0, 16, False),
        (0, 16, 16, False),
    ],
)
def test_airspeed_sensor_is_healthy_only_if_present_enabled_and_healthy(
    present: int, enabled: int, health: int, healthy: bool
) -> None:
    bits = {"present": present, "enabled": enabled, "health": health}
    status = one("SYS_STATUS", **{f"onboard_control_sensors_{name}": value for name, value in bits.items()})
    assert status == r.AirspeedSensor(RX, RX, healthy, healthy if present else None)


@pytest.mark.parametrize(
    ("jamming", "spoofing", "threatened"),
    [(0, 0, False), (1, 1, False), (2, 1, True), (3, 0, True), (1, 2, True), (0, 3, True)],
)
def test_receivers_own_integrity(jamming: int, spoofing: int, threatened: bool) -> None:
    """Of both states 0 is unknown, 1 none, 2 mitigated, 3 detected."""
    state = one("GNSS_INTEGRITY", id=1, jamming_state=jamming, spoofing_state=spoofing)
    assert state == r.GnssIntegrity(RX, RX, 1, jamming, spoofing)
    assert state.threatened is threatened


def test_gps_glitch_has_a_different_bit_for_each_filter() -> None:
    assert one("EKF_STATUS_REPORT", flags=831 | 32768).gnss_glitch
    assert not one("EKF_STATUS_REPORT", flags=1024).gnss_glitch
    status = one("ESTIMATOR_STATUS", "px4", flags=1024, pos_horiz_ratio=NAN, pos_horiz_accuracy=30.5)
    assert (status.gnss_glitch, status.position_ratio, status.horizontal_accuracy) == (True, 0.0, 30.5)
    assert one("ESTIMATOR_STATUS", "ardupilot", pos_horiz_accuracy=0.5).horizontal_accuracy is None


def test_system_time_before_a_fix_is_boot_time_alone() -> None:
    assert one("SYSTEM_TIME", time_boot_ms=5).unix_ns is None
    unix = one("SYSTEM_TIME", time_boot_ms=5, time_unix_usec=1_436_056_227_521_000)
    assert (unix.boot_ns, unix.unix_ns) == (5_000_000, 1_436_056_227_521_000_000)


def test_rsbn_uses_the_values_flagged_as_valid() -> None:
    fields = {"time_usec": 1000, "beacon_id": 7, "beacon_lat": LAT, "beacon_lon": LON, "beacon_alt": 600.0}
    values = {"azimuth": 1.25, "slant_range": 5e4, "sigma_azimuth": 0.0078125, "sigma_range": 150.0}
    both = one("RSBN_MEASUREMENT", status=3, **fields, **values)
    assert (both.t_ns, both.beacon, both.azimuth, both.slant_range) == (BOOT + 1_000_000, 7, 1.25, 5e4)
    assert (both.sigma_azimuth, both.sigma_range, both.alt) == (0.0078125, 150.0, 600.0)
    assert one("RSBN_MEASUREMENT", status=1, **fields, **values).slant_range is None
    assert one("RSBN_MEASUREMENT", status=2, **fields, **values).azimuth is None
    assert one("RSBN_MEASUREMENT", status=3, **fields, **values | {"azimuth": NAN}).azimuth is None
    configured = one("RSBN_MEASUREMENT", status=3, **fields, **values | {"sigma_range": NAN})
    assert configured.sigma_range == Sender(BootedAt()).sigma_range


def test_truth_uses_the_integer_position() -> None:
    state = one("SIM_STATE", lat=557500032.0, lat_int=557_500_000, lon_int=376_099_976, yaw=-1.0, vd=-2.0)
    assert math.degrees(state.lat) == pytest.approx(55.75, abs=1e-12)
    assert state.attitude == pytest.approx((0.0, 0.0, math.tau - 1.0))
    turned = one("HIL_STATE_QUATERNION", lat=LAT, lon=LON, attitude_quaternion=[-1.0, 0, 0, 0], vx=-50)
    assert (turned.v_n, turned.attitude) == ((-0.5, 0.0, 0.0), (0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("autopilot", "kind", "status", "multirotor", "flying", "fixed_wing"),
    [
        ("ardupilot", "QUADROTOR", "ACTIVE", True, True, False),
        ("ardupilot", "HEXAROTOR", "STANDBY", True, False, False),
        ("ardupilot", "QUADROTOR", "BOOT", True, False, False),
        ("ardupilot", "OCTOROTOR", "CRITICAL", True, None, False),  # a failsafe, on the ground or not
        ("px4", "QUADROTOR", "ACTIVE", True, None, False),  # armed, perhaps on the ground
        ("ardupilot", "FIXED_WING", "ACTIVE", False, True, True),
        ("ardupilot", "FIXED_WING", "STANDBY", False, False, True),  # armed or not
        ("ardupilot", "FIXED_WING", "CRITICAL", False, None, True),
        ("px4", "FIXED_WING", "ACTIVE", False, None, True),  # armed, perhaps on the ground
        ("ardupilot", "HELICOPTER", "ACTIVE", False, None, False),
        ("px4", "VTOL_QUADROTOR", "ACTIVE", False, None, True),
    ],
)
def test_heartbeat_states_the_kind_of_vehicle(
    autopilot: Autopilot, kind: str, status: str, multirotor: bool, flying: bool | None, fixed_wing: bool
) -> None:
    fields = {
        "type": getattr(mavlink, f"MAV_TYPE_{kind}"),
        "system_status": getattr(mavlink, f"MAV_STATE_{status}"),
    }
    assert one("HEARTBEAT", autopilot, **fields) == r.Vehicle(RX, RX, multirotor, flying, fixed_wing)


@pytest.mark.parametrize("mode", ["QSTABILIZE", "QHOVER", "QLOITER", "QLAND", "QRTL", "QACRO"])
def test_a_quadplane_that_hovers_does_not_fly_by_its_wing(mode: str) -> None:
    """Its HEARTBEAT has the type of a fixed wing (ArduPlane, Q_MAV_TYPE 0) and it is active."""
    fields = {"type": mavlink.MAV_TYPE_FIXED_WING, "system_status": mavlink.MAV_STATE_ACTIVE}
    hovering = one("HEARTBEAT", **fields, custom_mode=getattr(mavlink, f"PLANE_MODE_{mode}"))
    assert (hovering.flying, hovering.fixed_wing) == (True, False)
    assert one("HEARTBEAT", **fields, custom_mode=mavlink.PLANE_MODE_FLY_BY_WIRE_A).fixed_wing


@pytest.mark.parametrize(("landed", "flying"), [(1, False), (2, True), (3, True), (4, True)])
def test_landed_state(landed: int, flying: bool) -> None:
    assert one("EXTENDED_SYS_STATE", landed_state=landed) == r.Vehicle(RX, RX, flying=flying)
    assert decoded("EXTENDED_SYS_STATE", landed_state=0) == ()


@pytest.mark.parametrize(("vtol", "hovering"), [(0, None), (1, True), (2, True), (3, True), (4, False)])
def test_vtol_state(vtol: int, hovering: bool | None) -> None:
    """Only as an aeroplane (4) does it fly by its wing; 0: it is no VTOL."""
    assert one("EXTENDED_SYS_STATE", landed_state=2, vtol_state=vtol).hovering is hovering


def test_other_messages_give_no_record() -> None:
    assert decoded("STATUSTEXT", text="hello") == decoded("PING") == ()


READ = sorted({name for name, _, _ in REJECTED} | {"RAW_IMU", "SCALED_IMU", "VFR_HUD", "ESTIMATOR_STATUS"})


@settings(max_examples=300)
@given(st.sampled_from(READ), st.binary(max_size=255), st.sampled_from(["ardupilot", "px4", "other"]))
def test_no_payload_raises_and_every_record_survives_the_log(
    name: str, payload: bytes, autopilot: Autopilot
) -> None:
    msgid = dialect.type_named(name).msgid
    message = dialect.decode(frame.Frame(msgid, payload, 0, 1, 1, None, b""))
    for record in decode(message, RX, Sender(BootClock(), autopilot)):
        assert r.DECODERS[type(record).__name__].decode(r.encode(record)) == record


def test_real_flight_decodes_to_its_known_values() -> None:
    """A copter on the ground near Canberra: gravity in the accelerometers, the right place and pressure."""
    clock = BootClock()
    records: dict[type[r.Stamped], list[Any]] = {}
    for rx_ns, found in tlog.Tlog(CUT):
        message = dialect.decode(found)
        if found.msgid == 30:
            clock.update(message.time_boot_ms * 1_000_000, rx_ns)
        for record in decode(message, rx_ns, Sender(clock, "ardupilot")):
            records.setdefault(type(record), []).append(record)
    for imu in records[r.Imu]:
        assert math.hypot(*imu.f_b) == pytest.approx(G0, rel=0.05)
    fixes = [fix for fix in records[r.Gnss] if fix.has_3d_fix]
    assert fixes
    for fix in fixes:
        assert math.degrees(fix.lat) == pytest.approx(-35.3623, abs=1e-3)
        assert math.degrees(fix.lon) == pytest.approx(149.1657, abs=1e-3)
        assert 1.0 < fix.sigma_horizontal < 20.0
    assert all(95_000 < pressure.static < 96_000 for pressure in records[r.Pressure])
