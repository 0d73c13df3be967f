#include "clock.h"

#include "stm32f411.h"

#define HSE_TRIES 1000 /* some 60 ms */
#define TICKS_PER_US 96
#define LONGEST_SLEEP_US 100000u

static void wait_1000_cycles(void) {
    for (volatile int i = 0; i < 100; i++) {
    }
}

/* 8 MHz from the ST-LINK, which has a crystal; without it the internal 16 MHz, good to 1 % at room
 * temperature. Either is divided to 2 MHz. */
static uint32_t pll_source(void) {
    RCC->CR |= RCC_CR_HSEBYP;
    RCC->CR |= RCC_CR_HSEON;
    for (int tries = 0; tries < HSE_TRIES; tries++) {
        if (RCC->CR & RCC_CR_HSERDY) return RCC_PLLCFGR_HSE | 4;
        wait_1000_cycles();
    }
    return 8;
}

static void run_at_96_mhz(void) {
    RCC->APB1ENR |= RCC_APB1_PWR;
    (void)RCC->APB1ENR; /* a peripheral may be used two cycles after its clock is on */
    PWR->CR |= PWR_CR_VOS_1; /* for more than 84 MHz; only while the PLL is off */
    RCC->PLLCFGR = 4u << 24 | 0u << 16 /* divide by 2 */ | 96u << 6 | pll_source();
    RCC->CR |= RCC_CR_PLLON;
    while (!(RCC->CR & RCC_CR_PLLRDY)) {
    }
    FLASH->ACR = FLASH_ACR_PREFETCH_AND_CACHES | 3; /* wait states for 90 to 100 MHz */
    RCC->CFGR = RCC_CFGR_PPRE1_2 | RCC_CFGR_SW_PLL;
    while ((RCC->CFGR & RCC_CFGR_SWS) != RCC_CFGR_SWS_PLL) {
    }
}

/* The timers of APB1 run at twice its clock. */
static void begin_timers(void) {
    RCC->APB1ENR |= RCC_APB1_TIM2 | RCC_APB1_TIM5;
    (void)RCC->APB1ENR;
    TIM2->PSC = TICKS_PER_US - 1;
    TIM2->ARR = 0xFFFFFFFF;
    TIM2->EGR = TIM_EGR_UG;
    TIM2->CR1 = TIM_CR1_CEN;
    TIM5->PSC = TICKS_PER_US - 1;
    TIM5->CR1 = TIM_CR1_URS | TIM_CR1_OPM;
    TIM5->DIER = TIM_DIER_UIE;
    enable_interrupt(TIM5_IRQ);
}

void clock_begin(void) {
    run_at_96_mhz();
    begin_timers();
}

uint64_t clock_us(void *context) {
    static uint32_t last, wraps;
    (void)context;
    const uint32_t now = TIM2->CNT;
    if (now < last) wraps++;
    last = now;
    return (uint64_t)wraps << 32 | now;
}

void clock_sleep(uint64_t until_us) {
    const uint64_t now = clock_us(0);
    if (now >= until_us) return;
    const uint64_t left = until_us - now;
    TIM5->ARR = left < LONGEST_SLEEP_US ? (uint32_t)left : LONGEST_SLEEP_US;
    TIM5->EGR = TIM_EGR_UG; /* from 0, to the new end */
    TIM5->CR1 = TIM_CR1_URS | TIM_CR1_OPM | TIM_CR1_CEN;
    wait_for_interrupt();
    TIM5->CR1 = TIM_CR1_URS | TIM_CR1_OPM;
}

void tim5_interrupt(void) {
    TIM5->SR = 0;
    (void)TIM5->SR; /* has arrived before the interrupt ends, or it would come twice */
}
