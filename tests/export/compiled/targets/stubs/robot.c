/* A robot for the loop of docs/how-to/compile.md: 300 cycles, of which the second hundred begins with a lost sensor. */
#include <math.h>
#include <stdbool.h>
#include <stdio.h>

#include "ur5.h"

bool read_sensors(float obs[UR5_OBS_SIZE]);
void command_joints(const float action[UR5_ACTION_SIZE]);
void hold(void);

static int cycles, moved, held;

bool read_sensors(float obs[UR5_OBS_SIZE]) {
    for (int i = 0; i < UR5_OBS_SIZE; i++) obs[i] = 0.01f * (float)i;
    if (cycles >= 100 && cycles < 200) obs[5] = NAN;
    if (cycles == 300) printf("moved %d, held %d\n", moved, held);
    return cycles++ < 300;
}

void command_joints(const float action[UR5_ACTION_SIZE]) {
    moved += action[0] >= -1 && action[0] <= 1;
}

void hold(void) { held++; }
