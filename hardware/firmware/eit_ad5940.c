/* Registers and bits have the names of the AD5940/AD5941 data sheet. The wiring is drive+ = CE0,
 * drive- = AIN1, sense+ = AIN2, sense- = AIN3, and RCAL between RCAL0 and RCAL1. */
#include "eit_ad5940.h"

#define SETADDR 0x20
#define WRITEREG 0x2D
#define READREG 0x6D

enum {
    GP0CON = 0x0000,
    GP0OEN = 0x0004,
    ADIID = 0x0400,
    CHIPID = 0x0404,
    AFECON = 0x2000,
    SWCON = 0x200C,
    HSDACCON = 0x2010,
    WGCON = 0x2014,
    WGFCW = 0x2030,
    WGPHASE = 0x2034,
    WGOFFSET = 0x2038,
    WGAMPLITUDE = 0x203C,
    ADCFILTERCON = 0x2044,
    DFTREAL = 0x2078,
    DFTIMAG = 0x207C,
    ADCMIN = 0x20A8,
    ADCMINSM = 0x20AC,
    ADCMAX = 0x20B0,
    ADCMAXSMEN = 0x20B4,
    DFTCON = 0x20D0,
    HSRTIACON = 0x20F0,
    DE0RESCON = 0x20F8,
    HSTIACON = 0x20FC,
    DSWFULLCON = 0x2150,
    NSWFULLCON = 0x2154,
    PSWFULLCON = 0x2158,
    TSWFULLCON = 0x215C,
    BUFSENCON = 0x2180,
    ADCCON = 0x21A8,
    PMBW = 0x22F0,
    INTCPOL = 0x3000,
    INTCCLR = 0x3004,
    INTCSEL0 = 0x3008,
    INTCSEL1 = 0x300C,
    INTCFLAG1 = 0x3014,
    FIRST_32_BIT = 0x1000,
    LAST_32_BIT = 0x3014,
};

#define ADI 0x4144u
#define CHIP_S1 0x5500u /* frequency word of 26 bits, not 30 */
#define CHIP_S2 0x5501u
#define CHIP_S3 0x5502u

/* AFECON. All that needs time to settle stays on; only converting starts and stops. */
#define ALDOILIMITEN (1u << 19) /* as after reset */
#define POWERED                                                                                  \
    (ALDOILIMITEN | 1u << 20 /* DACREFEN */ | 1u << 14 /* WAVEGENEN */ | 1u << 11 /* TIAEN */ |  \
     1u << 10 /* INAMPEN */ | 1u << 9 /* EXBUFEN */ | 1u << 7 /* ADCEN */ | 1u << 6 /* DACEN */)
#define CONVERTING (POWERED | 1u << 15 /* DFTEN */ | 1u << 8 /* ADCCONVEN */)

/* Interrupt sources, the same in all of INTC. */
#define DFTRDY (1u << 1)
#define ADCMINERR (1u << 4)
#define ADCMAXERR (1u << 5)
#define ALL_ONES 0xFFFFFFFFu /* read from a bus without an answer */

#define T9 (1u << 8) /* to the transimpedance amplifier */

#define MCLK_HZ 16e6f
#define FULL_AMPLITUDE 2047.0f /* WGAMPLITUDE, 11 bits */
#define TIA_LIMIT_A 3e-3f
#define ADC_FULL_SCALE_V 1.835f /* of 32768 codes at a gain of 1 */
#define HEADROOM 0.8f

/* Written after each reset, in this order, for the part to keep to its data sheet. */
static const struct {
    uint16_t address;
    uint32_t value;
} required[] = {
    {0x0908, 0x02C9}, {0x0C08, 0x206C}, {0x21F0, 0x0010},     {0x0410, 0x02C9}, {0x0A28, 0x0009},
    {0x238C, 0x0104}, {0x0A04, 0x4859}, {0x0A04, 0xF27B},     {0x0A00, 0x8009}, {0x22F0, 0x0000},
    {0x2230, 0xDE87A5AF}, {0x2250, 0x103F}, {0x22B0, 0x203C}, {0x2230, 0xDE87A5A0},
};

static bool is_32_bit(uint16_t address) {
    return address >= FIRST_32_BIT && address <= LAST_32_BIT;
}

static void set_address(const eit_hal *hal, uint16_t address) {
    const uint8_t out[3] = {SETADDR, (uint8_t)(address >> 8), (uint8_t)address};
    uint8_t in[3];
    hal->spi_transfer(hal->context, out, in, sizeof out);
}

static void write_register(const eit_hal *hal, uint16_t address, uint32_t value) {
    const size_t width = is_32_bit(address) ? 4 : 2;
    uint8_t out[5] = {WRITEREG}, in[5];
    for (size_t i = 0; i < width; i++) out[width - i] = (uint8_t)(value >> 8 * i);
    set_address(hal, address);
    hal->spi_transfer(hal->context, out, in, 1 + width);
}

static uint32_t read_register(const eit_hal *hal, uint16_t address) {
    const size_t width = is_32_bit(address) ? 4 : 2;
    const uint8_t out[6] = {READREG};
    uint8_t in[6] = {0};
    uint32_t value = 0;
    set_address(hal, address);
    hal->spi_transfer(hal->context, out, in, 2 + width); /* the first byte back is a dummy */
    for (size_t i = 0; i < width; i++) value = value << 8 | in[2 + i];
    return value;
}

static float smaller(float a, float b) { return a < b ? a : b; }

/* Largest amplitude of the transimpedance amplifier's output without clipping [V]. */
static float current_limit_volt(const eit_config *config) {
    return smaller(eit_pga_volt(config), TIA_LIMIT_A * eit_rtia_ohm(config));
}

/* WGAMPLITUDE: full on the sensor; on RCAL no more than the current channel takes, since RCAL is
 * the one impedance known beforehand, and clipping would spoil every later frame. */
static uint32_t amplitude_word(const eit_config *config, eit_target target) {
    if (target == EIT_SENSOR) return (uint32_t)FULL_AMPLITUDE;
    const float current = current_limit_volt(config) / eit_rtia_ohm(config);
    const float volt = HEADROOM * smaller(current * config->rcal_ohm, eit_pga_volt(config));
    return (uint32_t)(FULL_AMPLITUDE * smaller(volt / eit_excitation_volt(config), 1.0f));
}

static uint32_t frequency_word(const eit_config *config, uint32_t chip) {
    const float steps = chip == CHIP_S1 ? 67108864.0f : 1073741824.0f; /* 2^26 or 2^30 */
    return (uint32_t)(config->frequency_hz / MCLK_HZ * steps + 0.5f);
}

static void begin_excitation(const eit_hal *hal, const eit_config *config, uint32_t chip) {
    const bool quarter = config->excitation == EIT_75_MV || config->excitation == EIT_15_MV;
    const bool fifth = config->excitation == EIT_121_MV || config->excitation == EIT_15_MV;
    /* INAMPGNMDE: gain 1/4 for 2; RATE 7; ATTENEN: gain 1/5 for 1. */
    write_register(hal, HSDACCON, (uint32_t)quarter << 12 | 7u << 1 | (uint32_t)fifth);
    write_register(hal, WGFCW, frequency_word(config, chip));
    write_register(hal, WGPHASE, 0);
    write_register(hal, WGOFFSET, 0);
    write_register(hal, WGCON, 1u << 5 | 1u << 4 | 2u << 1); /* calibrated, TYPESEL sinusoid */
}

static void begin_measurement(const eit_hal *hal, const eit_config *config) {
    write_register(hal, HSTIACON, 0); /* VBIASSEL 1.1 V */
    write_register(hal, HSRTIACON, 31u << 5 | config->rtia); /* CTIACON 31 pF, RTIACON */
    write_register(hal, DE0RESCON, 0xFF); /* the amplifier's other input stays open */
    /* ADCCLK 800 kSPS, no mains filter (LPFBYPEN), SINC3OSR 2 */
    write_register(hal, ADCFILTERCON, 1u | 1u << 4 | 2u << 12);
    /* SINC3 output, 2048 points: 204.8 periods of 40 kHz, hence the Hanning window. */
    write_register(hal, DFTCON, 1u << 20 | 9u << 4 | 1u);
    write_register(hal, ADCMINSM, 0);
    write_register(hal, ADCMAXSMEN, 0);
}

bool eit_ad5940_begin(const eit_hal *hal, const eit_config *config) {
    for (size_t i = 0; i < sizeof required / sizeof required[0]; i++) {
        write_register(hal, required[i].address, required[i].value);
    }
    const uint32_t chip = read_register(hal, CHIPID);
    if (read_register(hal, ADIID) != ADI || chip < CHIP_S1 || chip > CHIP_S3) return false;
    write_register(hal, PMBW, 3u << 2); /* SYSBW 250 kHz: less phase at 40 kHz than 50 kHz has */
    write_register(hal, BUFSENCON, 1u << 4 | 1u << 0); /* V1P1HPADCEN, V1P8HPADCEN */
    begin_excitation(hal, config, chip);
    begin_measurement(hal, config);
    write_register(hal, INTCPOL, 0);
    write_register(hal, INTCSEL0, DFTRDY); /* to the pin */
    write_register(hal, INTCSEL1, DFTRDY | ADCMINERR | ADCMAXERR); /* to be read */
    write_register(hal, GP0CON, 0); /* GPIO0 is interrupt 0 */
    write_register(hal, GP0OEN, 1);
    write_register(hal, AFECON, POWERED);
    return true;
}

void eit_ad5940_connect(const eit_hal *hal, const eit_config *config, eit_target target) {
    const bool sensor = target == EIT_SENSOR;
    write_register(hal, WGAMPLITUDE, amplitude_word(config, target));
    write_register(hal, DSWFULLCON, sensor ? 1u << 4 /* D5: CE0 */ : 1u << 0 /* DR0 */);
    write_register(hal, PSWFULLCON, sensor ? 1u << 10 /* P11: CE0 */ : 1u << 0 /* PR0 */);
    write_register(hal, NSWFULLCON, sensor ? 1u << 1 /* N2: AIN1 */ : 1u << 9 /* NR1 */);
    write_register(hal, TSWFULLCON, T9 | (sensor ? 1u << 1 /* T2: AIN1 */ : 1u << 11 /* TR1 */));
    write_register(hal, SWCON, 1u << 16); /* SWSOURCESEL: as in the four above, all at once */
}

void eit_ad5940_select(
    const eit_hal *hal, const eit_config *config, eit_target target, eit_channel channel) {
    uint32_t plus = 0x01, minus = 0x01; /* HSTIA_P, HSTIA_N */
    float limit = current_limit_volt(config);
    if (channel == EIT_VOLTAGE) {
        plus = target == EIT_SENSOR ? 0x06 /* AIN2 */ : 0x24 /* P node */;
        minus = target == EIT_SENSOR ? 0x07 /* AIN3 */ : 0x14 /* N node */;
        limit = eit_pga_volt(config);
    }
    const uint32_t codes = (uint32_t)(limit * eit_pga_gain(config) / ADC_FULL_SCALE_V * 32768.0f);
    write_register(hal, ADCCON, (uint32_t)config->pga << 16 | minus << 8 | plus);
    write_register(hal, ADCMIN, 32768u - codes);
    write_register(hal, ADCMAX, 32768u + codes);
}

void eit_ad5940_convert(const eit_hal *hal) {
    write_register(hal, INTCCLR, DFTRDY | ADCMINERR | ADCMAXERR);
    write_register(hal, AFECON, CONVERTING);
}

static int32_t read_18_bits(const eit_hal *hal, uint16_t address) {
    const int32_t code = (int32_t)(read_register(hal, address) & 0x3FFFF);
    return code < EIT_DFT_CODES ? code : code - 2 * EIT_DFT_CODES;
}

static bool is_saturated(int32_t code) {
    return code >= EIT_DFT_CODES - 1 || code <= -EIT_DFT_CODES + 1;
}

bool eit_ad5940_finish(const eit_hal *hal, eit_channel channel, eit_transform *transform) {
    const uint32_t flags = read_register(hal, INTCFLAG1);
    write_register(hal, AFECON, POWERED);
    if (!(flags & DFTRDY) || flags == ALL_ONES) return false;
    eit_code code = {read_18_bits(hal, DFTREAL), read_18_bits(hal, DFTIMAG)};
    write_register(hal, INTCCLR, DFTRDY);
    transform->clipped =
        (flags & (ADCMINERR | ADCMAXERR)) || is_saturated(code.re) || is_saturated(code.im);
    code.im = -code.im; /* DFTIMAG is the imaginary part of the opposite rotation */
    if (channel == EIT_CURRENT) { /* the amplifier inverts */
        code.re = -code.re;
        code.im = -code.im;
    }
    transform->code = code;
    return true;
}
