#include "eit_board.h"

#include <string.h>

enum { HELLO = 0x01, START = 0x02, STOP = 0x03, GET_TABLE = 0x04, CALIBRATE = 0x05 };
enum { INFO = 0x81, ACK = 0x82, FRAME = 0x83, EVENT = 0x84, TABLE = 0x85 };
enum { DONE = 0, UNKNOWN_TYPE = 1, MALFORMED = 2, FAILED = 4 };
enum { NOTE = 0, WARNING = 1, ERROR = 2 };
enum { AFE_ABSENT = 1, AFE_SILENT = 2, CALIBRATION_FAILED = 3 };

#define FIRMWARE_SIZE 16
#define LATE_US 1000
#define ROWS_PER_PACKET 251 /* of TABLE in parts */

/* Fewer bytes than between the ends of two packets, so that one read means one answer. */
#define LISTEN_SIZE 8

static eit_writer begin(eit_board *board, uint8_t version, uint8_t type) {
    return eit_begin(
        board->outgoing + board->size, EIT_SEND_SIZE - board->size, version, type, board->seq);
}

/* Version of what depends on the size of the table: 2 where a frame needs several packets. */
static uint8_t size_version(const eit_config *config) {
    return config->n_measurements > EIT_PER_PACKET ? 2 : 1;
}

/* Send a packet whole or, without room, not at all; the host then asks again. */
static bool end(eit_board *board, eit_writer *writer) {
    const size_t size = eit_end(writer);
    board->size += size;
    if (size > 0) board->seq++;
    return size > 0;
}

static void send_table(eit_board *board) {
    eit_writer writer = begin(board, 1, TABLE);
    eit_put_bytes(&writer, board->config->table, 4u * board->config->n_measurements);
    end(board, &writer);
}

static void send_rows(eit_board *board, uint16_t first) {
    const uint16_t n = board->config->n_measurements;
    const uint16_t left = (uint16_t)(n - first);
    eit_writer writer = begin(board, 2, TABLE);
    eit_put_u16(&writer, n);
    eit_put_u16(&writer, first);
    eit_put_bytes(
        &writer, board->config->table[first], 4u * (left < ROWS_PER_PACKET ? left : ROWS_PER_PACKET));
    end(board, &writer);
}

static void send_info(eit_board *board) {
    const eit_config *config = board->config;
    const uint8_t *table = (const uint8_t *)config->table;
    char firmware[FIRMWARE_SIZE] = {0};
    uint8_t uid[EIT_UID_SIZE] = {0};
    for (size_t i = 0; i < FIRMWARE_SIZE && config->firmware[i]; i++) {
        firmware[i] = config->firmware[i];
    }
    board->hal->unique_id(board->hal->context, uid);
    eit_writer writer = begin(board, size_version(config), INFO);
    eit_put_bytes(&writer, "EITS", 4);
    eit_put_bytes(&writer, firmware, sizeof firmware);
    eit_put_bytes(&writer, uid, sizeof uid);
    eit_put_u32(&writer, board->boot_count);
    eit_put_u8(&writer, config->n_electrodes);
    if (size_version(config) == 1) eit_put_u8(&writer, (uint8_t)config->n_measurements);
    else eit_put_u16(&writer, config->n_measurements);
    eit_put_u32(&writer, eit_crc32(0, table, 4u * config->n_measurements));
    eit_put_f32(&writer, config->frequency_hz);
    eit_put_f32(&writer, eit_excitation_volt(config));
    eit_put_f32(&writer, eit_rtia_ohm(config));
    eit_put_f32(&writer, config->rcal_ohm);
    eit_put_u32(&writer, config->period_us);
    end(board, &writer);
}

static void send_ack(eit_board *board, const eit_packet *request, uint8_t status) {
    eit_writer writer = begin(board, 1, ACK);
    eit_put_u16(&writer, request->seq);
    eit_put_u8(&writer, request->type);
    eit_put_u8(&writer, status);
    end(board, &writer);
}

static void send_event(eit_board *board, uint8_t level, uint16_t code, const char *text) {
    eit_writer writer = begin(board, 1, EVENT);
    eit_put_u8(&writer, level);
    eit_put_u16(&writer, code);
    eit_put_bytes(&writer, text, strlen(text));
    end(board, &writer);
}

static void send_absence(eit_board *board) {
    send_event(board, ERROR, AFE_ABSENT, "no AD5940 answers: check its SPI and its supply");
}

/* Send the measurements that are held: a frame, or a part that names the part before it by the
 * checksum of its packet. */
static bool send_measurements(eit_board *board) {
    const eit_scan *scan = &board->scan;
    const eit_config *config = board->config;
    eit_writer writer = begin(board, size_version(config), FRAME);
    eit_put_u32(&writer, board->number);
    eit_put_u64(&writer, scan->started_us - board->booted_us);
    eit_put_u32(&writer, (uint32_t)(scan->ended_us - scan->started_us));
    eit_put_u8(&writer, 0); /* kind: the sensor */
    eit_put_u8(&writer, (uint8_t)scan->held);
    eit_put_u16(&writer, 0); /* flags */
    if (size_version(config) == 2) {
        eit_put_u16(&writer, config->n_measurements);
        eit_put_u16(&writer, scan->first);
        eit_put_u32(&writer, scan->first > 0 ? board->part_checksum : 0);
    }
    for (uint16_t i = 0; i < scan->held; i++) {
        eit_put_f32(&writer, scan->impedances[i].re);
        eit_put_f32(&writer, scan->impedances[i].im);
    }
    eit_put_bytes(&writer, scan->statuses, scan->held);
    board->part_checksum = writer.crc;
    if (!end(board, &writer)) return false;
    board->frame_end = board->size;
    return true;
}

/* Send a frame or a part. While an old frame waits a new one is not begun, and after a part that found
 * no room nothing more of its frame is sent; the gap in the numbers shows the skip. */
static void finish_part(eit_board *board) {
    if (board->scan.first == 0) board->torn = board->frame_end > 0;
    if (!board->torn) board->torn = !send_measurements(board);
}

static void finish_frame(eit_board *board) {
    finish_part(board);
    board->number++;
    if (board->left > 0 && --board->left == 0) board->streaming = false;
}

static uint8_t start(eit_board *board, const eit_packet *request) {
    if (request->size != 4) return MALFORMED;
    if (board->scan.absent) {
        send_absence(board); /* the host may have missed the first report */
        return FAILED;
    }
    if (!board->streaming) board->due_us = board->hal->clock_us(board->hal->context);
    board->left = eit_get_u32(request->payload);
    board->streaming = true;
    return DONE;
}

static uint8_t stop(eit_board *board) {
    board->streaming = false;
    eit_scan_stop(&board->scan);
    return DONE;
}

static uint8_t calibrate(eit_board *board) {
    if (board->scan.absent) return FAILED;
    eit_scan_calibrate(&board->scan);
    return DONE;
}

static uint8_t obey(eit_board *board, const eit_packet *request) {
    if (request->version != 1) return UNKNOWN_TYPE;
    switch (request->type) {
    case START:
        return start(board, request);
    case STOP:
        return request->size == 0 ? stop(board) : MALFORMED;
    case CALIBRATE:
        return request->size == 0 ? calibrate(board) : MALFORMED;
    case HELLO: /* well-formed requests have been answered */
        return MALFORMED;
    default:
        return UNKNOWN_TYPE;
    }
}

/* Send the table, whole in version 1 and from a row on in version 2. */
static uint8_t answer_table(eit_board *board, const eit_packet *request) {
    const uint16_t n = board->config->n_measurements;
    if (request->size != (request->version == 1 ? 0u : 2u)) return MALFORMED;
    if (request->version == 1) {
        if (n > EIT_PER_PACKET) return FAILED;
        send_table(board);
        return DONE;
    }
    const uint16_t first = eit_get_u16(request->payload);
    if (first >= n) return MALFORMED;
    send_rows(board, first);
    return DONE;
}

static void answer(eit_board *board, const eit_packet *request) {
    uint8_t status;
    if (request->type == GET_TABLE) {
        status = answer_table(board, request);
        if (status != DONE) send_ack(board, request, status);
    } else if (request->type == HELLO && request->version == 1 && request->size == 0) {
        send_info(board);
    } else {
        send_ack(board, request, obey(board, request));
    }
}

/* Answer at most one request; requests wait while the answer would not fit. */
static bool listen(eit_board *board) {
    uint8_t bytes[LISTEN_SIZE];
    if (EIT_SEND_SIZE - board->size < EIT_MAX_PACKET) return false;
    const size_t n = board->hal->uart_read(board->hal->context, bytes, sizeof bytes);
    for (size_t i = 0; i < n; i++) {
        eit_packet request;
        if (eit_decode(&board->decoder, bytes[i], &request)) answer(board, &request);
    }
    return n > 0;
}

static bool flush(eit_board *board) {
    if (board->size == 0) return false;
    const size_t n = board->hal->uart_write(board->hal->context, board->outgoing, board->size);
    board->size -= n;
    board->frame_end -= n < board->frame_end ? n : board->frame_end;
    memmove(board->outgoing, board->outgoing + n, board->size);
    return n > 0;
}

static bool measure(eit_board *board) {
    const eit_outcome outcome = eit_scan_poll(&board->scan);
    switch (outcome) {
    case EIT_PART_MEASURED:
        finish_part(board);
        break;
    case EIT_FRAME_MEASURED:
        finish_frame(board);
        break;
    case EIT_AFE_ABSENT:
        board->streaming = false;
        send_absence(board);
        break;
    case EIT_AFE_SILENT:
        send_event(board, WARNING, AFE_SILENT, "a frame of DFT timeouts: resetting the AD5940");
        break;
    case EIT_CALIBRATION_FAILED:
        send_event(board, WARNING, CALIBRATION_FAILED, "RCAL reads wrong: RTIA is not calibrated");
        break;
    default:
        break;
    }
    return outcome != EIT_NOTHING;
}

/* Frames keep to their period, however long a poll takes; a late frame, after a calibration for
 * instance, begins a new count of periods. */
static bool start_frame(eit_board *board) {
    const uint64_t now = board->hal->clock_us(board->hal->context);
    if (!board->streaming || !eit_scan_is_ready(&board->scan) || now < board->due_us) return false;
    if (now - board->due_us > LATE_US) board->due_us = now;
    board->due_us += board->config->period_us;
    eit_scan_start_frame(&board->scan);
    return true;
}

static uint64_t next_time(const eit_board *board) {
    if (board->streaming && eit_scan_is_ready(&board->scan)) return board->due_us;
    return board->scan.until_us;
}

bool eit_boot(eit_board *board, const eit_hal *hal, const eit_config *config) {
    memset(board, 0, sizeof *board);
    if (!eit_config_is_possible(config)) return false;
    board->hal = hal;
    board->config = config;
    board->boot_count = hal->next_boot_count(hal->context);
    board->booted_us = hal->clock_us(hal->context);
    eit_scan_begin(&board->scan, hal, config);
    send_info(board);
    return true;
}

void eit_poll(eit_board *board) {
    bool busy = flush(board);
    busy = listen(board) || busy;
    busy = measure(board) || busy;
    busy = start_frame(board) || busy;
    if (!busy) board->hal->idle(board->hal->context, next_time(board));
}
