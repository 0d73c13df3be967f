/* Count of boots in two pages of flash, which survives a power cut at any moment. */
#ifndef EIT_BOOT_COUNT_H
#define EIT_BOOT_COUNT_H

#include <stdint.h>

/* Two pages of flash: erased words have all bits set, and a write only clears bits. */
typedef struct {
    void *context;
    uint32_t words; /* of one page, an even number */
    uint32_t (*read)(void *context, int page, uint32_t word);
    void (*write)(void *context, int page, uint32_t word, uint32_t value);
    void (*erase)(void *context, int page);
} eit_store;

/* Count one boot more, and give the new count. A page is erased only while the other one holds the
 * newest count. */
uint32_t eit_count_boot(const eit_store *store);

#endif
