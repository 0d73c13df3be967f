/* What the firmware needs of a microcontroller: ten functions, and nothing else.
 *
 * None of them may block, apart from the SPI transfer, which takes microseconds. `context` is
 * the port's own and is handed back to each. hardware/firmware/README.md says which peripheral
 * of an STM32 stands behind which. */
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
    /* Hold the AD5940 in reset, or let it go. */
    void (*afe_reset)(void *context, bool held);
    /* Whether the AD5940 pulls its interrupt line low. */
    bool (*afe_interrupt)(void *context);
    /* Connect one multiplexer to an electrode, from 0. */
    void (*mux_select)(void *context, eit_mux mux, uint8_t electrode);
    /* Take at most n bytes that have come from the host; how many there were. */
    size_t (*uart_read)(void *context, uint8_t *data, size_t n);
    /* Hand over at most n bytes for the host; how many were taken. */
    size_t (*uart_write)(void *context, const uint8_t *data, size_t n);
    /* A clock that never runs backwards [us]. */
    uint64_t (*clock_us)(void *context);
    /* The number of this one microcontroller. */
    void (*unique_id)(void *context, uint8_t uid[EIT_UID_SIZE]);
    /* One more than the last time, over resets and power cuts. Called once on each boot. */
    uint32_t (*next_boot_count)(void *context);
    /* There is nothing to do before this time, unless an interrupt comes; may return early. */
    void (*idle)(void *context, uint64_t until_us);
} eit_hal;

#endif
