"""Output to the autopilot: which solutions may steer it, and the messages that carry them.

gate              solutions that may be sent, as a `Position`; every other one with a reason
encode            positions and solutions as MAVLink messages of each make of autopilot
position_reset    when MAV_CMD_EXTERNAL_POSITION_ESTIMATE may reset the autopilot's position
source_switch     when ArduPilot's EKF source set is switched
gnss_fusion       when PX4's GNSS fusion is switched
beacon_witness    whether the beacons themselves contradict GNSS
pace              when each message is due
autopilot_output  all but the pace joined
"""
