/* eitskin board on a NUCLEO-F411RE with the AD5940 as a shield. */
#include "boot_flash.h"
#include "clock.h"
#include "eit_board.h"
#include "front_end.h"
#include "serial.h"
#include "stm32f411.h"

#include <string.h>

/* The watchdog has an oscillator of its own, of 32 kHz, anywhere from 17 to 47 kHz. */
#define WATCHDOG_TICKS 500 /* of 2 ms: 1 s, or 0.7 to 1.9 s */

static eit_board board; /* 4.2 kB: not on the stack */
static eit_config config;

static void unique_id(void *context, uint8_t uid[EIT_UID_SIZE]) {
    (void)context;
    for (int i = 0; i < EIT_UID_SIZE; i++) uid[i] = (uint8_t)(UNIQUE_ID[i / 4] >> 8 * (i % 4));
}

static uint32_t next_boot_count(void *context) {
    (void)context;
    return eit_count_boot(&boot_flash);
}

/* Interrupts are masked while it looks once more, so that none comes between look and sleep. */
static void idle(void *context, uint64_t until_us) {
    disable_interrupts();
    if (!serial_has_received() && !front_end_interrupt(context)) clock_sleep(until_us);
    enable_interrupts();
}

static const eit_hal hal = {
    .spi_transfer = front_end_transfer,
    .afe_reset = front_end_reset,
    .afe_interrupt = front_end_interrupt,
    .mux_select = front_end_select,
    .uart_read = serial_read,
    .uart_write = serial_write,
    .clock_us = clock_us,
    .unique_id = unique_id,
    .next_boot_count = next_boot_count,
    .idle = idle,
};

/* The settings of this board; all others are those of eit_config.c. */
static void configure(void) {
    config = eit_pairwise_8;
    config.firmware = "eitskin-f411 1.0";
    config.period_us = 302000; /* its SPI is slower than 16 MHz */
}

static void start_watchdog(void) {
    IWDG->KR = IWDG_START;
    IWDG->KR = IWDG_UNLOCK;
    IWDG->PR = IWDG_PR_64;
    IWDG->RLR = WATCHDOG_TICKS;
    while (IWDG->SR) {
    }
    IWDG->KR = IWDG_RELOAD;
}

int main(void) {
    clock_begin();
    front_end_begin();
    serial_begin();
    configure();
    if (!eit_boot(&board, &hal, &config)) return 1; /* impossible settings: it stays silent */
    start_watchdog();
    for (;;) {
        eit_poll(&board);
        IWDG->KR = IWDG_RELOAD;
    }
}
