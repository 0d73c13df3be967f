/* Measurement table and settings: all differences between boards are data. */
#ifndef EIT_CONFIG_H
#define EIT_CONFIG_H

#include <stdbool.h>
#include <stdint.h>

#define EIT_PER_PACKET 109 /* measurements in one packet: a frame, or a part of a larger one */

/* Amplitude of the excitation, by the gains of the excitation amplifier and the DAC. */
typedef enum { EIT_607_MV, EIT_121_MV, EIT_75_MV, EIT_15_MV, EIT_EXCITATIONS } eit_excitation;

/* Resistor of the transimpedance amplifier, in the order of HSRTIACON. */
typedef enum {
    EIT_RTIA_200,
    EIT_RTIA_1K,
    EIT_RTIA_5K,
    EIT_RTIA_10K,
    EIT_RTIA_20K,
    EIT_RTIA_40K,
    EIT_RTIA_80K,
    EIT_RTIA_160K,
    EIT_RTIAS
} eit_rtia;

/* Gain before the ADC, in the order of ADCCON. */
typedef enum { EIT_PGA_1, EIT_PGA_1P5, EIT_PGA_2, EIT_PGA_4, EIT_PGA_9, EIT_PGAS } eit_pga;

typedef struct {
    const char *firmware; /* name and version, at most 16 ASCII characters */
    const uint8_t (*table)[4]; /* rows of drive+, drive-, sense+, sense- */
    uint16_t n_measurements;
    uint8_t n_electrodes;
    uint8_t excitation, rtia, pga; /* eit_excitation, eit_rtia, eit_pga */
    float frequency_hz;
    float rcal_ohm;
    float open_ohm; /* a larger impedance is that of a lead without electrode */
    uint32_t settle_us; /* time from switching to the first sample */
    uint32_t period_us; /* time from frame to frame; 10600 for each measurement suffice */
} eit_config;

/* Eight electrodes, every pair once, driven and sensed at the same two. */
extern const eit_config eit_pairwise_8;

/* Whether the configuration is possible. */
bool eit_config_is_possible(const eit_config *config);

/* Values of the settings: amplitude [V], resistor [ohm], largest amplitude at the ADC [V], gain. */
float eit_excitation_volt(const eit_config *config);
float eit_rtia_ohm(const eit_config *config);
float eit_pga_volt(const eit_config *config);
float eit_pga_gain(const eit_config *config);

#endif
