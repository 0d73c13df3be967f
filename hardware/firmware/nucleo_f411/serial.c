#include "serial.h"

#include "stm32f411.h"

#define BAUD_DIVIDER 52 /* 48 MHz / 52 = 923,077 baud, 0.16 % more than 921,600 */
#define RING 256 /* a power of two; a longer one would hold old frames back on a slow line */

/* Filled at `end` and emptied at `start`, each moved by one side alone: the main loop or the
 * interrupt. */
typedef struct {
    volatile uint32_t start, end;
    volatile uint8_t bytes[RING];
} ring;

static ring incoming, outgoing;

static bool put(ring *r, uint8_t byte) {
    const uint32_t end = r->end;
    if (end - r->start == RING) return false;
    r->bytes[end % RING] = byte;
    r->end = end + 1;
    return true;
}

static bool take(ring *r, uint8_t *byte) {
    const uint32_t start = r->start;
    if (r->end == start) return false;
    *byte = r->bytes[start % RING];
    r->start = start + 1;
    return true;
}

/* Interrupts must be masked, or this be one. */
static void send_waiting(void) {
    uint8_t byte;
    while (USART2->SR & USART_SR_TXE) {
        if (!take(&outgoing, &byte)) {
            USART2->CR1 &= ~USART_CR1_TXEIE;
            return;
        }
        USART2->DR = byte;
    }
    USART2->CR1 |= USART_CR1_TXEIE;
}

void serial_begin(void) {
    RCC->APB1ENR |= RCC_APB1_USART2;
    (void)RCC->APB1ENR;
    USART2->BRR = BAUD_DIVIDER;
    USART2->CR1 = USART_CR1_UE | USART_CR1_TE | USART_CR1_RE | USART_CR1_RXNEIE;
    enable_interrupt(USART2_IRQ);
}

size_t serial_read(void *context, uint8_t *data, size_t n) {
    size_t taken = 0;
    (void)context;
    while (taken < n && take(&incoming, data + taken)) taken++;
    return taken;
}

size_t serial_write(void *context, const uint8_t *data, size_t n) {
    size_t given = 0;
    (void)context;
    while (given < n && put(&outgoing, data[given])) given++;
    disable_interrupts();
    send_waiting();
    enable_interrupts();
    return given;
}

bool serial_has_received(void) { return incoming.end != incoming.start; }

/* A byte that finds no room is lost, and its packet with it; the host asks again. */
void usart2_interrupt(void) {
    const uint32_t status = USART2->SR;
    if (status & (USART_SR_RXNE | USART_SR_ORE)) { /* an overrun ends by reading the byte, too */
        const uint8_t byte = (uint8_t)USART2->DR;
        if (status & USART_SR_RXNE) put(&incoming, byte);
    }
    if (USART2->CR1 & USART_CR1_TXEIE) send_waiting();
}
