#include "eit_boot_count.h"

#include <stdbool.h>

#define ERASED 0xFFFFFFFFu

/* A record is a count and its complement: one that a power cut broke off does not fit together. */
#define RECORD 2u

typedef struct {
    uint32_t newest; /* largest count, 0 without any */
    uint32_t free; /* first word of the first erased record, or the size of the page */
} page_state;

static bool is_erased(uint32_t count, uint32_t complement) {
    return count == ERASED && complement == ERASED;
}

static page_state look_at(const eit_store *store, int page) {
    page_state state = {0, 0};
    for (; state.free < store->words; state.free += RECORD) {
        const uint32_t count = store->read(store->context, page, state.free);
        const uint32_t complement = store->read(store->context, page, state.free + 1);
        if (is_erased(count, complement)) break;
        if (count == ~complement && count > state.newest) state.newest = count;
    }
    return state;
}

uint32_t eit_count_boot(const eit_store *store) {
    const page_state pages[2] = {look_at(store, 0), look_at(store, 1)};
    int page = pages[1].newest > pages[0].newest;
    const uint32_t count = pages[page].newest + 1;
    uint32_t word = pages[page].free;
    if (word >= store->words) {
        page = 1 - page;
        word = 0;
        store->erase(store->context, page);
    }
    store->write(store->context, page, word, count);
    store->write(store->context, page, word + 1, ~count);
    return count;
}
