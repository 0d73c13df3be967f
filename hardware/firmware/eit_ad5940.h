/* Registers of the AD5940: one transform of voltage or current at a time. */
#ifndef EIT_AD5940_H
#define EIT_AD5940_H

#include "eit_config.h"
#include "eit_hal.h"

/* One transform: 2048 points of the SINC3 filter, of 2 samples each, at 800 kSPS. The filter
 * needs two more points to fill, so (2048 + 2) * 2 + 1 samples: 5126 us. */
#define EIT_DFT_US 5127
#define EIT_DFT_CODES 131072 /* 18 bits, of which one is the sign */

typedef enum { EIT_SENSOR, EIT_RCAL } eit_target;
typedef enum { EIT_VOLTAGE, EIT_CURRENT } eit_channel;

typedef struct {
    int32_t re, im;
} eit_code;

typedef struct {
    eit_code code; /* current in the direction of the voltage */
    bool clipped;
} eit_transform;

/* Set up the AD5940 after a reset; false where none answers. */
bool eit_ad5940_begin(const eit_hal *hal, const eit_config *config);

/* Put the excitation on the sensor, or on the calibration resistor. */
void eit_ad5940_connect(const eit_hal *hal, const eit_config *config, eit_target target);

/* Connect the ADC to the channel to be transformed. */
void eit_ad5940_select(
    const eit_hal *hal, const eit_config *config, eit_target target, eit_channel channel);

void eit_ad5940_convert(const eit_hal *hal);

/* Stop converting, and give the transform; false for an unfinished one. */
bool eit_ad5940_finish(const eit_hal *hal, eit_channel channel, eit_transform *transform);

#endif
