"""Doctor: what an autopilot lacks for the configured output profile; sets parameters after confirmation.

diagnosis      findings as values
examination    one link observed, parameters read and set; no I/O
rendering      tables and JSON
command        the command `companion doctor`: connection, clock and terminal
"""
