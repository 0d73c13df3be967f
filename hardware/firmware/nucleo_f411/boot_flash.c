#include "boot_flash.h"

#include "stm32f411.h"

#define FIRST_SECTOR 2 /* of 16 KB, as the first four are */
#define SECTOR_BYTES 0x4000u
#define FIRST_ADDRESS 0x08008000u

static reg *word_at(int page, uint32_t word) {
    return (reg *)(FIRST_ADDRESS + SECTOR_BYTES * (uint32_t)page) + word;
}

static void unlock(void) {
    FLASH->KEYR = FLASH_KEY_1;
    FLASH->KEYR = FLASH_KEY_2;
    FLASH->SR = FLASH_SR_ERRORS;
}

/* The bus waits by itself, too, as the program is read from the same flash. */
static void wait_and_lock(void) {
    while (FLASH->SR & FLASH_SR_BSY) {
    }
    FLASH->CR = FLASH_CR_LOCK;
}

static uint32_t read_word(void *context, int page, uint32_t word) {
    (void)context;
    return *word_at(page, word);
}

/* 32 bits at once take 2.7 V or more, which the board has. */
static void write_word(void *context, int page, uint32_t word, uint32_t value) {
    (void)context;
    unlock();
    FLASH->CR = FLASH_CR_PSIZE_32 | FLASH_CR_PG;
    *word_at(page, word) = value;
    wait_and_lock();
}

/* Half a second at most, once in 2048 boots. */
static void erase_page(void *context, int page) {
    (void)context;
    unlock();
    FLASH->CR = FLASH_CR_PSIZE_32 | FLASH_CR_SER | FLASH_CR_SNB(FIRST_SECTOR + page);
    FLASH->CR |= FLASH_CR_STRT;
    wait_and_lock();
}

const eit_store boot_flash = {
    .words = SECTOR_BYTES / 4,
    .read = read_word,
    .write = write_word,
    .erase = erase_page,
};
