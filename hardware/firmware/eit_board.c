#include "eit_board.h"

#include <string.h>

enum { HELLO = 0x01, START = 0x02, STOP = 0x03, GET_TABLE = 0x04, CALIBRATE = 0x05 };
enum { INFO = 0x81, ACK = 0x82, FRAME = 0x83, EVENT = 0x84, TABLE = 0x85 };
enum { DONE = 0, UNKNOWN_TYPE = 1, MALFORMED = 2, FAILED = 4 };
enum { NOTE = 0, WARNING = 1, ERROR = 2 };
enum { AFE_ABSENT = 1, AFE_SILENT = 2, CALIBRATION_FAILED = 3 };

#define FIRMWARE_SIZE 16
#define LATE_US 1000

/* Fewer bytes than between the ends of two packets, so that one read means one answer. */
#define LISTEN_SIZE 8

static eit_writer begin(eit_board *board, uint8_t type) {
    return eit_begin(
        board->outgoing + board->size, EIT_SEND_SIZE - board->size, type, board->seq);
}

/* Send a packet whole or, without room, not at all; the host then asks again. */
static bool end(eit_board *board, eit_writer *writer) {
    const size_t size = eit_end(writer);
    board->size += size;
    if (size > 0) board->seq++;
    return size > 0;
}

static void send_table(eit_board *board) {
    eit_writer writer = begin(board, TABLE);
    eit_put_bytes(&writer, board->config->table, 4u * board->config->n_measurements);
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
    eit_writer writer = begin(board, INFO);
    eit_put_bytes(&writer, "EITS", 4);
    eit_put_bytes(&writer, firmware, sizeof firmware);
    eit_put_bytes(&writer, uid, sizeof uid);
    eit_put_u32(&writer, board->boot_count);
    eit_put_u8(&writer, config->n_electrodes);
    eit_put_u8(&writer, config->n_measurements);
    eit_put_u32(&writer, eit_crc32(0, table, 4u * config->n_measurements));
    eit_put_f32(&writer, config->frequency_hz);
    eit_put_f32(&writer, eit_excitation_volt(config));
    eit_put_f32(&writer, eit_rtia_ohm(config));
    eit_put_f32(&writer, config->rcal_ohm);
    eit_put_u32(&writer, config->period_us);
    end(board, &writer);
}

static void send_ack(eit_board *board, const eit_packet *request, uint8_t status) {
    eit_writer writer = begin(board, ACK);
    eit_put_u16(&writer, request->seq);
    eit_put_u8(&writer, request->type);
    eit_put_u8(&writer, status);
    end(board, &writer);
}

static void send_event(eit_board *board, uint8_t level, uint16_t code, const char *text) {
    eit_writer writer = begin(board, EVENT);
    eit_put_u8(&writer, level);
    eit_put_u16(&writer, code);
    eit_put_bytes(&writer, text, strlen(text));
    end(board, &writer);
}

static void send_absence(eit_board *board) {
    send_event(board, ERROR, AFE_ABSENT, "no AD5940 answers: check its SPI and its supply");
}

static void send_frame(eit_board *board) {
    const eit_scan *scan = &board->scan;
    const uint8_t n = board->config->n_measurements;
    eit_writer writer = begin(board, FRAME);
    eit_put_u32(&writer, board->number);
    eit_put_u64(&writer, scan->started_us - board->booted_us);
    eit_put_u32(&writer, (uint32_t)(scan->ended_us - scan->started_us));
    eit_put_u8(&writer, 0); /* kind: the sensor */
    eit_put_u8(&writer, n);
    eit_put_u16(&writer, 0); /* flags */
    for (uint8_t row = 0; row < n; row++) {
        eit_put_f32(&writer, scan->impedances[row].re);
        eit_put_f32(&writer, scan->impedances[row].im);
    }
    eit_put_bytes(&writer, scan->statuses, n);
    if (end(board, &writer)) board->frame_end = board->size;
}

/* Send the frame, or skip it while another waits: an old frame is worth nothing, and the gap in
 * the numbers shows the skip. */
static void finish_frame(eit_board *board) {
    if (board->frame_end == 0) send_frame(board);
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
    switch (request->type) {
    case START:
        return start(board, request);
    case STOP:
        return request->size == 0 ? stop(board) : MALFORMED;
    case CALIBRATE:
        return request->size == 0 ? calibrate(board) : MALFORMED;
    case HELLO:
    case GET_TABLE: /* well-formed requests have been answered */
        return MALFORMED;
    default:
        return UNKNOWN_TYPE;
    }
}

static void answer(eit_board *board, const eit_packet *request) {
    if (request->type == HELLO && request->size == 0) send_info(board);
    else if (request->type == GET_TABLE && request->size == 0) send_table(board);
    else send_ack(board, request, obey(board, request));
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
