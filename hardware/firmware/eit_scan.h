/* The measurement: a state machine that takes the AD5940 through the rows of the table, voltage
 * then current, without ever waiting. */
#ifndef EIT_SCAN_H
#define EIT_SCAN_H

#include "eit_ad5940.h"
#include "eit_config.h"
#include "eit_hal.h"

/* Status of one measurement, as in FRAME. */
#define EIT_CLIPPED 0x01
#define EIT_DFT_TIMEOUT 0x04
#define EIT_OPEN 0x08
#define EIT_LOW_CURRENT 0x10
#define EIT_UNCALIBRATED 0x20

typedef struct {
    float re, im;
} eit_complex;

typedef enum {
    EIT_RESET_HELD, /* AD5940 held in reset */
    EIT_WAKING, /* AD5940 released from reset */
    EIT_RESTING, /* no measurement running */
    EIT_SETTLING, /* switched, not yet converting */
    EIT_TRANSFORMING,
    EIT_WAITING, /* no AD5940 answered after its reset; searched for again */
} eit_phase;

/* Result of one poll. */
typedef enum {
    EIT_NOTHING,
    EIT_MOVED_ON,
    EIT_PART_MEASURED, /* as many measurements as a packet holds, with more to come */
    EIT_FRAME_MEASURED,
    EIT_AFE_ABSENT,
    EIT_AFE_SILENT, /* a whole frame of timeouts; the AD5940 is being reset */
    EIT_CALIBRATION_FAILED,
} eit_outcome;

typedef struct {
    const eit_hal *hal;
    const eit_config *config;
    eit_phase phase;
    uint64_t until_us; /* end of the phase */
    eit_target target;
    eit_channel channel;
    uint16_t row, timeouts;
    uint8_t status; /* status of the row so far */
    eit_code voltage;
    bool calibration_due, calibrated;
    uint8_t uncalibrated; /* frames since a calibration failed */
    bool absent; /* no AD5940 has answered since the reset */
    eit_complex rtia; /* ohm, with the phase of the whole current channel */
    uint64_t started_us, ended_us; /* start of the frame, end of the newest part */
    uint16_t first, held; /* row of the first measurement below, and how many are held */
    eit_complex impedances[EIT_PER_PACKET]; /* ohm */
    uint8_t statuses[EIT_PER_PACKET];
} eit_scan;

/* Start from the reset of the AD5940; a calibration follows. */
void eit_scan_begin(eit_scan *scan, const eit_hal *hal, const eit_config *config);

/* Measure the calibration resistor before the next frame. */
void eit_scan_calibrate(eit_scan *scan);

/* Whether a frame may start. */
bool eit_scan_is_ready(const eit_scan *scan);

void eit_scan_start_frame(eit_scan *scan);

/* Abandon the frame that is being measured. */
void eit_scan_stop(eit_scan *scan);

/* Do the step that is due, if any. */
eit_outcome eit_scan_poll(eit_scan *scan);

#endif
