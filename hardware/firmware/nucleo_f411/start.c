/* Vector table, and the way from reset to main. */
#include "stm32f411.h"

extern uint32_t stack_top, data_start, data_end, data_in_flash, bss_start, bss_end;

int main(void);
void reset(void);
void usart2_interrupt(void);
void exti15_10_interrupt(void);
void tim5_interrupt(void);

/* A fault, or an interrupt that nobody asked for: the watchdog starts the board again. */
static void stop(void) {
    for (;;) {
    }
}

void reset(void) {
    CPACR |= 0xFu << 20; /* full access to the floating-point unit */
    __asm__ volatile("dsb\n isb" ::: "memory");
    for (uint32_t *to = &data_start, *from = &data_in_flash; to < &data_end;) *to++ = *from++;
    for (uint32_t *to = &bss_start; to < &bss_end;) *to++ = 0;
    main();
    stop();
}

typedef void (*handler)(void);

/* The core's exceptions, then the chip's interrupts; RM0383, table of vectors. */
typedef struct {
    uint32_t *stack;
    handler reset, nmi, hard_fault, memory_fault, bus_fault, usage_fault, reserved_7[4];
    handler svc, debug, reserved_13, pendsv, systick;
    handler interrupts[86];
} vector_table;

__attribute__((section(".vectors"), used)) static const vector_table vectors = {
    .stack = &stack_top,
    .reset = reset,
    .nmi = stop,
    .hard_fault = stop,
    .memory_fault = stop,
    .bus_fault = stop,
    .usage_fault = stop,
    .svc = stop,
    .debug = stop,
    .pendsv = stop,
    .systick = stop,
    .interrupts =
        {
            [USART2_IRQ] = usart2_interrupt,
            [EXTI15_10_IRQ] = exti15_10_interrupt,
            [TIM5_IRQ] = tim5_interrupt,
        },
};
