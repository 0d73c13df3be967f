/* Packets on the wire: docs/wire-protocol.md, version 1.
 *
 * packet = 00 | COBS(version u8, type u8, seq u16, payload, crc32 u32) | 00
 *
 * Numbers are taken apart and put together byte by byte, so that neither the order of bytes in
 * the machine nor the padding of a struct matters. */
#ifndef EIT_PACKET_H
#define EIT_PACKET_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define EIT_VERSION 1
#define EIT_MAX_PACKET 1024 /* on the wire, both zeros included */
#define EIT_MAX_STUFFED (EIT_MAX_PACKET - 2)

/* CRC-32 as in zlib, of n more bytes; start with 0. */
uint32_t eit_crc32(uint32_t crc, const uint8_t *data, size_t n);

uint32_t eit_get_u32(const uint8_t *data);

typedef struct {
    uint8_t type;
    uint16_t seq;
    const uint8_t *payload; /* good until the next byte is decoded */
    size_t size;
} eit_packet;

/* Holds what came of a packet that is not finished; all zero is the start. */
typedef struct {
    uint8_t stuffed[EIT_MAX_STUFFED];
    size_t size;
    bool too_long;
} eit_decoder;

/* Take one byte; true where it ends a whole packet. What is damaged is dropped in silence. */
bool eit_decode(eit_decoder *decoder, uint8_t byte, eit_packet *packet);

/* Stuffs a packet as it is written, so that it needs no buffer but the one it is sent from. */
typedef struct {
    uint8_t *bytes;
    size_t room, size;
    size_t block; /* where the length of the present block goes */
    uint32_t crc;
} eit_writer;

eit_writer eit_begin(uint8_t *bytes, size_t room, uint8_t type, uint16_t seq);
void eit_put_u8(eit_writer *writer, uint8_t value);
void eit_put_u16(eit_writer *writer, uint16_t value);
void eit_put_u32(eit_writer *writer, uint32_t value);
void eit_put_u64(eit_writer *writer, uint64_t value);
void eit_put_f32(eit_writer *writer, float value);
void eit_put_bytes(eit_writer *writer, const void *data, size_t n);

/* Finish the packet: its size on the wire, 0 where there was no room for it. */
size_t eit_end(eit_writer *writer);

#endif
