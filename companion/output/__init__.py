"""Output to the autopilot: which solutions may steer it, and the messages that carry them.

gate              solutions that may be sent, as a `Position`; every other one with a reason
encode            positions and solutions as MAVLink messages of each make of autopilot
position_reset    when MAV_CMD_EXTERNAL_POSITION_ESTIMATE may reset the autopilot's position
source_switch     when ArduPilot's EKF source set is switched
autopilot_output  the four joined, per link
"""
