/* USART2, which the ST-LINK on the board shows to the host as a serial port. */
#ifndef SERIAL_H
#define SERIAL_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

void serial_begin(void);

/* Read or write at most n bytes without waiting; gives their number. */
size_t serial_read(void *context, uint8_t *data, size_t n);
size_t serial_write(void *context, const uint8_t *data, size_t n);

bool serial_has_received(void);

#endif
