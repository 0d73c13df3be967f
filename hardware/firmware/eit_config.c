#include "eit_config.h"

#include "eit_ad5940.h"

static const uint8_t pairs_of_8[][4] = {
    {0, 1, 0, 1}, {0, 2, 0, 2}, {0, 3, 0, 3}, {0, 4, 0, 4}, {0, 5, 0, 5}, {0, 6, 0, 6},
    {0, 7, 0, 7},
    {1, 2, 1, 2}, {1, 3, 1, 3}, {1, 4, 1, 4}, {1, 5, 1, 5}, {1, 6, 1, 6}, {1, 7, 1, 7},
    {2, 3, 2, 3}, {2, 4, 2, 4}, {2, 5, 2, 5}, {2, 6, 2, 6}, {2, 7, 2, 7},
    {3, 4, 3, 4}, {3, 5, 3, 5}, {3, 6, 3, 6}, {3, 7, 3, 7},
    {4, 5, 4, 5}, {4, 6, 4, 6}, {4, 7, 4, 7},
    {5, 6, 5, 6}, {5, 7, 5, 7},
    {6, 7, 6, 7},
};

const eit_config eit_pairwise_8 = {
    .firmware = "eitskin-c 1.0",
    .table = pairs_of_8,
    .n_measurements = sizeof pairs_of_8 / sizeof pairs_of_8[0],
    .n_electrodes = 8,
    .excitation = EIT_607_MV,
    .rtia = EIT_RTIA_200,
    .pga = EIT_PGA_1P5,
    .frequency_hz = 40e3f,
    .rcal_ohm = 200.0f,
    .open_ohm = 20e3f,
    .settle_us = 120,
    .period_us = 28 * 10600,
};

/* Full scale of the excitation, data sheet table of HSDACCON. */
static const float excitation_volt[EIT_EXCITATIONS] = {0.607f, 0.121f, 0.075f, 0.015f};
static const float rtia_ohm[EIT_RTIAS] = {200.0f, 1e3f, 5e3f, 10e3f, 20e3f, 40e3f, 80e3f, 160e3f};
static const float pga_volt[EIT_PGAS] = {0.9f, 0.9f, 0.6f, 0.3f, 0.133f};
static const float pga_gain[EIT_PGAS] = {1.0f, 1.5f, 2.0f, 4.0f, 9.0f};

float eit_excitation_volt(const eit_config *config) { return excitation_volt[config->excitation]; }

float eit_rtia_ohm(const eit_config *config) { return rtia_ohm[config->rtia]; }

float eit_pga_volt(const eit_config *config) { return pga_volt[config->pga]; }

float eit_pga_gain(const eit_config *config) { return pga_gain[config->pga]; }

static uint32_t shortest_period_us(const eit_config *config) {
    return config->n_measurements * 2 * (config->settle_us + EIT_DFT_US);
}

bool eit_config_is_possible(const eit_config *config) {
    if (config->n_measurements < 1) return false;
    for (uint16_t row = 0; row < config->n_measurements; row++) {
        const uint8_t *pair = config->table[row];
        for (int i = 0; i < 4; i++) {
            if (pair[i] >= config->n_electrodes) return false;
        }
        if (pair[0] == pair[1] || pair[2] == pair[3]) return false;
    }
    return config->excitation < EIT_EXCITATIONS && config->rtia < EIT_RTIAS &&
           config->pga < EIT_PGAS && config->frequency_hz > 0.0f && config->rcal_ohm > 0.0f &&
           config->period_us >= shortest_period_us(config);
}
