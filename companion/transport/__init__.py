"""Byte streams over serial lines, UDP and TCP, reconnected until stopped. Knows no MAVLink.

address         connection strings
reconnect       open a connection, and open it again after each failure
connection      an open connection: reads, writes and its end
send_queue      frames that wait for a slow line; the oldest are dropped
peers           who a listening link sends to
drop_monitor    reports when frames begin and cease to be dropped
daemon_thread   blocking work outside the event loop
serial_line, sockets, tcp, udp      the kinds of connections
"""
