/* Pins of the AD5940 and of the four multiplexers: SPI, reset, interrupt and address lines. */
#ifndef FRONT_END_H
#define FRONT_END_H

#include "eit_hal.h"

void front_end_begin(void);

void front_end_transfer(void *context, const uint8_t *out, uint8_t *in, size_t n);
void front_end_reset(void *context, bool held);
bool front_end_interrupt(void *context);
void front_end_select(void *context, eit_mux mux, uint8_t electrode);

#endif
