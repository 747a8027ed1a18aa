"""Decoding the companion's output messages returns position, accuracy and time."""

import math

import pytest

from companion.link import dialect, frame
from companion.nav.geometry import separation
from companion.output.encode import ENCODERS, Receiver, encode
from companion.output.gate import Position
from companion.records import LocalOrigin
from sitl.positions import POSITION_MESSAGES, affects_estimator, position_of

NOW = 5_000_000_000_000
SENT = Position(
    NOW,
    math.radians(55.8),
    math.radians(37.7),
    250.0,
    (15.0, -10.0, 0.5),
    (400.0, 0.0, 400.0),
    25.0,
    True,
    0.3,
)


def through_the_wire(message):
    (found,) = frame.Reader().receive(frame.encode(message, 0, 1, 191))
    return dialect.decode(found)


@pytest.mark.parametrize("make", ["ardupilot", "px4"])
@pytest.mark.parametrize("name", sorted(ENCODERS))
def test_decoded_position_equals_the_encoded_one(make: str, name: str) -> None:
    origin = LocalOrigin(NOW, NOW, math.radians(55.75), math.radians(37.61), 150.0, make)
    receiver = Receiver(make, 1, origin=origin, unix_ns=1_790_000_000_000_000_000)
    message = through_the_wire(encode(SENT, receiver, name))
    reported = position_of(message, origin, make)
    was = SENT.at(NOW - reported.age_ns)
    north, east, _ = separation(reported.place, reported.place._replace(lat=was.lat, lon=was.lon))
    assert math.hypot(north, east) < 0.02
    assert reported.sigma == pytest.approx(20.0, rel=1e-4)
    assert reported.stamp_ns in (0, NOW)
    assert affects_estimator(message) and dialect.id_of(message) in POSITION_MESSAGES


def test_local_position_needs_an_origin() -> None:
    assert position_of(dialect.new("ODOMETRY", x=1.0), None, "px4") is None


def test_nan_position_is_ignored() -> None:
    origin = LocalOrigin(0, 0, 0.9, 0.6, 0.0, "px4")
    assert position_of(dialect.new("ODOMETRY", x=math.nan), origin, "px4") is None


@pytest.mark.parametrize(("command", "effect"), [(43003, True), (42007, True), (511, False)])
def test_command_id_decides_effect_on_the_estimator(command: int, effect: bool) -> None:
    assert affects_estimator(dialect.new("COMMAND_INT", command=command)) is effect
    assert affects_estimator(dialect.new("COMMAND_LONG", command=command)) is effect
    assert not affects_estimator(dialect.new("NAVIGATION_STATUS"))
