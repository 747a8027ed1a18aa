"""Flights of any log, with navigator outputs.

Our own MCAP logs contain the outputs. The logs of other recorders, and MCAP logs converted from them, contain
inputs only: the navigator is run over them here, in memory.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Set
from dataclasses import replace
from pathlib import Path

from companion.analysis.flight_arrays import Flight, collect_flights
from companion.analysis.replay_inputs import (
    CONVERTED,
    DERIVED,
    input_errors_as_log_errors,
    is_own_log,
    open_inputs,
)
from companion.config import Config, Sensor
from companion.navigator import Navigator
from companion.records import (
    INPUTS,
    AirData,
    AirspeedSensor,
    Attitude,
    Imu,
    LocalPosition,
    Stamped,
)
from companion.storage import flight_log
from companion.storage.reader import LogError, is_closed
from companion.storage.run_metadata import run_metadata

MAX_NS = 2**62
OWN_INS = "local position of an INS of its own"
LOCAL_VELOCITY = "velocity of the autopilot's local position, which may depend on that GNSS"
SENSORS: dict[Sensor, str] = {"imu": "IMU", "air_data": "airspeed"}


def open_flights(path: Path, config: Config) -> list[Flight]:
    """Return the flights in the log at `path`; `config` is used if the navigator has to be run.

    Raises LogError if the file cannot be read, is empty or was made by `smooth`.
    """
    with input_errors_as_log_errors():
        first_unix_ns, remarks = None, list[str]()
        if is_own_log(path):
            first = next(iter(flight_log.read(path)), None)
            if first is None:
                raise LogError(f"{path} contains no messages: nothing to report")
            about = flight_log.metadata(path)
            derived = about.get(DERIVED, {})
            if derived.get("by") == "smooth":
                raise LogError(
                    f"{path} has a smoothed track and no estimate: give the log that it was made from, "
                    f"{derived.get('from')}"
                )
            first_unix_ns = first.log_time
            if not is_closed(path):
                bytes_lost = flight_log.info(path).bytes_lost
                lost = f"; {bytes_lost} bytes at its end are unreadable" if bytes_lost else ""
                remarks.append(f"The log was not closed{lost}.")
            if CONVERTED not in about:
                return collect_flights(
                    _read_outputs(path),
                    path.name,
                    unix_ns=first_unix_ns,
                    metadata=about,
                    remarks=tuple(remarks),
                )
        sensors = set[str]()
        flights = collect_flights(
            _run_navigator(open_inputs(path, config).records, config, sensors),
            path.name,
            unix_ns=first_unix_ns,
            metadata=run_metadata(config),
            remarks=tuple(remarks),
        )
        ours = "This is the log of another recorder: the navigator was run over it for this report."
        added = f"{ours} {describe_channel(config, sensors)}"
        return [replace(flight, remarks=(*flight.remarks, added)) for flight in flights]


def describe_channel(config: Config, sensors: Set[str | None]) -> str:
    """Describe what the inertial channel rests on: the `sensors` in the log that the configuration uses."""
    if config.has_own_ins and "local_position" in sensors:
        return f"The inertial channel is the {OWN_INS}."
    if config.has_own_ins:
        return "The log has nothing for an inertial channel."
    if config.uses_local_velocity and "local_position" in sensors:
        return f"The inertial channel is the {LOCAL_VELOCITY}."
    used = [text for name, text in SENSORS.items() if name in sensors and config.uses(name)]
    if used and "attitude" in sensors:
        by = " and ".join(("attitude", *used)) if len(used) == 1 else "attitude, IMU and airspeed"
        return f"The inertial channel is the companion's own, by the autopilot's {by}."
    if "attitude" in sensors and config.uses("air_data"):
        return (
            "The log has no IMU and no sensor of airspeed: a fixed wing is taken to keep its airspeed, "
            "anything else its velocity from fix to fix."
        )
    hint = " Give --with inertial.source=local_position to go by the autopilot's velocity."
    return f"The log has nothing for an inertial channel.{hint if 'local_position' in sensors else ''}"


def sensor_of(record: Stamped) -> str | None:
    """Return the name of the sensor that the record shows to be there, None if it shows none."""
    match record:
        case Imu():
            return "imu"
        case AirData(sensed=True) | AirspeedSensor(healthy=True):
            return "air_data"  # without a sensor VFR_HUD has the autopilot's own number, which is not used
        case LocalPosition():
            return "local_position"
        case Attitude():
            return "attitude"
    return None


def _read_outputs(path: Path) -> Iterator[tuple[str, Stamped]]:
    for entry in flight_log.read(path):
        if isinstance(entry.value, Stamped):
            if max(abs(entry.value.t_ns), abs(entry.value.rx_ns)) >= MAX_NS:
                raise LogError(f"{path}: a record of {entry.topic} has an impossible time")
            yield entry.topic, entry.value


def _run_navigator(
    records: Iterable[Stamped], config: Config, sensors: set[str]
) -> Iterator[tuple[str, Stamped]]:
    """Yield records and outputs of the navigator, by topic; add the sensors of the log to `sensors`."""
    navigator = Navigator(config)
    for record in records:
        if (sensor := sensor_of(record)) is not None:
            sensors.add(sensor)
        yield flight_log.topic_of_input(record), record
        if isinstance(record, INPUTS):
            for output in navigator.handle(record):
                yield flight_log.topic_of(type(output)), output
