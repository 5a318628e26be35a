// Copyright 2026 psd_deflection maintainers
// SPDX-License-Identifier: Apache-2.0
/* A PSD device: samples six channels at 1 kHz from a timer's interrupt and sends the frames of docs/protocol.md.
 *
 * Data flow. The timer's interrupt takes a sample, numbers and stamps it by the clock, and puts it into a ring. The
 * main loop makes frames of them and hands those to the UART's ring, which the transmit interrupt empties. The receive
 * interrupt collects bytes up to a zero; the main loop reads them as a frame. Each ring has one writer and one reader and
 * indices that only the one or the other writes, so no lock is needed; indices run freely and wrap at 2^32, which is why
 * the sizes are powers of two.
 *
 * When the ring of samples is full (the UART does not get rid of them), the sample is dropped, counted, and the next one
 * that fits carries flag bit 1. Nothing is allocated while it runs.
 */
#include "board.h"
#include "converter.h"
#include "frames.h"

#ifndef DEVICE_SERIAL
#define DEVICE_SERIAL "PSD-0001" /* better: the microcontroller's own unique number */
#endif

enum { SAMPLES = 64, REQUEST_BYTES = 64, REQUESTS = 4 };

struct sample {
    uint64_t t_us;
    uint32_t seq;
    uint8_t flags;
    int16_t counts[CHANNELS];
};

static struct sample samples[SAMPLES];
static volatile uint32_t samples_in, samples_out;

/* Written by the timer's interrupt alone. The time takes more than one word: see now_us(). */
static volatile uint64_t ticks;
static volatile uint32_t last_ticks;
static volatile uint32_t taken, overruns;
static volatile bool streaming = true;

struct request {
    uint8_t bytes[REQUEST_BYTES];
    size_t size;
    uint64_t t_us;
};

static struct request requests[REQUESTS];
static volatile uint32_t requests_in, requests_out;

static uint8_t frame[MAX_FRAME];

static uint64_t now_us(void)
{
    const uint32_t state = interrupts_off();
    const uint64_t now = ticks + (uint32_t)(board_ticks() - last_ticks);
    interrupts_restore(state);
    return now / TICKS_PER_US;
}

void on_sample_timer(void)
{
    static bool dropped;
    int16_t counts[CHANNELS];
    const uint32_t now = board_ticks();

    ticks = ticks + (uint32_t)(now - last_ticks);
    last_ticks = now;
    /* The clock gives the sample's number, not the count of interrupts: otherwise an interrupt that is more than a
     * period late, or missing, would be an unreported loss. */
    const uint64_t t_us = ticks / TICKS_PER_US;
    const uint32_t number = (uint32_t)(ticks / TICKS_PER_PERIOD) - 1u;
    const int32_t missed = (int32_t)(number - taken);
    if (missed < 0)
        return; /* made good already by the interrupt before */
    converter_sample(number, counts);
    taken = number + 1u;
    if (!streaming)
        return;
    if (missed > 0) {
        overruns = overruns + (uint32_t)missed;
        dropped = true;
    }
    if (samples_in - samples_out == SAMPLES) {
        overruns = overruns + 1u;
        dropped = true;
        return;
    }
    struct sample *s = &samples[samples_in % SAMPLES];
    s->t_us = t_us;
    s->seq = number;
    s->flags = dropped ? FLAG_DROPPED : 0;
    dropped = false;
    for (unsigned i = 0; i < CHANNELS; i++) {
        s->counts[i] = counts[i];
        if (counts[i] == INT16_MAX || counts[i] == INT16_MIN)
            s->flags |= FLAG_OVER_RANGE;
    }
    samples_in = samples_in + 1u;
}

void on_received(uint8_t byte)
{
    /* Host frames have at most 15 bytes; a longer one is invalid and is skipped up to its zero. */
    static bool too_long;
    static size_t size;
    struct request *r = &requests[requests_in % REQUESTS];

    if (byte != 0) {
        if (size < REQUEST_BYTES && !too_long)
            r->bytes[size++] = byte;
        else
            too_long = true;
        return;
    }
    if (!too_long && size > 0 && requests_in - requests_out < REQUESTS - 1u) {
        r->size = size;
        /* The time of a PING is that of its last byte, not that of when the main loop came to it. */
        r->t_us = now_us();
        requests_in = requests_in + 1u;
    }
    size = 0;
    too_long = false;
}

static void send(uint8_t type, const uint8_t *body, size_t size)
{
    uart_send(frame, frame_encode(type, body, size, frame));
}

static void send_hello(void)
{
    static const char about[] = "{\"serial\":\"" DEVICE_SERIAL "\",\"firmware\":\"psd_deflection example 1, %\","
                                "\"sample_rate_hz\":1000,\"channels\":[\"x1\",\"y1\",\"sum1\",\"x2\",\"y2\",\"sum2\"],"
                                "\"volts_per_count\":0.00030517578125}";
    _Static_assert(sizeof about < MAX_BODY - 32, "HELLO has to fit one frame");
    static uint8_t body[MAX_BODY];
    size_t size = 0;

    body[size++] = PROTOCOL_VERSION;
    for (const char *c = about; *c != '\0'; c++) {
        if (*c != '%') {
            body[size++] = (uint8_t)*c;
            continue;
        }
        for (const char *n = converter_name; *n != '\0' && size < MAX_BODY - 1u; n++)
            body[size++] = (uint8_t)*n;
    }
    send(TYPE_HELLO, body, size);
}

static void send_status(void)
{
    uint8_t body[STATUS_BODY];
    put_u32(body, overruns);
    put_u16(body + 4, 32767); /* no thermometer */
    send(TYPE_STATUS, body, sizeof body);
}

static void send_sample(const struct sample *s)
{
    uint8_t body[SAMPLE_BODY];
    body[0] = s->flags;
    put_u32(body + 1, s->seq);
    put_u64(body + 5, s->t_us);
    for (unsigned i = 0; i < CHANNELS; i++)
        put_u16(body + 13 + 2 * i, (uint16_t)s->counts[i]);
    send(TYPE_SAMPLE, body, sizeof body);
}

static void obey(struct request *r)
{
    if (!frame_decode(r->bytes, &r->size))
        return;
    const size_t body = r->size - 1;
    switch (r->bytes[0]) {
    case TYPE_HELLO_REQUEST:
        if (body == 0)
            send_hello();
        break;
    case TYPE_PING:
        if (body == 8) {
            uint8_t answer[PONG_BODY];
            for (unsigned i = 0; i < 8; i++)
                answer[i] = r->bytes[1 + i];
            put_u64(answer + 8, r->t_us);
            send(TYPE_PONG, answer, sizeof answer);
        }
        break;
    case TYPE_START:
        if (body == 0)
            streaming = true;
        break;
    case TYPE_STOP:
        if (body == 0)
            streaming = false;
        break;
    default:
        break;
    }
}

int main(void)
{
    uint32_t hello_at = 0;

    converter_start();
    board_start();
    for (;;) {
        /* Each kind waits for room for the longest frame, so that no frame is ever cut. */
        while (requests_out != requests_in && uart_room() >= MAX_FRAME) {
            obey(&requests[requests_out % REQUESTS]);
            requests_out = requests_out + 1u;
        }
        if ((int32_t)(taken - hello_at) >= 0 && uart_room() >= 2 * MAX_FRAME) {
            hello_at += SAMPLE_RATE_HZ;
            send_hello();
            send_status();
        }
        while (samples_out != samples_in && uart_room() >= MAX_FRAME) {
            send_sample(&samples[samples_out % SAMPLES]);
            samples_out = samples_out + 1u;
        }
        board_wait();
    }
}
