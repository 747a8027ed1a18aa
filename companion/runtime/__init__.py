"""Runtime: the companion as a service of the operating system.

core                      sessions, navigator and output joined; no I/O and no clock
service                   the asyncio shell and the command `companion run`
check_config              the command `companion check-config`
link_addresses            addresses of the links checked before a start
ground_station_services   commands, parameters and STATUSTEXT for ground stations
parameter_check           autopilot parameters checked at the start of a flight
signing_key, state_file   state that outlives a restart
stderr_writer             lines to stderr outside the event loop
systemd                   readiness and watchdog notification
"""
