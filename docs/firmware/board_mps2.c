// Copyright 2026 psd_deflection maintainers
// SPDX-License-Identifier: Apache-2.0
/* ARM MPS2 board with the AN385 image (Cortex-M3, 25 MHz), which qemu-system-arm has as `mps2-an385`.
 * Sources: ARM DAI 0385 (memory map, interrupts), ARM DDI 0479 (CMSDK timer and UART), ARMv7-M Architecture Reference
 * Manual (vector table, NVIC). */
#include "board.h"

#define REGISTER(address) (*(volatile uint32_t *)(address))

enum { CLOCK_HZ = TICKS_PER_US * 1000000, BAUD = 921600 };

#define CLOCK_BASE 0x40001000u /* the second timer, free running */
#define CLOCK_CTRL REGISTER(CLOCK_BASE + 0x0u)
#define CLOCK_VALUE REGISTER(CLOCK_BASE + 0x4u)
#define CLOCK_RELOAD REGISTER(CLOCK_BASE + 0x8u)

#define TIMER_BASE 0x40000000u
#define TIMER_CTRL REGISTER(TIMER_BASE + 0x0u)
#define TIMER_VALUE REGISTER(TIMER_BASE + 0x4u)
#define TIMER_RELOAD REGISTER(TIMER_BASE + 0x8u)
#define TIMER_INT REGISTER(TIMER_BASE + 0xCu)

#define UART_BASE 0x40004000u
#define UART_DATA REGISTER(UART_BASE + 0x00u)
#define UART_STATE REGISTER(UART_BASE + 0x04u)
#define UART_CTRL REGISTER(UART_BASE + 0x08u)
#define UART_INT REGISTER(UART_BASE + 0x0Cu)
#define UART_DIVIDER REGISTER(UART_BASE + 0x10u)
#define UART_TX_FULL 1u
#define UART_RX_FULL 2u
#define UART_INT_TX 1u
#define UART_INT_RX 2u

#define NVIC_ENABLE REGISTER(0xE000E100u)
#define NVIC_PRIORITY ((volatile uint8_t *)0xE000E400u)

enum { IRQ_UART_RX = 0, IRQ_UART_TX = 1, IRQ_TIMER = 8 };

/* A second of HELLO and STATUS and 30 ms of samples. */
enum { TX_SIZE = 2048 };

static uint8_t tx[TX_SIZE];
static volatile uint32_t tx_in, tx_out;

static void transmit(void)
{
    while (tx_out != tx_in && !(UART_STATE & UART_TX_FULL)) {
        UART_DATA = tx[tx_out % TX_SIZE];
        tx_out = tx_out + 1u;
    }
}

size_t uart_room(void)
{
    return TX_SIZE - (tx_in - tx_out);
}

void uart_send(const uint8_t *bytes, size_t size)
{
    for (size_t i = 0; i < size; i++)
        tx[(tx_in + i) % TX_SIZE] = bytes[i];
    const uint32_t state = interrupts_off();
    tx_in = tx_in + size;
    /* A line at rest raises no interrupt: the first byte has to be put on it. */
    transmit();
    interrupts_restore(state);
}

uint32_t board_ticks(void)
{
    return 0xFFFFFFFFu - CLOCK_VALUE;
}

uint32_t interrupts_off(void)
{
    uint32_t state;
    __asm volatile("mrs %0, primask\n\tcpsid i" : "=r"(state)::"memory");
    return state;
}

void interrupts_restore(uint32_t state)
{
    __asm volatile("msr primask, %0" ::"r"(state) : "memory");
}

void board_wait(void)
{
    __asm volatile("wfi" ::: "memory");
}

void board_start(void)
{
    UART_DIVIDER = (CLOCK_HZ + BAUD / 2) / BAUD;
    UART_CTRL = 1u | 2u | 4u | 8u; /* transmit and receive, with their interrupts */
    /* The clock first: a period is then never found to end before its time. */
    CLOCK_RELOAD = 0xFFFFFFFFu;
    CLOCK_VALUE = 0xFFFFFFFFu;
    CLOCK_CTRL = 1u;
    TIMER_RELOAD = TICKS_PER_PERIOD - 1u;
    TIMER_VALUE = TICKS_PER_PERIOD - 1u;
    TIMER_CTRL = 1u | 8u; /* run, with its interrupt */
    /* Sampling comes first: its instant must not wait for a byte. */
    NVIC_PRIORITY[IRQ_TIMER] = 0x00;
    NVIC_PRIORITY[IRQ_UART_RX] = 0x40;
    NVIC_PRIORITY[IRQ_UART_TX] = 0x80;
    NVIC_ENABLE = (1u << IRQ_TIMER) | (1u << IRQ_UART_RX) | (1u << IRQ_UART_TX);
}

static void timer_handler(void)
{
    TIMER_INT = 1u;
    on_sample_timer();
}

static void uart_rx_handler(void)
{
    UART_INT = UART_INT_RX;
    while (UART_STATE & UART_RX_FULL)
        on_received((uint8_t)UART_DATA);
}

static void uart_tx_handler(void)
{
    UART_INT = UART_INT_TX;
    transmit();
}

static void stuck(void)
{
    for (;;) {
    }
}

extern uint32_t stack_top, data_load, data_start, data_end, bss_start, bss_end;
int main(void);

void reset_handler(void);

void reset_handler(void)
{
    const uint32_t *from = &data_load;
    for (uint32_t *to = &data_start; to < &data_end;)
        *to++ = *from++;
    for (uint32_t *to = &bss_start; to < &bss_end;)
        *to++ = 0;
    main();
    stuck();
}

typedef void (*handler)(void);

__attribute__((section(".vectors"), used)) static const struct {
    uint32_t *stack;
    handler system[15];
    handler irq[32];
} vectors = {
    .stack = &stack_top,
    .system = {reset_handler, stuck, stuck, stuck, stuck, stuck, stuck, stuck, stuck, stuck, stuck, stuck, stuck, stuck,
               stuck},
    .irq = {[IRQ_UART_RX] = uart_rx_handler, [IRQ_UART_TX] = uart_tx_handler, [IRQ_TIMER] = timer_handler},
};
