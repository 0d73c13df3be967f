/* Clocks of the chip, the clock in microseconds, and sleep. */
#ifndef CLOCK_H
#define CLOCK_H

#include <stdint.h>

/* Run at 96 MHz and start the clock. APB1 has 48 MHz, APB2 96 MHz. */
void clock_begin(void);

/* Time since clock_begin [us]; to be called at least once in 71 minutes. */
uint64_t clock_us(void *context);

/* Sleep until this time, until an interrupt, or for 0.1 s, after which the watchdog must be fed.
 * Interrupts must be disabled, and are afterwards. */
void clock_sleep(uint64_t until_us);

#endif
