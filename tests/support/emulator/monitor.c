/* The parts of an STM32F411 that QEMU's STM32F405 lacks, played by a program on the host.
 *
 * The firmware runs as it is flashed. The memory protection unit forbids it the registers of the
 * missing parts; each access faults, is read from the instruction, told to the host through a pipe
 * (by semihosting, which stops the machine meanwhile), and done. Timer 2 stands still meanwhile, so
 * that the firmware's time is that of its own instructions and of what the host adds. */
#include <stdbool.h>
#include <stdint.h>

#define REG(address) (*(volatile uint32_t *)(address))

#define EXTICR3 REG(0x40013810)
#define EXTI_IMR REG(0x40013C00)
#define EXTI_FTSR REG(0x40013C0C)
#define EXTI_SWIER REG(0x40013C10)
#define SYST_CSR REG(0xE000E010)
#define SYST_RVR REG(0xE000E014)
#define SYST_CVR REG(0xE000E018)
#define NVIC_ISPR ((volatile uint32_t *)0xE000E200)
#define VTOR REG(0xE000ED08)
#define AIRCR REG(0xE000ED0C)
#define CFSR REG(0xE000ED28)
#define HFSR REG(0xE000ED2C)
#define MMFAR REG(0xE000ED34)
#define MPU_CTRL REG(0xE000ED94)
#define MPU_RBAR REG(0xE000ED9C)
#define MPU_RASR REG(0xE000EDA0)

#define FIRMWARE ((const uint32_t *)0x08000000)
#define RAM ((uint32_t *)0x20000000)
#define RAM_WORDS (128u * 1024 / 4)
#define UNTOUCHED 0xA5A5A5A5u
#define VECTORS 102
#define DATA_ACCESS (1u << 7 | 1u << 1) /* MMARVALID, DACCVIOL */
#define LONGEST_US 1000000u
#define SHORTEST_US 2u /* in which the firmware gets on, too */
#define NEVER 0xFFFFFFFFu
#define SPI1_SR 0x40013008u
#define SPI1_DR 0x4001300Cu
#define SENT_AND_RECEIVED 3u

enum { READ, WRITE, TICK, BOOT, FAULT }; /* what the host is told */
enum { RAISE_EXTI_10 = 1, RAISE_TIM5 = 2, RAISE_USART2 = 4, FORBID_USART2 = 8, RESET = 16, SPI_HANGS = 32 };

#define AHEAD 8 /* bytes of SPI that are exchanged without a question */

enum { OPEN_FILE = 1, WRITE_FILE = 5, READ_FILE = 6, EXIT = 0x18 }; /* of semihosting */
#define EXIT_REASON ((const void *)0x20026)

typedef struct {
    uint32_t kind, address, size, value, now_us, pc;
    uint32_t sent; /* bytes by SPI since the question before */
    uint8_t bytes[AHEAD];
} question;

typedef struct {
    uint32_t value, actions, next_us, took_us;
    uint8_t bytes[AHEAD]; /* by SPI, in exchange for those that follow */
} answer;

static uint32_t vectors[128] __attribute__((aligned(512)));
static int to_host, from_host;
static uint32_t now; /* timer 2 as the interruption began, moved on by what the host adds */
static bool spi_hangs;
static uint32_t received; /* by SPI1, with the byte sent before */
static uint32_t sent, known; /* bytes sent and not yet told, and how many may be */
static uint8_t bytes_sent[AHEAD], bytes_known[AHEAD];

static int semihosting(int operation, const void *parameters) {
    register int r0 __asm__("r0") = operation;
    register const void *r1 __asm__("r1") = parameters;
    __asm__ volatile("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
    return r0;
}

static int open_pipe(const char *name, int mode) {
    const uint32_t parameters[] = {(uint32_t)name, (uint32_t)mode, 4};
    return semihosting(OPEN_FILE, parameters);
}

static void raise(int interrupt) { NVIC_ISPR[interrupt / 32] = 1u << interrupt % 32; }

/* As the pin would: if line 10 is port A's, its falling edge counts and is not masked. */
static void fall_at_exti_10(void) {
    const uint32_t line = 1u << 10;
    if ((EXTICR3 >> 8 & 15) == 0 && EXTI_FTSR & line && EXTI_IMR & line) EXTI_SWIER = line;
}

static void wake_in(uint32_t us) {
    SYST_CSR = 0;
    if (us == NEVER) return;
    if (us > LONGEST_US) us = LONGEST_US;
    if (us < SHORTEST_US) us = SHORTEST_US;
    SYST_RVR = us * 8 + us / 16 + 1; /* as it runs beside timer 2; the host waits on where it is early */
    SYST_CVR = 0;
    SYST_CSR = 7;
}

static answer ask(uint32_t kind, uint32_t address, uint32_t size, uint32_t value, uint32_t pc) {
    question asked = {kind, address, size, value, now, pc, sent, {0}};
    answer given;
    const uint32_t out[] = {(uint32_t)to_host, (uint32_t)&asked, sizeof asked};
    const uint32_t in[] = {(uint32_t)from_host, (uint32_t)&given, sizeof given};
    for (uint32_t i = 0; i < sent; i++) asked.bytes[i] = bytes_sent[i];
    semihosting(WRITE_FILE, out);
    if (semihosting(READ_FILE, in) != 0) semihosting(EXIT, EXIT_REASON); /* the host is gone */
    sent = known = 0;
    if (given.actions & RESET) {
        AIRCR = 0x05FA0004;
        for (;;) {
        }
    }
    spi_hangs = given.actions & SPI_HANGS;
    if (given.actions & RAISE_EXTI_10) fall_at_exti_10();
    if (given.actions & RAISE_TIM5) raise(50);
    if (given.actions & RAISE_USART2) raise(38);
    wake_in(given.next_us);
    now += given.took_us;
    return given;
}

typedef struct {
    int size; /* bytes, 0 for an instruction that is not known */
    int width; /* of the instruction */
    int reg;
    bool load, is_signed;
} access;

/* Loads and stores of the ARMv7-M manual, as compilers write them for registers. */
static access decode(const uint16_t *pc) {
    const uint16_t a = pc[0], b = pc[1];
    access found = {0, 2, a & 7, (a & 0x0800) != 0, false};
    switch (a >> 12) {
    case 5: { /* register offset */
        static const int sizes[8] = {4, 2, 1, 1, 4, 2, 1, 2};
        const int operation = a >> 9 & 7;
        found.size = sizes[operation];
        found.load = operation >= 3;
        found.is_signed = operation == 3 || operation == 7;
        return found;
    }
    case 6:
        found.size = 4;
        return found;
    case 7:
        found.size = 1;
        return found;
    case 8:
        found.size = 2;
        return found;
    }
    if ((a & 0xFE00) == 0xF800) { /* 32 bits, without a change of the base */
        const bool long_offset = a & 0x80, plain = (b & 0x0F00) == 0x0C00 || (b & 0x0FC0) == 0;
        found.width = 4;
        found.reg = b >> 12;
        found.load = a & 0x10;
        found.is_signed = a & 0x100;
        if (long_offset || plain) found.size = 1 << (a >> 5 & 3);
    }
    return found;
}

static uint32_t *register_of(int number, uint32_t *frame, uint32_t *saved) {
    if (number < 4) return frame + number;
    if (number < 12) return saved + number - 4;
    return number == 12 ? frame + 4 : frame + 5;
}

static uint32_t extended(uint32_t value, access done) {
    const int unused = 32 - 8 * done.size;
    if (done.is_signed) return (uint32_t)((int32_t)(value << unused) >> unused);
    return value << unused >> unused;
}

/* A fault of the firmware's own, or an instruction that is not known: wait for the watchdog. */
static void die(uint32_t pc) {
    for (;;) {
        ask(FAULT, MMFAR, CFSR, HFSR, pc);
    }
}

static uint32_t load(uint32_t address, int size, uint32_t pc) {
    if (address == SPI1_SR && !spi_hangs) return SENT_AND_RECEIVED;
    if (address == SPI1_DR) return received;
    return ask(READ, address, (uint32_t)size, 0, pc).value;
}

/* A byte is exchanged when it is written. What the first byte of a transfer is answered by, the host
 * says together with all that follows. */
static void store(uint32_t address, int size, uint32_t value, uint32_t pc) {
    if (address != SPI1_DR) {
        ask(WRITE, address, (uint32_t)size, value, pc);
    } else if (sent < known) {
        received = bytes_known[sent];
        bytes_sent[sent++] = (uint8_t)value;
    } else {
        const answer given = ask(WRITE, address, (uint32_t)size, value, pc);
        received = given.value;
        for (known = 0; known < AHEAD; known++) bytes_known[known] = given.bytes[known];
    }
}

__attribute__((used)) uint32_t handle_fault(uint32_t *frame, uint32_t *saved, uint32_t count) {
    now = count;
    const uint32_t pc = frame[6];
    if ((CFSR & DATA_ACCESS) != DATA_ACCESS) die(pc);
    const access done = decode((const uint16_t *)pc);
    if (done.size == 0) die(pc);
    const uint32_t address = MMFAR;
    CFSR = CFSR;
    HFSR = HFSR;
    uint32_t *value = register_of(done.reg, frame, saved);
    if (done.load) *value = extended(load(address, done.size, pc), done);
    else store(address, done.size, extended(*value, done), pc);
    frame[6] = pc + (uint32_t)done.width;
    return now;
}

/* On a stack of the monitor's own. Timer 2 is read first and put back last. */
#define INTERRUPTION(handler)                                                                    \
    __asm__ volatile("mov r2, #0x40000000\n"                                                    \
                     "ldr r2, [r2, #0x24]\n"                                                    \
                     "mov r0, sp\n"                                                             \
                     "ldr r1, =monitor_stack\n"                                                 \
                     "mov sp, r1\n"                                                             \
                     "push {r0, lr}\n"                                                          \
                     "push {r4-r11}\n"                                                          \
                     "mov r1, sp\n"                                                             \
                     "bl " handler "\n"                                                         \
                     "pop {r4-r11}\n"                                                           \
                     "pop {r2, lr}\n"                                                           \
                     "mov sp, r2\n"                                                             \
                     "mov r2, #0x40000000\n"                                                    \
                     "str r0, [r2, #0x24]\n"                                                    \
                     "bx lr\n")

__attribute__((naked)) static void fault(void) { INTERRUPTION("handle_fault"); }

__attribute__((used)) uint32_t handle_tick(uint32_t *frame, uint32_t *saved, uint32_t count) {
    (void)frame, (void)saved;
    now = count;
    ask(TICK, 0, 0, 0, 0);
    return now;
}

__attribute__((naked)) static void tick(void) { INTERRUPTION("handle_tick"); }

static void forbid(int region, uint32_t address, int size_log2) {
    MPU_RBAR = address | 1u << 4 | (uint32_t)region;
    MPU_RASR = 1u << 28 | (uint32_t)(size_log2 - 1) << 1 | 1;
}

static void forbid_registers(bool usart2) {
    forbid(0, 0x40020000, 14); /* GPIO, RCC, FLASH */
    forbid(1, 0x40013000, 10); /* SPI1 */
    forbid(2, 0x40007000, 10); /* PWR */
    forbid(3, 0x40000C00, 10); /* TIM5 */
    forbid(4, 0x40003000, 10); /* IWDG */
    forbid(5, 0x1FFF7800, 10); /* unique identifier */
    forbid(6, 0x08008000, 15); /* sectors 2 and 3 of flash */
    if (usart2) forbid(7, 0x40004400, 10);
    MPU_CTRL = 1u << 2 | 1; /* all else as without it, and nothing in faults */
}

__attribute__((used)) void begin(void) {
    to_host = open_pipe("asks", 4);
    from_host = open_pipe("told", 0);
    for (uint32_t i = 0; i < RAM_WORDS; i++) RAM[i] = UNTOUCHED;
    for (int i = 0; i < VECTORS; i++) vectors[i] = FIRMWARE[i];
    vectors[3] = (uint32_t)fault;
    vectors[15] = (uint32_t)tick;
    VTOR = (uint32_t)vectors;
    forbid_registers(ask(BOOT, 0, 0, 0, 0).actions & FORBID_USART2);
    __asm__ volatile("msr msp, %0\n bx %1" : : "r"(FIRMWARE[0]), "r"(FIRMWARE[1]));
}

__attribute__((naked)) void start(void) {
    __asm__ volatile("ldr r0, =monitor_stack\n mov sp, r0\n b begin\n");
}
