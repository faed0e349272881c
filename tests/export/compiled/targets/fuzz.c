/* Random bits as observations: a step never leaves its arrays, and refuses or gives an action that is one. */
#include <stdio.h>
#include <string.h>

#include POLICY_HEADER

static uint64_t seed = 88172645463325252u;

static uint64_t bits(void) {
    seed ^= seed << 13;
    seed ^= seed >> 7;
    seed ^= seed << 17;
    return seed;
}

int main(void) {
    static OBS obs;
    static STATE state;
    static ACTION action, before;
    int refused = 0;
    RESET(&state);
    for (int step = 0; step < 3000; step++) {
        unsigned char *bytes = (unsigned char *)&obs;
        const int wild = (int)(bits() % 8);
        for (size_t i = 0; i < sizeof obs; i++)
            if (bits() % 8 <= (uint64_t)wild) bytes[i] = (unsigned char)bits();
        if (wild == 0) memset(&obs, 0, sizeof obs);
        memset(&action, 0x5a, sizeof action);
        memcpy(&before, &action, sizeof action);
        const int32_t code = ACT(&obs, &state, &action);
        if (code < 0 || code >> 24 > 5) return printf("step %d: result %d\n", step, (int)code), 1;
        if (REFUSED(code)) {
            refused++;
            if (memcmp(&before, &action, sizeof action) != 0) return printf("step %d: a refused action\n", step), 1;
            if (ELEMENT(code)[0] == '\0') return printf("step %d: a nameless element\n", step), 1;
        } else {
            for (size_t i = 0; i < sizeof action.values / sizeof action.values[0]; i++)
                if (!(action.values[i] >= LOW && action.values[i] <= HIGH)) return printf("step %d: outside\n", step), 1;
        }
        if (bits() % 100 == 0) RESET(&state);
    }
    printf("%d of 3000 refused\n", refused);
    return refused > 0 && refused < 3000 ? 0 : 1;
}
