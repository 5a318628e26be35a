// Copyright 2026 psd_deflection maintainers
// SPDX-License-Identifier: Apache-2.0
/* What main.c needs of a board. board_mps2.c is one; for another microcontroller only that file (and the linker
 * script) is written anew. */
#ifndef BOARD_H
#define BOARD_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum { SAMPLE_RATE_HZ = 1000, CHANNELS = 6 };

/* The board's free-running counter, and the sample period in it. */
enum { TICKS_PER_US = 25, TICKS_PER_PERIOD = 1000000 / SAMPLE_RATE_HZ * TICKS_PER_US };

/* Clocks, timer at SAMPLE_RATE_HZ, UART at 921600 baud with interrupts. Sampling begins: the n-th period (from 1) ends
 * when board_ticks() passes n * TICKS_PER_PERIOD. */
void board_start(void);

/* Called by the board from the timer's interrupt, once a sample period. Defined in main.c. */
void on_sample_timer(void);

/* Called by the board from the UART's receive interrupt. Defined in main.c. */
void on_received(uint8_t byte);

/* Counts up from 0 at board_start(), wraps at 2^32 (172 s). */
uint32_t board_ticks(void);

/* Bytes that uart_send can take now. */
size_t uart_room(void);

/* Queues bytes for the transmit interrupt; the caller asked uart_room() before. Main loop only. */
void uart_send(const uint8_t *bytes, size_t size);

/* Until the next interrupt. */
void board_wait(void);

/* Interrupts off and on again, for the few lines that share more than one word with an interrupt. */
uint32_t interrupts_off(void);
void interrupts_restore(uint32_t state);

#endif
