"""MAVLink messages and constants: pymavlink's generated dialect and our own messages. No parser, no I/O.

The only importer of pymavlink. Its dialect `all` is used: it holds every message of `ardupilotmega` and
`development` (PX4) with the same CRC_EXTRA bytes and 50 more, at the same cost: 0.03 s to import from a
compiled cache, and 13 MB. pymavlink's own parser and signature check are not used, see
`companion.link.frame`.

Our messages are defined in rsbn.xml, public ones that pymavlink lacks in public.xml.
`python -m companion.link.dialect` regenerates generated/rsbn_dialect.py from them with the mavgen of the
installed wheel; `regenerate` writes it to another path.

Create a message by `new("ODOMETRY", x=...)`, read its attributes, and get its id by `id_of(message)`. Do not
read `.id`, `.name`, `.type`: payload fields shadow them in 41 messages.
"""

from __future__ import annotations

import contextlib
import difflib
import io
import os
import re
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from pymavlink.dialects.v20 import all as _all

from companion.link.generated import rsbn_dialect as _rsbn

if TYPE_CHECKING:
    from companion.link.frame import Frame

#: The generated dialects, for their constants: `mavlink.MAV_TYPE_GCS`, `mavlink.MAVLINK_MSG_ID_HEARTBEAT`,
#: `rsbn.RSBN_STATUS_TEST`. Import MAVLink ids and enum values from here.
mavlink: Any = _all
rsbn: Any = _rsbn

#: A MAVLink message: an instance of one of pymavlink's generated classes, which carry no types.
Message = Any

#: Messages of receivers, which are components of their own, and the field that names what is received.
MEASUREMENTS = {
    rsbn.MAVLINK_MSG_ID_RSBN_MEASUREMENT: "beacon_id",
    rsbn.MAVLINK_MSG_ID_STAR_FIX: "star_id",
    rsbn.MAVLINK_MSG_ID_RANGE_DIFFERENCE: "chain_id",
    rsbn.MAVLINK_MSG_ID_SECOND_INS_POSITION: "ins_id",
}

XML = Path(__file__).with_name("rsbn.xml")
PUBLIC_XML = Path(__file__).with_name("public.xml")


class Field(NamedTuple):
    """Position of a field among the values unpacked by the message's struct."""

    name: str
    first: int
    length: int
    text: bool


class MessageType(NamedTuple):
    """Name, layout and CRC_EXTRA byte of a message."""

    msgid: int
    name: str
    layout: struct.Struct
    crc_extra: int
    #: Payload size without the extension fields: the least that MAVLink 1, which trims nothing, sends.
    base_size: int
    #: Names in wire order if every field is one number, else empty.
    scalars: tuple[str, ...]
    #: Fields in wire order.
    fields: tuple[Field, ...]
    cls: Any
    #: Default value of every field, and the names of the text fields.
    zeros: dict[str, Any]
    texts: tuple[str, ...]
    #: Attributes set by pymavlink's base class, shared by all messages of the type.
    base: dict[str, Any]


def _describe(msgid: int, cls: Any) -> MessageType:
    fields = []
    first = 0
    types = dict(zip(cls.fieldnames, cls.fieldtypes))
    for name, length in zip(cls.ordered_fieldnames, cls.lengths):
        fields.append(Field(name, first, length, types[name] == "char"))
        first += length
    # mavgen gives default values to the extension fields only; they are last on the wire
    extensions = len(cls.__init__.__defaults__ or ())
    formats = re.findall(r"\d*[a-zA-Z]", cls.unpacker.format)
    base_size = struct.calcsize("<" + "".join(formats[: len(formats) - extensions]))
    plain = all(field.length == 1 and not field.text for field in fields)
    blank = object.__new__(cls)
    _all.MAVLink_message.__init__(blank, msgid, cls.msgname)
    base = dict(blank.__dict__)
    base |= {"_fieldnames": cls.fieldnames, "_instance_field": cls.instance_field}
    base["_instance_offset"] = cls.instance_offset
    scalars = tuple(cls.ordered_fieldnames) if plain else ()
    # arrays are tuples: all messages of the type share them
    zeros = {f.name: b"" if f.text else 0 if f.length == 1 else (0,) * f.length for f in fields}
    texts = tuple(f.name for f in fields if f.text)
    return MessageType(
        msgid,
        cls.msgname,
        cls.unpacker,
        cls.crc_extra,
        base_size,
        scalars,
        tuple(fields),
        cls,
        zeros,
        texts,
        base,
    )


#: Every known message by its id.
TYPES: Mapping[int, MessageType] = {
    msgid: _describe(msgid, cls) for msgid, cls in (_all.mavlink_map | rsbn.mavlink_map).items()
}
_BY_NAME: Mapping[str, MessageType] = {kind.name: kind for kind in TYPES.values()}


def id_of(message: Message) -> int:
    """Return the message id."""
    return int(message._header.msgId)


def entry_name(enum: str, value: int) -> str:
    """Return an entry of an enum as words, "temporarily rejected"; "MAV_RESULT 99" if it is unknown."""
    entry = mavlink.enums[enum].get(value)
    return entry.name.removeprefix(f"{enum}_").replace("_", " ").lower() if entry else f"{enum} {value}"


def type_named(name: str) -> MessageType:
    """Return the type of the message `name` (as in the XML, "GPS_RAW_INT"). ValueError if unknown."""
    try:
        return _BY_NAME[name]
    except KeyError:
        near = difflib.get_close_matches(name, _BY_NAME, 1)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise ValueError(f"no MAVLink message is called {name!r}{hint}") from None


def new(name: str, /, **values: Any) -> Message:
    """Create a message by its name; fields not given are 0 (text: empty, arrays: all 0).

    Units are those of the wire, given in the message's XML. ValueError for an unknown message or field.
    """
    kind = type_named(name)
    if unknown := values.keys() - kind.zeros.keys():
        names = ", ".join(kind.zeros)
        raise ValueError(f"{name} has no field {sorted(unknown)[0]!r}; it has {names}")
    message = _blank_message(kind, 0, 0, 0, 0)
    for field in kind.texts:
        value = values.get(field, b"")
        raw = value.encode() if isinstance(value, str) else value
        values |= {field: raw.split(b"\0", 1)[0].decode("ascii", "replace"), f"_{field}_raw": raw}
    message.__dict__ |= kind.zeros | values
    return message


def command_long(system: int, command: int, **parameters: float | None) -> Message:
    """Create COMMAND_LONG to the autopilot of `system`; `command` is MAV_CMD."""
    component = mavlink.MAV_COMP_ID_AUTOPILOT1
    return new(
        "COMMAND_LONG", target_system=system, target_component=component, command=command, **parameters
    )


def decode(frame: Frame) -> Message:
    """Decode the message of a frame; a payload shorter than the message is padded with zeros.

    KeyError if the id is unknown. The checksum was verified by the frame reader.
    """
    msgid, payload = frame.msgid, frame.payload
    kind = TYPES[msgid]
    size = kind.layout.size
    if len(payload) != size:
        payload = payload[:size].ljust(size, b"\0")
    values = kind.layout.unpack(payload)
    message = _blank_message(kind, len(payload), frame.sequence, frame.system, frame.component)
    attributes = message.__dict__
    if kind.scalars:
        attributes.update(zip(kind.scalars, values))
    else:
        for name, first, length, text in kind.fields:
            if text:
                raw = values[first].rstrip(b"\0")
                attributes[f"_{name}_raw"] = raw
                attributes[name] = raw.split(b"\0", 1)[0].decode("ascii", "replace")
            else:
                attributes[name] = values[first] if length == 1 else list(values[first : first + length])
    return message


def _blank_message(kind: MessageType, size: int, sequence: int, system: int, component: int) -> Message:
    """Return a message without its fields, bypassing the constructors, which dominate the cost."""
    message = object.__new__(kind.cls)
    header = object.__new__(_all.MAVLink_header)
    header.__dict__ = {
        "mlen": size,
        "seq": sequence,
        "srcSystem": system,
        "srcComponent": component,
        "msgId": kind.msgid,
        "incompat_flags": 0,
        "compat_flags": 0,
    }
    message.__dict__ = kind.base | {"_header": header}
    return message


def payload(message: Message) -> bytes:
    """Encode the full payload of a message, zeros not trimmed; inverse of `decode`.

    ValueError if a field does not fit its wire type.
    """
    kind = TYPES[message._header.msgId]
    attributes = message.__dict__
    values = [attributes[name] for name in kind.scalars]
    if not kind.scalars:
        for name, _, length, text in kind.fields:
            value = attributes[f"_{name}_raw" if text else name]
            if length == 1:
                values.append(value)
            else:
                values.extend(value)
    try:
        return kind.layout.pack(*values)
    except (struct.error, TypeError, OverflowError) as error:
        raise ValueError(f"{kind.name} cannot be packed: {error}; a field is out of its range") from None


def regenerate(path: Path) -> None:
    """Generate the Python module of both XML files at `path` with the installed mavgen (MAVLink 2)."""
    from pymavlink.generator import mavgen  # slow to import, not needed in flight

    options = mavgen.Opts(os.fspath(path), wire_protocol="2.0", language="Python", validate=True)
    output = io.StringIO()
    with contextlib.redirect_stdout(output):
        done = mavgen.mavgen(options, [os.fspath(XML), os.fspath(PUBLIC_XML)])
    if not done:
        raise ValueError(f"mavgen rejected {XML.name}: {output.getvalue().strip()}")


if __name__ == "__main__":
    regenerate(XML.parent / "generated" / "rsbn_dialect.py")
