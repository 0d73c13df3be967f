/* The board: requests, answers and frames. One struct holds the whole state, and nothing is
 * allocated. A port calls eit_boot once and eit_poll for ever. */
#ifndef EIT_BOARD_H
#define EIT_BOARD_H

#include "eit_config.h"
#include "eit_hal.h"
#include "eit_packet.h"
#include "eit_scan.h"

/* Room for the largest packet while the largest answer waits. */
#define EIT_SEND_SIZE (2 * EIT_MAX_PACKET)

typedef struct {
    const eit_hal *hal;
    const eit_config *config;
    eit_scan scan;
    eit_decoder decoder;
    uint8_t outgoing[EIT_SEND_SIZE];
    size_t size; /* bytes that wait to be sent */
    size_t frame_end; /* bytes up to the end of a FRAME; 0 where none waits */
    bool torn; /* a part of the present frame was not sent */
    uint32_t part_checksum; /* of the packet with the part before */
    uint32_t boot_count, number; /* number of the next frame */
    uint32_t left; /* frames still to come, 0 for ever */
    bool streaming;
    uint16_t seq;
    uint64_t booted_us, due_us;
} eit_board;

/* Boot; false for an impossible configuration. Both pointers must stay valid. */
bool eit_boot(eit_board *board, const eit_hal *hal, const eit_config *config);

/* Do one short task that is due, or call idle. Never waits. */
void eit_poll(eit_board *board);

#endif
