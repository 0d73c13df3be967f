/* Registers of the STM32F411 that this port uses, by the names of its reference manual (RM0383),
 * which also has the addresses, the bits and the numbers of the interrupts. */
#ifndef STM32F411_H
#define STM32F411_H

#include <stdint.h>

#define BIT(n) (1u << (n))

typedef volatile uint32_t reg;

typedef struct {
    reg CR, PLLCFGR, CFGR, CIR, AHB1RSTR, AHB2RSTR, reserved_18[2], APB1RSTR, APB2RSTR;
    reg reserved_28[2], AHB1ENR, AHB2ENR, reserved_38[2], APB1ENR, APB2ENR;
} rcc_registers;

typedef struct {
    reg ACR, KEYR, OPTKEYR, SR, CR, OPTCR;
} flash_registers;

typedef struct {
    reg CR, CSR;
} pwr_registers;

typedef struct {
    reg MODER, OTYPER, OSPEEDR, PUPDR, IDR, ODR, BSRR, LCKR, AFR[2];
} gpio_registers;

typedef struct {
    reg CR1, CR2, SR, DR;
} spi_registers;

typedef struct {
    reg SR, DR, BRR, CR1, CR2, CR3;
} usart_registers;

typedef struct {
    reg CR1, CR2, SMCR, DIER, SR, EGR, CCMR1, CCMR2, CCER, CNT, PSC, ARR;
} tim_registers;

typedef struct {
    reg MEMRMP, PMC, EXTICR[4];
} syscfg_registers;

typedef struct {
    reg IMR, EMR, RTSR, FTSR, SWIER, PR;
} exti_registers;

typedef struct {
    reg KR, PR, RLR, SR;
} iwdg_registers;

#define TIM2 ((tim_registers *)0x40000000)
#define TIM5 ((tim_registers *)0x40000C00)
#define IWDG ((iwdg_registers *)0x40003000)
#define USART2 ((usart_registers *)0x40004400)
#define PWR ((pwr_registers *)0x40007000)
#define SPI1 ((spi_registers *)0x40013000)
#define SYSCFG ((syscfg_registers *)0x40013800)
#define EXTI ((exti_registers *)0x40013C00)
#define GPIOA ((gpio_registers *)0x40020000)
#define GPIOB ((gpio_registers *)0x40020400)
#define GPIOC ((gpio_registers *)0x40020800)
#define RCC ((rcc_registers *)0x40023800)
#define FLASH ((flash_registers *)0x40023C00)
#define UNIQUE_ID ((const reg *)0x1FFF7A10) /* 96 bits */
#define NVIC_ISER ((reg *)0xE000E100)
#define CPACR (*(reg *)0xE000ED88) /* coprocessors, of which two are the floating-point unit */

enum { USART2_IRQ = 38, EXTI15_10_IRQ = 40, TIM5_IRQ = 50 };

#define RCC_CR_HSEON BIT(16)
#define RCC_CR_HSERDY BIT(17)
#define RCC_CR_HSEBYP BIT(18)
#define RCC_CR_PLLON BIT(24)
#define RCC_CR_PLLRDY BIT(25)
#define RCC_PLLCFGR_HSE BIT(22)
#define RCC_CFGR_SW_PLL 2u
#define RCC_CFGR_SWS (3u << 2)
#define RCC_CFGR_SWS_PLL (2u << 2)
#define RCC_CFGR_PPRE1_2 (4u << 10)
#define RCC_AHB1_GPIO (BIT(0) | BIT(1) | BIT(2)) /* A, B, C */
#define RCC_APB1_TIM2 BIT(0)
#define RCC_APB1_TIM5 BIT(3)
#define RCC_APB1_USART2 BIT(17)
#define RCC_APB1_PWR BIT(28)
#define RCC_APB2_SPI1 BIT(12)
#define RCC_APB2_SYSCFG BIT(14)

#define PWR_CR_VOS_1 (3u << 14)
#define FLASH_ACR_PREFETCH_AND_CACHES (BIT(8) | BIT(9) | BIT(10))
#define FLASH_SR_ERRORS 0xF2u /* cleared by writing ones */
#define FLASH_SR_BSY BIT(16)
#define FLASH_CR_PG BIT(0)
#define FLASH_CR_SER BIT(1)
#define FLASH_CR_SNB(sector) ((uint32_t)(sector) << 3)
#define FLASH_CR_PSIZE_32 (2u << 8)
#define FLASH_CR_STRT BIT(16)
#define FLASH_CR_LOCK BIT(31)
#define FLASH_KEY_1 0x45670123u
#define FLASH_KEY_2 0xCDEF89ABu

#define SPI_CR1_MSTR BIT(2)
#define SPI_CR1_BR_8 (2u << 3)
#define SPI_CR1_SPE BIT(6)
#define SPI_CR1_SSI BIT(8)
#define SPI_CR1_SSM BIT(9)
#define SPI_SR_RXNE BIT(0)
#define SPI_SR_TXE BIT(1)
#define SPI_SR_BSY BIT(7)

#define USART_SR_ORE BIT(3)
#define USART_SR_RXNE BIT(5)
#define USART_SR_TXE BIT(7)
#define USART_CR1_RE BIT(2)
#define USART_CR1_TE BIT(3)
#define USART_CR1_RXNEIE BIT(5)
#define USART_CR1_TXEIE BIT(7)
#define USART_CR1_UE BIT(13)

#define TIM_CR1_CEN BIT(0)
#define TIM_CR1_URS BIT(2) /* UG makes no interrupt */
#define TIM_CR1_OPM BIT(3)
#define TIM_DIER_UIE BIT(0)
#define TIM_EGR_UG BIT(0)

#define IWDG_RELOAD 0xAAAAu
#define IWDG_UNLOCK 0x5555u
#define IWDG_START 0xCCCCu
#define IWDG_PR_64 4u

static inline void enable_interrupt(int number) { NVIC_ISER[number / 32] = BIT(number % 32); }

static inline void disable_interrupts(void) { __asm__ volatile("cpsid i" ::: "memory"); }

static inline void enable_interrupts(void) { __asm__ volatile("cpsie i" ::: "memory"); }

/* Sleep until an interrupt is pending, masked or not. */
static inline void wait_for_interrupt(void) { __asm__ volatile("dsb\n wfi" ::: "memory"); }

#endif
