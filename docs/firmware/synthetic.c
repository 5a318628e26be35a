// Copyright 2026 psd_deflection maintainers
// SPDX-License-Identifier: Apache-2.0
/* Numbers in place of a converter, to run in qemu: every count is a function of the sample's number, so the host can
 * check each one (check.py knows the same function). */
#include "converter.h"

const char converter_name[] = "synthetic";

void converter_start(void)
{
}

void converter_sample(uint32_t number, int16_t counts[CHANNELS])
{
    const int32_t ramp = (int32_t)(number % 2000u) - 1000;
    counts[0] = (int16_t)ramp;
    counts[1] = (int16_t)-ramp;
    counts[2] = (int16_t)(16384u + number % 7u); /* a converter is never still, and the daemon would say so */
    counts[3] = (int16_t)(number % 256u);        /* often zero bytes: COBS has something to do */
    counts[4] = (int16_t)(number % 5u);
    counts[5] = (int16_t)(16384u - number % 11u);
}
