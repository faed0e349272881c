// What the sketch of examples/compiled uses of an Arduino core, and of its owner.
#pragma once
#include <cstdint>

struct Port {
  void begin(long) {}
  void println(const char *) {}
};
extern Port Serial;
uint32_t micros();
float readSensor(int number);
void driveMotor(int number, float value);
void stopMotors();
