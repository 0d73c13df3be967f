#include "front_end.h"

#include "stm32f411.h"

#define SPI1_FUNCTION 5
#define USART2_FUNCTION 7
#define LINES 4 /* of one multiplexer: A0 to A3 */

typedef enum { INPUT, OUTPUT, ALTERNATE } pin_mode;

typedef struct {
    gpio_registers *port;
    uint8_t number;
} pin;

/* As on a shield in the Arduino connectors: D13, D12, D11, D10, A3, D2. */
static const pin sck = {GPIOA, 5}, miso = {GPIOA, 6}, mosi = {GPIOA, 7};
static const pin chip_select = {GPIOB, 6}, reset_low = {GPIOB, 0}, interrupt_low = {GPIOA, 10};
static const pin transmit = {GPIOA, 2}, receive = {GPIOA, 3};

/* On the outer connectors alone, which a shield leaves free. */
static const pin mux_lines[][LINES] = {
    [EIT_DRIVE_PLUS] = {{GPIOC, 2}, {GPIOC, 3}, {GPIOC, 4}, {GPIOC, 5}},
    [EIT_DRIVE_MINUS] = {{GPIOC, 8}, {GPIOC, 9}, {GPIOC, 10}, {GPIOC, 11}},
    [EIT_SENSE_PLUS] = {{GPIOB, 12}, {GPIOB, 13}, {GPIOB, 14}, {GPIOB, 15}},
    [EIT_SENSE_MINUS] = {{GPIOA, 11}, {GPIOA, 12}, {GPIOB, 1}, {GPIOB, 2}},
};

static void set(pin p, bool high) { p.port->BSRR = BIT(high ? p.number : p.number + 16); }

static void set_field(reg *word, int field, int width, uint32_t value) {
    const uint32_t mask = BIT(width) - 1;
    *word = (*word & ~(mask << field * width)) | value << field * width;
}

static void use(pin p, pin_mode mode) { set_field(&p.port->MODER, p.number, 2, mode); }

static void use_function(pin p, uint32_t function) {
    set_field(&p.port->AFR[p.number / 8], p.number % 8, 4, function);
    set_field(&p.port->OSPEEDR, p.number, 2, 2); /* fast */
    use(p, ALTERNATE);
}

static void pull_up(pin p) { set_field(&p.port->PUPDR, p.number, 2, 1); }

static void begin_pins(void) {
    RCC->AHB1ENR |= RCC_AHB1_GPIO;
    (void)RCC->AHB1ENR; /* a peripheral may be used two cycles after its clock is on */
    set(chip_select, true);
    use(chip_select, OUTPUT);
    set(reset_low, true);
    use(reset_low, OUTPUT);
    pull_up(interrupt_low);
    pull_up(miso); /* a part that is not there reads as ones */
    for (int mux = EIT_DRIVE_PLUS; mux <= EIT_SENSE_MINUS; mux++) {
        for (int line = 0; line < LINES; line++) use(mux_lines[mux][line], OUTPUT);
    }
    use_function(sck, SPI1_FUNCTION);
    use_function(miso, SPI1_FUNCTION);
    use_function(mosi, SPI1_FUNCTION);
    use_function(transmit, USART2_FUNCTION);
    use_function(receive, USART2_FUNCTION);
}

/* Master in mode 0, 8 bits, most significant first, 96 MHz / 8 = 12 MHz. */
static void begin_spi(void) {
    RCC->APB2ENR |= RCC_APB2_SPI1;
    (void)RCC->APB2ENR;
    SPI1->CR1 = SPI_CR1_MSTR | SPI_CR1_SSM | SPI_CR1_SSI | SPI_CR1_BR_8 | SPI_CR1_SPE;
}

/* A falling edge ends the sleep; what it says is read from the pin. */
static void begin_interrupt(void) {
    RCC->APB2ENR |= RCC_APB2_SYSCFG;
    (void)RCC->APB2ENR;
    /* The line of this number is that of port A. */
    set_field(&SYSCFG->EXTICR[interrupt_low.number / 4], interrupt_low.number % 4, 4, 0);
    EXTI->FTSR |= BIT(interrupt_low.number);
    EXTI->IMR |= BIT(interrupt_low.number);
    enable_interrupt(EXTI15_10_IRQ);
}

void front_end_begin(void) {
    begin_pins();
    begin_spi();
    begin_interrupt();
}

void front_end_transfer(void *context, const uint8_t *out, uint8_t *in, size_t n) {
    (void)context;
    set(chip_select, false);
    for (size_t i = 0; i < n; i++) {
        while (!(SPI1->SR & SPI_SR_TXE)) {
        }
        SPI1->DR = out[i];
        while (!(SPI1->SR & SPI_SR_RXNE)) {
        }
        in[i] = (uint8_t)SPI1->DR;
    }
    while (SPI1->SR & SPI_SR_BSY) {
    }
    set(chip_select, true);
}

void front_end_reset(void *context, bool held) {
    (void)context;
    set(reset_low, !held);
}

bool front_end_interrupt(void *context) {
    (void)context;
    return !(interrupt_low.port->IDR & BIT(interrupt_low.number));
}

/* One line after the other: for less than a microsecond other electrodes are connected, long before
 * anything is measured. */
void front_end_select(void *context, eit_mux mux, uint8_t electrode) {
    (void)context;
    for (int line = 0; line < LINES; line++) set(mux_lines[mux][line], electrode >> line & 1);
}

void exti15_10_interrupt(void) {
    EXTI->PR = BIT(interrupt_low.number);
    (void)EXTI->PR; /* has arrived before the interrupt ends, or it would come twice */
}
