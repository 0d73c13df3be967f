/* What the tests look at inside the firmware; compiled together with it. */
#include "eit_board.h"

#include <string.h>

size_t shim_size(void) { return sizeof(eit_board); }

bool shim_is_streaming(const eit_board *board) { return board->streaming; }

size_t shim_unsent(const eit_board *board) { return board->size; }

uint32_t shim_number(const eit_board *board) { return board->number; }

void shim_set_number(eit_board *board, uint32_t number) { board->number = number; }

size_t shim_encode(
    uint8_t version, uint8_t type, uint16_t seq, const uint8_t *payload, size_t n, uint8_t *out,
    size_t room) {
    eit_writer writer = eit_begin(out, room, version, type, seq);
    eit_put_bytes(&writer, payload, n);
    return eit_end(&writer);
}

/* Each packet found in the stream as version, type, seq, size and payload, little-endian. */
size_t shim_decode(const uint8_t *stream, size_t n, uint8_t *found) {
    eit_decoder decoder = {.size = 0};
    size_t size = 0;
    for (size_t i = 0; i < n; i++) {
        eit_packet packet;
        if (!eit_decode(&decoder, stream[i], &packet)) continue;
        const uint8_t head[6] = {
            packet.version, packet.type, (uint8_t)packet.seq, (uint8_t)(packet.seq >> 8), (uint8_t)packet.size,
            (uint8_t)(packet.size >> 8)};
        memcpy(found + size, head, sizeof head);
        memcpy(found + size + sizeof head, packet.payload, packet.size);
        size += sizeof head + packet.size;
    }
    return size;
}
