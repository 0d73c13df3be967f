/* The AD5940 at the level of its registers: one transform of voltage or current at a time. */
#ifndef EIT_AD5940_H
#define EIT_AD5940_H

#include "eit_config.h"
#include "eit_hal.h"

/* One transform: 2048 points of the SINC3 filter, of 2 samples each, at 800 kSPS. The filter
 * needs two more of its points to fill, so (2048 + 2) * 2 + 1 samples: 5126 us. */
#define EIT_DFT_US 5127
#define EIT_DFT_CODES 131072 /* 18 bits, of which one is the sign */

typedef enum { EIT_SENSOR, EIT_RCAL } eit_target;
typedef enum { EIT_VOLTAGE, EIT_CURRENT } eit_channel;

typedef struct {
    int32_t re, im;
} eit_code;

typedef struct {
    eit_code code; /* the current is counted in the direction of the voltage */
    bool clipped;
} eit_transform;

/* Set it up after a reset; false where no AD5940 answers. */
bool eit_ad5940_begin(const eit_hal *hal, const eit_config *config);

/* Put the excitation on the sensor, or on the calibration resistor. */
void eit_ad5940_connect(const eit_hal *hal, const eit_config *config, eit_target target);

/* Point the ADC at what is to be transformed. */
void eit_ad5940_select(
    const eit_hal *hal, const eit_config *config, eit_target target, eit_channel channel);

void eit_ad5940_convert(const eit_hal *hal);

/* Stop converting, and give the transform; false where it has not finished. */
bool eit_ad5940_finish(const eit_hal *hal, eit_channel channel, eit_transform *transform);

#endif
