/* Packets on the wire: docs/reference/wire-protocol.md, versions 1 and 2.
 *
 * packet = 00 | COBS(version u8, type u8, seq u16, payload, crc32 u32) | 00
 *
 * Numbers are packed and unpacked byte by byte, independent of the byte order of the machine and
 * of the padding of structs. */
#ifndef EIT_PACKET_H
#define EIT_PACKET_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define EIT_LAST_VERSION 2
#define EIT_MAX_PACKET 1024 /* on the wire, both zeros included */
#define EIT_MAX_STUFFED (EIT_MAX_PACKET - 2)

/* CRC-32 as in zlib, of n more bytes; start with 0. */
uint32_t eit_crc32(uint32_t crc, const uint8_t *data, size_t n);

uint16_t eit_get_u16(const uint8_t *data);
uint32_t eit_get_u32(const uint8_t *data);

typedef struct {
    uint8_t version, type;
    uint16_t seq;
    const uint8_t *payload; /* valid until the next byte is decoded */
    size_t size;
} eit_packet;

/* Decoder with the bytes of an unfinished packet; all zero at the start. */
typedef struct {
    uint8_t stuffed[EIT_MAX_STUFFED];
    size_t size;
    bool too_long;
} eit_decoder;

/* Decode one byte; true at the end of a whole packet. Damaged packets are dropped silently. */
bool eit_decode(eit_decoder *decoder, uint8_t byte, eit_packet *packet);

/* Writer that stuffs a packet in the buffer that it is sent from. */
typedef struct {
    uint8_t *bytes;
    size_t room, size;
    size_t block; /* position of the present block's length */
    uint32_t crc; /* checksum of the packet, once all its payload is put */
} eit_writer;

eit_writer eit_begin(uint8_t *bytes, size_t room, uint8_t version, uint8_t type, uint16_t seq);
void eit_put_u8(eit_writer *writer, uint8_t value);
void eit_put_u16(eit_writer *writer, uint16_t value);
void eit_put_u32(eit_writer *writer, uint32_t value);
void eit_put_u64(eit_writer *writer, uint64_t value);
void eit_put_f32(eit_writer *writer, float value);
void eit_put_bytes(eit_writer *writer, const void *data, size_t n);

/* Finish the packet; gives its size on the wire, 0 without room for it. */
size_t eit_end(eit_writer *writer);

#endif
