// Copyright 2026 psd_deflection maintainers
// SPDX-License-Identifier: Apache-2.0
/* Where samples come from: ad7606.c (the real converter) or synthetic.c (numbers, for qemu), chosen when linking. */
#ifndef CONVERTER_H
#define CONVERTER_H

#include <stdint.h>

#include "board.h"

extern const char converter_name[];

void converter_start(void);

/* x1 y1 sum1 x2 y2 sum2, 16 bits over +-10 V. Called from the timer's interrupt, once a sample period, and always at
 * the same place in it, so that the sampling instant does not wander. number: samples taken before. */
void converter_sample(uint32_t number, int16_t counts[CHANNELS]);

#endif
