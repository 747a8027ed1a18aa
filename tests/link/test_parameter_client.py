"""Parameter protocol client, joined to our own server, to a simulated autopilot of either encoding, and to
recorded values of real ones. Every request ends, with the value in effect, however many messages are lost.
"""

import struct
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.config import Config
from companion.link import dialect, frame
from companion.link.parameter_client import (
    AT_ONCE,
    ATTEMPTS,
    LAYOUTS,
    REAL32,
    SILENCE,
    TIMEOUT,
    Answer,
    Encoding,
    ParameterClient,
    encoding_of,
    equal_real32,
    to_value,
    to_wire,
)
from companion.link.parameter_server import ParameterServer, parameter_table
from tests.frames import on_wire

ARDUPILOT, PX4 = 3, 12
SYSTEM, COMPONENT = 7, 1
INT8, INT16, INT32 = 2, 4, 6
REQUEST_READ, SET = 20, 23


class Vehicle:
    """Parameters of an autopilot; `stubborn` ones are echoed as set but keep their value."""

    def __init__(
        self, encoding: Encoding, values: dict[str, tuple[float, int]], errors: bool = False
    ) -> None:
        self.encoding, self.values, self.errors = encoding, dict(values), errors
        self.stubborn: set[str] = set()
        self.received: list[int] = []

    def receive(self, found: frame.Frame) -> list[frame.Frame]:
        message = dialect.decode(found)
        self.received.append(found.msgid)
        name = message.param_id
        if name not in self.values:
            if self.errors:
                return [on_wire(dialect.new("PARAM_ERROR", param_id=name, error=1), SYSTEM, COMPONENT)]
            return []
        value, kind = self.values[name]
        if found.msgid == SET:
            assert message.param_type == kind
            value = to_value(found.payload[:4].ljust(4, b"\0"), kind, self.encoding)
            if name not in self.stubborn:
                self.values[name] = value, kind
        sent = to_wire(value, kind, self.encoding)
        count = len(self.values)
        fields = {"param_value": sent, "param_type": kind, "param_count": count}
        return [on_wire(dialect.new("PARAM_VALUE", param_id=name, **fields), SYSTEM, COMPONENT)]


def play(
    client: ParameterClient,
    vehicle: Callable[[frame.Frame], list[frame.Frame]],
    lost: Callable[[], bool] = lambda: False,
) -> tuple[dict[str, Answer], int]:
    """Exchange messages until the client is idle; return the answers and the duration, ns."""
    answers: list[Answer] = []
    now = 0
    while not client.is_idle:
        answers += client.poll(now)
        sent = [on_wire(message, 255, 190) for message in client.to_send() if not lost()]
        for request in sent:
            for reply in vehicle(request):
                if not lost():
                    answers += client.receive(dialect.decode(reply), reply)
        if (due := client.deadline()) is not None:
            now = max(now, due)
        assert now < 1000 * TIMEOUT
    assert len({answer.name for answer in answers}) == len(answers)
    return {answer.name: answer for answer in answers}, now


VALUES = {
    "VISO_TYPE": (0, INT8),
    "EK3_SRC2_POSXY": (3, INT8),
    "GPS2_TYPE": (14, INT8),
    "GPS2_DELAY_MS": (-220, INT16),
    "EKF2_AGP0_ID": (-2, INT32),
    "EKF2_AGP0_NOISE": (0.9, REAL32),
    "EKF2_EV_CTRL": (15, INT32),
}


@pytest.mark.parametrize("encoding", ["cast", "bytewise"])
def test_values_are_read_with_either_encoding(encoding: Encoding) -> None:
    client = ParameterClient(SYSTEM, COMPONENT, encoding)
    vehicle = Vehicle(encoding, VALUES)
    client.read(VALUES)
    answers, took = play(client, vehicle.receive)
    assert {name: answer.value for name, answer in answers.items()} == {
        name: pytest.approx(value, rel=1e-7) if kind == REAL32 else value
        for name, (value, kind) in VALUES.items()
    }
    assert not any(answer.trouble for answer in answers.values())
    assert took == 0 and len(vehicle.received) == len(VALUES)


@pytest.mark.parametrize("encoding", ["cast", "bytewise"])
def test_change_is_verified_by_reading_it_again(encoding: Encoding) -> None:
    client = ParameterClient(SYSTEM, COMPONENT, encoding)
    vehicle = Vehicle(encoding, VALUES)
    client.read(VALUES)
    play(client, vehicle.receive)
    vehicle.received.clear()
    vehicle.stubborn.add("EKF2_EV_CTRL")
    client.set("VISO_TYPE", 1)
    client.set("EKF2_AGP0_NOISE", 2.5)
    client.set("EKF2_EV_CTRL", 1)
    answers, _ = play(client, vehicle.receive)
    assert answers["VISO_TYPE"] == ("VISO_TYPE", 1, "")
    assert answers["EKF2_AGP0_NOISE"] == ("EKF2_AGP0_NOISE", 2.5, "")
    assert answers["EKF2_EV_CTRL"] == (
        "EKF2_EV_CTRL",
        15,
        "not accepted",
    )  # echoed as set, but unchanged: only the reading shows it
    assert vehicle.received.count(SET) == vehicle.received.count(REQUEST_READ) == 3


def test_rejected_change_ends_with_the_value_in_effect() -> None:
    client = ParameterClient(SYSTEM, COMPONENT, "cast")
    vehicle = Vehicle("cast", VALUES)

    def reject_set(request: frame.Frame) -> list[frame.Frame]:
        if request.msgid == SET:
            message = dialect.decode(request)
            read = dialect.new("PARAM_REQUEST_READ", param_id=message.param_id, param_index=-1)
            request = on_wire(read, SYSTEM, COMPONENT)
        return vehicle.receive(request)

    client.read(["VISO_TYPE"])
    play(client, vehicle.receive)
    client.set("VISO_TYPE", 1)
    answers, took = play(client, reject_set)
    assert answers["VISO_TYPE"] == ("VISO_TYPE", 0, "not accepted")
    assert took == ATTEMPTS * TIMEOUT


@pytest.mark.parametrize(
    ("errors", "sent", "took"), [(True, "does not exist", 0), (False, SILENCE, ATTEMPTS)]
)
def test_missing_parameter_is_reported(errors: bool, sent: str, took: int) -> None:
    client = ParameterClient(SYSTEM, COMPONENT, "cast")
    client.read(["EK3_SRC9_POSXY", "VISO_TYPE"])
    answers, ended = play(client, Vehicle("cast", VALUES, errors).receive)
    assert answers["EK3_SRC9_POSXY"] == ("EK3_SRC9_POSXY", None, sent)
    assert answers["VISO_TYPE"].value == 0
    assert ended == took * TIMEOUT


def test_a_slow_line_is_not_flooded() -> None:
    names = [f"NOT_THERE_{i}" for i in range(3 * AT_ONCE)]
    client = ParameterClient(SYSTEM, COMPONENT, "cast")
    client.read(names)
    answers, took = play(client, Vehicle("cast", {}).receive)
    assert set(answers) == set(names) and took == 3 * ATTEMPTS * TIMEOUT
    client.read(names)
    client.poll(0)
    assert len(client.to_send()) == AT_ONCE
    client.poll(TIMEOUT - 1)
    assert client.to_send() == []


@given(st.randoms(use_true_random=False), st.sampled_from(["cast", "bytewise"]))
@settings(max_examples=60)
def test_with_losses_an_answer_is_right_or_absent(random, encoding: Encoding) -> None:
    client = ParameterClient(SYSTEM, COMPONENT, encoding)
    vehicle = Vehicle(encoding, VALUES)
    client.read(VALUES)
    answers, _ = play(client, vehicle.receive, lambda: random.random() < 0.3)
    assert set(answers) == set(VALUES)
    for name, answer in answers.items():
        assert (
            answer.trouble == SILENCE if answer.value is None else equal_real32(answer.value, VALUES[name][0])
        )
    known = [name for name, answer in answers.items() if answer.value is not None]
    for name in known:
        client.set(name, 7)
    answers, _ = play(client, vehicle.receive, lambda: random.random() < 0.3)
    for name in known:
        if not answers[name].trouble:
            assert vehicle.values[name][0] == answers[name].value == 7


def test_other_components_and_unrequested_parameters_are_ignored() -> None:
    client = ParameterClient(SYSTEM, COMPONENT, "cast")
    client.read(["VISO_TYPE"])
    client.poll(0)
    value = dialect.new("PARAM_VALUE", param_id="VISO_TYPE", param_value=5.0, param_type=INT8)
    for system, component in ((SYSTEM, 191), (9, COMPONENT)):
        stranger = on_wire(value, system, component)
        assert client.receive(dialect.decode(stranger), stranger) == []
    runtime = dialect.new("PARAM_VALUE", param_id="STAT_RUNTIME", param_value=5.0, param_type=INT32)
    other = on_wire(runtime, SYSTEM, COMPONENT)
    assert client.receive(dialect.decode(other), other) == []
    ours = on_wire(value, SYSTEM, COMPONENT)
    assert client.receive(dialect.decode(ours), ours) == [("VISO_TYPE", 5, "")]


def test_set_of_an_unread_parameter_or_an_invalid_value_is_an_error() -> None:
    client = ParameterClient(SYSTEM, COMPONENT, "cast")
    with pytest.raises(ValueError, match="read before"):
        client.set("VISO_TYPE", 1)
    client.read(["VISO_TYPE"])
    play(client, Vehicle("cast", VALUES).receive)
    for value in (300, 0.5):
        with pytest.raises(ValueError, match=r"integer|fit"):
            client.set("VISO_TYPE", value)
    assert client.is_idle


def test_client_reads_and_sets_our_own_server() -> None:
    server = ParameterServer(191, Config())
    client = ParameterClient(SYSTEM, 191, "bytewise")
    names = [parameter.name for parameter in parameter_table()]

    def serve(request: frame.Frame) -> list[frame.Frame]:
        nonlocal now
        now += 10**9
        server.receive(dialect.decode(request), request, SYSTEM, now)
        return [on_wire(message, SYSTEM, 191) for message in server.to_send(now)]

    now = 0
    client.read(names)
    answers, _ = play(client, serve)
    for parameter in parameter_table():
        assert equal_real32(answers[parameter.name].value, float(parameter.value_in(Config())))
    client.set("GNSS_SIGMA_M", 3.5)
    answers, _ = play(client, serve)
    assert answers["GNSS_SIGMA_M"].value == 3.5 and server.config.gnss.sigma_m == 3.5


# -- encodings ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("param_value", "kind", "encoding", "expected"),
    [  # PARAM_VALUEs of ArduPlane 4.7-dev and PX4 main of 2026-03 in flight
        (3.0, INT8, "cast", 3),  # EK3_SRC1_POSXY: GPS
        (100.0, INT16, "cast", 100),  # TKOFF_ALT, echoed with its own type though set as a REAL32
        (36.0, INT32, "cast", 36),  # STAT_FLTTIME
        (2013.9466552734375, REAL32, "cast", 2013.9466552734375),  # ARSPD_OFFSET
        (5.605193857299268e-45, INT32, "bytewise", 4),  # COM_RC_IN_MODE
        (7.006492321624085e-44, INT32, "bytewise", 50),  # CAL_MAG0_PRIO
        (60.0, REAL32, "bytewise", 60.0),  # COM_OBC_LOSS_T
    ],
)
def test_values_recorded_from_real_autopilots(
    param_value: float, kind: int, encoding: Encoding, expected: float
) -> None:
    assert to_value(struct.pack("<f", param_value), kind, encoding) == expected
    assert to_wire(expected, kind, encoding) == param_value


@given(st.sampled_from(sorted(LAYOUTS)), st.sampled_from(["cast", "bytewise"]), st.data())
@settings(max_examples=200)
def test_encoding_and_decoding_are_inverse(kind: int, encoding: Encoding, data: st.DataObject) -> None:
    if kind == REAL32:
        value: float = data.draw(st.floats(width=32, allow_nan=False))
    else:
        bits = {1: (0, 255), 2: (-128, 127), 3: (0, 65535), 4: (-32768, 32767)}
        value = data.draw(st.integers(*bits.get(kind, (0, 2**24))))
    assert to_value(struct.pack("<f", to_wire(value, kind, encoding)), kind, encoding) == value


@pytest.mark.parametrize(
    ("capabilities", "make", "encoding"),
    [
        (None, ARDUPILOT, "cast"),
        (None, PX4, "bytewise"),
        (16, ARDUPILOT, "bytewise"),  # the stated encoding has priority
        (131072, PX4, "cast"),
        (2, PX4, "cast"),
        (16 | 2, PX4, "bytewise"),
        (8192, ARDUPILOT, "cast"),
    ],
)
def test_encoding_is_the_stated_one_or_that_of_the_autopilot_type(
    capabilities: int | None, make: int, encoding: Encoding
) -> None:
    assert encoding_of(capabilities, make) == encoding


def test_type_that_does_not_fit_four_bytes_is_reported() -> None:
    client = ParameterClient(SYSTEM, COMPONENT, "bytewise")
    client.read(["BIG"])
    client.poll(0)
    sent = on_wire(dialect.new("PARAM_VALUE", param_id="BIG", param_type=8), SYSTEM, COMPONENT)
    (answer,) = client.receive(dialect.decode(sent), sent)
    assert answer.value is None and "type 8" in answer.trouble and client.is_idle
