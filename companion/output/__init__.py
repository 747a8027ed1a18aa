"""Output to the autopilot: which solutions may steer it, and the messages that carry them.

gate              solutions that may be sent, as a `Position`; every other one with a reason
encode            positions and solutions as MAVLink messages of each make of autopilot
position_reset    when MAV_CMD_EXTERNAL_POSITION_ESTIMATE may reset the autopilot's position
source_table      whether the autopilot may fly by GNSS or by our position
source_switch     ArduPilot's EKF source set, requested by that table
gnss_fusion       PX4's GNSS fusion, switched by it
beacon_witness    whether the beacons themselves contradict GNSS
flown_receiver    which of two receivers the autopilot flies by
pace              when each message is due
autopilot_output  all but the pace joined

own_position_monitor  reports an autopilot that stays far from our position
"""
