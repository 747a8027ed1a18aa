"""Fly the loopback from Python: a simulated aircraft that loses GNSS, and the errors by phase."""

from companion.config import load
from sitl.loopback import error_table, fly_scenario, simulator_config
from sitl.scenarios import get_scenario

scenario = get_scenario("short", seed=3)
config = simulator_config(load(flags={"output.profile": "ardupilot"}))
flown = fly_scenario(scenario, config)
print("phase        corrected, m r.m.s.   95 %")
for row in error_table(flown):
    print(f"{row.phase:12} {row.rms['corrected']:19.1f} {row.p95['corrected']:6.1f}")
