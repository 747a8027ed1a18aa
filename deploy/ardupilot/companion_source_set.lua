-- EKF source set 1 again when the companion has stopped.
--
-- On source set 2 ArduPilot follows the companion's ODOMETRY. If the companion fails for good, nobody else
-- switches back: the autopilot stays on set 2 by airspeed, also when GPS returns. This script selects set 1
-- when set 2 leads, no ODOMETRY (or VISION_POSITION_ESTIMATE) has arrived for 3 s, and GPS has had a 3D fix
-- for 3 s.
--
-- It does nothing
-- - if set 2 is not external navigation (EK3_SRC2_POSXY other than 6);
-- - if the pilot's switch (RCx_OPTION 90) stands on another set than 1;
-- - twice: if set 2 is selected again while no ODOMETRY arrives, a person wants it.
--
-- Once a second it sends NAMED_VALUE_FLOAT "EKFSRC": the leading source set, negative if this script selected
-- it. `companion doctor` tells by it that the script runs, the companion which set leads.
--
-- Install: copy to APM/scripts/ on the SD card, SCR_ENABLE 1, reboot. ArduPilot 4.5 or later.

local PERIOD_MS = 100
local SILENT_MS = 3000 -- no ODOMETRY for so long
local FIX_MS = 3000 -- GPS has had a fix for so long
local REPORT_MS = 1000
local EXTERNAL_NAVIGATION = 6 -- EK3_SRC2_POSXY
local SET_1, SET_2 = 0, 1 -- ArduPilot's scripts count from 0
local SWITCH_OPTION, LOW = 90, 0 -- RCx_OPTION "EKF Source Set" and its position for set 1
local NOTICE = 5

local received_ms = millis():tofloat() -- last ODOMETRY; at the start: now
local no_fix_ms = received_ms -- last time without a 3D fix
local reported_ms = -REPORT_MS
local is_spent = false -- this silence was acted on
local is_ours = false -- the present set was selected here

local function has_fix()
  return gps:num_sensors() > 0 and gps:status(gps:primary_sensor()) >= gps.GPS_OK_FIX_3D
end

local function pilot_holds_another()
  local position = rc:get_aux_cached(SWITCH_OPTION)
  return position ~= nil and position ~= LOW
end

local function update()
  local now = millis():tofloat()
  local set = ahrs:get_posvelyaw_source_set()
  if set ~= SET_1 then
    is_ours = false
  end
  if visual_odom and visual_odom:healthy() then
    received_ms, is_spent = now, false
  end
  if not has_fix() then
    no_fix_ms = now
  end
  local is_due = set == SET_2 and now - received_ms >= SILENT_MS and now - no_fix_ms >= FIX_MS
  if is_due and not is_spent and not pilot_holds_another()
     and param:get("EK3_SRC2_POSXY") == EXTERNAL_NAVIGATION then
    ahrs:set_posvelyaw_source_set(SET_1)
    set, is_ours, is_spent = SET_1, true, true
    gcs:send_text(NOTICE, "EKF source set 1: no ODOMETRY, GPS has a fix")
  end
  if now - reported_ms >= REPORT_MS then
    reported_ms = now
    gcs:send_named_float("EKFSRC", is_ours and -(set + 1) or set + 1)
  end
  return update, PERIOD_MS
end

gcs:send_text(6, "companion_source_set.lua runs")
return update()
