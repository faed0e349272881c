// Arduino sketch around a policy of `rlservo compile`: put `ur5.c` and `ur5.h` beside it.
#include "ur5.h"

static ur5_obs obs;
static ur5_state state;
static ur5_action action;

void setup() {
  Serial.begin(115200);
  ur5_reset(&state);
}

void loop() {
  static uint32_t next = micros();
  for (int i = 0; i < UR5_OBS_SIZE; i++) obs.values[i] = readSensor(i);  // yours
  const int32_t code = ur5_act(&obs, &state, &action);
  if (UR5_REFUSED(code)) {
    stopMotors();  // yours
    Serial.println(ur5_element(code));
  } else {
    for (int i = 0; i < UR5_ACTION_SIZE; i++) driveMotor(i, action.values[i]);  // yours
  }
  next += static_cast<uint32_t>(1e6 / UR5_CONTROL_RATE_HZ);
  while (static_cast<int32_t>(next - micros()) > 0) {
  }
}
