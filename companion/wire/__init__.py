"""MAVLink messages <-> records: the only place where scaling, units and sentinels change. Pure, no clock.

`decode(message, rx_ns, sender)` turns what an autopilot says into records, `encode(position, receiver,
name)` a position into a message; each is a table of small functions by message. Between a solution and a
position stands the gate. The simulator's half of the mirror (records of sensors -> messages) is
`sitl.encode`.

It knows nothing of links, frames of bytes, who may speak (a message is believed to come from the autopilot
it is handed in for) or of what a record is used for.
"""

from companion.wire.decode import MAKES, Autopilot, Clock, Sender, decode
from companion.wire.encode import ENCODERS, Receiver, Unsent, encode, navigation_status
from companion.wire.gate import Gate, Position, Withheld

__all__ = [
    "ENCODERS",
    "MAKES",
    "Autopilot",
    "Clock",
    "Gate",
    "Position",
    "Receiver",
    "Sender",
    "Unsent",
    "Withheld",
    "decode",
    "encode",
    "navigation_status",
]
