#include "eit_packet.h"

#include <string.h>

#define HEADER_SIZE 4
#define CRC_SIZE 4
#define LONGEST_BLOCK 0xFF

/* FRAME holds IEEE 754 single precision, which `float` must be. */
typedef char float_is_32_bits[sizeof(float) == 4 ? 1 : -1];

uint32_t eit_crc32(uint32_t crc, const uint8_t *data, size_t n) {
    crc = ~crc;
    while (n--) {
        crc ^= *data++;
        for (int bit = 0; bit < 8; bit++) crc = crc >> 1 ^ (crc & 1 ? 0xEDB88320u : 0);
    }
    return ~crc;
}

uint16_t eit_get_u16(const uint8_t *data) { return (uint16_t)(data[0] | data[1] << 8); }

uint32_t eit_get_u32(const uint8_t *data) {
    return data[0] | (uint32_t)data[1] << 8 | (uint32_t)data[2] << 16 | (uint32_t)data[3] << 24;
}

/* Unstuff in place, possible because the result is never longer; false where a block runs past
 * the end. */
static bool unstuff(uint8_t *data, size_t *size) {
    size_t from = 0, to = 0;
    while (from < *size) {
        const uint8_t block = data[from];
        if (from + block > *size) return false;
        memmove(data + to, data + from + 1, block - 1u);
        to += block - 1u;
        from += block;
        if (from < *size && block != LONGEST_BLOCK) data[to++] = 0;
    }
    *size = to;
    return true;
}

static bool open_packet(uint8_t *data, size_t size, eit_packet *packet) {
    if (!unstuff(data, &size) || size < HEADER_SIZE + CRC_SIZE) return false;
    size -= CRC_SIZE;
    if (eit_get_u32(data + size) != eit_crc32(0, data, size)) return false;
    if (data[0] < 1 || data[0] > EIT_LAST_VERSION) return false;
    packet->version = data[0];
    packet->type = data[1];
    packet->seq = eit_get_u16(data + 2);
    packet->payload = data + HEADER_SIZE;
    packet->size = size - HEADER_SIZE;
    return true;
}

bool eit_decode(eit_decoder *decoder, uint8_t byte, eit_packet *packet) {
    if (byte != 0) {
        if (decoder->size == EIT_MAX_STUFFED) decoder->too_long = true;
        else decoder->stuffed[decoder->size++] = byte;
        return false;
    }
    const size_t size = decoder->too_long ? 0 : decoder->size;
    decoder->size = 0;
    decoder->too_long = false;
    return size > 0 && open_packet(decoder->stuffed, size, packet);
}

static void put_raw(eit_writer *writer, uint8_t byte) {
    if (writer->size < writer->room) writer->bytes[writer->size] = byte;
    writer->size++;
}

static void end_block(eit_writer *writer) {
    if (writer->block < writer->room) {
        writer->bytes[writer->block] = (uint8_t)(writer->size - writer->block);
    }
}

static void begin_block(eit_writer *writer) {
    writer->block = writer->size;
    put_raw(writer, 0);
}

static void stuff(eit_writer *writer, uint8_t byte) {
    /* A full block ends without a zero; another block follows only with more bytes. */
    if (writer->size - writer->block == LONGEST_BLOCK) {
        end_block(writer);
        begin_block(writer);
    }
    if (byte != 0) {
        put_raw(writer, byte);
    } else {
        end_block(writer);
        begin_block(writer);
    }
}

void eit_put_u8(eit_writer *writer, uint8_t value) {
    writer->crc = eit_crc32(writer->crc, &value, 1);
    stuff(writer, value);
}

void eit_put_u16(eit_writer *writer, uint16_t value) {
    eit_put_u8(writer, (uint8_t)value);
    eit_put_u8(writer, (uint8_t)(value >> 8));
}

void eit_put_u32(eit_writer *writer, uint32_t value) {
    eit_put_u16(writer, (uint16_t)value);
    eit_put_u16(writer, (uint16_t)(value >> 16));
}

void eit_put_u64(eit_writer *writer, uint64_t value) {
    eit_put_u32(writer, (uint32_t)value);
    eit_put_u32(writer, (uint32_t)(value >> 32));
}

void eit_put_f32(eit_writer *writer, float value) {
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    eit_put_u32(writer, bits);
}

void eit_put_bytes(eit_writer *writer, const void *data, size_t n) {
    const uint8_t *bytes = data;
    while (n--) eit_put_u8(writer, *bytes++);
}

eit_writer eit_begin(uint8_t *bytes, size_t room, uint8_t version, uint8_t type, uint16_t seq) {
    eit_writer writer = {.bytes = bytes, .room = room};
    put_raw(&writer, 0);
    begin_block(&writer);
    eit_put_u8(&writer, version);
    eit_put_u8(&writer, type);
    eit_put_u16(&writer, seq);
    return writer;
}

size_t eit_end(eit_writer *writer) {
    eit_put_u32(writer, writer->crc);
    end_block(writer);
    put_raw(writer, 0);
    return writer->size <= writer->room ? writer->size : 0;
}
