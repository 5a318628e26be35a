// Copyright 2026 psd_deflection maintainers
// SPDX-License-Identifier: Apache-2.0
/* AD7606 (Analog Devices): eight simultaneous inputs, 16 bits, +-10 V, on an SPI bus. Page and figure numbers are of
 * data sheet AD7606/AD7606-6/AD7606-4 Rev. F.
 *
 * Strapping: PAR/SER/BYTE SEL high (serial), RANGE high (+-10 V), OS2..OS0 low (no oversampling), STBY high, REF SELECT
 * high (internal 2.5 V), CONVST A and B tied together (all inputs at one instant). V1..V6 are x1 y1 sum1 x2 y2 sum2.
 * One count is 20 V / 65536 = 305 uV; the code is two's complement ("Transfer function", ADC transfer characteristics).
 *
 * One sample: CONVST rises (that is the sampling instant), BUSY goes high, and low again after t_CONV, at most 4.15 us
 * without oversampling (Timing Specifications). Then CS falls and DOUTA gives V1..V8, most significant bit first
 * (Figure "Serial Read"); six words are read, the rest is left there. SCLK may run at 17 MHz at 3.3 V; it runs at 12.5.
 *
 * The registers here are those of the MPS2 board's PL022 SPI (ARM DDI 0194) and CMSDK GPIO (ARM DDI 0479). This file is
 * compiled and linked by `make demo NAME=firmware`, but has no converter to talk to there: it was not tried on hardware.
 */
#include "converter.h"

const char converter_name[] = "AD7606";

#define REGISTER(address) (*(volatile uint32_t *)(address))

#define SPI_BASE 0x40026000u /* shield 0 */
#define SPI_CR0 REGISTER(SPI_BASE + 0x00u)
#define SPI_CR1 REGISTER(SPI_BASE + 0x04u)
#define SPI_DATA REGISTER(SPI_BASE + 0x08u)
#define SPI_STATUS REGISTER(SPI_BASE + 0x0Cu)
#define SPI_PRESCALE REGISTER(SPI_BASE + 0x10u)
#define SPI_RECEIVED 4u

#define GPIO_BASE 0x40010000u
#define GPIO_DATA REGISTER(GPIO_BASE + 0x00u)
#define GPIO_OUT REGISTER(GPIO_BASE + 0x04u)
#define GPIO_OUT_ENABLE REGISTER(GPIO_BASE + 0x10u)

#define PIN_CONVST (1u << 0)
#define PIN_RESET (1u << 1)
#define PIN_CS (1u << 2)
#define PIN_BUSY (1u << 3)

enum { BUSY_TRIES = 1000 };

static void wait_some(void)
{
    /* RESET has to be high for 50 ns at least; CONVST low for 25 ns. */
    for (volatile unsigned i = 0; i < 4; i++) {
    }
}

void converter_start(void)
{
    GPIO_OUT = PIN_CS | PIN_CONVST;
    GPIO_OUT_ENABLE = PIN_CONVST | PIN_RESET | PIN_CS;
    /* Motorola frame, 16 bits, SPO = 1, SPH = 0: the AD7606 shifts on the rising edge, so the falling one reads. */
    SPI_PRESCALE = 2;
    SPI_CR0 = 15u | (1u << 6);
    SPI_CR1 = 2u;
    /* A reset is required after power-up ("RESET" in the pin function descriptions). */
    GPIO_OUT |= PIN_RESET;
    wait_some();
    GPIO_OUT &= ~PIN_RESET;
}

void converter_sample(uint32_t number, int16_t counts[CHANNELS])
{
    (void)number;
    GPIO_OUT &= ~PIN_CONVST;
    wait_some();
    GPIO_OUT |= PIN_CONVST;
    wait_some();
    for (unsigned tries = 0; (GPIO_DATA & PIN_BUSY) && tries < BUSY_TRIES; tries++) {
        /* A converter that stays busy must not block the device: then its old values are read. */
    }
    GPIO_OUT &= ~PIN_CS;
    for (unsigned channel = 0; channel < CHANNELS; channel++) {
        SPI_DATA = 0;
        while (!(SPI_STATUS & SPI_RECEIVED)) {
        }
        counts[channel] = (int16_t)(uint16_t)SPI_DATA;
    }
    GPIO_OUT |= PIN_CS;
}
