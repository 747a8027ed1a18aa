"""Encoding by the simulated autopilot and decoding by the companion agree to the rounding of the messages."""

import math

import pytest

from companion import records as r
from companion.link import dialect
from companion.link.decode import Autopilot, Sender, decode
from sitl.encode import SimulatedSender, encode
from tests.frames import on_wire

BOOT = 5_000_000_000
T = BOOT + 123_456_000_000
LAT, LON = math.radians(-35.3627085), math.radians(149.1656122)
RX = T + 7


class BootedAt:
    def local(self, stamp: int, received: int) -> int:
        return BOOT + stamp if stamp else received


def encode_and_decode(record: r.Stamped, autopilot: Autopilot) -> tuple[r.Stamped, ...]:
    found = on_wire(encode(record, SimulatedSender(autopilot, BOOT)), 1, 1)
    return decode(dialect.decode(found), RX, Sender(BootedAt(), autopilot))


IMU = r.Imu(T, RX, 0, (0.5, -0.25, -9.75), (0.125, -0.0625, 0.25))
RECORDS = {
    "imu": IMU,
    "imu 1": r.Imu(T, RX, 1, (0.5, -0.25, -9.75), (0.125, -0.0625, 0.25)),
    "attitude": r.Attitude(T, RX, 0.1, -0.2, 6.0, (0.01, 0.02, 0.03)),
    "attitude without rates": r.Attitude(T, RX, 0.1, -0.2, 1.0),
    "gnss": r.Gnss(
        T, RX, 0, 123_456_000, 3, LAT, LON, 588.59, 1.5, 2.5, (10.0, -5.0, 0.0), 0.3, 11, 0.9, 610.0
    ),
    "second gnss, bare": r.Gnss(T, RX, 1, 123_456_000, 1, LAT, LON, 588.59),
    "local position": r.LocalPosition(T, RX, (1234.5, -987.25, -100.0), (20.0, -3.0, 0.5)),
    "home": r.HomePosition(T, RX, LAT, LON, 588.59),
    "global position": r.GlobalPosition(T, RX, LAT, LON, 588.59, (20.0, -3.25, 0.5), 12.345, 4.5),
    "global position without heading": r.GlobalPosition(T, RX, LAT, LON, 588.59, (20.0, -3.25, 0.5), 12.345),
    "air data": r.AirData(RX, RX, 25.5, False, 24.0, -1.5, math.radians(90.0), 600.0),
    "airspeed sensor": r.AirspeedSensor(RX, RX, True, True),
    "no airspeed sensor": r.AirspeedSensor(RX, RX, False),
    "wind": r.Wind(RX, RX, (-7.0, 3.0, 0.5)),
    "pressure": r.Pressure(T, RX, 95_552.5, 125.0, 298.15),
    "filter status": r.FilterStatus(RX, RX, 831 | 32768, True, 0.07),
    "system time": r.SystemTime(T, RX, 123_456_000_000, 1_795_231_211_919_574_000),
    "system time before a fix": r.SystemTime(T, RX, 123_456_000_000),
    "rsbn": r.RsbnFix(T, RX, 7, LAT, LON, 600.0, 1.25, 54321.0, 0.004, 200.0),
    "rsbn azimuth": r.RsbnFix(T, RX, 7, LAT, LON, 600.0, 1.25, None, 0.004, 200.0),
    "rsbn range": r.RsbnFix(T, RX, 7, LAT, LON, 600.0, None, 54321.0, 0.004, 200.0),
    "star": r.StarFix(T, RX, 3, LAT, LON, 0.75, 2.5, 1e-4, 1.5e-4),
    "star without azimuth": r.StarFix(T, RX, 3, LAT, LON, 0.75, None, 1e-4, math.tau),
    "line of position": r.RangeDifference(T, RX, 1, LAT, LON, 50.0, LAT + 0.01, LON, 60.0, -12345.0, 50.0),
    "second ins": r.SecondIns(T, RX, 2, LAT, LON),
    "truth": r.Truth(RX, RX, LAT, LON, 600.0, (20.0, -3.0, 0.5), (0.1, -0.2, 6.0)),
}
PX4_RECORDS = {
    "imu": IMU,
    "wind": r.Wind(T, RX, (-7.0, 3.0, 0.5), 0.75),
    "filter status": r.FilterStatus(T, RX, 831 | 1024, True, 0.07, 30.5),
    "truth": r.Truth(T, RX, LAT, LON, 600.0, (20.0, -3.0, 0.5), (0.1, -0.2, 6.0)),
}


#: Half the resolution of integer fields (mG, mrad/s, mm, cm/s, cdeg); floats have single precision.
HALF_STEP = {r.Imu: 5e-3, r.Gnss: 5.1e-3, r.GlobalPosition: 5.1e-3, r.Pressure: 5.1e-3}


def assert_close(decoded: object, record: object, half_step: float) -> None:
    if isinstance(record, tuple):
        for one, other in zip(decoded, record, strict=True):  # type: ignore[call-overload]
            assert_close(one, other, half_step)
    elif isinstance(record, float):
        assert decoded == pytest.approx(record, rel=1e-6, abs=half_step)
    else:
        assert decoded == record


def check(record: r.Stamped, autopilot: Autopilot) -> None:
    (decoded,) = encode_and_decode(record, autopilot)
    assert type(decoded) is type(record)
    half_step = HALF_STEP.get(type(record), 1e-6)
    for name in record.__struct_fields__:
        assert_close(getattr(decoded, name), getattr(record, name), half_step)
    for name in ("lat", "lon", "lat_a", "lon_a", "lat_b", "lon_b"):
        if hasattr(record, name):
            assert getattr(decoded, name) == pytest.approx(getattr(record, name), abs=math.radians(0.51e-7))


@pytest.mark.parametrize("name", RECORDS)
def test_ardupilot_records_survive_encoding(name: str) -> None:
    check(RECORDS[name], "ardupilot")


@pytest.mark.parametrize("name", PX4_RECORDS)
def test_px4_records_survive_encoding(name: str) -> None:
    check(PX4_RECORDS[name], "px4")


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_origin_has_the_projection_of_its_make(autopilot: Autopilot) -> None:
    check(r.LocalOrigin(T, RX, LAT, LON, 588.59, autopilot), autopilot)


def test_repeated_fix_is_recognised_after_decoding() -> None:
    (first,) = encode_and_decode(RECORDS["gnss"], "ardupilot")
    (again,) = encode_and_decode(RECORDS["gnss"], "ardupilot")
    assert isinstance(first, r.Gnss) and isinstance(again, r.Gnss)
    assert again.repeats(first)


def test_companion_record_cannot_be_encoded() -> None:
    with pytest.raises(ValueError, match="no autopilot sends a Rejection"):
        encode(r.Rejection(T, T, "gnss", "test"), SimulatedSender())
