"""Command server: results, addressing, intervals and rate limit; two sessions joined in memory."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.link import dialect, frame
from companion.link.commands import BURST, CAPABILITIES, RATE_HZ, CommandServer, Result
from companion.link.rate_limiter import RateLimiter
from companion.link.session import MessageReceived, Session
from tests.frames import on_wire

SECOND = 1_000_000_000
STATUSTEXT, HOME, ODOMETRY, NAVIGATION_STATUS = 253, 242, 331, 180_001
GET_INTERVAL, SET_INTERVAL, REQUEST, CAPABILITIES_OF, ARM = 510, 511, 512, 520, 400
SYSTEM, COMPONENT = 7, 191


def commands() -> CommandServer:
    return CommandServer(
        COMPONENT,
        {ODOMETRY: 200_000, NAVIGATION_STATUS: 1_000_000},
        {STATUSTEXT: lambda: dialect.new("STATUSTEXT", text="here"), HOME: lambda: None},
    )


def ask(
    to: CommandServer,
    command: int,
    *params: float,
    now: int = 0,
    system: int = SYSTEM,
    component: int = COMPONENT,
    kind: str = "COMMAND_LONG",
    fixed: dict[int, int] | None = None,
) -> list[dialect.Message]:
    values = {f"param{i}": value for i, value in enumerate(params, 1)}
    message = dialect.new(kind, command=command, target_system=system, target_component=component, **values)
    found = on_wire(message, 255, 190)
    replies = to.receive(dialect.decode(found), found, SYSTEM, now, fixed or {})
    for reply in replies:
        frame.encode(reply, 0, SYSTEM, COMPONENT)  # every reply can be encoded
    return replies


@pytest.mark.parametrize("kind", ["COMMAND_LONG", "COMMAND_INT"])
@pytest.mark.parametrize(
    ("command", "params", "result", "answer"),
    [
        (REQUEST, (STATUSTEXT,), Result.ACCEPTED, "STATUSTEXT"),
        (REQUEST, (148,), Result.ACCEPTED, "AUTOPILOT_VERSION"),
        (REQUEST, (HOME,), Result.FAILED, None),
        (REQUEST, (30,), Result.UNSUPPORTED, None),
        (REQUEST, (253.5,), Result.DENIED, None),
        (REQUEST, (math.nan,), Result.DENIED, None),
        (REQUEST, (math.inf,), Result.DENIED, None),
        (REQUEST, (-1,), Result.DENIED, None),
        (CAPABILITIES_OF, (1,), Result.ACCEPTED, "AUTOPILOT_VERSION"),
        (CAPABILITIES_OF, (0,), Result.DENIED, None),
        (GET_INTERVAL, (ODOMETRY,), Result.ACCEPTED, "MESSAGE_INTERVAL"),
        (GET_INTERVAL, (30,), Result.ACCEPTED, "MESSAGE_INTERVAL"),
        (GET_INTERVAL, (NAVIGATION_STATUS,), Result.DENIED, None),
        (SET_INTERVAL, (ODOMETRY, 100_000), Result.ACCEPTED, None),
        (SET_INTERVAL, (ODOMETRY, 1), Result.DENIED, None),
        (SET_INTERVAL, (ODOMETRY, -2), Result.DENIED, None),
        (SET_INTERVAL, (ODOMETRY, math.nan), Result.DENIED, None),
        (SET_INTERVAL, (ODOMETRY, math.inf), Result.DENIED, None),
        (SET_INTERVAL, (30, 100_000), Result.UNSUPPORTED, None),
        (SET_INTERVAL, (math.nan, 100_000), Result.DENIED, None),
        (ARM, (1,), Result.UNSUPPORTED, None),
        (65_535, (), Result.UNSUPPORTED, None),
    ],
)
def test_results(
    kind: str, command: int, params: tuple[float, ...], result: Result, answer: str | None
) -> None:
    ack, *replies = ask(commands(), command, *params, kind=kind)
    assert (ack.get_type(), ack.command, ack.result) == ("COMMAND_ACK", command, result)
    assert (ack.target_system, ack.target_component) == (255, 190)
    assert [reply.get_type() for reply in replies] == ([answer] if answer else [])


def test_only_what_is_addressed_to_us_is_answered() -> None:
    here = commands()
    for system, component, answered in [
        (SYSTEM, COMPONENT, True),
        (SYSTEM, 0, True),
        (SYSTEM, 1, False),
        (8, COMPONENT, False),
        (0, 0, False),
    ]:
        assert bool(ask(here, REQUEST, 148, system=system, component=component)) == answered


def test_unsupported_broadcast_command_is_not_answered() -> None:
    assert ask(commands(), ARM, 1, component=0) == []
    assert ask(commands(), ARM, 1)[0].result == Result.UNSUPPORTED


def test_intervals_are_set_read_disabled_and_restored() -> None:
    here = commands()

    def interval_us_of(msgid: int) -> int:
        return int(ask(here, GET_INTERVAL, msgid)[1].interval_us)

    assert (interval_us_of(ODOMETRY), interval_us_of(STATUSTEXT), interval_us_of(30)) == (200_000, -1, 0)
    ask(here, SET_INTERVAL, ODOMETRY, 50_000)
    assert interval_us_of(ODOMETRY) == here.intervals_us[ODOMETRY] == 50_000
    ask(here, SET_INTERVAL, ODOMETRY, -1)
    assert interval_us_of(ODOMETRY) == here.intervals_us[ODOMETRY] == -1
    ask(here, SET_INTERVAL, ODOMETRY, 0)
    assert interval_us_of(ODOMETRY) == 200_000
    ask(here, SET_INTERVAL, NAVIGATION_STATUS, 500_000)
    assert here.intervals_us[NAVIGATION_STATUS] == 500_000


def test_what_the_autopilot_is_fed_is_not_changed_by_command() -> None:
    here, fed = commands(), {ODOMETRY: 100_000}
    for interval in (50_000, -1, 0):
        assert ask(here, SET_INTERVAL, ODOMETRY, interval, fixed=fed)[0].result == Result.DENIED
    assert ask(here, GET_INTERVAL, ODOMETRY, fixed=fed)[1].interval_us == 100_000
    assert here.intervals_us[ODOMETRY] == 200_000


def test_version_states_our_capabilities() -> None:
    version = ask(commands(), REQUEST, 148)[1]
    assert version.capabilities == CAPABILITIES
    assert version.flight_sw_version >> 8 & 0xFFFFFF > 0


def test_commands_above_the_rate_limit_are_rejected() -> None:
    here = commands()
    results = [ask(here, REQUEST, 148, now=step * SECOND // 100)[0].result for step in range(1000)]
    accepted = results.count(Result.ACCEPTED)
    assert set(results) == {Result.ACCEPTED, Result.TEMPORARILY_REJECTED}
    assert accepted == pytest.approx(BURST + 10 * RATE_HZ, abs=1)
    assert results[:BURST] == [Result.ACCEPTED] * BURST


@settings(max_examples=200)
@given(
    command=st.sampled_from([GET_INTERVAL, SET_INTERVAL, REQUEST, CAPABILITIES_OF]) | st.integers(0, 65_535),
    params=st.lists(st.floats(width=32), min_size=7, max_size=7),
)
def test_any_command_has_one_acknowledgement(command: int, params: list[float]) -> None:
    acks = [r for r in ask(commands(), command, *params) if r.get_type() == "COMMAND_ACK"]
    assert [ack.command for ack in acks] == [command]


def test_two_sessions_joined_in_memory() -> None:
    station = Session(autopilot_system=255, component=190)
    companion = Session(autopilot_system=SYSTEM, component=COMPONENT)
    here = commands()
    request = {"command": REQUEST, "param1": 148, "target_system": SYSTEM, "target_component": COMPONENT}
    station.send(dialect.new("COMMAND_LONG", **request))
    for event in companion.receive(b"".join(station.to_send()), 0):
        assert isinstance(event, MessageReceived)
        for reply in here.receive(event.message, event.frame, companion.system, event.received_ns, {}):
            companion.send(reply)
    received = station.receive(b"".join(companion.to_send()), 0)
    assert [e.message.get_type() for e in received if isinstance(e, MessageReceived)] == [
        "COMMAND_ACK",
        "AUTOPILOT_VERSION",
    ]


@settings(max_examples=100)
@given(
    waits=st.lists(st.integers(0, 3 * SECOND), max_size=60),
    rate_hz=st.sampled_from([0.5, 3.0, 10.0]),
    burst=st.integers(1, 5),
)
def test_rate_limiter_grants_burst_and_rate_and_states_the_next_time(
    waits: list[int], rate_hz: float, burst: int
) -> None:
    limiter, now, taken = RateLimiter(rate_hz, burst), 0, []
    for wait in waits:
        now += wait
        ready = limiter.ready_at(now)
        assert limiter.take(now) == (ready == now)
        if ready == now:
            taken.append(now)
    for i, start in enumerate(taken):
        for j in range(i, len(taken)):
            assert j - i + 1 <= burst + (taken[j] - start) * rate_hz / SECOND + 1e-6
