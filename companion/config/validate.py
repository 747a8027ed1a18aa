"""What of a configuration cannot be meant together, each in one sentence that says what to do.

Above all: no autopilot is fed its own position. A profile that feeds its estimator, on an inertial channel
that is its local position, is refused unless the operator says that this is the position of an INS of its
own. Asked wherever a configuration comes to be: read from a file, set by a ground station, handed to an
`Onboard`.
"""

from __future__ import annotations

from collections.abc import Iterator

from companion.config.profiles import MESSAGES, PROFILES
from companion.config.schema import Config


def conflicts(config: Config) -> Iterator[tuple[str, str, str]]:
    """What cannot be meant together: the section and key at fault, and a sentence that says what to do."""
    output, rates = config.output, config.output.rates_hz
    ways = PROFILES[output.profile].ways
    if output.via != "auto" and output.via not in ways:
        choice = f"choose {', '.join(ways)} or auto" if ways else "leave it out"
        yield (
            "output",
            "via",
            f"output.via = '{output.via}' is no way of profile '{output.profile}': {choice}",
        )
    for via, message in MESSAGES.items():
        key = f"{via}_hz"
        if rates[message] > 0.0 and via not in ways and output.profile != "custom":
            why = (
                "never feeds an autopilot: set output.profile"
                if output.profile == "monitor"
                else f"has no reader for it: its autopilot takes {', '.join(ways)}"
            )
            yield "output", key, f"output.{key} = {rates[message]:g}, but profile '{output.profile}' {why}"
    if config.channel == "local_position" and output.feeds_estimator and not config.inertial.independent:
        yield (
            "inertial",
            "source",
            f"inertial.source = 'local_position' would feed the autopilot its own position back (profile "
            f"'{output.profile}' feeds its estimator): set inertial.source = 'auto', or inertial.independent "
            "= true if LOCAL_POSITION_NED is that of an INS of its own, which takes no part of what we send",
        )
    if rates["GPS_INPUT"] > 0.0 and config.gnss.receiver == 1:
        yield (
            "gnss",
            "receiver",
            "gnss.receiver = 1 is the one that GPS_INPUT feeds, so our own position would come back as a "
            "fix: set gnss.receiver = 0",
        )
    if config.estimator.scheme == "feedback" and config.channel == "local_position":
        yield (
            "estimator",
            "scheme",
            "estimator.scheme = 'feedback' corrects a channel of our own: "
            "set inertial.source = 'air_data' or 'strapdown'",
        )
    if config.leading == "restrictive" and config.channel != "air_data":
        yield (
            "estimator",
            "output",
            "estimator.output = 'restrictive' runs by air data only: set inertial.source = 'air_data'",
        )
