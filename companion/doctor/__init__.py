"""What an autopilot lacks for the configured output profile: looked at, told and, after a yes, set.

diagnosis    what is found, as values      examination   one link watched and asked, sans-IO
show         tables and JSON               command       `companion doctor`: socket, clock, terminal
"""
