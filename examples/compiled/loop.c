/* A 1 kHz loop around a compiled policy: at the policy's own rate it acts, in between it repeats. */
#define _POSIX_C_SOURCE 200809L
#include <stdbool.h>
#include <stdio.h>
#include <time.h>

#include "ur5.h"

bool read_sensors(float obs[UR5_OBS_SIZE]); /* yours; false ends the loop */
void command_joints(const float action[UR5_ACTION_SIZE]);
void hold(void); /* yours: what is safe without an action */

int main(void) {
    static ur5_obs obs;
    static ur5_state state;
    static ur5_action action;
    const int every = (int)(1000 / UR5_CONTROL_RATE_HZ);
    bool holding = true;
    struct timespec next;
    ur5_reset(&state); /* at the start of each episode */
    clock_gettime(CLOCK_MONOTONIC, &next);
    for (int cycle = 0; read_sensors(obs.values); cycle = (cycle + 1) % every) {
        if (cycle == 0) {
            const int32_t code = ur5_act(&obs, &state, &action);
            holding = UR5_REFUSED(code);
            if (code != UR5_OK) fprintf(stderr, "%d: %s\n", (int)UR5_KIND(code), ur5_element(code));
        }
        if (holding)
            hold();
        else
            command_joints(action.values);
        next.tv_nsec += 1000000;
        if (next.tv_nsec >= 1000000000) {
            next.tv_nsec -= 1000000000;
            next.tv_sec++;
        }
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &next, NULL);
    }
    return 0;
}
