/* Start of a program on a Cortex-M4F in qemu (mps2-an386): floating-point unit on, newlib's output to qemu, main. */
#include <stdint.h>
#include <stdlib.h>

extern uint32_t stack_top[];
void initialise_monitor_handles(void);
int main(void);
void _init(void) {}
void _fini(void) {}

static void reset(void) {
    *(volatile uint32_t *)0xE000ED88u |= 0xFu << 20; /* CPACR: coprocessors 10 and 11 */
    initialise_monitor_handles();
    exit(main());
}

__attribute__((section(".vectors"), used)) static const struct {
    uint32_t *stack;
    void (*reset)(void);
} vectors = {stack_top, reset};
