/* The firmware on a host: takes what the host sends from standard input, in pieces of any length,
 * and writes what it sends to standard output. Its AD5940 answers with noise. */
#include "eit_board.h"

#include <stdio.h>
#include <string.h>

typedef struct {
    uint64_t clock;
    uint32_t noise;
    uint16_t address;
    bool ended;
} machine;

static uint32_t noise(machine *m) { /* xorshift, Marsaglia 2003 */
    m->noise ^= m->noise << 13;
    m->noise ^= m->noise >> 17;
    m->noise ^= m->noise << 5;
    return m->noise;
}

static void spi_transfer(void *context, const uint8_t *out, uint8_t *in, size_t n) {
    machine *m = context;
    for (size_t i = 0; i < n; i++) in[i] = (uint8_t)noise(m);
    if (out[0] == 0x20 && n == 3) m->address = (uint16_t)(out[1] << 8 | out[2]);
    if (out[0] == 0x6D && m->address == 0x0400) memcpy(in + 2, "\x41\x44", 2);
    if (out[0] == 0x6D && m->address == 0x0404) memcpy(in + 2, "\x55\x02", 2);
}

static void afe_reset(void *context, bool held) { (void)context, (void)held; }

static bool afe_interrupt(void *context) { return noise(context) % 4 == 0; }

static void mux_select(void *context, eit_mux mux, uint8_t electrode) {
    (void)context, (void)mux, (void)electrode;
}

static size_t uart_read(void *context, uint8_t *data, size_t n) {
    machine *m = context;
    n = noise(m) % (n + 1);
    size_t got = fread(data, 1, n, stdin);
    m->ended = m->ended || got < n;
    return got;
}

static size_t uart_write(void *context, const uint8_t *data, size_t n) {
    const size_t most = noise(context) % 24;
    return fwrite(data, 1, n < most ? n : most, stdout);
}

static uint64_t clock_us(void *context) { return ((machine *)context)->clock += 3; }

static void unique_id(void *context, uint8_t uid[EIT_UID_SIZE]) {
    (void)context;
    memset(uid, 0, EIT_UID_SIZE);
}

static uint32_t next_boot_count(void *context) { return (void)context, 1; }

static void idle(void *context, uint64_t until_us) {
    machine *m = context;
    if (until_us != EIT_FOREVER && until_us > m->clock) m->clock = until_us;
}

/* Adjacent protocol of 32 electrodes, in several packets. */
static eit_config large_config(void) {
    static uint8_t table[928][4];
    uint16_t n = 0;
    for (uint8_t drive = 0; drive < 32; drive++) {
        for (uint8_t next = 2; next < 31; next++) {
            const uint8_t sense = (uint8_t)((drive + next) % 32);
            const uint8_t row[4] = {
                drive, (uint8_t)((drive + 1) % 32), sense, (uint8_t)((sense + 1) % 32)};
            memcpy(table[n++], row, sizeof row);
        }
    }
    eit_config config = eit_pairwise_8;
    config.table = (const uint8_t (*)[4])table;
    config.n_measurements = n;
    config.n_electrodes = 32;
    config.period_us = 928u * 10600u;
    return config;
}

int main(int argc, char **argv) {
    (void)argv;
    const eit_config config = argc > 1 ? large_config() : eit_pairwise_8;
    machine m = {.noise = 2463534242u};
    const eit_hal hal = {
        &m,         spi_transfer, afe_reset, afe_interrupt,   mux_select, uart_read,
        uart_write, clock_us,     unique_id, next_boot_count, idle,
    };
    static eit_board board;
    if (!eit_boot(&board, &hal, &config)) return 1;
    while (!m.ended || board.size > 0) {
        eit_poll(&board);
        if (m.ended) board.streaming = false; /* or there is no end to it */
    }
    return 0;
}
