/* Two sectors of flash behind the firmware, for the count of boots. */
#ifndef BOOT_FLASH_H
#define BOOT_FLASH_H

#include "eit_boot_count.h"

extern const eit_store boot_flash;

#endif
