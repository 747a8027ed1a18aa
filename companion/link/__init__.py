"""MAVLink protocol core: frames, dialect, session, clock, signing, parameters and decoding. No I/O.

Every module takes bytes or messages and the current time, and returns events, records or messages to send.
No module reads a clock, opens a socket or raises on what a peer sends.
"""
