/* Plain loops; the compiler calls the first three by itself, too. */
#include <stdint.h>
#include <string.h>

void *memcpy(void *to, const void *from, size_t n) {
    uint8_t *out = to;
    for (const uint8_t *in = from; n--;) *out++ = *in++;
    return to;
}

void *memmove(void *to, const void *from, size_t n) {
    uint8_t *out = to;
    const uint8_t *in = from;
    if (out <= in) return memcpy(to, from, n);
    while (n--) out[n] = in[n];
    return to;
}

void *memset(void *to, int value, size_t n) {
    for (uint8_t *out = to; n--;) *out++ = (uint8_t)value;
    return to;
}

size_t strlen(const char *text) {
    size_t n = 0;
    while (text[n]) n++;
    return n;
}
