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
    counts[2] = 16384;
    counts[3] = (int16_t)(number % 256u); /* often zero bytes: COBS has something to do */
    counts[4] = 0;
    counts[5] = 16384;
}
