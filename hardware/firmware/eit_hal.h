/* Hardware abstraction: the ten functions that a microcontroller provides.
 *
 * No function may block, apart from the SPI transfer, which takes microseconds. `context` belongs
 * to the port and is passed to every function. hardware/firmware/README.md names the peripheral
 * of an STM32 for each. */
#ifndef EIT_HAL_H
#define EIT_HAL_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define EIT_UID_SIZE 12
#define EIT_FOREVER UINT64_MAX

/* The four multiplexers between the electrodes and the AD5940. */
typedef enum { EIT_DRIVE_PLUS, EIT_DRIVE_MINUS, EIT_SENSE_PLUS, EIT_SENSE_MINUS } eit_mux;

typedef struct {
    void *context;
    /* Send n bytes and receive as many, chip select low from the first to the last; mode 0. */
    void (*spi_transfer)(void *context, const uint8_t *out, uint8_t *in, size_t n);
    /* Hold the AD5940 in reset, or release it. */
    void (*afe_reset)(void *context, bool held);
    /* Whether the AD5940 pulls its interrupt line low. */
    bool (*afe_interrupt)(void *context);
    /* Connect one multiplexer to an electrode, from 0. */
    void (*mux_select)(void *context, eit_mux mux, uint8_t electrode);
    /* Read at most n bytes from the host; gives their number. */
    size_t (*uart_read)(void *context, uint8_t *data, size_t n);
    /* Write at most n bytes to the host; gives the number accepted. */
    size_t (*uart_write)(void *context, const uint8_t *data, size_t n);
    /* Monotonic clock [us]. */
    uint64_t (*clock_us)(void *context);
    /* Unique number of the microcontroller. */
    void (*unique_id)(void *context, uint8_t uid[EIT_UID_SIZE]);
    /* Count of boots, kept over resets and power cuts. Called once on each boot. */
    uint32_t (*next_boot_count)(void *context);
    /* Sleep until this time or an interrupt; may return early. */
    void (*idle)(void *context, uint64_t until_us);
} eit_hal;

#endif
