#include "eit_scan.h"

#include <math.h>

#define RESET_US 2000
#define ABSENT_US 1000000 /* between two searches for an AD5940 */
#define UNCALIBRATED_FRAMES 32 /* between two tries at a calibration */
#define WAKE_US 5000
#define TRANSFORM_TIMEOUT_US (2 * EIT_DFT_US)
#define LOW_CODES 16 /* a smaller current is known to some per cent at best */
#define RTIA_TOLERANCE 2.0f /* the data sheet gives 20 %; beyond this factor RCAL is missing */

static uint64_t now(const eit_scan *scan) { return scan->hal->clock_us(scan->hal->context); }

static void enter(eit_scan *scan, eit_phase phase, uint64_t lasts_us) {
    scan->phase = phase;
    scan->until_us = lasts_us == EIT_FOREVER ? EIT_FOREVER : now(scan) + lasts_us;
}

static void hold_in_reset(eit_scan *scan) {
    scan->hal->afe_reset(scan->hal->context, true);
    scan->calibration_due = true;
    enter(scan, EIT_RESET_HELD, RESET_US);
}

void eit_scan_begin(eit_scan *scan, const eit_hal *hal, const eit_config *config) {
    *scan = (eit_scan){.hal = hal, .config = config};
    scan->rtia.re = eit_rtia_ohm(config); /* until measured */
    hold_in_reset(scan);
}

void eit_scan_calibrate(eit_scan *scan) { scan->calibration_due = true; }

bool eit_scan_is_ready(const eit_scan *scan) {
    return scan->phase == EIT_RESTING && !scan->calibration_due;
}

static void select_channel(eit_scan *scan, eit_channel channel) {
    scan->channel = channel;
    eit_ad5940_select(scan->hal, scan->config, scan->target, channel);
    enter(scan, EIT_SETTLING, scan->config->settle_us);
}

static void start_row(eit_scan *scan, uint16_t row) {
    const uint8_t *electrodes = scan->config->table[row];
    for (int mux = EIT_DRIVE_PLUS; mux <= EIT_SENSE_MINUS; mux++) {
        scan->hal->mux_select(scan->hal->context, (eit_mux)mux, electrodes[mux]);
    }
    scan->row = row;
    scan->status = 0;
    select_channel(scan, EIT_VOLTAGE);
}

static void connect(eit_scan *scan, eit_target target) {
    scan->target = target;
    eit_ad5940_connect(scan->hal, scan->config, target);
}

void eit_scan_start_frame(eit_scan *scan) {
    scan->started_us = now(scan);
    scan->timeouts = 0;
    scan->first = scan->held = 0;
    connect(scan, EIT_SENSOR);
    start_row(scan, 0);
}

static void start_calibration(eit_scan *scan) {
    scan->status = 0;
    connect(scan, EIT_RCAL);
    select_channel(scan, EIT_VOLTAGE);
}

void eit_scan_stop(eit_scan *scan) {
    const bool measuring = scan->phase == EIT_SETTLING || scan->phase == EIT_TRANSFORMING;
    if (!measuring || scan->target == EIT_RCAL) return;
    eit_transform forgotten;
    eit_ad5940_finish(scan->hal, scan->channel, &forgotten);
    enter(scan, EIT_RESTING, EIT_FOREVER);
}

static float squared(eit_complex z) { return z.re * z.re + z.im * z.im; }

/* Complex quotient in real and imaginary parts, so that no angle has to be wrapped. */
static eit_complex divide(eit_code a, eit_code b) {
    const float ar = (float)a.re, ai = (float)a.im, br = (float)b.re, bi = (float)b.im;
    const float size = br * br + bi * bi;
    return (eit_complex){(ar * br + ai * bi) / size, (ai * br - ar * bi) / size};
}

static eit_complex multiply(eit_complex a, eit_complex b) {
    return (eit_complex){a.re * b.re - a.im * b.im, a.re * b.im + a.im * b.re};
}

/* Current in codes, at least one, so that no impedance is infinite. */
static eit_code at_least_one(eit_scan *scan, eit_code current) {
    const float size = squared((eit_complex){(float)current.re, (float)current.im});
    if (size < (float)LOW_CODES * LOW_CODES) scan->status |= EIT_LOW_CURRENT;
    return size > 0.0f ? current : (eit_code){1, 0};
}

/* Z = V / I RTIA. */
static void keep_impedance(eit_scan *scan, eit_code current) {
    const float open = scan->config->open_ohm;
    const eit_complex ratio = divide(scan->voltage, at_least_one(scan, current));
    const eit_complex z = multiply(ratio, scan->rtia);
    if (squared(z) > open * open) scan->status |= EIT_OPEN;
    if (!scan->calibrated) scan->status |= EIT_UNCALIBRATED;
    scan->impedances[scan->held] = z;
}

/* RTIA = RCAL I / V, with gain and phase of both channels, which cancel in Z. */
static bool keep_rtia(eit_scan *scan, eit_code current) {
    const eit_complex rcal = {scan->config->rcal_ohm, 0.0f};
    const float nominal = eit_rtia_ohm(scan->config);
    if (scan->status != 0 || (scan->voltage.re == 0 && scan->voltage.im == 0)) return false;
    const eit_complex rtia = multiply(divide(current, scan->voltage), rcal);
    const float factor = squared(rtia) / (nominal * nominal);
    const float limit = RTIA_TOLERANCE * RTIA_TOLERANCE;
    if (factor > limit || factor * limit < 1.0f) return false;
    scan->rtia = rtia;
    return true;
}

static eit_outcome end_calibration(eit_scan *scan, eit_code current) {
    scan->calibration_due = false;
    scan->calibrated = keep_rtia(scan, current);
    enter(scan, EIT_RESTING, EIT_FOREVER);
    return scan->calibrated ? EIT_MOVED_ON : EIT_CALIBRATION_FAILED;
}

static eit_outcome end_frame(eit_scan *scan) {
    /* A contact at RCAL may come back. */
    if (!scan->calibrated && ++scan->uncalibrated == UNCALIBRATED_FRAMES) {
        scan->uncalibrated = 0;
        scan->calibration_due = true;
    }
    enter(scan, EIT_RESTING, EIT_FOREVER);
    return EIT_FRAME_MEASURED;
}

static eit_outcome end_row(eit_scan *scan, eit_code current) {
    if (scan->held == EIT_PER_PACKET) { /* the part before has been sent */
        scan->first = scan->row;
        scan->held = 0;
    }
    if (scan->status & EIT_DFT_TIMEOUT) {
        scan->impedances[scan->held] = (eit_complex){NAN, NAN};
        scan->timeouts++;
    } else {
        keep_impedance(scan, current);
    }
    scan->statuses[scan->held++] = scan->status;
    scan->ended_us = now(scan);
    if (scan->row + 1 == scan->config->n_measurements) return end_frame(scan);
    start_row(scan, (uint16_t)(scan->row + 1));
    return scan->held == EIT_PER_PACKET ? EIT_PART_MEASURED : EIT_MOVED_ON;
}

static eit_outcome end_transform(eit_scan *scan) {
    eit_transform transform = {{0, 0}, false};
    if (!eit_ad5940_finish(scan->hal, scan->channel, &transform)) scan->status |= EIT_DFT_TIMEOUT;
    if (transform.clipped) scan->status |= EIT_CLIPPED;
    /* Without a voltage the current is not needed. */
    if (scan->channel == EIT_VOLTAGE && !(scan->status & EIT_DFT_TIMEOUT)) {
        scan->voltage = transform.code;
        select_channel(scan, EIT_CURRENT);
        return EIT_MOVED_ON;
    }
    if (scan->target == EIT_RCAL) return end_calibration(scan, transform.code);
    return end_row(scan, transform.code);
}

static eit_outcome end_waking(eit_scan *scan) {
    const bool was_absent = scan->absent;
    scan->absent = !eit_ad5940_begin(scan->hal, scan->config);
    if (!scan->absent) {
        enter(scan, EIT_RESTING, EIT_FOREVER);
        return EIT_MOVED_ON;
    }
    enter(scan, EIT_WAITING, ABSENT_US);
    return was_absent ? EIT_MOVED_ON : EIT_AFE_ABSENT;
}

/* Reset an AD5940 that lost its registers (spark, supply dip): it would time out for ever. */
static bool has_gone_silent(const eit_scan *scan) {
    return scan->timeouts == scan->config->n_measurements;
}

static eit_outcome leave_rest(eit_scan *scan) {
    if (has_gone_silent(scan)) {
        scan->timeouts = 0;
        hold_in_reset(scan);
        return EIT_AFE_SILENT;
    }
    if (!scan->calibration_due) return EIT_NOTHING;
    start_calibration(scan);
    return EIT_MOVED_ON;
}

eit_outcome eit_scan_poll(eit_scan *scan) {
    const bool over = now(scan) >= scan->until_us;
    switch (scan->phase) {
    case EIT_RESTING:
        return leave_rest(scan);
    case EIT_TRANSFORMING:
        return over || scan->hal->afe_interrupt(scan->hal->context) ? end_transform(scan)
                                                                    : EIT_NOTHING;
    case EIT_SETTLING:
        if (!over) return EIT_NOTHING;
        eit_ad5940_convert(scan->hal);
        enter(scan, EIT_TRANSFORMING, TRANSFORM_TIMEOUT_US);
        return EIT_MOVED_ON;
    case EIT_RESET_HELD:
        if (!over) return EIT_NOTHING;
        scan->hal->afe_reset(scan->hal->context, false);
        enter(scan, EIT_WAKING, WAKE_US);
        return EIT_MOVED_ON;
    case EIT_WAKING:
        return over ? end_waking(scan) : EIT_NOTHING;
    default: /* EIT_WAITING */
        if (!over) return EIT_NOTHING;
        hold_in_reset(scan);
        return EIT_MOVED_ON;
    }
}
